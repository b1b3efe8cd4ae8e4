"""What several test files share: scenes, finished runs, an independent reader of COLMAP files."""

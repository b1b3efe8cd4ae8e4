"""Real tracks, triangulation and bundle adjustment of a stitched model."""

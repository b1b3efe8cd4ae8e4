"""One file per format that a scene is written to."""

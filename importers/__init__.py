"""One file per kind of source that images come from."""

"""Features, image pairs and matches of the whole run."""

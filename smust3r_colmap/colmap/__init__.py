"""Everything that touches COLMAP's files and objects: databases, model files, reconstructions."""

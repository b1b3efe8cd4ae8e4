"""Offline structure from motion for COLMAP workflows, segment by segment (the method of S-MUSt3R)."""

__version__ = "0.1.0"

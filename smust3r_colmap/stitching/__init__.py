"""Submodels placed in one frame: loops verified, pose graph optimised, cameras fused (paper section III-F)."""

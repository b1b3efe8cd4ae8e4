"""Depth after the cameras are final: consistent depth maps and the fused cloud."""

"""Robust fits that know nothing of segments: similarity, affine and projective transforms, weights, scales."""

"""Transforms between segments that share images. ``irls`` has the solver, ``seen_points`` chooses the group,
the others find correspondences."""

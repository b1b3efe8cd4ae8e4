"""Sim(3) between segments that share images. ``irls`` has the estimator, the others find correspondences."""

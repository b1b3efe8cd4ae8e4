"""Transforms between submodels that share images: ``pairwise`` has the edges, ``seen_points`` the choice of group,
the others the correspondences and the covariance. The solvers are in ``estimators``."""

"""The groups of transforms by the name of the setting, and how one lies inside another.

SE(3) in Sim(3) in Affine(3) in SL(4): ``from_matrix`` takes an element to a larger group, ``embed``
its tangent vectors. The next module to read is ``camera``.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.se3 import SE3
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform

TransformGroup = Literal["sim3", "se3", "affine3", "sl4"]

GROUPS: dict[str, type[Transform]] = {"sim3": Sim3, "se3": SE3, "affine3": Affine3, "sl4": SL4}
"""Every value of the setting ``transform_group``."""


def embed(larger: type[Transform], smaller: type[Transform]) -> FloatArray:
    """(larger DOF, smaller DOF) matrix E that takes tangent vectors of a group to one that contains it.

    ``larger.exp(E @ x)`` is the same map as ``smaller.exp(x)``. An information matrix comes down by
    ``E.T @ information @ E``, and goes up by ``P.T @ information @ P`` with ``P = pinv(E)``, which
    has no information in the directions that the smaller group lacks.

    Raises:
        ValueError: the second group is not inside the first.
    """
    basis = smaller.hat(np.eye(smaller.DOF))
    embedded = larger.vee(basis)
    lost = basis - larger.hat(embedded)
    factors = lost[:, 3, 3]  # matrices that differ by a multiple of the identity move points alike
    if np.abs(lost - factors[:, None, None] * np.eye(4)).max() > 1e-12:
        raise ValueError(f"{smaller.__name__} is not a subgroup of {larger.__name__}")
    return np.asarray(embedded.T)

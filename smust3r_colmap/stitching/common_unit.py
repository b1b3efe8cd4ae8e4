"""The unit of a metric scene is that of all its submodels, not of the first one.

A network's submodels are each in metres, with an error of their own, and the frame of a part is that of its first
submodel. The median of the scales of all of them has less error than any one. The next module to read is
``loop_verification``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from smust3r_colmap.estimators.robust import mad_sigma
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.stitching.spanning_tree import ChainedPart


def in_common_unit(part: ChainedPart) -> tuple[ChainedPart, float]:
    """The part scaled so that the median scale of its submodels is one, and the robust spread of the scales.

    Args:
        part: transforms in a group with one scale; parts in other groups are returned as they are.

    Returns:
        The part, whose first transform is then a scale, and 1.4826 times the median deviation of the log-scales, NaN
        of a single submodel or another group.
    """
    found = [one for one in part.world_from_seg if isinstance(one, Sim3)]
    if len(found) < 2 or len(found) < len(part.world_from_seg):
        return part, math.nan
    logs = np.log([float(one.scale) for one in found])
    unit = Sim3(scale=np.asarray(np.exp(-np.median(logs))), rotation=np.eye(3), translation=np.zeros(3))
    return replace(part, world_from_seg=tuple(unit @ one for one in found)), mad_sigma(logs)

"""The unit of a metric part is the median of its submodels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.stitching.common_unit import in_common_unit
from smust3r_colmap.stitching.spanning_tree import ChainedPart


def part(*scales: float) -> ChainedPart:
    return ChainedPart(
        submodels=tuple(range(len(scales))),
        world_from_seg=tuple(
            Sim3(scale=np.asarray(scale), rotation=np.eye(3), translation=np.array([float(k), 0, 0]))
            for k, scale in enumerate(scales)
        ),
        edges=(),
    )


def test_one_wrong_submodel_does_not_set_the_unit_even_if_it_is_the_first() -> None:
    # the first is too small by half, so that all others seem twice as large
    found, spread = in_common_unit(part(1.0, 2.0, 2.02, 1.98, 2.0))
    scales = [float(one.scale) for one in found.world_from_seg if isinstance(one, Sim3)]
    np.testing.assert_allclose(scales, [0.5, 1.0, 1.01, 0.99, 1.0])
    assert spread == pytest.approx(1.4826 * math.log(1.01), rel=0.02)


def test_positions_are_scaled_along() -> None:
    found, _ = in_common_unit(part(1.0, 2.0, 2.0))
    last = found.world_from_seg[2]
    np.testing.assert_allclose(last.apply(np.zeros((1, 3))), [[1.0, 0, 0]])


def test_a_single_submodel_has_no_spread() -> None:
    single = part(1.0)
    found, spread = in_common_unit(single)
    assert found is single
    assert math.isnan(spread)

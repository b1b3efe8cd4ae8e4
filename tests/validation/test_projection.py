"""Points projected into the images of a described model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.described_models import misplaced_observations

from smust3r_colmap.validation.description import Subject
from smust3r_colmap.validation.projection import index_of


def test_projection_errors_are_those_of_pycolmap(good: Subject, scene: Path) -> None:
    reference = pycolmap.Reconstruction(scene / "sparse" / "0")
    reference.update_point_3d_errors()
    assert good.model.points is not None
    noisy = misplaced_observations(good)

    assert np.abs(good.projection.error_px).max() < 1e-6
    np.testing.assert_allclose(noisy.projection.error_px, np.hypot(2, 2), atol=1e-6)
    assert reference.compute_mean_reprojection_error() == pytest.approx(0, abs=1e-6)
    assert (good.projection.depth > 0).all()


def test_ids_are_found_in_a_table_or_by_searching() -> None:
    for ids in (np.array([7, 3, 9]), np.array([7, 3, 10**15])):
        np.testing.assert_array_equal(index_of(ids, np.array([3, 7, 8, -1, ids[2], 10**16])), [1, 0, -1, -1, 2, -1])
    np.testing.assert_array_equal(index_of(np.empty(0, np.int64), np.array([1])), [-1])

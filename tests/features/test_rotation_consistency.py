"""Two walls that look alike: pairs between them are told by rotations, and true pairs are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.features.rotation_consistency import MAX_ROTATION_ERROR_DEG, rotation_errors_deg
from smust3r_colmap.features.view_graph_calibration import VerifiedPairs
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection, SourceImage

CAMERA = Intrinsics(model="SIMPLE_PINHOLE", width=640, height=480, params=(500.0, 320.0, 240.0), has_prior_focal=True)
NUM_IMAGES, REACH = 24, 3
NUM_POINTS = 60
FALSE = ((0, 12), (1, 13), (5, 17), (6, 18))


def looking_out(k: int) -> np.ndarray:
    """(3, 4) camera k of a ring, looking away from its centre."""
    angle = 2 * np.pi * k / NUM_IMAGES
    forward = np.array([np.sin(angle), 0, np.cos(angle)])
    rotation = np.stack([np.cross([0, 1.0, 0], forward), [0, 1.0, 0], forward])
    return np.column_stack([rotation, -rotation @ (1.5 * forward)])


def in_front(cam_from_world: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(NUM_POINTS, 3) of the world, before a camera."""
    points_cam = rng.uniform((-1, -1, 5), (1, 1, 9), size=(NUM_POINTS, 3))
    points_world: np.ndarray = (points_cam - cam_from_world[:, 3]) @ cam_from_world[:, :3]
    return points_world


def seen(cam_from_world: np.ndarray, points_world: np.ndarray) -> np.ndarray:
    return CAMERA.xy_img(points_world @ cam_from_world[:, :3].T + cam_from_world[:, 3])


@pytest.fixture
def task(tmp_path: Path) -> VerifiedPairs:
    rng = np.random.default_rng(0)
    keypoints: list[list[np.ndarray]] = [[] for _ in range(NUM_IMAGES)]
    matches: dict[Pair, np.ndarray] = {}

    def add(pair: Pair, xy: tuple[np.ndarray, np.ndarray]) -> None:
        rows = []
        for image, own in zip(pair, xy, strict=True):
            first = sum(len(one) for one in keypoints[image])
            keypoints[image].append(own + rng.normal(scale=0.3, size=own.shape))
            rows.append(np.arange(first, first + NUM_POINTS))
        matches[pair] = np.column_stack(rows).astype(np.uint32)

    for a in range(NUM_IMAGES):
        for step in range(1, REACH + 1):
            b = (a + step) % NUM_IMAGES
            middle = looking_out(a)
            points = in_front(middle, rng)
            add((min(a, b), max(a, b)), (seen(looking_out(min(a, b)), points), seen(looking_out(max(a, b)), points)))
    for a, b in FALSE:  # the far wall shows what the camera two steps on would see of the near one
        points = in_front(looking_out(a), rng)
        add((a, b), (seen(looking_out(a), points), seen(looking_out(a + 1), points)))
    collection = ImageCollection(
        images=tuple(
            SourceImage(name=f"{k}.png", path=tmp_path / f"{k}.png", width=640, height=480, camera=0, digest=str(k))
            for k in range(NUM_IMAGES)
        ),
        cameras=(CAMERA,),
    )
    write_colmap_database(
        tmp_path / "features.db",
        collection,
        (CAMERA,),
        keypoints={k: np.concatenate(own).astype(np.float32) for k, own in enumerate(keypoints)},
        matches=matches,
        j_from_i={},
        priors=(),
    )
    return VerifiedPairs(
        database=tmp_path / "features.db",
        pairs=tuple(sorted(matches)),
        cameras=(CAMERA,),
        camera_of=dict.fromkeys(range(NUM_IMAGES), 0),
        seed=0,
    )


def test_pairs_between_look_alike_walls_are_far_from_all_others(task: VerifiedPairs) -> None:
    errors = dict(zip(task.pairs, rotation_errors_deg(task).tolist(), strict=True))
    assert {pair for pair, error in errors.items() if error > MAX_ROTATION_ERROR_DEG} == set(FALSE)
    for pair in FALSE:
        assert errors[pair] == pytest.approx(180 - 15, abs=5)


def test_every_connected_component_is_averaged_by_itself(task: VerifiedPairs) -> None:
    left, right = set(range(1, 10)), set(range(13, 22))
    inside = tuple(pair for pair in task.pairs if set(pair) <= left or set(pair) <= right)
    errors = rotation_errors_deg(replace(task, pairs=inside))
    assert np.isfinite(errors).all()
    assert errors.max() < 5


def test_no_pairs(task: VerifiedPairs) -> None:
    assert rotation_errors_deg(replace(task, pairs=())).shape == (0,)

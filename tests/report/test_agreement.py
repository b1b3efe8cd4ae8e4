"""The fraction of matches that agree, pair by pair, and the groups that show a fold."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    World,
    arc,
    ball,
    make_collection,
    make_world,
    model_with_true_tracks,
    pairs_within,
    true_matches,
    write_features,
    wrong_matches,
)

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement.misregistration import EpipolarSupport
from smust3r_colmap.report.agreement import MAX_CELLS, Agreement, agreement_of, coloured, read_verified

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

GOOD = EpipolarSupport(num_matches=100, inlier_fraction=0.95)
BAD = EpipolarSupport(num_matches=100, inlier_fraction=0.1)


def line(num_images: int) -> FloatArray:
    """(N, 3) centres on a straight path."""
    return np.outer(np.arange(num_images), [1.0, 0, 0]).astype(np.float64)


def example(num_images: int = 6) -> tuple[World, pycolmap.Reconstruction]:
    rng = np.random.default_rng(7)
    world = make_world(arc(num_images), ball(200, rng), rng, noise_px=0.2)
    return world, model_with_true_tracks(world, world.cam_from_world, rng, noise=0)


def write_database(folder: Path, world: World, *, wrong_in: tuple[int, int] | None = None) -> Path:
    """With 60 true matches of every pair; of one pair, 20 true and 40 that are wrong."""
    verified = {pair: true_matches(world, pair)[:60] for pair in pairs_within(range(len(world)), len(world))}
    if wrong_in is not None:
        wrong = wrong_matches(world, wrong_in, 40, np.random.default_rng(8))
        verified[wrong_in] = np.concatenate([verified[wrong_in][:20], wrong])
    path = folder / "database.db"
    write_features(path, make_collection(folder, len(world)), world, verified=verified)
    return path


def test_the_fraction_of_a_hand_made_pair_is_that_of_its_true_matches(tmp_path: Path) -> None:
    world, model = example()
    database = write_database(tmp_path, world, wrong_in=(1, 4))
    found = agreement_of(model, read_verified(database, model))
    assert len(found.support) == 15
    assert found.support[1, 4].num_matches == 60
    # of 40 wrong matches a few lie on their epipolar lines by chance
    assert 20 / 60 <= found.support[1, 4].inlier_fraction < 26 / 60
    assert min(one.inlier_fraction for pair, one in found.support.items() if pair != (1, 4)) > 0.97
    matrix = found.matrix()
    assert matrix[1, 4] == matrix[4, 1] == found.support[1, 4].inlier_fraction
    assert np.isnan(np.diag(matrix)).all()
    assert found.worst_pairs()[0][0] == (1, 4)
    assert found.counts(near=True) == (1, 15)


def test_reading_leaves_the_database_as_it_is(tmp_path: Path) -> None:
    world, model = example()
    database = write_database(tmp_path, world)
    before, listing = database.read_bytes(), sorted(tmp_path.iterdir())
    read_verified(database, model)
    assert database.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == listing


def test_images_of_a_foreign_database_go_by_name(tmp_path: Path) -> None:
    """Its ids are those of the model backwards."""
    world, model = example()
    backwards = World(
        cam_from_world=world.cam_from_world[::-1],
        points=world.points,
        keypoints=world.keypoints[::-1],
        point_of=world.point_of[::-1],
    )
    path = write_database(tmp_path, backwards)
    with pycolmap.Database.open(path) as database:
        for image in database.read_all_images():
            image.name = f"{len(world) - image.image_id:04d}.png"
            database.update_image(image)
    found = agreement_of(model, read_verified(path, model))
    assert len(found.support) == 15
    assert min(one.inlier_fraction for one in found.support.values()) > 0.97


def test_what_is_no_database_is_refused(tmp_path: Path) -> None:
    _, model = example(3)
    path = tmp_path / "database.db"
    path.write_text("this is no database at all, but a text that goes on for a while" * 20)
    with pytest.raises(InputError, match=r"database.db: is no COLMAP database"):
        read_verified(path, model)
    shutil.copyfile(tmp_path / "database.db", tmp_path / "empty.db")
    (tmp_path / "empty.db").write_bytes(b"")
    with pytest.raises(InputError, match="no such table"):
        read_verified(tmp_path / "empty.db", model)


def test_groups_that_contradict_each_other_are_a_fold() -> None:
    within = {pair: GOOD for part in (range(6), range(6, 10)) for pair in pairs_within(part, 3)}
    across = {(0, 7): BAD, (1, 8): BAD, (5, 6): BAD}
    found = Agreement.of(within | across, line(10))
    assert [group.rows for group in found.groups] == [tuple(range(6)), tuple(range(6, 10))]
    assert (found.groups[1].num_supporting, found.groups[1].num_contradicting) == (0, 3)
    assert found.is_split
    assert found.counts(near=True) == (1, 1 + 12 + 6)
    assert found.counts(near=False) == (2, 2)
    assert not Agreement.of(within | {(5, 6): GOOD}, line(10)).is_split


def test_images_without_an_order_are_shown_group_by_group() -> None:
    odd, even = range(1, 10, 2), range(0, 12, 2)
    support = {(i, j): GOOD for part in (odd, even) for i in part for j in part if i < j} | {(0, 1): BAD}
    found = Agreement.of(support, line(12))
    assert not found.is_sequence
    order = found.display_order().tolist()
    assert (sorted(order[:6]), sorted(order[6:11]), order[11]) == ([*even], [*odd], 11)
    assert found.counts(near=True) == (0, 0)


def test_images_that_match_are_near_each_other_in_the_matrix() -> None:
    """A path whose names were shuffled; the matrix has it in order again, from either end."""
    shuffled = np.random.default_rng(2).permutation(40)
    place = {int(image): k for k, image in enumerate(shuffled)}
    support = {(min(place[a], place[b]), max(place[a], place[b])): GOOD for a, b in pairs_within(range(40), 2)}
    found = Agreement.of(support, line(40)[shuffled])
    assert not found.is_sequence
    steps = np.abs(np.diff(shuffled[found.display_order()]))
    assert steps.max() <= 3


def test_where_all_pairs_match_the_steps_tell_whether_there_is_an_order() -> None:
    support = dict.fromkeys(pairs_within(range(20), 20), GOOD)
    assert Agreement.of(support, line(20)).is_sequence
    assert not Agreement.of(support, line(20)[np.random.default_rng(1).permutation(20)]).is_sequence
    assert Agreement.of({(0, 1): GOOD, (1, 2): GOOD}, line(3)).is_sequence


def test_frames_between_keyframes_are_a_sequence_though_they_match_keyframes_only() -> None:
    support = {(k - k % 10, k): GOOD for k in range(200) if k % 10}
    assert Agreement.of(support, line(200)).is_sequence
    assert not Agreement.of(support, line(200)[np.random.default_rng(1).permutation(200)]).is_sequence


def test_of_many_images_a_cell_has_the_fraction_of_all_its_matches() -> None:
    support = {(i, i + 1): GOOD for i in range(2 * MAX_CELLS - 1)}
    support[0, 2] = EpipolarSupport(num_matches=300, inlier_fraction=0.0)
    matrix = Agreement.of(support, line(2 * MAX_CELLS)).matrix()
    assert matrix.shape == (MAX_CELLS, MAX_CELLS)
    # (1, 2) with 95 of 100, and (0, 2) with none of 300
    assert matrix[0, 1] == pytest.approx(95 / 400)
    assert matrix[5, 6] == pytest.approx(0.95)
    assert np.isnan(matrix[0, 5])


def test_colours_tell_all_from_nothing_and_from_unknown() -> None:
    rgba = coloured(np.array([0.0, 1.0, np.nan]))
    assert rgba.tolist()[:2] == [[190, 30, 45, 255], [20, 90, 170, 255]]
    assert rgba[2, 3] == 0

"""Triangulation and bundle adjustment: disturbed cameras come back, and the frame of the world stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from helpers.tracked_scenes import (
    CAMERA,
    World,
    angle_deg,
    arc,
    ball,
    centres_of,
    disturbed,
    disturbed_around_the_truth,
    fitted,
    make_collection,
    make_world,
    pairs_within,
    poses_of,
    rms,
    straight,
    true_matches,
)
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.refinement import bundle_adjustment as adjustment
from smust3r_colmap.refinement.bundle_adjustment import (
    MIN_PRIORS,
    PRIOR_SIGMA_FRACTION,
    Tolerance,
    adjust,
    adjust_images,
    extent_of,
    mean_covisible,
    pose_priors,
    priors_of,
    robust_cost,
    triangulate,
)
from smust3r_colmap.refinement.statistics import Statistics

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

COARSE = Tolerance(pixels=8.0, angle_deg=4.0)
ITERATIONS = 30


@dataclass(frozen=True, kw_only=True, eq=False)
class Mapper:
    """pycolmap's mapper on the true matches, at given poses."""

    world: World
    path: Path

    def model(self, cam_from_world: FloatArray) -> tuple[pycolmap.Reconstruction, pycolmap.IncrementalMapper]:
        """Triangulated at the given poses."""
        with pycolmap.Database.open(self.path) as database:
            cache = pycolmap.DatabaseCache.create(
                database, pycolmap.DatabaseCacheOptions(min_num_matches=1, load_all_images=True)
            )
        model = pycolmap.Reconstruction()
        model.load(cache)
        for index, pose in enumerate(cam_from_world):
            model.frame(index + 1).rig_from_world = pycolmap.Rigid3d(pose)
            model.register_frame(index + 1)
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(model)
        triangulate(mapper, COARSE)
        mapper.end_reconstruction(False)
        return model, mapper


MakeMapper = Callable[[str, World], Mapper]


@pytest.fixture(scope="module")
def make_mapper(tmp_path_factory: pytest.TempPathFactory) -> MakeMapper:
    def make(name: str, world: World) -> Mapper:
        folder = tmp_path_factory.mktemp(name)
        write_colmap_database(
            folder / "database.db",
            make_collection(folder, len(world)),
            [CAMERA],
            keypoints=dict(enumerate(world.keypoints)),
            matches={pair: true_matches(world, pair) for pair in pairs_within(range(len(world)), 5)},
            j_from_i={},
            priors=(),
        )
        return Mapper(world=world, path=folder / "database.db")

    return make


@pytest.fixture(scope="module")
def round_a_ball(make_mapper: MakeMapper) -> Mapper:
    rng = np.random.default_rng(1)
    return make_mapper("ball", make_world(arc(14), ball(220, rng), rng))


@pytest.fixture(scope="module")
def road(make_mapper: MakeMapper) -> Mapper:
    rng = np.random.default_rng(2)
    return make_mapper("road", make_world(straight(10), rng.uniform([-3, -2, 4], [5, 2, 9], (300, 3)), rng))


def poses_in_order(model: pycolmap.Reconstruction) -> FloatArray:
    poses = poses_of(model)
    return np.stack([poses[i] for i in sorted(poses)])


# --------------------------------------------------------------------------- adjustment
@pytest.mark.parametrize("seed", [1, 2])
def test_disturbed_cameras_come_back_to_the_truth_in_its_own_frame_and_scale(round_a_ball: Mapper, seed: int) -> None:
    world = round_a_ball.world
    start = disturbed_around_the_truth(world, np.random.default_rng(seed))
    assert 0.01 < rms(centres_of(start), world.centres) / world.extent < 0.025
    model, _ = round_a_ball.model(start)
    assert Statistics.of(model).reprojection_error_px > 3
    assert adjust(model, priors_of(model), calibrated=False, max_iterations=ITERATIONS, threads=1)
    found = poses_in_order(model)
    scale, aligned = fitted(centres_of(found), world.centres)
    assert abs(scale - 1) < 0.002
    assert 1e-5 < rms(aligned, world.centres) / world.extent < 1e-3, "0.3 px of noise remain"
    assert rms(centres_of(found), world.centres) / world.extent < 0.005, "without any alignment"
    assert max(angle_deg(a, b) for a, b in zip(found, world.cam_from_world, strict=True)) < 0.3
    assert 0.15 < Statistics.of(model).reprojection_error_px < 0.5
    assert abs(model.camera(1).params[0] / CAMERA.params[0] - 1) < 0.02


def test_equations_solved_iteratively_lead_to_the_same_minimum(
    round_a_ball: Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of many images that all see the same are; the last bits tell that it is another solver."""
    start = disturbed_around_the_truth(round_a_ball.world, np.random.default_rng(1))
    found = []
    for limit in (adjustment.MAX_COVISIBLE_IMAGES, 0):
        monkeypatch.setattr(adjustment, "MAX_COVISIBLE_IMAGES", limit)
        model, _ = round_a_ball.model(start)
        priors = priors_of(model)
        assert adjust(model, priors, calibrated=False, max_iterations=100, threads=1, function_tolerance=1e-10)
        found.append(poses_in_order(model))
    direct, iterative = found
    np.testing.assert_allclose(iterative, direct, atol=1e-3)
    assert not np.array_equal(iterative, direct)


def test_cost_is_the_cauchy_loss_of_observations_in_front_of_their_cameras(round_a_ball: Mapper) -> None:
    model, _ = round_a_ball.model(disturbed_around_the_truth(round_a_ball.world, np.random.default_rng(1)))
    first = model.image(1)
    behind = next(point.point3D_id for point in first.get_observation_points2D())
    model.point3D(behind).xyz = first.projection_center() - first.viewing_direction()
    expected, unseen = 0.0, 0
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.image(element.image_id)
            pixel = image.project_point(point.xyz)
            if pixel is None:
                unseen += 1
            else:
                expected += np.log1p(np.sum((pixel - image.point2D(element.point2D_idx).xy) ** 2))
    assert unseen > 0
    assert expected > 100
    assert robust_cost(model) == pytest.approx(expected, rel=1e-9)
    assert robust_cost(pycolmap.Reconstruction()) == 0


def test_covisibility_counts_the_images_that_share_points_with_an_image() -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(camera_id=1, model="PINHOLE", width=9, height=9, params=[9] * 4))
    for image_id in (1, 2, 3, 4, 9):
        image = pycolmap.Image(name=str(image_id), camera_id=1, image_id=image_id)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2))] * 2)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    assert mean_covisible(model) == 0
    for row, images in enumerate([(1, 2, 3), (3, 4)]):
        track = pycolmap.Track([pycolmap.TrackElement(image_id, row) for image_id in images])
        model.add_point3D(np.zeros(3), track, np.zeros(3, np.uint8))
    assert mean_covisible(model) == pytest.approx((2 + 2 + 3 + 1) / 4)


def test_without_priors_the_scale_drifts(round_a_ball: Mapper, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the priors are for: two cameras alone hold the scale as well as they were placed."""
    world = round_a_ball.world
    model, _ = round_a_ball.model(disturbed_around_the_truth(world, np.random.default_rng(1)))
    monkeypatch.setattr(adjustment, "MIN_PRIORS", 1000)
    assert adjust(model, priors_of(model), calibrated=False, max_iterations=ITERATIONS, threads=1)
    scale, aligned = fitted(centres_of(poses_in_order(model)), world.centres)
    assert rms(aligned, world.centres) / world.extent < 2e-3
    assert 0.01 < abs(scale - 1) < 0.3


def test_cameras_on_a_line_do_not_roll_around_it(road: Mapper) -> None:
    """Centres say nothing about the roll, and pycolmap's alignment with the priors took any: by 134 degrees."""
    world = road.world
    start = disturbed(world.cam_from_world, np.random.default_rng(3), position=1e-3, rotation_deg=0.3)
    model, _ = road.model(start)
    for _ in range(2):
        assert adjust(model, priors_of(model), calibrated=True, max_iterations=ITERATIONS, threads=1)
    found = poses_in_order(model)
    assert max(angle_deg(a, b) for a, b in zip(found, world.cam_from_world, strict=True)) < 0.4
    assert rms(centres_of(found), world.centres) / world.extent < 0.005
    assert Statistics.of(model).reprojection_error_px < 0.5


@pytest.mark.parametrize("calibrated", [True, False])
def test_calibrated_cameras_stay_to_the_last_digit(round_a_ball: Mapper, calibrated: bool) -> None:
    model, _ = round_a_ball.model(disturbed_around_the_truth(round_a_ball.world, np.random.default_rng(2)))
    assert adjust(model, priors_of(model), calibrated=calibrated, max_iterations=5, threads=1)
    adjust_images(model, sorted(model.reg_image_ids())[:6], max_iterations=3, threads=1)
    assert (tuple(model.camera(1).params) == CAMERA.params) == calibrated
    assert tuple(model.camera(1).params[1:3]) == CAMERA.params[1:3], "the principal point always stays"


def test_two_images_keep_about_their_distance_and_exactly_their_intrinsics(make_mapper: MakeMapper) -> None:
    rng = np.random.default_rng(4)
    mapper = make_mapper("two", make_world(arc(12)[[0, 2]], ball(200, rng), rng, noise_px=0.05))
    assert len(mapper.world) < MIN_PRIORS
    start = disturbed(mapper.world.cam_from_world, rng, position=0.02, rotation_deg=0.3)
    model, _ = mapper.model(start)
    assert adjust(model, priors_of(model), calibrated=False, max_iterations=ITERATIONS, threads=1)
    found = poses_in_order(model)
    assert tuple(model.camera(1).params) == CAMERA.params
    assert np.linalg.norm(np.diff(centres_of(found), axis=0)) == pytest.approx(
        np.linalg.norm(np.diff(centres_of(start), axis=0)), rel=0.1
    )
    relative, truth = (poses[1, :, :3] @ poses[0, :, :3].T for poses in (found, mapper.world.cam_from_world))
    assert np.rad2deg(Rotation.from_matrix(relative @ truth.T).magnitude()) < 0.3
    assert Statistics.of(model).num_observations > 150


def test_a_camera_far_off_is_corrected_by_its_observations_and_does_not_move_the_others(
    round_a_ball: Mapper,
) -> None:
    """8 % of the extent: eight standard deviations of a prior, which then counts for little."""
    world = round_a_ball.world
    start = world.cam_from_world.copy()
    far = np.array([0.0, 0.08 * world.extent, 0.0])
    start[6, :, 3] -= start[6, :, :3] @ far
    assert np.linalg.norm(centres_of(start)[6] - world.centres[6]) / world.extent == pytest.approx(0.08)
    model, _ = round_a_ball.model(world.cam_from_world)
    priors = priors_of(model)
    priors = replace(priors, centres={**priors.centres, 7: centres_of(start)[6]})
    assert adjust(model, priors, calibrated=True, max_iterations=ITERATIONS, threads=1)
    off = np.linalg.norm(centres_of(poses_in_order(model)) - world.centres, axis=1) / world.extent
    assert 1e-6 < off.max() < 0.004, "with a squared loss 0.007"


def test_one_thread_gives_the_same_bits_twice(round_a_ball: Mapper) -> None:
    bits = []
    for _ in range(2):
        model, _ = round_a_ball.model(disturbed_around_the_truth(round_a_ball.world, np.random.default_rng(1)))
        adjust(model, priors_of(model), calibrated=False, max_iterations=4, threads=1)
        bits.append([pose.tobytes() for pose in poses_of(model).values()])
    assert bits[0] == bits[1]


def test_subset_of_images_is_adjusted_to_the_points_of_the_others(round_a_ball: Mapper) -> None:
    world = round_a_ball.world
    subset = range(5, 9)
    start = world.cam_from_world.copy()
    start[5:9] = disturbed(start[5:9], np.random.default_rng(5), position=0.01 * world.extent, rotation_deg=0.5)
    model, _ = round_a_ball.model(world.cam_from_world)
    for index in subset:
        model.frame(index + 1).rig_from_world = pycolmap.Rigid3d(start[index])
    others = {i: pose.tobytes() for i, pose in poses_of(model).items() if i not in subset}
    assert adjust_images(model, [i + 1 for i in subset], max_iterations=ITERATIONS, threads=1)
    assert {i: pose.tobytes() for i, pose in poses_of(model).items() if i not in subset} == others
    off = np.linalg.norm(centres_of(poses_in_order(model)) - world.centres, axis=1) / world.extent
    assert rms(centres_of(start)[5:9], world.centres[5:9]) / world.extent > 0.01
    assert off[5:9].max() < 0.003
    assert tuple(model.camera(1).params) == CAMERA.params


def test_images_without_points_are_left_as_they_are(round_a_ball: Mapper) -> None:
    model, _ = round_a_ball.model(round_a_ball.world.cam_from_world)
    before = poses_of(model)
    for point_id in list(model.point3D_ids()):
        model.delete_point3D(point_id)
    assert adjust_images(model, [6, 7], max_iterations=ITERATIONS, threads=1)
    assert all((pose == before[i]).all() for i, pose in poses_of(model).items())


# --------------------------------------------------------------------- triangulation
def test_triangulation_leaves_the_poses_and_makes_tracks_of_the_true_points(round_a_ball: Mapper) -> None:
    world = round_a_ball.world
    model, _ = round_a_ball.model(world.cam_from_world)
    for i, pose in poses_of(model).items():
        np.testing.assert_allclose(pose, world.cam_from_world[i], atol=1e-12)
    pure = 0
    for point in model.points3D.values():
        seen = {world.point_of[e.image_id - 1][e.point2D_idx] for e in point.track.elements}
        assert len({e.image_id for e in point.track.elements}) >= 2, "never a track of length one"
        pure += int(len(seen) == 1 and np.linalg.norm(world.points[seen.pop()] - point.xyz) < 0.05)
    assert pure >= 0.98 * len(model.points3D)
    assert 0.95 * len(world.points) < len(model.points3D) < 1.2 * len(world.points)


def test_points_of_two_images_are_made_for_images_that_see_few_others(make_mapper: MakeMapper) -> None:
    """Image 9 shares 25 points with image 8 and nothing with any other; images 0 and 1 share 30 by themselves."""
    rng = np.random.default_rng(6)
    world = make_world(arc(10), ball(260, rng), rng, clutter=0)
    point_of = [rows.copy() for rows in world.point_of]
    only_8_and_9, only_0_and_1 = range(25), range(25, 55)
    for image, rows in enumerate(point_of):
        rows[np.isin(rows, only_8_and_9) & (image < 8)] = -1
        rows[np.isin(rows, only_0_and_1) & (image > 1)] = -1
        if image == 9:
            rows[~np.isin(rows, only_8_and_9)] = -1
    mapper = make_mapper("few", replace(world, point_of=tuple(point_of)))
    model, _ = mapper.model(world.cam_from_world)
    pairs = [
        tuple(sorted(e.image_id - 1 for e in point.track.elements))
        for point in model.points3D.values()
        if point.track.length() == 2
    ]
    assert pairs.count((8, 9)) > 8
    assert pairs.count((0, 1)) == 0, "both see enough"
    assert model.image(10).num_points3D == pairs.count((8, 9))


# --------------------------------------------------------------------------- priors
def test_priors_have_the_ids_of_the_images_and_the_uncertainty_of_stitching(round_a_ball: Mapper) -> None:
    model, _ = round_a_ball.model(round_a_ball.world.cam_from_world)
    priors = priors_of(model)
    assert set(priors.centres) == set(range(1, 15))
    np.testing.assert_allclose(priors.centres[3], round_a_ball.world.centres[2], atol=1e-9)
    assert 0.005 * round_a_ball.world.extent < priors.sigma <= PRIOR_SIGMA_FRACTION * round_a_ball.world.extent
    made = pose_priors(model, priors)
    assert [prior.pose_prior_id for prior in made] == list(range(1, 15))
    for prior in made:
        assert prior.corr_data_id == model.image(prior.pose_prior_id).data_id
        np.testing.assert_allclose(prior.position_covariance, np.eye(3) * priors.sigma**2)
    model.deregister_frame(4)
    model.tear_down()
    assert 4 not in {prior.pose_prior_id for prior in pose_priors(model, priors)}


def test_extent_leaves_out_what_lies_far_off() -> None:
    line = np.column_stack([np.linspace(0, 10, 101), np.zeros(101), np.zeros(101)])
    assert extent_of(line) == pytest.approx(9.0)
    line[-1] = [1e6, 0, 0]
    assert extent_of(line) == pytest.approx(9.0, rel=0.01)
    assert extent_of(np.ones((5, 3))) == 1.0, "one place has none"
    assert extent_of(np.zeros((1, 3))) == 1.0

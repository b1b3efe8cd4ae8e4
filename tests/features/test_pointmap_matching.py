"""Tracks without features: true to the pixels where geometry is only nearly so, and none where images contradict it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.features.correspondences import Correspondences
from smust3r_colmap.features.patch_alignment import align_patches
from smust3r_colmap.features.pointmap_matching import CACHED_VIEWS, MappedView, match_by_pointmaps
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray, Pair, UInt8Array
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

WIDTH, HEIGHT = 320, 240
STEPS = 48
"""Of the round through the demo room: 7 degrees and 13 cm between neighbours."""
NEIGHBOURS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Photo:
    """A rendered image with its true camera and depth, which covers the same pixels."""

    cam_from_world: FloatArray
    intrinsics: Intrinsics
    grey: UInt8Array
    depth: Float32Array

    def view(self, index: int, **changes: object) -> MappedView:
        """The truth, but for what is changed; arrays stand for what reads them."""
        values = {
            "cam_from_world": self.cam_from_world,
            "intrinsics": self.intrinsics,
            "depth": self.depth,
            "confidence": np.full(self.depth.shape, 5, np.float32),
            "grey": self.grey,
        }
        values |= changes
        loaders = {name: reading(values.pop(name)) for name in ("depth", "confidence", "grey")}
        return MappedView(index=index, **values, **loaders)  # type: ignore[arg-type]


def reading(array: object) -> Callable[[], object]:
    return lambda: array


@pytest.fixture(scope="module")
def room() -> DemoScene:
    return DemoScene(0)


def photograph(room: DemoScene, world_from_cam: FloatArray, intrinsics: Intrinsics) -> Photo:
    rgb, depth = room.render(world_from_cam, intrinsics)
    grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return Photo(cam_from_world=invert_rigid(world_from_cam), intrinsics=intrinsics, grey=grey, depth=depth)


@pytest.fixture(scope="module")
def photos(room: DemoScene) -> list[Photo]:
    """Ten, of a fifth of the way round the room."""
    intrinsics = demo_intrinsics(WIDTH, HEIGHT)
    return [photograph(room, pose, intrinsics) for pose in room.camera_path(STEPS)[:10]]


def disturbed(photo: Photo, index: int, rng: np.random.Generator) -> MappedView:
    """4 cm and 0.3 degrees beside its place, depth wrong by 1 %, half of it everywhere, half from pixel to pixel."""
    world_from_cam = invert_rigid(photo.cam_from_world)
    world_from_cam[:, 3] += rng.normal(size=3) * 0.04 / np.sqrt(3)
    turn = Rotation.from_rotvec(rng.normal(size=3) * np.deg2rad(0.3) / np.sqrt(3))
    world_from_cam[:, :3] = world_from_cam[:, :3] @ turn.as_matrix()
    factor = 1 + 0.007 * rng.normal() + 0.007 * rng.normal(size=photo.depth.shape)
    return photo.view(
        index, cam_from_world=invert_rigid(world_from_cam), depth=(photo.depth * factor).astype(np.float32)
    )


def neighbours(number: int, reach: int = NEIGHBOURS) -> list[Pair]:
    return [(i, j) for i in range(number) for j in range(i + 1, min(number, i + reach + 1))]


def true_errors_px(found: Correspondences, photos: Sequence[Photo], pair: Pair) -> FloatArray:
    """(M,) distance of each match from where the true depth of the first image puts it in the second."""
    a, b = (photos[k] for k in pair)
    xy_a, xy_b = (found.keypoints[k][rows].astype(float) for k, rows in zip(pair, found.matches[pair].T, strict=True))
    map_a = xy_a * (a.depth.shape[1] / a.intrinsics.width, a.depth.shape[0] / a.intrinsics.height)
    depth = a.depth[map_a[:, 1].astype(int), map_a[:, 0].astype(int)]
    world_from_a = invert_rigid(a.cam_from_world)
    points_world = (a.intrinsics.rays_cam(xy_a) * depth[:, None]) @ world_from_a[:, :3].T + world_from_a[:, 3]
    seen = b.intrinsics.xy_img(points_world @ b.cam_from_world[:, :3].T + b.cam_from_world[:, 3])
    errors: FloatArray = np.linalg.norm(seen - xy_b, axis=1)
    return errors


def all_errors_px(found: Correspondences, photos: Sequence[Photo]) -> FloatArray:
    return np.concatenate([true_errors_px(found, photos, pair) for pair in found.matches])


def tracks_and_images(found: Correspondences) -> npt.NDArray[np.int64]:
    """(K, 2) of all keypoints: the connected component of the matches, and the image."""
    images = list(found.keypoints)
    sizes = [len(found.keypoints[k]) for k in images]
    first = dict(zip(images, np.cumsum([0, *sizes]), strict=False))
    rows = np.concatenate([m + np.array([first[i], first[j]]) for (i, j), m in found.matches.items()])
    graph = coo_matrix((np.ones(len(rows)), tuple(rows.T)), shape=(sum(sizes),) * 2)
    return np.stack([connected_components(graph, directed=False)[1], np.repeat(images, sizes)], axis=1)


# ------------------------------------------------------------------------ the main path
@pytest.fixture(scope="module")
def views(photos: list[Photo]) -> list[MappedView]:
    rng = np.random.default_rng(3)
    return [disturbed(photo, k, rng) for k, photo in enumerate(photos)]


@pytest.fixture(scope="module")
def found(views: list[MappedView]) -> Correspondences:
    return match_by_pointmaps(views, neighbours(len(views)), max_keypoints=500)


@pytest.mark.slow
def test_matches_are_right_to_a_tenth_of_a_pixel_although_cameras_are_off_by_ten(
    found: Correspondences, photos: list[Photo], views: list[MappedView]
) -> None:
    stitched = [replace(photo, cam_from_world=view.cam_from_world) for photo, view in zip(photos, views, strict=True)]
    assert 3 < np.median(all_errors_px(found, stitched)) < 15
    errors = all_errors_px(found, photos)
    assert 0.01 < np.median(errors) < 0.1
    assert (errors < 1).mean() > 0.98


def test_neighbours_share_hundreds_of_matches_and_tracks_are_long(found: Correspondences) -> None:
    assert set(found.matches) == set(neighbours(10))
    next_to = [len(found.matches[k, k + 1]) for k in range(9)]
    assert 200 < min(next_to) <= max(next_to) < 1000
    tracks = tracks_and_images(found)
    assert 3.5 < len(tracks) / len(np.unique(tracks[:, 0])) < 10


def test_no_track_meets_an_image_twice(found: Correspondences) -> None:
    tracks = tracks_and_images(found)
    assert len(np.unique(tracks, axis=0)) == len(tracks) > 1000


def test_no_pixel_is_used_twice_by_a_pair(found: Correspondences) -> None:
    for pair, rows in found.matches.items():
        for image, column in zip(pair, rows.T, strict=True):
            assert len(set(column)) == len(rows), (pair, image)


def test_every_keypoint_is_matched_and_none_is_there_twice(found: Correspondences) -> None:
    for image, points in found.keypoints.items():
        used = {int(row) for pair, m in found.matches.items() if image in pair for row in m[:, pair.index(image)]}
        assert used == set(range(len(points)))
        apart = np.linalg.norm(points[:, None] - points[None], axis=2) + 10 * np.eye(len(points))
        assert apart.min() > 0.75


def test_bundle_adjustment_gains_accuracy_from_them(
    found: Correspondences, photos: list[Photo], views: list[MappedView], tmp_path: Path
) -> None:
    """Camera centres from centimetres to a tenth of a millimetre, reprojection from pixels to hundredths."""
    write_database(tmp_path / "database.db", found, views)
    model = triangulated(tmp_path, views)
    before_px, before_m = model.compute_mean_reprojection_error(), centre_rmse(model, photos)
    options = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, refine_extra_params=False)
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    pycolmap.bundle_adjustment(model, options)
    pycolmap.ObservationManager(model).filter_all_points3D(2.0, 1.0)
    assert 1.5 < before_px < 6
    assert 0.01 < before_m < 0.05
    assert model.num_points3D() > 500
    assert model.compute_mean_track_length() > 3.5
    assert 0.01 < model.compute_mean_reprojection_error() < 0.1
    assert 1e-5 < centre_rmse(model, photos) < 2e-3


def write_database(path: Path, found: Correspondences, views: Sequence[MappedView]) -> None:
    with pycolmap.Database.open(str(path)) as database:
        camera = views[0].intrinsics.colmap_camera(1)
        database.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
        database.write_rig(rig, use_rig_id=True)
        for view in views:
            image = colmap_image(view)
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image.image_id, rig_id=1)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_keypoints(image.image_id, found.keypoints[view.index])
        for (i, j), rows in found.matches.items():
            geometry = pycolmap.TwoViewGeometry(config=2, inlier_matches=rows)
            database.write_matches(i + 1, j + 1, rows)
            database.write_two_view_geometry(i + 1, j + 1, geometry)


def colmap_image(view: MappedView) -> pycolmap.Image:
    return pycolmap.Image(name=f"{view.index:06d}.jpg", camera_id=1, image_id=view.index + 1)


def triangulated(folder: Path, views: Sequence[MappedView]) -> pycolmap.Reconstruction:
    """Points on the disturbed cameras, whose errors of some pixels are let through."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(views[0].intrinsics.colmap_camera(1))
    for view in views:
        model.add_image_with_trivial_frame(colmap_image(view), pycolmap.Rigid3d(view.cam_from_world))
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, extract_colors=False)
    options.mapper.filter_max_reproj_error = 12
    options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = 12
    options.triangulation.create_max_angle_error = options.triangulation.continue_max_angle_error = 3
    options.triangulation.ignore_two_view_tracks = False
    return pycolmap.triangulate_points(
        model, str(folder / "database.db"), str(folder), str(folder), options=options, refine_intrinsics=False
    )


def centre_rmse(model: pycolmap.Reconstruction, photos: Sequence[Photo]) -> float:
    """Of the camera centres in metres, after one similarity."""
    estimated = {image.name: invert_rigid(image.cam_from_world().matrix()) for image in model.images.values()}
    true = {f"{k:06d}.jpg": invert_rigid(photo.cam_from_world) for k, photo in enumerate(photos)}
    return compare_trajectories(estimated, true).position_rmse


def test_the_same_input_gives_the_same_matches(photos: list[Photo]) -> None:
    views = [disturbed(photo, k, np.random.default_rng(k)) for k, photo in enumerate(photos[:3])]
    first, second = (match_by_pointmaps(views, [(0, 1), (1, 2)], max_keypoints=150) for _ in range(2))
    assert set(first.matches) == {(0, 1), (1, 2)}
    for pair, rows in first.matches.items():
        np.testing.assert_array_equal(rows, second.matches[pair])
    for image, points in first.keypoints.items():
        np.testing.assert_array_equal(points, second.keypoints[image])


def test_few_corners_are_spread_over_the_image(photos: list[Photo]) -> None:
    """Of the hundred strongest, nine parts of the image would have 4 to 23."""
    views = [photo.view(k) for k, photo in enumerate((photos[0], photos[0]))]
    xy = match_by_pointmaps(views, [(0, 1)], max_keypoints=100).keypoints[0]
    column, row = (xy * 3 / (WIDTH, HEIGHT)).astype(int).T
    counts = np.bincount(3 * row + column, minlength=9)
    assert 90 < counts.sum() <= 100
    assert 7 <= counts.min() <= counts.max() <= 16


def test_a_corner_found_from_two_sides_is_one_keypoint(photos: list[Photo]) -> None:
    """Images 0 and 1 do not know of each other, both know of image 2; half of their corners are the same pixels."""
    views = [photos[k].view(number) for number, k in enumerate((0, 0, 1))]
    found = match_by_pointmaps(views, [(0, 2), (1, 2)], max_keypoints=300)
    from_both = set(found.matches[0, 2][:, 1]) & set(found.matches[1, 2][:, 1])
    assert 100 < len(from_both) <= 300


# ------------------------------------------------------------------------------ cameras
def test_distorted_cameras_are_as_exact_as_ideal_ones(photos: list[Photo]) -> None:
    distorted = [with_distortion(photo) for photo in photos[:3]]
    found = match_by_pointmaps([p.view(k) for k, p in enumerate(distorted)], [(0, 1), (1, 2)], max_keypoints=300)
    errors = all_errors_px(found, distorted)
    assert 200 < len(errors) < 600
    assert 0.01 < np.median(errors) < 0.15
    assert (errors < 1).mean() > 0.97


def with_distortion(photo: Photo) -> Photo:
    """Seen through a lens that pulls the corners in by 5 %."""
    focal_px, _, cx, cy = photo.intrinsics.params
    lens = Intrinsics(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=(1.15 * focal_px, cx, cy, -0.08))
    xy = photo.intrinsics.xy_img(lens.rays_cam(pixel_centres(WIDTH, HEIGHT))).reshape(HEIGHT, WIDTH, 2)
    at = (xy - 0.5).astype(np.float32)
    grey = np.asarray(cv2.remap(photo.grey, at[..., 0], at[..., 1], cv2.INTER_CUBIC), dtype=np.uint8)
    depth = np.asarray(cv2.remap(photo.depth, at[..., 0], at[..., 1], cv2.INTER_NEAREST), dtype=np.float32)
    return replace(photo, intrinsics=lens, grey=grey, depth=depth)


def test_images_of_other_sizes_and_maps_of_other_sizes_match(room: DemoScene, photos: list[Photo]) -> None:
    """One photograph is half as large again, grey images and maps are smaller than the cameras say, each in its way."""
    large = photograph(room, room.camera_path(STEPS)[1], demo_intrinsics(480, 360))
    small = replace(photos[0], depth=photos[0].depth[1::3, 1::3])
    shrunk = np.asarray(cv2.resize(large.grey, (360, 270), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    found = match_by_pointmaps([small.view(0), large.view(1, grey=shrunk)], [(0, 1)], max_keypoints=300)
    assert found.keypoints[1].max() > 400
    errors = true_errors_px(found, [photos[0], large], (0, 1))
    assert 100 < len(errors) < 400
    assert 0.01 < np.median(errors) < 0.25
    assert (errors < 1.5).mean() > 0.95


def test_a_camera_that_only_rotated_is_matched_too(room: DemoScene, photos: list[Photo]) -> None:
    """There is no parallax to triangulate, which is for the triangulation to find."""
    pose = room.camera_path(STEPS)[0].copy()
    pose[:, :3] = pose[:, :3] @ Rotation.from_euler("yz", [12, 5], degrees=True).as_matrix()
    both = [photos[0], photograph(room, pose, demo_intrinsics(WIDTH, HEIGHT))]
    found = match_by_pointmaps([photo.view(k) for k, photo in enumerate(both)], [(0, 1)], max_keypoints=300)
    errors = true_errors_px(found, both, (0, 1))
    assert 100 < len(errors) < 300
    assert np.median(errors) < 0.1


# ----------------------------------------------------------------------- contradictions
def test_an_image_of_another_place_is_matched_with_nothing(photos: list[Photo]) -> None:
    """Its depth says that it sees the same walls; its pixels do not show them there."""
    elsewhere = photos[9].view(2, cam_from_world=photos[1].cam_from_world, depth=photos[1].depth)
    views = [photos[0].view(0), photos[1].view(1), elsewhere]
    found = match_by_pointmaps(views, [(0, 1), (0, 2), (1, 2)], max_keypoints=300)
    assert set(found.matches) == {(0, 1)}
    assert found.keypoints[2].shape == (0, 2)


def test_depths_that_disagree_are_not_matched(photos: list[Photo]) -> None:
    deeper = photos[1].view(1, depth=photos[1].depth * np.float32(1.25))
    assert not match_by_pointmaps([photos[0].view(0), deeper], [(0, 1)], max_keypoints=300).matches


def test_corners_are_transferred_by_confident_depth_only(photos: list[Photo]) -> None:
    confidence = np.full((HEIGHT, WIDTH), 5, np.float32)
    confidence[:, : WIDTH // 2] = 1
    found = match_by_pointmaps(
        [photos[0].view(0, confidence=confidence), photos[1].view(1)], [(0, 1)], max_keypoints=300
    )
    assert len(found.keypoints[0]) > 50
    assert found.keypoints[0][:, 0].min() > WIDTH // 2


def facing_a_wall(grey: UInt8Array, *, to_the_right: float = 0.0, depth: float = 2.0) -> Photo:
    """2 m away, so that a step of one metre moves pixels by 120."""
    camera = demo_intrinsics(WIDTH, HEIGHT)
    cam_from_world = np.column_stack([np.eye(3), [-to_the_right, 0, 0]])
    return Photo(
        cam_from_world=cam_from_world,
        intrinsics=camera,
        grey=grey,
        depth=np.full((HEIGHT, WIDTH), depth, np.float32),
    )


def test_depth_must_lead_back_to_the_pixel() -> None:
    """1.9 % of depth is within what two maps may differ by, and two pixels away over so wide a baseline."""
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH + 120)), (0, 0), 2)
    wall = np.clip(120 + 30 * noise / noise.std(), 0, 255).astype(np.uint8)
    left = facing_a_wall(wall[:, :WIDTH]).view(0)
    exact, wrong = (
        match_by_pointmaps(
            [left, facing_a_wall(wall[:, 120:], to_the_right=1.0, depth=depth).view(1)], [(0, 1)], max_keypoints=300
        )
        for depth in (2.0, 2.0 * 1.019)
    )
    assert 100 < exact.num_matches < 300
    assert wrong.num_matches == 0


def test_look_alike_surfaces_without_a_common_motion_are_not_matched() -> None:
    """Two walls of dots on the same grid, each dot beside its place at random: every dot finds one near by."""
    views = [facing_a_wall(dots(seed)).view(k) for k, seed in enumerate((0, 0, 1))]
    found = match_by_pointmaps(views, [(0, 1), (0, 2)], max_keypoints=400)
    assert set(found.matches) == {(0, 1)}
    assert 100 < len(found.matches[0, 1]) < 400


def dots(seed: int) -> UInt8Array:
    """(H, W) dots 16 px apart, moved by up to 5 px each."""
    places = pixel_centres(WIDTH // 16, HEIGHT // 16) * 16
    places += np.random.default_rng(seed).uniform(-5, 5, places.shape)
    across, down = (
        np.exp(-((np.arange(size) + 0.5 - centres[:, None]) ** 2) / (2 * 2.5**2))
        for size, centres in zip((WIDTH, HEIGHT), places.T, strict=True)
    )
    return np.asarray((40 + 180 * np.minimum(down.T @ across, 1)).astype(np.uint8))


# ------------------------------------------------------------------------ nothing to see
def no_depth(photo: Photo) -> MappedView:
    return photo.view(1, depth=np.zeros((HEIGHT, WIDTH), np.float32))


def only_nan(photo: Photo) -> MappedView:
    return photo.view(1, depth=np.full((HEIGHT, WIDTH), np.nan, np.float32))


def white_wall(photo: Photo) -> MappedView:
    return photo.view(1, grey=np.full((HEIGHT, WIDTH), 200, np.uint8))


def noise_only(photo: Photo) -> MappedView:
    noise = np.random.default_rng(0).normal(200, 0.5, (HEIGHT, WIDTH))
    return photo.view(1, grey=noise.round().astype(np.uint8))


def turned_away(photo: Photo) -> MappedView:
    return photo.view(1, cam_from_world=np.diag([-1.0, 1.0, -1.0]) @ photo.cam_from_world)


def tiny(photo: Photo) -> MappedView:
    return photo.view(1, grey=photo.grey[:8, :8])


def four_times_as_coarse(photo: Photo) -> MappedView:
    return photo.view(1, grey=cv2.resize(photo.grey, (WIDTH // 4, HEIGHT // 4), interpolation=cv2.INTER_AREA))


@pytest.mark.parametrize("other", [no_depth, only_nan, white_wall, noise_only, turned_away, tiny, four_times_as_coarse])
def test_an_image_that_shows_nothing_gets_no_keypoints(
    photos: list[Photo], other: Callable[[Photo], MappedView]
) -> None:
    found = match_by_pointmaps([photos[0].view(0), other(photos[1])], [(0, 1)], max_keypoints=200)
    assert found.matches == {}
    assert [found.keypoints[k].shape for k in (0, 1)] == [(0, 2), (0, 2)]


def test_texture_as_faint_as_noise_has_no_corners(photos: list[Photo]) -> None:
    faint = [photo.view(k, grey=(127 + photo.grey / 128).astype(np.uint8)) for k, photo in enumerate(photos[:2])]
    assert not match_by_pointmaps(faint, [(0, 1)], max_keypoints=300).matches


def test_an_image_without_partners_is_never_read(photos: list[Photo]) -> None:
    def unreadable() -> Float32Array:
        raise AssertionError("was read")

    alone = MappedView(
        index=7,
        cam_from_world=photos[0].cam_from_world,
        intrinsics=photos[0].intrinsics,
        depth=unreadable,
        confidence=unreadable,
        grey=lambda: unreadable().astype(np.uint8),
    )
    found = match_by_pointmaps([alone], [], max_keypoints=100)
    assert found.keypoints[7].shape == (0, 2)
    assert found.keypoints[7].dtype == np.float32
    assert match_by_pointmaps([], [], max_keypoints=100).num_matches == 0


def test_each_image_of_a_sequence_is_read_once(photos: list[Photo]) -> None:
    reads: list[int] = []

    def reader(index: int) -> Callable[[], UInt8Array]:
        def read() -> UInt8Array:
            reads.append(index)
            return np.zeros((48, 64), np.uint8)

        return read

    number = 2 * CACHED_VIEWS
    coarse = photos[0].view(0, depth=np.ones((6, 8), np.float32), confidence=np.ones((6, 8), np.float32))
    views = [replace(coarse, index=k, grey=reader(k)) for k in range(number)]
    match_by_pointmaps(views, neighbours(number, 12), max_keypoints=100)
    assert sorted(reads) == list(range(number))


# ---------------------------------------------------------------------------- refusals
def test_pairs_and_numbers_that_make_no_sense_are_refused(photos: list[Photo]) -> None:
    views = [photos[0].view(0), photos[1].view(1)]
    with pytest.raises(ValueError, match=r"pair \(1, 0\) is not ascending"):
        match_by_pointmaps(views, [(1, 0)], max_keypoints=100)
    with pytest.raises(ValueError, match=r"pair \(0, 5\) .* names no view"):
        match_by_pointmaps(views, [(0, 5)], max_keypoints=100)
    with pytest.raises(ValueError, match="2 views have 1 indices"):
        match_by_pointmaps([views[0], views[0]], [], max_keypoints=100)
    with pytest.raises(ValueError, match="max_keypoints is 0"):
        match_by_pointmaps(views, [], max_keypoints=0)
    with pytest.raises(ValueError, match=r"pose \(4, 4\)"):
        photos[0].view(0, cam_from_world=np.eye(4))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"confidence": np.ones((3, 4), np.float32)}, r"image 1: depth is \(240, 320\), confidence \(3, 4\)"),
        ({"grey": np.zeros((240, 320, 3), np.uint8)}, r"image 1: grey is \(240, 320, 3\)"),
        ({"grey": np.zeros((2, 40_000), np.uint8)}, "at most 32766 a side"),
    ],
)
def test_arrays_of_wrong_shapes_are_refused(photos: list[Photo], changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        match_by_pointmaps([photos[0].view(0), photos[1].view(1, **changes)], [(0, 1)], max_keypoints=100)


# ------------------------------------------------------------------------------ patches
@pytest.fixture(scope="module")
def texture() -> Float32Array:
    """(H, W) smooth noise, sampled ten times as finely as a pixel."""
    noise = np.random.default_rng(5).normal(size=(1600, 1600)).astype(np.float32)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 20), dtype=np.float32)
    return np.asarray(smooth / smooth.std())


def pictured(texture: Float32Array, at_from_pixel: FloatArray, size: int = 120) -> list[UInt8Array]:
    """A pyramid of the texture seen at (2, 3) affine coordinates, in texels, of pixel centres."""
    xy = pixel_centres(size, size) @ at_from_pixel[:, :2].T + at_from_pixel[:, 2]
    at = xy.astype(np.float32).reshape(size, size, 2)
    sampled = np.asarray(cv2.remap(texture, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
    levels = [np.clip(120 + 30 * sampled, 0, 255).round().astype(np.uint8)]
    for _ in range(3):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return levels


def test_a_warped_patch_is_found_to_a_hundredth_of_a_pixel(texture: Float32Array) -> None:
    """Under rotation, stretch and shear, darker and with less contrast, from up to ten pixels off."""
    rng = np.random.default_rng(0)
    b_from_a = np.array([[1.2, -0.3, 4.3], [0.25, 0.9, -6.6]])
    linear = b_from_a[:, :2]
    a_from_b = np.column_stack([np.linalg.inv(linear), -np.linalg.inv(linear) @ b_from_a[:, 2]])
    image_a = pictured(texture, np.column_stack([10 * np.eye(2), [200.0, 200.0]]))
    image_b = pictured(texture, np.column_stack([10 * a_from_b[:, :2], 10 * a_from_b[:, 2] + 200]))
    image_b = [(0.6 * level + 10).astype(np.uint8) for level in image_b]
    xy_a = rng.uniform(35, 75, (60, 2))
    true_b = xy_a @ linear.T + b_from_a[:, 2]
    off = rng.uniform(-7, 7, (60, 2))
    aligned = align_patches(
        image_a, xy_a, image_b, true_b + off, np.broadcast_to(linear, (60, 2, 2)).copy(), reach_px=12
    )
    settled = aligned.correlation > 0.95
    assert settled.mean() > 0.9
    errors = np.linalg.norm(aligned.xy_b - true_b, axis=1)[settled]
    assert 1e-4 < np.median(errors) < 0.03
    assert errors.max() < 0.2


def test_a_patch_beyond_reach_or_without_texture_is_not_found(texture: Float32Array) -> None:
    image = pictured(texture, np.column_stack([10 * np.eye(2), [200.0, 200.0]]))
    flat = [np.full_like(level, 90) for level in image]
    xy, same = np.array([[60.3, 58.9]]), np.eye(2)[None]
    near = align_patches(image, xy, image, xy + 1.5, same, reach_px=4)
    assert near.correlation[0] > 0.99
    assert align_patches(image, xy, image, xy + 1.5, same, reach_px=1).correlation[0] == -1
    assert align_patches(flat, xy, image, xy, same, reach_px=4).correlation[0] <= 0
    assert align_patches(image, xy, flat, xy, same, reach_px=4).correlation[0] <= 0

"""The judge of models by held-out matches: its distances, what it holds out, and whom it prefers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import judge_by_epipolar_error as judge
import numpy as np
import pycolmap
import pytest
from helpers.scenes import points_ahead, rotation_about_y, walk
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

FOCAL_PX = 500.0
WIDTH, HEIGHT = 640, 480
RADIAL = -0.15


def model_of(
    poses: dict[str, FloatArray],
    *,
    params: Sequence[float] = (FOCAL_PX, WIDTH / 2, HEIGHT / 2, RADIAL),
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> pycolmap.Reconstruction:
    """SIMPLE_RADIAL cameras at (3, 4) ``world_from_cam``, without points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=size[0], height=size[1], params=list(params))
    model.add_camera_with_trivial_rig(camera)
    for number, (name, pose) in enumerate(poses.items(), start=1):
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_rigid(pose[None])[0]))
    return model


def with_tracks(model: pycolmap.Reconstruction, points_world: FloatArray) -> pycolmap.Reconstruction:
    """The same, every point seen in every image where it falls into it."""
    seen: list[list[pycolmap.TrackElement]] = [[] for _ in points_world]
    for image in model.images.values():
        xy = np.array([image.project_point(point) for point in points_world], dtype=np.float64)
        inside = np.flatnonzero((xy > 0).all(axis=1) & (xy < [image.camera.width, image.camera.height]).all(axis=1))
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy[point]) for point in inside])
        for place, point in enumerate(inside):
            seen[point].append(pycolmap.TrackElement(image.image_id, place))
    for point, elements in zip(points_world, seen, strict=True):
        if len(elements) >= 2:
            model.add_point3D(point, pycolmap.Track(elements), np.zeros(3, np.uint8))
    return model


def two_cameras(pitch_deg: float = 0.0) -> dict[str, FloatArray]:
    """The second stands one unit to the right of the first and looks up by ``pitch_deg``."""
    c, s = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    pitch = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return {"a": np.eye(3, 4), "b": np.column_stack([pitch, [1.0, 0.0, 0.0]])}


def true_matches(model: pycolmap.Reconstruction, points_world: FloatArray) -> judge.HeldOutMatches:
    a, b = (judge.image_named(model, name) for name in ("a", "b"))
    xy_a, xy_b = (np.array([image.project_point(point) for point in points_world]) for image in (a, b))
    return judge.HeldOutMatches(pair=("a", "b"), xy_a_img=xy_a, xy_b_img=xy_b)


def ahead() -> FloatArray:
    return np.random.default_rng(1).uniform([-1.0, -1.0, 4.0], [2.0, 1.0, 8.0], size=(400, 3))


# ---------------------------------------------------------------------------- distances
def test_true_matches_lie_on_the_lines_of_the_true_model() -> None:
    model = model_of(two_cameras())
    distances = judge.epipolar_distances_px({"true": model}, true_matches(model, ahead()))
    assert distances.shape == (1, 400)
    assert distances.max() < 1e-6


def test_a_wrong_pitch_shifts_the_lines_of_cameras_side_by_side_by_as_many_pixels() -> None:
    model, pitched = model_of(two_cameras()), model_of(two_cameras(pitch_deg=0.1))
    distances = judge.epipolar_distances_px({"pitched": pitched}, true_matches(model, ahead()))
    # In the middle of the image; towards its borders the shift grows with 1 + y^2.
    shift_px = FOCAL_PX * np.tan(np.radians(0.1))
    assert np.median(distances) == pytest.approx(shift_px, rel=0.05)
    assert 0.95 * shift_px < distances.min() < distances.max() < 1.15 * shift_px


def test_noise_across_the_lines_is_what_is_measured() -> None:
    model = model_of(two_cameras(), params=(FOCAL_PX, WIDTH / 2, HEIGHT / 2, 0.0))
    exact = true_matches(model, ahead())
    noise_px = np.random.default_rng(2).normal(size=(400, 2))
    noisy = judge.HeldOutMatches(pair=exact.pair, xy_a_img=exact.xy_a_img, xy_b_img=exact.xy_b_img + noise_px)
    # The lines of cameras side by side are horizontal.
    distances = judge.epipolar_distances_px({"true": model}, noisy)
    np.testing.assert_allclose(distances[0], np.abs(noise_px[:, 1]), atol=1e-6)


def test_a_model_without_the_distortion_is_off_by_it_towards_the_borders() -> None:
    poses = {"a": np.eye(3, 4), "b": np.column_stack([rotation_about_y(-20.0), [1.0, 0.0, 0.0]])}
    model = model_of(poses)
    plain = model_of(poses, params=(FOCAL_PX, WIDTH / 2, HEIGHT / 2, 0.0))
    distances = judge.epipolar_distances_px({"true": model, "plain": plain}, true_matches(model, ahead()))
    assert distances[0].max() < 1e-6
    assert 0.2 < np.median(distances[1]) < 5.0


# ------------------------------------------------------------------------------- choice
def test_pairs_are_those_that_share_points_in_any_model() -> None:
    poses = {f"{k}.jpg": pose for k, pose in enumerate(walk(12, step=1.5))}
    tracked = with_tracks(model_of(poses), points_ahead(300, np.random.default_rng(0)))
    overlap = judge.overlaps(tracked, list(poses))
    seen = {
        image.name: {point.point3D_id for point in image.points2D if point.has_point3D()}
        for image in tracked.images.values()
    }
    shares = {(a, b): len(seen[a] & seen[b]) / max(len(seen[a]), len(seen[b])) for a in poses for b in poses}
    assert overlap[2, 5] == shares["2.jpg", "5.jpg"] > 0
    assert overlap[4, 4] == 0
    expected = [(a, b) for (a, b), share in shares.items() if int(a[:-4]) < int(b[:-4]) and share >= judge.MIN_OVERLAP]
    assert 0 < len(expected) < 66
    assert judge.overlapping_pairs({"bare": model_of(poses), "tracked": tracked}) == expected


def test_without_tracks_neighbours_are_paired_in_natural_order() -> None:
    poses = {f"{k}.jpg": pose for k, pose in enumerate(walk(12))}
    lacking = {name: pose for name, pose in poses.items() if name != "4.jpg"}
    pairs = judge.overlapping_pairs({"all": model_of(poses), "lacking": model_of(lacking)})
    assert ("9.jpg", "10.jpg") in pairs
    assert ("3.jpg", "5.jpg") in pairs
    assert not any("4.jpg" in pair for pair in pairs)
    assert len(pairs) == 3 * 11 - 6


def test_corners_on_a_track_of_any_model_are_left_out() -> None:
    poses = {f"{k}.jpg": pose for k, pose in enumerate(walk(3))}
    models = {
        "bare": model_of(poses),
        "tracked": with_tracks(model_of(poses), points_ahead(50, np.random.default_rng(0))),
    }
    tracked = [point.xy for point in judge.image_named(models["tracked"], "1.jpg").points2D]
    near, far = np.array(tracked) + 1.0, np.array([[-50.0, -50.0]])
    corners = judge.Corners(
        xy_img=np.concatenate([near, far]), descriptors=np.arange(len(near) + 1, dtype=np.float32)[:, None]
    )
    kept = judge.without_tracked(corners, "1.jpg", models)
    np.testing.assert_array_equal(kept.xy_img, far)
    assert kept.descriptors.item() == len(near)


def test_corners_are_found_to_a_fraction_of_a_pixel_in_colmaps_frame() -> None:
    grey = np.full((80, 100), 40, np.uint8)
    grey[20:50, 30:70] = 200  # whose borders lie between pixels: at 30 and 70, 20 and 50 in COLMAP's frame
    found = judge.find_corners(np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7), np.uint8))
    expected = {(30, 20), (70, 20), (30, 50), (70, 50)}
    assert {(round(x), round(y)) for x, y in found.xy_img} == expected
    assert np.abs(found.xy_img - found.xy_img.round()).max() < 0.15
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-3)


def test_an_image_without_corners_has_no_matches() -> None:
    blank = judge.find_corners(np.full((60, 80), 128, np.uint8))
    assert blank.xy_img.shape == (0, 2)
    assert [len(rows) for rows in judge.mutual_matches(blank, blank)] == [0, 0]


def test_matches_are_mutual_and_clear() -> None:
    directions = np.eye(6, dtype=np.float32)
    a = judge.Corners(xy_img=np.zeros((4, 2)), descriptors=directions[[0, 1, 2, 2]])
    b = judge.Corners(xy_img=np.zeros((4, 2)), descriptors=directions[[2, 1, 0, 5]])
    rows_a, rows_b = judge.mutual_matches(a, b)
    # The third and fourth of a are alike: only one can be the nearest of the first of b.
    assert dict(zip(rows_a.tolist(), rows_b.tolist(), strict=True)) == {0: 2, 1: 1, 2: 0}
    doubled = judge.Corners(xy_img=np.zeros((2, 2)), descriptors=directions[[1, 1]])
    assert len(judge.mutual_matches(a, doubled)[0]) == 0


def test_the_filter_drops_what_no_fundamental_matrix_explains_and_nothing_that_distortion_bends() -> None:
    model = model_of(two_cameras())
    matches = true_matches(model, ahead())
    wrong = np.random.default_rng(4).permutation(matches.xy_b_img[:100])
    xy_b = np.concatenate([wrong, matches.xy_b_img[100:]])
    kept = judge.loosely_consistent(matches.xy_a_img, xy_b, judge.LOOSE_SHARE * WIDTH)
    assert kept[100:].mean() > 0.95
    assert kept[:100].mean() < 0.2


# ---------------------------------------------------------------------------- judgement
def test_the_same_model_twice_is_a_draw_and_ratios_have_a_range() -> None:
    model, pitched = model_of(two_cameras()), model_of(two_cameras(pitch_deg=0.1))
    exact = true_matches(model, ahead())
    rng = np.random.default_rng(2)
    noisy = [
        judge.HeldOutMatches(
            pair=exact.pair, xy_a_img=exact.xy_a_img, xy_b_img=exact.xy_b_img + 0.5 * rng.normal(size=(400, 2))
        )
        for _ in range(5)
    ]
    first, same, worse = judge.judge({"first": model, "same": model, "worse": pitched}, noisy, rng=rng)
    assert (first.ratio, same.ratio, same.ratio_low, same.ratio_high) == (1.0, 1.0, 1.0, 1.0)
    assert (first.num_pairs, first.num_matches) == (5, 2000)
    # The median of the length of a normal number is 0.6745; the pitch moves all lines by 0.87 pixels.
    assert first.median_px == pytest.approx(0.5 * 0.6745, rel=0.1)
    assert worse.median_px == pytest.approx(0.88, rel=0.1)
    assert worse.ratio_low < worse.ratio < worse.ratio_high
    assert 1.1 * worse.ratio_low > worse.ratio_high
    assert first.share_below_1px == pytest.approx(0.954, abs=0.02)
    assert first.share_below_1px > worse.share_below_1px


def test_what_one_model_cannot_undistort_is_left_out_for_all() -> None:
    model = model_of(two_cameras())
    exact = true_matches(model, ahead())
    folded = model_of(two_cameras(), params=(FOCAL_PX, WIDTH / 2, HEIGHT / 2, -2.0))
    (true, other) = judge.judge({"true": model, "folded": folded}, [exact], rng=np.random.default_rng(0))
    assert true.num_matches == other.num_matches
    assert 0 < true.num_matches < 400


def test_no_matches_are_no_judgement() -> None:
    with pytest.raises(InputError, match="no matches to judge by in 0 pairs"):
        judge.judge({"one": model_of(two_cameras())}, [], rng=np.random.default_rng(0))


# ---------------------------------------------------------------------------- the script
@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of the rendered room, the true model of them, one with disturbed poses, one with a wrong focal length."""
    folder = tmp_path_factory.mktemp("room")
    scene, camera = DemoScene(), demo_intrinsics(240, 180)
    truth = {f"{k}.png": pose for k, pose in enumerate(scene.camera_path(60)[:4])}
    (folder / "images").mkdir()
    for name, pose in truth.items():
        cv2.imwrite(str(folder / "images" / name), scene.render(pose, camera)[0])
    rng = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.radians(0.5) * rng.normal(size=(4, 3))).as_matrix()
    off = {
        name: np.column_stack([pose[:, :3] @ turn, pose[:, 3]])
        for (name, pose), turn in zip(truth.items(), turns, strict=True)
    }
    for label, poses, focal in (
        ("true", truth, camera.focal_px),
        ("disturbed", off, camera.focal_px),
        ("long", truth, 1.1 * camera.focal_px),
    ):
        (folder / label).mkdir()
        model_of(poses, params=(focal, 120.0, 90.0, 0.0), size=(240, 180)).write_binary(folder / label)
    return folder


def words(room: Path, *labels: str) -> list[str]:
    return [str(room / "images"), *(f"{label}={room / label}" for label in labels), "--pairs", "5"]


@pytest.mark.slow
def test_the_true_model_of_rendered_images_wins(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = room / "report.json"
    assert judge.main([*words(room, "true", "disturbed", "long"), "--json", str(report)]) == 0
    true, disturbed, long = json.loads(report.read_text())
    assert 0.02 < true["median_px"] < 0.5
    assert 3 < disturbed["ratio_low"] < disturbed["ratio"]
    assert 1.1 < long["ratio_low"] < long["ratio"]
    assert true["num_pairs"] >= 3
    table = capsys.readouterr().out.splitlines()
    assert table[0] == f"{true['num_matches']} held-out matches of {true['num_pairs']} pairs"
    assert [line.split()[0] for line in table[1:]] == ["model", "true", "disturbed", "long"]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_figures(room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = []
    for _ in range(2):
        assert judge.main([*words(room, "true", "disturbed"), "--pairs", "2"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1]


def test_what_cannot_be_judged_is_refused_by_name(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert judge.main([str(room / "images"), f"none={tmp_path}"]) == 2
    assert "not a COLMAP model" in capsys.readouterr().err
    models = {"true": judge.read_model(room / "true")}
    first = min(image.name for image in models["true"].images.values())
    with pytest.raises(InputError, match=f"{first}: cannot be read"):
        judge.read_grey(tmp_path, first, models)
    cv2.imwrite(str(tmp_path / first), np.zeros((180, 200), np.uint8))
    with pytest.raises(InputError, match=r"200 x 180 pixels, but 240 x 180 in true"):
        judge.read_grey(tmp_path, first, models)
    apart = model_of({"elsewhere.jpg": np.eye(3, 4)})
    with pytest.raises(InputError, match=r"no two .* in all models \(true has 4, apart has 1\)"):
        next(judge.held_out_matches(tmp_path, {**models, "apart": apart}, num_pairs=3, rng=np.random.default_rng(0)))


@pytest.mark.parametrize("models", [["folder"], ["a=x", "a=y"]])
def test_models_need_a_label_each(models: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        judge.parse_arguments(["images", *models])
    assert "LABEL=FOLDER" in capsys.readouterr().err

"""The judge of depth maps by a sensor: its registration, its measures, and whole workspaces with stated errors."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import judge_depth_maps as judge
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.dense_scenes import cameras_from_world, exact_depth, picture
from PIL import Image
from scipy.spatial.transform import Rotation

from smust3r_colmap.errors import InputError
from smust3r_colmap.exporters.dense_workspace import write_map
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid

FloatMap = npt.NDArray[np.float32]

VIEW = Intrinsics(model="PINHOLE", width=120, height=90, params=(100.0, 102.0, 61.0, 44.0))
SENSOR = Intrinsics(model="PINHOLE", width=160, height=120, params=(146.0, 146.0, 80.0, 60.0))
NAMES = ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
UNIT_M = 0.25  # of the model


def steps(sensor: Intrinsics) -> FloatMap:
    """A near plane on the left half and a far one on the right."""
    depth = np.full((sensor.height, sensor.width), 4.0, np.float32)
    depth[:, : sensor.width // 2] = 2.0
    return depth


# ------------------------------------------------------------------------- registration
def test_a_sensor_in_the_place_of_the_camera_is_seen_pixel_by_pixel() -> None:
    depth = np.random.default_rng(0).uniform(1, 5, (90, 120)).astype(np.float32)
    depth[10:20, 30:50] = 0
    np.testing.assert_array_equal(judge.depth_in_view(depth, VIEW, np.eye(3, 4), VIEW), depth)


def test_a_sensor_beside_the_camera_sees_the_scene_as_the_camera_does() -> None:
    """Both look at a ball before a wall; away from edges and within what both see, drawn and true depth agree."""
    view_from_sensor = np.column_stack([Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix(), [-0.03, 0.01, 0.02]])
    sensor_from_world = cameras_from_world()[2]
    view_from_world = compose(view_from_sensor, sensor_from_world)
    measured = exact_depth(SENSOR, sensor_from_world)
    seen = judge.depth_in_view(measured, SENSOR, view_from_sensor, VIEW)
    truth = exact_depth(VIEW, view_from_world)
    read = seen > 0
    assert 0.85 < read.mean() <= 1
    error = np.abs(seen[read] / truth[read] - 1)
    assert np.quantile(error, 0.95) < 0.01
    # Half a pixel of the view, or the registration left out, would show.
    shifted = judge.depth_in_view(measured, SENSOR, np.eye(3, 4), VIEW)
    both = read & (shifted > 0)
    assert np.median(np.abs(shifted[both] / truth[both] - 1)) > 5 * np.median(np.abs(seen[both] / truth[both] - 1))


def test_of_two_surfaces_in_a_pixel_the_nearer_is_taken() -> None:
    moved = np.column_stack([np.eye(3), [0.4, 0.0, 0.0]])  # the near plane slides over the far one
    seen = judge.depth_in_view(steps(VIEW), VIEW, moved, VIEW)
    edge_near = 60 + 100 * 0.4 / 2.0
    edge_far = 60 + 100 * 0.4 / 4.0
    assert (seen[:, 25 : int(edge_near)] == 2).all()
    assert edge_far < edge_near
    assert (seen[:, int(edge_near) + 1 :] == 4).all()


@pytest.mark.parametrize("size", [(160, 120), (400, 300)])
def test_a_view_larger_than_the_sensor_has_no_holes(size: tuple[int, int]) -> None:
    view = SENSOR.resized(*size).zoomed(1.05)
    seen = judge.depth_in_view(steps(SENSOR), SENSOR, np.eye(3, 4), view)
    assert (seen > 0).all()


# ----------------------------------------------------------------------------- measures
def test_measures_are_those_of_the_ratios() -> None:
    ratios = np.array([1.0, 1.04, 1 / 1.04, 1.06, 1 / 1.06, 1.3])
    found = judge.figures("", ratios, 12)
    assert found.abs_rel == pytest.approx((0.04 + 1 - 1 / 1.04 + 0.06 + 1 - 1 / 1.06 + 0.3) / 6)
    assert found.median_rel == pytest.approx((0.04 + 1 - 1 / 1.06) / 2)
    assert (found.delta_105, found.delta_125, found.coverage) == (3 / 6, 5 / 6, 6 / 12)


def test_points_that_are_not_before_their_camera_are_counted_and_not_compared() -> None:
    """A point as far behind the camera as the surface is before it would be off by nothing."""
    model, truth = pycolmap.Reconstruction(), np.full((VIEW.height, VIEW.width), 2, np.float32)
    model.add_camera_with_trivial_rig(VIEW.colmap_camera(1))
    image = pycolmap.Image(name="a", camera_id=1, image_id=1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D([30.0, 40.0])] * 4)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    for k, z in enumerate((2.0, 3.0, -2.0, 0.0)):
        model.add_point3D([0, 0, z], pycolmap.Track([pycolmap.TrackElement(1, k)]), np.zeros(3, np.uint8))
    ratios, num_behind = judge.point_ratios(model, model.image(1), truth)
    assert (ratios.tolist(), num_behind) == ([1.0, 1.5], 2)


def test_what_cannot_be_compared_has_no_figures() -> None:
    nothing = judge.figures("", np.empty(0), 7)
    assert nothing.coverage == 0
    assert math.isnan(nothing.abs_rel) and math.isnan(nothing.median_rel) and math.isnan(nothing.delta_105)
    assert judge.without_nan({"a": [math.nan, 1.0], "b": "x"}) == {"a": [None, 1.0], "b": "x"}


def test_one_scale_is_taken_of_all_pixels_together() -> None:
    small, large = (
        judge.Comparison(name=name, num_true=count, ratios=np.full(count, ratio), point_ratios=np.empty(0))
        for name, count, ratio in (("a", 10, 0.5), ("b", 30, 0.4))
    )
    assert judge.scale_of_depth([small, large]) == pytest.approx(2.5)
    with pytest.raises(InputError, match=r"no pixel of 1 images .* \(9 have\)"):
        judge.scale_of_depth([judge.Comparison(name="", num_true=9, ratios=np.empty(0), point_ratios=np.empty(0))])


# --------------------------------------------------------------------------- the script
def compose(c_from_b: FloatArray, b_from_a: FloatArray) -> FloatArray:
    """(3, 4) rigid."""
    return np.column_stack([c_from_b[:, :3] @ b_from_a[:, :3], c_from_b[:, :3] @ b_from_a[:, 3] + c_from_b[:, 3]])


def view_poses() -> dict[str, FloatArray]:
    """``cam_from_world`` in metres."""
    return dict(zip(NAMES, cameras_from_world(len(NAMES)), strict=True))


def write_data(folder: Path) -> Path:
    """What the nominal Kinect beside each view measures; ``d.jpg`` has no depth."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    lines = []
    for name, view_from_world in view_poses().items():
        sensor_from_world = compose(invert_rigid(judge.REGISTRATIONS["kinect"]), view_from_world)
        world_from_sensor = invert_rigid(sensor_from_world)
        x, y, z, w = Rotation.from_matrix(world_from_sensor[:, :3]).as_quat()
        lines.append(" ".join(map(str, (name, w, x, y, z, *world_from_sensor[:, 3]))))
        Image.fromarray(picture(VIEW, view_from_world)).save(folder / "images" / name)
        if name != "d.jpg":
            millimetres = np.rint(1000 * exact_depth(SENSOR, sensor_from_world)).astype(np.uint16)
            millimetres[:, :16] = 0
            Image.fromarray(millimetres).save(folder / "depth" / f"{name[:-4]}.png")
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    values = (SENSOR.width, SENSOR.height, *SENSOR.params)
    (folder / "intrinsics.txt").write_text(" ".join(map(str, values)), encoding="utf-8")
    return folder


def write_run(folder: Path, factors: Mapping[str, float], *, holes: int = 0) -> Path:
    """A dense workspace in units of ``UNIT_M``, each depth map wrong by its factor and empty in the first rows."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(VIEW.colmap_camera(1))
    seen: list[list[pycolmap.TrackElement]] = []
    places = []
    for number, (name, pose) in enumerate(view_poses().items(), start=1):
        in_units = np.column_stack([pose[:, :3], pose[:, 3] / UNIT_M])
        depth = exact_depth(VIEW, pose) / np.float32(UNIT_M)
        image = pycolmap.Image(name=name, camera_id=1, image_id=number)
        xy, points_world = some_points(depth, in_units)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(one) for one in xy])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(in_units))
        seen += [[pycolmap.TrackElement(number, k)] for k in range(len(xy))]
        places += list(points_world)
        if name in factors:
            depth[:holes] = 0
            write_map(folder / f"dense/stereo/depth_maps/{name}.geometric.bin", depth * np.float32(factors[name]))
    for place, elements in zip(places, seen, strict=True):
        model.add_point3D(place, pycolmap.Track(elements), np.zeros(3, np.uint8))
    (folder / "dense/sparse").mkdir(parents=True)
    model.write_binary(folder / "dense/sparse")
    return folder


def some_points(depth: FloatMap, cam_from_world: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pixel centres and (N, 3) what is seen there."""
    xy = pixel_centres(VIEW.width, VIEW.height)[::371]
    points_cam = VIEW.rays_cam(xy) * depth[xy[:, 1].astype(int), xy[:, 0].astype(int), None]
    return xy, (points_cam - cam_from_world[:, 3]) @ cam_from_world[:, :3]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("data"))


def test_exact_maps_are_right_but_for_the_edges(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, report = write_run(tmp_path / "run", dict.fromkeys(NAMES, 1.0), holes=45), tmp_path / "report.json"
    assert judge.main([str(run), str(data), "--json", str(report)]) == 0
    facts = json.loads(report.read_text())
    assert facts["scale_of_depth"] == pytest.approx(UNIT_M, rel=2e-3)
    assert facts["scale_of_cameras"] == pytest.approx(UNIT_M, rel=1e-4)
    overall, points = facts["overall"], facts["points"]
    assert 1e-5 < overall["median_rel"] < 5e-3
    assert overall["median_rel"] <= overall["abs_rel"] < 0.02
    assert 0.95 < overall["delta_105"] <= overall["delta_125"] <= 1
    # The sensor looks at rows 2 to 86, the map begins at row 45.
    assert overall["coverage"] == pytest.approx(41 / 84, abs=0.02)
    assert points["num_compared"] > 60
    assert points["coverage"] is None
    assert facts["num_behind"] == 0
    assert 0 < points["abs_rel"] < 0.02
    assert [one["what"] for one in facts["images"]] == ["a.jpg", "b.jpg", "c.jpg"]
    table = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in table[1:4]] == ["a.jpg", "b.jpg", "c.jpg"]
    assert len({len(line) for line in table[:-1]}) == 1
    assert table[-1].endswith("registration kinect")


def test_a_map_off_by_a_tenth_against_the_others_shows_as_a_tenth(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"a.jpg": 1.0, "b.jpg": 1.0, "c.jpg": 1.1})
    found = judge.judge(run, data, registration="kinect")
    assert found.scale_of_depth == pytest.approx(UNIT_M, rel=5e-3)
    medians = {one.what: one.median_rel for one in found.images}
    assert medians["c.jpg"] == pytest.approx(0.1, abs=0.01)
    assert max(medians["a.jpg"], medians["b.jpg"]) < 0.01
    assert found.overall.delta_105 == pytest.approx(2 / 3, abs=0.03)


def test_a_common_factor_goes_into_the_scale_of_depth_and_not_into_that_of_the_cameras(
    data: Path, tmp_path: Path
) -> None:
    run = write_run(tmp_path, dict.fromkeys(NAMES, 1.2))
    found = judge.judge(run, data, registration="kinect")
    assert found.scale_of_depth == pytest.approx(UNIT_M / 1.2, rel=5e-3)
    assert found.overall.abs_rel < 0.02
    assert found.scale_of_cameras == pytest.approx(UNIT_M, rel=1e-4)
    assert found.at_scale_of_cameras.median_rel == pytest.approx(0.2, abs=0.01)


def test_an_image_without_a_map_covers_nothing(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"a.jpg": 1.0, "b.jpg": 1.0})
    found = judge.judge(run, data, registration="kinect")
    assert [one.coverage > 0.99 for one in found.images] == [True, True, False]
    assert found.images[2].num_compared == 0
    assert found.overall.coverage == pytest.approx(2 / 3, abs=0.01)


def test_the_wrong_registration_is_worse(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, dict.fromkeys(NAMES, 1.0))
    right, wrong = (judge.judge(run, data, registration=name).overall for name in ("kinect", "none"))
    assert wrong.abs_rel > 1.3 * right.abs_rel


# ----------------------------------------------------------------------------- refusals
def test_a_run_without_a_workspace_is_refused_with_the_way_out(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert judge.main([str(tmp_path), str(data)]) == 2
    assert f"export {tmp_path} --format dense" in capsys.readouterr().err


def test_another_data_set_is_refused(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", {"d.jpg": 1.0})
    with pytest.raises(InputError, match="has no map of the 3 images"):
        judge.judge(run, data, registration="kinect")
    with pytest.raises(InputError, match="has none of the 4 images"):
        judge.judge(run, tmp_path, registration="kinect")


def test_broken_maps_are_refused_by_name(data: Path, tmp_path: Path) -> None:
    run = write_run(tmp_path, {"b.jpg": 1.0})
    path = run / "dense/stereo/depth_maps/b.jpg.geometric.bin"
    whole = path.read_bytes()
    path.write_bytes(whole[:-4])
    with pytest.raises(InputError, match=rf"b.jpg.* {len(whole) - 4} bytes, needed {len(whole)}"):
        judge.judge(run, data, registration="kinect")
    write_map(path, np.ones((20, 30), np.float32))
    with pytest.raises(InputError, match=r"b.jpg.* of 30 x 20 pixels, its camera has 120 x 90"):
        judge.judge(run, data, registration="kinect")

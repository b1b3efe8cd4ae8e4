"""Depth maps of a run's dense workspace against a depth sensor, after one scale for the whole model.

    python scripts/judge_depth_maps.py OUT ../shared/data/kitchen_rgbd

OUT is a finished run with ``dense/`` (``smust3r-colmap export OUT --format dense`` writes it), and the data set has
``depth/*.png`` (16 bits, millimetres), ``poses.txt`` and ``intrinsics.txt`` of its sensor. The readings of the sensor
are points; they are moved to the colour camera and drawn into the pixels of the undistorted view, of several in a
pixel the nearest. There they are compared with the maps as they were written, without blending either.

The scale is the median of sensor over map, of all pixels of all images together. The cameras give one, too: that of
the similarity from the model to the sensor's path. The line below that of all images takes it. The last line is of the
model's own points, which were triangulated and not swept: what they are off is to a large part the sensor, its
registration, and edges, on which many of them lie.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from benchmark_plane_sweep import COLOUR_FROM_SENSOR

from smust3r_colmap.errors import InputError, SmustrError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.synthetic.truth import TrueScene, z_buffer

FloatMap = npt.NDArray[np.float32]

REGISTRATIONS = {"kinect": COLOUR_FROM_SENSOR, "none": np.eye(3, 4)}
"""``view_from_sensor``: the nominal Kinect's, or the colour camera is where the sensor is and looks the same way."""
READINGS_PER_PIXEL = 1.5
"""Along each axis, at least: fewer would leave holes in a surface, through which the one behind it is seen."""
NO_LIMIT_PX = 1 << 20
"""The sensor's maps are taken at their own size."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """What one image's map, and the points that it observes, have against the sensor.

    Args:
        name: of the image.
        num_true: pixels with a reading of the sensor.
        ratios: (P,) depth of the map over that of the sensor, at the pixels that have both.
        point_ratios: (Q,) the same of the sparse points, of those before the camera.
        num_behind: points that the image observes and that lie behind it, where no depth is right.
    """

    name: str
    num_true: int
    ratios: FloatArray
    point_ratios: FloatArray
    num_behind: int = 0


@dataclass(frozen=True, kw_only=True)
class Figures:
    """How good depth is; NaN where nothing could be compared.

    Args:
        what: an image, or what all of them are taken for.
        num_compared: pixels, or points.
        abs_rel: mean of abs(d - t) / t, with t the sensor's depth and d ours.
        median_rel: median of the same.
        delta_105, delta_125: share with max(d / t, t / d) below 1.05 and 1.25.
        coverage: share of the pixels with a reading that have depth of ours, too; NaN for points.
    """

    what: str
    num_compared: int
    abs_rel: float
    median_rel: float
    delta_105: float
    delta_125: float
    coverage: float


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """All figures of one run.

    Args:
        registration: between sensor and colour camera.
        scale_of_depth, scale_of_cameras: metres per unit of the model.
        overall: at the scale of depth. at_scale_of_cameras: at the other. points: of sparse points, at that of depth.
        num_behind: observed points that lie behind their camera and are in no figure.
        images: each image at the scale of depth.
    """

    registration: str
    scale_of_depth: float
    scale_of_cameras: float
    overall: Figures
    at_scale_of_cameras: Figures
    points: Figures
    num_behind: int
    images: tuple[Figures, ...]


def main(words: Sequence[str] | None = None) -> int:
    """Judge the run named on the command line; the exit code is 2 when it cannot be."""
    arguments = parse_arguments(words)
    try:
        judgement = judge(arguments.run, arguments.data, registration=arguments.registration)
    except SmustrError as error:
        print(error, file=sys.stderr)
        return 2
    print(render_table(judgement))
    if arguments.json:
        arguments.json.write_text(json.dumps(without_nan(asdict(judgement)), indent=1), encoding="utf-8")
    return 0


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output folder of smust3r-colmap with dense/")
    parser.add_argument("data", type=Path, help="data set with depth/, poses.txt and intrinsics.txt of the sensor")
    parser.add_argument(
        "--registration",
        choices=sorted(REGISTRATIONS),
        default="kinect",
        help="where the colour camera is, seen from the sensor (%(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, too")
    return parser.parse_args(words)


def judge(run: Path, data: Path, *, registration: str) -> Judgement:
    """Compare a run with the sensor.

    Raises:
        InputError: the run has no dense workspace, none of its images has a reading, or a file is not as it should be.
        DegenerateAlignmentError: fewer than three images have a pose in both, or the sensor stood still.
    """
    workspace = run / "dense"
    model = read_workspace(workspace)
    view_from_sensor = REGISTRATIONS[registration]
    comparisons = tuple(compare(workspace, model, data, view_from_sensor))
    scale = scale_of_depth(comparisons)
    scale_of_cameras = similarity_scale(workspace / "sparse", data, view_from_sensor)
    return Judgement(
        registration=registration,
        scale_of_depth=scale,
        scale_of_cameras=scale_of_cameras,
        overall=pooled("all images", comparisons, scale),
        at_scale_of_cameras=pooled("at the cameras' scale", comparisons, scale_of_cameras),
        points=figures("sparse points", np.concatenate([one.point_ratios for one in comparisons]) * scale, None),
        num_behind=sum(one.num_behind for one in comparisons),
        images=tuple(pooled(one.name, [one], scale) for one in comparisons),
    )


# ------------------------------------------------------------------------------ reading
def read_workspace(workspace: Path) -> pycolmap.Reconstruction:
    """The undistorted model of a dense workspace.

    Raises:
        InputError: there is none.
    """
    try:
        return pycolmap.Reconstruction(workspace / "sparse")
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(
            f"{workspace}: no dense workspace; write it with smust3r-colmap export {workspace.parent} --format dense"
        ) from error


def read_depth_map(path: Path, camera: Intrinsics) -> FloatMap | None:
    """(H, W) z-depth in the unit of the model, 0 for none; None where the image has no map.

    Raises:
        InputError: the map is cut short, or of another size than the camera.
    """
    if not path.is_file():
        return None
    with path.open("rb") as file:
        size = file.read(64).split(b"&")[:3]
    if size != [str(number).encode() for number in (camera.width, camera.height, 1)]:
        found = b" x ".join(size[:2]).decode(errors="replace")
        raise InputError(f"{path}: is a map of {found} pixels, its camera has {camera.width} x {camera.height}")
    needed = sum(len(number) + 1 for number in size) + 4 * camera.width * camera.height
    if path.stat().st_size != needed:
        raise InputError(f"{path}: {path.stat().st_size} bytes, needed {needed}; write the workspace again")
    stored = pycolmap.DepthMap()
    stored.read(path)
    depth: FloatMap = stored.to_array()
    return depth


def similarity_scale(sparse: Path, data: Path, view_from_sensor: FloatArray) -> float:
    """Metres per unit of the model, from the places of the cameras."""
    sensor_from_view = np.vstack([invert_rigid(view_from_sensor), [0.0, 0.0, 0.0, 1.0]])
    truth = {name: pose @ sensor_from_view for name, pose in read_poses_txt(data / "poses.txt").items()}
    similarity = compare_trajectories(read_model_poses(sparse), truth).reference_from_estimated
    return float(similarity.scale)


# --------------------------------------------------------------------------- comparison
def compare(
    workspace: Path, model: pycolmap.Reconstruction, data: Path, view_from_sensor: FloatArray
) -> Iterator[Comparison]:
    """All images that have a map and a reading of the sensor, in the order of their names.

    Raises:
        InputError: there are none, or a file is not as it should be.
    """
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: str(image.name))
    seen = [image for image in images if (data / "depth" / Path(image.name).with_suffix(".png").name).is_file()]
    if not seen:
        raise InputError(f"{data / 'depth'}: has none of the {len(images)} images of {workspace}; is it the same set?")
    sensor = TrueScene.from_rgbd_folder(data, [image.name for image in seen], max_size=NO_LIMIT_PX)
    num_maps = 0
    for k, image in enumerate(seen):
        camera = Intrinsics.from_colmap(model.camera(image.camera_id))
        depth = read_depth_map(workspace / f"stereo/depth_maps/{image.name}.geometric.bin", camera)
        if depth is None:
            depth = np.zeros((camera.height, camera.width), np.float32)  # which counts as nothing covered
        else:
            num_maps += 1
        truth = depth_in_view(sensor.depth(k), sensor.intrinsics, view_from_sensor, camera)
        ratios_of_points, num_behind = point_ratios(model, image, truth)
        yield Comparison(
            name=image.name,
            num_true=int((truth > 0).sum()),
            ratios=map_ratios(depth, truth),
            point_ratios=ratios_of_points,
            num_behind=num_behind,
        )
    if not num_maps:
        raise InputError(f"{workspace / 'stereo/depth_maps'}: has no map of the {len(seen)} images with a reading")


def depth_in_view(depth: FloatMap, sensor: Intrinsics, view_from_sensor: FloatArray, view: Intrinsics) -> FloatMap:
    """(H, W) what a sensor measured, as a camera beside it sees it; 0 where there is no reading.

    Args:
        depth: (h, w) z-depth of the sensor, 0 for none.
        sensor: of an image of w x h pixels.
        view_from_sensor: (3, 4) rigid, in the unit of the depth.
        view: the camera, of H x W pixels.
    """
    repeats = math.ceil(READINGS_PER_PIXEL * max(view.width / sensor.width, view.height / sensor.height))
    dense = np.repeat(np.repeat(depth, repeats, axis=0), repeats, axis=1).ravel()
    read = dense > 0
    rays = sensor.resized(sensor.width * repeats, sensor.height * repeats).rays_cam(
        pixel_centres(sensor.width * repeats, sensor.height * repeats)
    )
    points_sensor = rays[read] * dense[read, None]
    return z_buffer(points_sensor @ view_from_sensor[:, :3].T + view_from_sensor[:, 3], view)


def map_ratios(depth: FloatMap, truth: FloatMap) -> FloatArray:
    """(P,) of two maps (H, W), at the pixels where both have depth."""
    both = (depth > 0) & (truth > 0)
    ratios: FloatArray = depth[both].astype(np.float64) / truth[both]
    return ratios


def point_ratios(model: pycolmap.Reconstruction, image: pycolmap.Image, truth: FloatMap) -> tuple[FloatArray, int]:
    """(Q,) depth of the points that an image observes, over the truth (H, W) in their pixel, where there is any.

    Points that are not before the camera are left out and counted: their ratio means nothing.
    """
    observed = [(*point.xy, *model.point3D(point.point3D_id).xyz) for point in image.points2D if point.has_point3D()]
    table = np.array(observed, dtype=np.float64).reshape(-1, 5)
    cam_from_world = np.asarray(image.cam_from_world().matrix())
    z = table[:, 2:] @ cam_from_world[2, :3] + cam_from_world[2, 3]
    columns, rows = np.floor(table[:, :2]).astype(int).T
    height, width = truth.shape
    inside = (z > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    there = truth[rows[inside], columns[inside]].astype(np.float64)
    ratios: FloatArray = z[inside][there > 0] / there[there > 0]
    return ratios, int((z <= 0).sum())


def scale_of_depth(comparisons: Sequence[Comparison]) -> float:
    """Metres per unit of the model by which the median of all ratios becomes 1.

    Raises:
        InputError: no pixel has both depths.
    """
    ratios = np.concatenate([one.ratios for one in comparisons])
    if not len(ratios):
        num_true = sum(one.num_true for one in comparisons)
        raise InputError(f"no pixel of {len(comparisons)} images has depth of ours and of the sensor ({num_true} have)")
    return float(1 / np.median(ratios))


def pooled(what: str, comparisons: Sequence[Comparison], scale: float) -> Figures:
    """The pixels of several images as one."""
    ratios = np.concatenate([one.ratios for one in comparisons])
    return figures(what, ratios * scale, sum(one.num_true for one in comparisons))


def figures(what: str, ratios: FloatArray, num_true: int | None) -> Figures:
    """Of ratios (P,) above 0, after the scale, 1 where depth is right; ``num_true`` None for no coverage.

    Source: Eigen et al. 2014, section 4.2, for the measures of depth; 1.05 and 1.25 are thresholds of their delta.
    """
    errors = np.abs(ratios - 1)
    factors = np.maximum(ratios, 1 / ratios)
    return Figures(
        what=what,
        num_compared=len(ratios),
        abs_rel=mean_of(errors),
        median_rel=float(np.median(errors)) if len(errors) else math.nan,
        delta_105=mean_of(factors < 1.05),
        delta_125=mean_of(factors < 1.25),
        coverage=len(ratios) / num_true if num_true else math.nan,
    )


def mean_of(values: npt.NDArray[np.float64] | npt.NDArray[np.bool_]) -> float:
    """NaN of none."""
    return float(values.mean()) if len(values) else math.nan


# ------------------------------------------------------------------------------- output
def render_table(judgement: Judgement) -> str:
    """One line per image, then all of them."""
    header = ["", "compared", "abs-rel", "median", "d < 1.05", "d < 1.25", "coverage"]
    rows = [*judgement.images, judgement.overall, judgement.at_scale_of_cameras, judgement.points]
    lines = [
        [
            one.what,
            str(one.num_compared),
            *(cell(value) for value in (one.abs_rel, one.median_rel, one.delta_105, one.delta_125, one.coverage)),
        ]
        for one in rows
    ]
    widths = [max(map(len, column)) for column in zip(header, *lines, strict=True)]
    table = [
        "  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in (header, *lines)
    ]
    scales = (
        f"metres per unit of the model: {judgement.scale_of_depth:.5g} by depth, "
        f"{judgement.scale_of_cameras:.5g} by the cameras; registration {judgement.registration}"
    )
    behind = [f"{judgement.num_behind} observed points lie behind their camera and are in no figure"]
    return "\n".join([*table, *(behind if judgement.num_behind else []), scales])


def cell(share: float) -> str:
    """A share in percent; nothing for none."""
    return "" if math.isnan(share) else f"{share:.2%}"


def without_nan(value: object) -> object:
    """The same facts with None for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(one) for one in value]
    return None if isinstance(value, float) and math.isnan(value) else value


if __name__ == "__main__":
    sys.exit(main())

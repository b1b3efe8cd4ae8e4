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
import pycolmap

from smust3r_colmap.config import DepthRegistration
from smust3r_colmap.errors import InputError, SmustrError
from smust3r_colmap.evaluation.depth_error import VIEW_FROM_SENSOR, DepthErrors, depth_in_view, map_ratios
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.geometry.arrays import Float32Array, FloatArray
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.importers.workspace_depth import DenseWorkspace
from smust3r_colmap.synthetic.truth import TrueScene

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
    overall: DepthErrors
    at_scale_of_cameras: DepthErrors
    points: DepthErrors
    num_behind: int
    images: tuple[DepthErrors, ...]


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
        choices=sorted(VIEW_FROM_SENSOR),
        default="kinect",
        help="where the colour camera is, seen from the sensor (%(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, too")
    return parser.parse_args(words)


def judge(run: Path, data: Path, *, registration: DepthRegistration) -> Judgement:
    """Compare a run with the sensor.

    Raises:
        InputError: the run has no dense workspace, none of its images has a reading, or a file is not as it should be.
        DegenerateAlignmentError: fewer than three images have a pose in both, or the sensor stood still.
    """
    workspace = DenseWorkspace.open(run / "dense")
    view_from_sensor = VIEW_FROM_SENSOR[registration]
    comparisons = tuple(compare(workspace, data, view_from_sensor))
    scale = scale_of_depth(comparisons)
    scale_of_cameras = similarity_scale(workspace.folder / "sparse", data, view_from_sensor)
    return Judgement(
        registration=registration,
        scale_of_depth=scale,
        scale_of_cameras=scale_of_cameras,
        overall=pooled("all images", comparisons, scale),
        at_scale_of_cameras=pooled("at the cameras' scale", comparisons, scale_of_cameras),
        points=DepthErrors.of("sparse points", np.concatenate([one.point_ratios for one in comparisons]) * scale, None),
        num_behind=sum(one.num_behind for one in comparisons),
        images=tuple(pooled(one.name, [one], scale) for one in comparisons),
    )


# ------------------------------------------------------------------------------ reading
def similarity_scale(sparse: Path, data: Path, view_from_sensor: FloatArray) -> float:
    """Metres per unit of the model, from the places of the cameras."""
    sensor_from_view = np.vstack([invert_rigid(view_from_sensor), [0.0, 0.0, 0.0, 1.0]])
    truth = {name: pose @ sensor_from_view for name, pose in read_poses_txt(data / "poses.txt").items()}
    similarity = compare_trajectories(read_model_poses(sparse), truth).reference_from_estimated
    return float(similarity.scale)


# --------------------------------------------------------------------------- comparison
def compare(workspace: DenseWorkspace, data: Path, view_from_sensor: FloatArray) -> Iterator[Comparison]:
    """All images that have a map and a reading of the sensor, in the order of their names.

    Raises:
        InputError: there are none, or a file is not as it should be.
    """
    model = workspace.model
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: str(image.name))
    seen = [image for image in images if (data / "depth" / Path(image.name).with_suffix(".png").name).is_file()]
    if not seen:
        raise InputError(
            f"{data / 'depth'}: has none of the {len(images)} images of {workspace.folder}; is it the same set?"
        )
    sensor = TrueScene.from_rgbd_folder(data, [image.name for image in seen], max_size=NO_LIMIT_PX)
    num_maps = 0
    for k, image in enumerate(seen):
        camera = workspace.camera(image.name)
        depth = workspace.depth(image.name)
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
        raise InputError(
            f"{workspace.folder / 'stereo/depth_maps'}: has no map of the {len(seen)} images with a reading"
        )


def point_ratios(model: pycolmap.Reconstruction, image: pycolmap.Image, truth: Float32Array) -> tuple[FloatArray, int]:
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


def pooled(what: str, comparisons: Sequence[Comparison], scale: float) -> DepthErrors:
    """The pixels of several images as one."""
    ratios = np.concatenate([one.ratios for one in comparisons])
    return DepthErrors.of(what, ratios * scale, sum(one.num_true for one in comparisons))


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

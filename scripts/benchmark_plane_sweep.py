"""Speed and accuracy of the plane sweep on real images.

    python scripts/benchmark_plane_sweep.py --data FOLDER --set kitchen_rgbd --size 288
    python scripts/benchmark_plane_sweep.py --data FOLDER --set fox --size 512

Maps a short stretch of the set with pycolmap (one thread), sweeps it and prints, for rising cuts of
the confidence, the share of pixels that are left and their error. The judge of ``kitchen_rgbd`` is the
depth sensor, after one scale for the whole stretch: its maps are carried into the colour camera
(nominal Kinect calibration, colour focal length as mapped). With ``fox`` it is the sparse points, which
are more exact than any pixel of a depth map but lie on texture only.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from smust3r_colmap.backbones.classical.plane_sweep import ImageDepth, reconstruct_depth
from smust3r_colmap.evaluation.depth_error import KINECT_COLOUR_FROM_SENSOR
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.products import Tracks

MAX_FEATURES = 4096
MATCH_NEIGHBOURS = 8
CONFIDENCE_CUTS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0)

SENSOR_FOCAL_PX = 585.0  # of the 640x480 depth images, as shipped with the set
COLOUR_FOCAL_PX = 525.0  # where the mapper starts


@dataclass(frozen=True, kw_only=True, eq=False)
class Stretch:
    """A mapped stretch of images, as ``reconstruct_depth`` wants it."""

    paths: tuple[Path, ...]
    seg_from_cam: FloatArray
    intrinsics: tuple[Intrinsics, ...]
    tracks: Tracks


def map_images(paths: list[Path], camera: Intrinsics | None) -> Stretch:
    """Features, matches and the largest incremental model of some images, one thread."""
    names = [path.name for path in paths]
    folder = paths[0].parent
    with tempfile.TemporaryDirectory() as scratch:
        database = Path(scratch) / "database.db"
        pycolmap.Database.open(str(database)).close()
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if camera is not None:
            reader.camera_params = ",".join(str(value) for value in camera.params)
        single = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, folder, single, image_names=names, options=reader)
        extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False, max_image_size=1024)
        extraction.sift.max_num_features = MAX_FEATURES
        pycolmap.extract_features(database, folder, names, single, reader, extraction)
        pairing = pycolmap.SequentialPairingOptions(overlap=MATCH_NEIGHBOURS, quadratic_overlap=False)
        matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
        mapper = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
        models = pycolmap.incremental_mapping(database, folder, scratch, mapper)
    if not models:
        raise SystemExit(f"{folder}: no model of {names[0]} to {names[-1]}")
    return stretch_of(max(models.values(), key=lambda model: model.num_reg_images()), folder)


def stretch_of(model: pycolmap.Reconstruction, folder: Path) -> Stretch:
    """The images and points of a model; images are numbered by their order of name."""
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: str(image.name))
    position = {image.image_id: k for k, image in enumerate(images)}
    elements = [(row, e) for row, point in enumerate(model.points3D.values()) for e in point.track.elements]
    return Stretch(
        paths=tuple(folder / image.name for image in images),
        seg_from_cam=np.array([image.cam_from_world().inverse().matrix() for image in images]),
        intrinsics=tuple(Intrinsics.from_colmap(model.cameras[image.camera_id]) for image in images),
        tracks=Tracks(
            points_seg=np.array([point.xyz for point in model.points3D.values()]),
            point_of_observation=np.array([row for row, _ in elements], dtype=np.int64),
            image_of_observation=np.array([position[e.image_id] for _, e in elements], dtype=np.int64),
            feature_of_observation=np.array([e.point2D_idx for _, e in elements], dtype=np.int64),
        ),
    )


def sweep(stretch: Stretch, size: int, planes: int) -> tuple[list[ImageDepth], float]:
    """All depth maps, and CPU seconds per image without reading the files."""
    loaded = [np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR_RGB), dtype=np.uint8) for path in stretch.paths]
    started = time.process_time()
    maps = list(
        reconstruct_depth(
            loaded.__getitem__,
            images=range(len(loaded)),
            seg_from_cam=stretch.seg_from_cam,
            intrinsics=stretch.intrinsics,
            tracks=stretch.tracks,
            dense_size=size,
            planes=planes,
        )
    )
    return maps, (time.process_time() - started) / len(loaded)


def sensor_depth(stretch: Stretch, k: int, width: int, height: int) -> FloatArray | None:
    """(height, width) metres in the colour image's own (distorted) pixels, 0 for none; nearest wins."""
    path = stretch.paths[k].parents[1] / "depth" / f"{stretch.paths[k].stem}.png"
    if not path.exists():
        return None
    sensor = np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), dtype=np.float64) / 1000.0
    xy = pixel_centres(640, 480) - (320.0, 240.0)
    points_sensor = np.column_stack([xy / SENSOR_FOCAL_PX, np.ones(len(xy))]) * sensor.reshape(-1, 1)
    points_sensor = points_sensor[(sensor.ravel() > 0) & (sensor.ravel() < 8.0)]  # beyond 8 m: no reading
    points = points_sensor @ KINECT_COLOUR_FROM_SENSOR[:, :3].T + KINECT_COLOUR_FROM_SENSOR[:, 3]
    columns, rows = np.floor(stretch.intrinsics[k].resized(width, height).xy_img(points)).astype(int).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    depth = np.full((height, width), np.inf)
    np.minimum.at(depth, (rows[inside], columns[inside]), points[inside, 2])
    return np.where(np.isfinite(depth), depth, 0.0)


def samples_against_sensor(stretch: Stretch, maps: list[ImageDepth]) -> tuple[FloatArray, FloatArray]:
    """(S, 3) found depth, true depth, confidence of all pixels with truth, after one scale."""
    rows = []
    for k, found in enumerate(maps):
        truth = sensor_depth(stretch, k, found.depth.shape[1], found.depth.shape[0])
        if truth is not None:
            seen = truth > 0
            rows.append(np.column_stack([found.depth[seen], truth[seen], found.confidence[seen]]))
    samples = np.concatenate(rows)
    sure = (samples[:, 0] > 0) & (samples[:, 2] >= 2.0)
    samples[:, 0] *= np.median(samples[sure, 1] / samples[sure, 0])
    return samples, samples


def samples_against_points(stretch: Stretch, maps: list[ImageDepth]) -> tuple[FloatArray, FloatArray]:
    """(S, 3) found depth, depth of the sparse point, confidence, at every observation; and of all pixels."""
    rows, pixels = [], []
    tracks = stretch.tracks
    for k, found in enumerate(maps):
        height, width = found.depth.shape
        points_seg = tracks.points_seg[tracks.point_of_observation[tracks.image_of_observation == k]]
        pose = stretch.seg_from_cam[k]
        points_cam = (points_seg - pose[:, 3]) @ pose[:, :3]
        xy = stretch.intrinsics[k].resized(width, height).xy_img(points_cam)
        column, row = np.clip(np.floor(xy).astype(int), 0, (width - 1, height - 1)).T
        rows.append(np.column_stack([found.depth[row, column], points_cam[:, 2], found.confidence[row, column]]))
        pixels.append(np.column_stack([found.depth.ravel(), found.depth.ravel(), found.confidence.ravel()]))
    return np.concatenate(rows), np.concatenate(pixels)


def report(samples: FloatArray, pixels: FloatArray, within: float) -> None:
    """Coverage over ``pixels`` and error over ``samples``, at rising cuts of the confidence."""
    print(f"{'confidence':>10} {'coverage':>9} {'median':>8} {'mean':>8} {'within ' + format(within, '.0%'):>10}")
    for cut in CONFIDENCE_CUTS:
        kept = samples[(samples[:, 0] > 0) & (samples[:, 2] >= cut)]
        coverage = ((pixels[:, 0] > 0) & (pixels[:, 2] >= cut)).mean()
        if len(kept):
            error = np.abs(kept[:, 0] / kept[:, 1] - 1.0)
            share = (error < within).mean()
            print(f"{cut:>10} {coverage:>9.1%} {np.median(error):>8.2%} {error.mean():>8.2%} {share:>10.1%}")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the image sets")
    parser.add_argument("--set", choices=["kitchen_rgbd", "fox"], default="kitchen_rgbd")
    parser.add_argument("--size", type=int, default=384, help="longer side of the maps")
    parser.add_argument("--planes", type=int, default=64)
    parser.add_argument("--images", type=int, default=0, help="length of the stretch; 0: 30 of kitchen, 12 of fox")
    parser.add_argument("--model", type=Path, help="a mapped stretch instead of mapping one")
    options = parser.parse_args()

    paths = sorted((options.data / options.set / "images").glob("*.jpg"))
    camera, judge, within = None, samples_against_points, 0.03
    if options.set == "kitchen_rgbd":
        paths = paths[::5]
        camera = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(COLOUR_FOCAL_PX, 320, 240, 0))
        judge, within = samples_against_sensor, 0.05
    paths = paths[: options.images or (30 if options.set == "kitchen_rgbd" else 12)]
    if options.model:
        stretch = stretch_of(pycolmap.Reconstruction(options.model), paths[0].parent)
    else:
        stretch = map_images(paths, camera)
    maps, seconds = sweep(stretch, options.size, options.planes)
    height, width = maps[0].depth.shape
    print(f"{options.set}: {len(maps)} of {len(paths)} images, {width}x{height}, {seconds:.3f} CPU s per image")
    report(*judge(stretch, maps), within)


if __name__ == "__main__":
    main()

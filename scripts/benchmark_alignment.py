"""How exact and how dear is the alignment of two segments? A synthetic room, beside peers' figures.

A pinhole camera moves through a room of 6 x 3 x 4 m and two segments share its images. Both have
depth noise along the ray (1 % unless said otherwise), and the target has outliers: blobs of 32 x 32
pixels that are 30 to 100 % too deep and as confident as the rest, or points anywhere in the room. The
source segment lives in another Sim(3) gauge (scale 1.7, 35 degrees).

Sections:
    similarity  Sim(3), beside VGGT-Long's chunk alignment (its numba path: all pixels, float32, Huber
                0.1, 5 iterations)
    groups      all four groups on the whole overlap with 30 % blobs: time and memory
    sl4         SL(4) on points of the overlap, beside VGGT-SLAM's solver (300 samples of 5, no refit)
    affine3     Affine(3) on the same; no peer was measured

The peers were measured on data made by the same description, but in another run. ``rot``, ``scale``
and ``anisotropy`` are of the error's affine part at the corner of the room, where a projective one
is larger than in the middle.

    OMP_NUM_THREADS=1 python scripts/benchmark_alignment.py
    python scripts/benchmark_alignment.py --only sl4 --seeds 5
    python scripts/benchmark_alignment.py --images 8 --height 96 --width 128 --seed 3
"""

from __future__ import annotations

import argparse
import logging
import resource
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.from_pointmaps import NUM_PIXELS, align_pointmaps
from smust3r_colmap.alignment.seen_points import SubmodelFit, align_seen_points
from smust3r_colmap.estimators.confidence import ConfidenceWeighting
from smust3r_colmap.estimators.robust import RobustKernel, RobustLoss
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.groups import TransformGroup
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import Submodel

Outliers = Literal["none", "blob", "random"]

ROOM_M = np.array([6.0, 3.0, 4.0])
DEPTH_NOISE = 0.01
BLOB_PX = 32
SOURCE_FROM_TARGET = Sim3(
    scale=np.array(1.7),
    rotation=Rotation.from_rotvec(np.deg2rad(35) * np.array([0.6, 0.64, 0.48])).as_matrix(),
    translation=np.array([1.0, -2.0, 3.0]),
)
FAR_AWAY_M = 1000.0
"""Per axis: 1.7 km from the origin."""


@dataclass(frozen=True, kw_only=True)
class Overlap:
    """What both segments see, and the peer's cpu s, rot deg, scale %, map cm on it at 30 x 384 x 512."""

    label: str
    outliers: Outliers
    share: float
    unit: float = 1.0
    far_m: float = 0.0
    peer: tuple[float, float, float, float]


BLOB_30 = Overlap(label="blob 30 %", outliers="blob", share=0.3, peer=(19.0, 0.10, 3.3, 8.2))
OVERLAPS = (
    Overlap(label="no outliers", outliers="none", share=0.0, peer=(17.5, 0.013, 0.03, 0.08)),
    Overlap(label="blob 10 %", outliers="blob", share=0.1, peer=(18.3, 0.02, 0.59, 1.2)),
    BLOB_30,
    Overlap(label="random 30 %", outliers="random", share=0.3, peer=(18.2, 0.02, 1.0, 2.5)),
    replace(BLOB_30, label="blob 30 %, scene x0.1", unit=0.1, peer=(17.4, 0.64, 17.0, 52.0)),
    replace(BLOB_30, label="blob 30 %, scene x100", unit=100.0, peer=(17.8, 0.11, 3.1, 7.7)),
    replace(BLOB_30, label="blob 30 %, 1.7 km away", far_m=FAR_AWAY_M, peer=(18.8, 0.9, 9.8, 28.0)),
)


@dataclass(frozen=True)
class Method:
    """How pointmaps are aligned."""

    kernel: RobustKernel = "cauchy"
    weighting: ConfidenceWeighting = "off"


DEFAULT = Method(weighting="relative")
CAUCHY_ALONE = Method()
TUKEY_ALONE = Method(kernel="tukey")
PAPER_HUBER = Method(kernel="huber")
CASES = (
    *(("default", overlap, DEFAULT) for overlap in OVERLAPS),
    ("cauchy alone", BLOB_30, CAUCHY_ALONE),
    ("tukey alone", BLOB_30, TUKEY_ALONE),
    *(("paper's huber", overlap, PAPER_HUBER) for overlap in OVERLAPS),
)


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Some points of the overlap, and the peer's figures on such: see `peer_columns`."""

    label: str
    count: int
    noise: float
    outliers: Outliers = "none"
    share: float = 0.0
    unit: float = 1.0
    one_wall: bool = False
    peer: tuple[float, ...] = ()


CLOUDS = (
    Cloud(label="20 k, exact", count=20_000, noise=0.0, peer=(0.9, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
    Cloud(label="2 k, 0.2 %", count=2000, noise=0.002, peer=(0.13, 0.36, 0.44, 0.08, 0.31, 0.1, 1.006)),
    Cloud(label="20 k, 0.2 %", count=20_000, noise=0.002, peer=(1.0, 0.40, 0.53, 0.13, 0.37, 0.2, 1.006)),
    Cloud(
        label="20 k, 0.2 %, 30 % blobs",
        count=20_000,
        noise=0.002,
        outliers="blob",
        share=0.3,
        peer=(1.0, 0.57, 0.96, 0.5, 4.2, 0.4, 1.02),
    ),
    Cloud(
        label="2 k, 1 %, 30 % blobs",
        count=2000,
        noise=0.01,
        outliers="blob",
        share=0.3,
        peer=(0.13, 2.2, 3.1, 0.8, 6.4, 0.7, 1.05),
    ),
    Cloud(label="20 k, 1 %", count=20_000, noise=0.01, peer=(0.9, 2.2, 3.3, 1.8, 5.2, 0.8, 1.08)),
    Cloud(
        label="20 k, 1 %, 30 % blobs",
        count=20_000,
        noise=0.01,
        outliers="blob",
        share=0.3,
        peer=(0.9, 3.3, 5.0, 2.6, 7.2, 1.4, 1.11),
    ),
    Cloud(label="20 k, 1 %, 30 % random", count=20_000, noise=0.01, outliers="random", share=0.3),
    Cloud(
        label="150 k, 1 %, 30 % blobs",
        count=150_000,
        noise=0.01,
        outliers="blob",
        share=0.3,
        peer=(6.9, 2.7, 4.7, 3.0, 13.0, 2.8, 1.13),
    ),
    Cloud(
        label="600 k, 1 %, 30 % blobs",
        count=600_000,
        noise=0.01,
        outliers="blob",
        share=0.3,
        peer=(28.0, 3.2, 5.2, 4.1, 17.0, 4.0, 1.20),
    ),
    Cloud(
        label="20 k, scene x10, 1 %, 30 % blobs",
        count=20_000,
        noise=0.01,
        outliers="blob",
        share=0.3,
        unit=10.0,
        peer=(0.9, 3.8, 8.0, 7.2, 12.0, 2.8, 1.36),
    ),
    Cloud(
        label="one wall, 16 k, 0.2 %",
        count=16_000,
        noise=0.002,
        one_wall=True,
        peer=(0.8, 1.2, 17.0, 30.0, 85.0, 27.0, 7.7),
    ),
    Cloud(
        label="one wall, 16 k, 1 %",
        count=16_000,
        noise=0.01,
        one_wall=True,
        peer=(0.7, 7.3, 18.0, 30.0, 62.0, 20.0, 4.2),
    ),
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """What one alignment cost and how far it is off, in metres of the room."""

    cpu_s: float
    rotation_deg: float
    scale_percent: float
    anisotropy: float
    map_cm: float
    relative_residual: float
    fallback: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """The exact scene: cameras and z-depths.

    Args:
        camera: pinhole. room_from_cam: (N, 3, 4). rays_room: (N, H, W, 3) with z_cam = 1. depth_m: (N, H, W).
    """

    camera: Intrinsics
    room_from_cam: FloatArray
    rays_room: FloatArray
    depth_m: FloatArray


@dataclass(frozen=True, kw_only=True, eq=False)
class MapsInMemory:
    """`DenseMaps` of one submodel."""

    points_seg: npt.NDArray[np.float32]
    depth_seg: npt.NDArray[np.float32]
    equal_confidence: npt.NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.depth_seg)

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) points."""
        pointmap: npt.NDArray[np.float32] = self.points_seg[k]
        return pointmap

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W) z-depth."""
        depth: npt.NDArray[np.float32] = self.depth_seg[k]
        return depth

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        """(H, W), the same everywhere: nothing gives the outliers away."""
        return self.equal_confidence

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        """(H, W, 3) black."""
        return np.zeros(self.points_seg[k].shape, dtype=np.uint8)


def walk_through_room(num_images: int, height: int, width: int) -> Room:
    """A camera that walks along the room and turns by 100 degrees."""
    camera = Intrinsics(
        model="PINHOLE", width=width, height=height, params=(0.9 * width, 0.9 * width, width / 2, height / 2)
    )
    along = np.linspace(0, 1, num_images)
    centres = np.column_stack([1.5 + 3.0 * along, 1.5 + 0.2 * np.sin(6 * along), 1.2 + 0.6 * along])
    turns = Rotation.from_rotvec(np.deg2rad(-50 + 100 * along)[:, None] * [0, 1, 0]).as_matrix()
    rays_cam = camera.rays_cam(pixel_centres(width, height))
    rays_room = np.einsum("nij,pj->npi", turns, rays_cam).reshape(num_images, height, width, 3)
    wall_m = np.where(rays_room > 0, ROOM_M, 0.0)
    depth_m = ((wall_m - centres[:, None, None]) / rays_room).min(axis=3)
    return Room(
        camera=camera,
        room_from_cam=np.concatenate([turns, centres[:, :, None]], axis=2),
        rays_room=rays_room,
        depth_m=depth_m,
    )


def segment_points(
    room: Room, outliers: Outliers, share: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Noisy points (N, H, W, 3) in the room and their depths, as one segment would have them."""
    depth = room.depth_m * (1 + DEPTH_NOISE * rng.standard_normal(room.depth_m.shape))
    n, height, width = depth.shape
    if outliers == "blob":
        blobs = (n, -(-height // BLOB_PX), -(-width // BLOB_PX))
        factor = np.where(rng.random(blobs) < share, rng.uniform(1.3, 2.0, blobs), 1.0)
        depth *= factor.repeat(BLOB_PX, axis=1).repeat(BLOB_PX, axis=2)[:, :height, :width]
    centres = room.room_from_cam[:, None, None, :, 3]
    points = centres + depth[..., None] * room.rays_room
    if outliers == "random":
        wrong = rng.random(depth.shape) < share
        points[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 3)) * ROOM_M
        depth[wrong] = np.linalg.norm(points - centres, axis=3)[wrong]
    return points, depth


def as_submodel(room: Room, segment: int) -> Submodel:
    """The room's cameras as a submodel; the alignment by pointmaps asks only which images it has."""
    n = len(room.room_from_cam)
    return Submodel(
        segment=segment,
        submodel=0,
        images=tuple(range(n)),
        seg_from_cam=room.room_from_cam,
        intrinsics=(room.camera,) * n,
        method="synthetic",
        reprojection_error_px=float("nan"),
        tracks=None,
    )


def overlap_maps(
    room: Room, overlap: Overlap, source_from_target: Sim3, *, seed: int
) -> tuple[MapsInMemory, MapsInMemory, Sim3]:
    """Maps of the target and of the source, and ``target_from_room``."""
    rng = np.random.default_rng(seed)
    target_from_room = Sim3(
        scale=np.array(overlap.unit), rotation=np.eye(3), translation=np.full(3, overlap.far_m * overlap.unit)
    )
    target_maps = maps_in_segment(target_from_room, *segment_points(room, overlap.outliers, overlap.share, rng))
    source_maps = maps_in_segment(source_from_target @ target_from_room, *segment_points(room, "none", 0.0, rng))
    return target_maps, source_maps, target_from_room


def score_maps(room: Room, overlap: Overlap, method: Method, *, num_pixels: int, seed: int) -> Score:
    """Make both segments, align them, compare with the truth."""
    target_maps, source_maps, target_from_room = overlap_maps(room, overlap, SOURCE_FROM_TARGET, seed=seed)
    began = time.process_time()
    fit = align_pointmaps(
        as_submodel(room, 0),
        as_submodel(room, 1),
        target_maps,
        source_maps,
        loss=RobustLoss(kernel=method.kernel),
        weighting=method.weighting,
        num_pixels=num_pixels,
    )
    cpu_s = time.process_time() - began
    return score_fit(room, fit, target_from_room, SOURCE_FROM_TARGET @ target_from_room, cpu_s)


def score_fit(
    room: Room, fit: SubmodelFit, target_from_room: Transform, source_from_room: Transform, cpu_s: float
) -> Score:
    """How far a fit is off in the room, at the exact points of every 16th pixel."""
    estimate = fit.estimate.b_from_a
    error = SL4.from_matrix(np.linalg.inv(target_from_room.matrix) @ estimate.matrix @ source_from_room.matrix)
    at_corner = error.affine_part()
    similar = at_corner.similarity_part()
    exact = (room.room_from_cam[:, None, None, :, 3] + room.depth_m[..., None] * room.rays_room)[:, ::16, ::16]
    exact = exact.reshape(-1, 3)
    return Score(
        cpu_s=cpu_s,
        rotation_deg=float(np.rad2deg(Rotation.from_matrix(similar.rotation).magnitude())),
        scale_percent=100 * abs(float(similar.scale) - 1),
        anisotropy=float(at_corner.anisotropy),
        map_cm=100 * float(np.linalg.norm(error.apply(exact) - exact, axis=1).mean()),
        relative_residual=fit.relative_residual,
        fallback=fit.fallback,
    )


def maps_in_segment(seg_from_room: Sim3, points_room: FloatArray, depth_m: FloatArray) -> MapsInMemory:
    """One segment's maps in its own gauge, in single precision as backbones give them."""
    return MapsInMemory(
        points_seg=seg_from_room.apply(points_room.reshape(-1, 3)).reshape(points_room.shape).astype(np.float32),
        depth_seg=(float(seg_from_room.scale) * depth_m).astype(np.float32),
        equal_confidence=np.full(depth_m.shape[1:], 3.0, dtype=np.float32),
    )


def cloud_points(
    room: Room, cloud: Cloud, pixels: npt.NDArray[np.int64], outliers: Outliers, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Noisy points (N, 3) in the room of some pixels (flat indices), and their depths (N,)."""
    image, row, column = np.unravel_index(pixels, room.depth_m.shape)
    depth = room.depth_m.ravel()[pixels] * (1 + cloud.noise * rng.standard_normal(len(pixels)))
    if outliers == "blob":
        n, height, width = room.depth_m.shape
        blobs = (n, -(-height // BLOB_PX), -(-width // BLOB_PX))
        factor = np.where(rng.random(blobs) < cloud.share, rng.uniform(1.3, 2.0, blobs), 1.0)
        depth *= factor[image, row // BLOB_PX, column // BLOB_PX]
    centres = room.room_from_cam[image, :, 3]
    points = centres + depth[:, None] * room.rays_room.reshape(-1, 3)[pixels]
    if outliers == "random":
        wrong = rng.random(len(pixels)) < cloud.share
        points[wrong] = rng.uniform(0, 1, (int(wrong.sum()), 3)) * ROOM_M
        depth[wrong] = np.linalg.norm(points - centres, axis=1)[wrong]
    return points, depth


def score_cloud(room: Room, cloud: Cloud, group: TransformGroup, *, seed: int) -> Score:
    """Draw the points, align them in a group, compare with the truth."""
    rng = np.random.default_rng(seed)
    pixels = np.arange(room.depth_m.size)
    if cloud.one_wall:
        reach = room.room_from_cam[:, None, None, 2, 3] + room.depth_m * room.rays_room[..., 2]
        pixels = np.flatnonzero(reach.ravel() > ROOM_M[2] - 1e-9)
    chosen = np.sort(rng.choice(pixels, min(cloud.count, len(pixels)), replace=False))
    target_from_room = Sim3(scale=np.array(cloud.unit), rotation=np.eye(3), translation=np.zeros(3))
    source_from_room = SOURCE_FROM_TARGET @ target_from_room
    target, depth_target = cloud_points(room, cloud, chosen, cloud.outliers, rng)
    source, depth_source = cloud_points(room, cloud, chosen, "none", rng)
    points_source, points_target = source_from_room.apply(source), target_from_room.apply(target)
    began = time.process_time()
    fit = align_seen_points(
        points_source,
        points_target,
        np.ones(len(chosen)),
        depth_source=float(source_from_room.scale) * depth_source,
        depth_target=float(target_from_room.scale) * depth_target,
        group=group,
        seed=seed,
    )
    return score_fit(room, fit, target_from_room, source_from_room, time.process_time() - began)


# ------------------------------------------------------------------------------ sections
def print_similarity(room: Room, arguments: argparse.Namespace) -> None:
    """Sim(3) on the whole overlap, by kernel and outliers."""
    columns = f"{'cpu s':>7} {'rot deg':>8} {'scale %':>8} {'map cm':>7}"
    print(f"{'':38} {'ours':^33} {'':>12} | {'VGGT-Long':^33}")
    print(f"{'case':38} {columns} {'resid/depth':>12} | {columns}")
    for name, overlap, method in CASES:
        dense = arguments.all_pixels and method is PAPER_HUBER
        num_pixels = room.depth_m.size if dense else NUM_PIXELS
        ours = score_maps(room, overlap, method, num_pixels=num_pixels, seed=arguments.seed)
        line = f"{ours.cpu_s:7.3f} {ours.rotation_deg:8.3f} {ours.scale_percent:8.3f} {ours.map_cm:7.2f}"
        peer = "{:7.1f} {:8.3f} {:8.2f} {:7.2f}".format(*overlap.peer)
        print(f"{name + ': ' + overlap.label:38} {line} {ours.relative_residual:12.4f} | {peer}", flush=True)


def print_groups(room: Room, arguments: argparse.Namespace) -> None:
    """Every group on the whole overlap with 30 % blobs; SE(3) in a gauge without scale."""
    print("peers on 5.9 M points: VGGT-Long Sim(3) 19.0 cpu s, 8.2 cm; VGGT-SLAM SL(4) would need 46 GB")
    print(f"{'group':10} {'cpu s':>7} {'rot deg':>8} {'scale %':>8} {'anisotropy':>10} {'map cm':>7} {'added MiB':>10}")
    rigid = replace(SOURCE_FROM_TARGET, scale=np.array(1.0))
    groups: tuple[TransformGroup, ...] = ("sim3", "se3", "affine3", "sl4")
    for group in groups:
        gauge = rigid if group == "se3" else SOURCE_FROM_TARGET
        target_maps, source_maps, target_from_room = overlap_maps(room, BLOB_30, gauge, seed=arguments.seed)

        def align(
            group: TransformGroup = group, target: MapsInMemory = target_maps, source: MapsInMemory = source_maps
        ) -> SubmodelFit:
            return align_pointmaps(as_submodel(room, 0), as_submodel(room, 1), target, source, group=group)

        began = time.process_time()
        fit = align()
        cpu_s = time.process_time() - began
        tracemalloc.start()
        align()
        added_mib = tracemalloc.get_traced_memory()[1] / 2**20
        tracemalloc.stop()
        ours = score_fit(room, fit, target_from_room, gauge @ target_from_room, cpu_s)
        print(
            f"{group:10} {ours.cpu_s:7.3f} {ours.rotation_deg:8.3f} {ours.scale_percent:8.3f} {ours.anisotropy:10.4f} "
            f"{ours.map_cm:7.2f} {added_mib:10.1f} {ours.fallback}",
            flush=True,
        )
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak of the process, with the synthetic maps: {peak_gib:.2f} GiB")


def print_clouds(group: TransformGroup) -> Callable[[Room, argparse.Namespace], None]:
    """The section of one group on points of the overlap."""

    def section(room: Room, arguments: argparse.Namespace) -> None:
        columns = f"{'cpu s':>6} {'map cm, worst':>14} {'rot deg, worst':>15} {'scale %':>8} {'aniso':>6}"
        peer_title = "VGGT-SLAM, median and worst of 5 seeds" if group == "sl4" else ""
        print(f"{'':32} {f'ours, median and worst of {arguments.seeds} seeds':^63} | {peer_title}")
        print(f"{'points':32} {columns} {'fell back':>9} | {columns if group == 'sl4' else ''}")
        for cloud in CLOUDS:
            scores = [score_cloud(room, cloud, group, seed=seed) for seed in range(arguments.seeds)]
            peer = cloud_columns(*cloud.peer) if cloud.peer and group == "sl4" else ""
            fallbacks = sum(bool(one.fallback) for one in scores)
            print(f"{cloud.label:32} {cloud_columns(*summarised(scores))} {fallbacks:9d} | {peer}", flush=True)

    return section


def summarised(scores: list[Score]) -> tuple[float, ...]:
    """Medians, and the worst of map and rotation, in the order of `cloud_columns`."""
    map_cm, rotation_deg = [one.map_cm for one in scores], [one.rotation_deg for one in scores]
    return (
        float(np.median([one.cpu_s for one in scores])),
        float(np.median(map_cm)),
        max(map_cm),
        float(np.median(rotation_deg)),
        max(rotation_deg),
        float(np.median([one.scale_percent for one in scores])),
        float(np.median([one.anisotropy for one in scores])),
    )


def cloud_columns(
    cpu_s: float, map_cm: float, worst_cm: float, rot_deg: float, worst_deg: float, scale_percent: float, aniso: float
) -> str:
    """One side of a row."""
    return (
        f"{cpu_s:6.2f} {map_cm:7.2f} {worst_cm:6.2f} {rot_deg:8.3f} {worst_deg:6.2f} {scale_percent:8.3f} {aniso:6.3f}"
    )


SECTIONS: dict[str, Callable[[Room, argparse.Namespace], None]] = {
    "similarity": print_similarity,
    "groups": print_groups,
    "sl4": print_clouds("sl4"),
    "affine3": print_clouds("affine3"),
}


def main(argv: Sequence[str] | None = None) -> None:
    """Run the sections and print their tables."""
    parser = argparse.ArgumentParser(description="Accuracy and cost of the alignment on a synthetic room.")
    parser.add_argument("--images", type=int, default=30, help="images shared by both segments")
    parser.add_argument("--height", type=int, default=384, help="rows of each map")
    parser.add_argument("--width", type=int, default=512, help="columns of each map")
    parser.add_argument("--seed", type=int, default=0, help="of noise and outliers of the whole overlap")
    parser.add_argument("--seeds", type=int, default=20, help="how many for each cloud of points")
    parser.add_argument("--only", choices=list(SECTIONS), help="this section alone")
    parser.add_argument("--all-pixels", action="store_true", help="give the paper's Huber every pixel, as the peer")
    arguments = parser.parse_args(argv)
    logging.getLogger("smust3r_colmap").setLevel(logging.ERROR)  # fallbacks are counted in the tables
    room = walk_through_room(arguments.images, arguments.height, arguments.width)
    print(
        f"{arguments.images} x {arguments.height} x {arguments.width}, seed {arguments.seed}; peers at 30 x 384 x 512"
    )
    for name in [arguments.only] if arguments.only else SECTIONS:
        print(f"\n{name}")
        SECTIONS[name](room, arguments)


if __name__ == "__main__":
    main()

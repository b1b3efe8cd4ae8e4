"""How exact and how dear is the alignment of two segments? A synthetic room, beside a peer's figures.

A pinhole camera moves through a room of 6 x 3 x 4 m and two segments share its images. Both have
depth noise of 1 % along the ray, and the target has outliers: blobs of 32 x 32 pixels that are 30 to
100 % too deep and as confident as the rest, or points anywhere in the room. The source segment lives
in another Sim(3) gauge (scale 1.7, 35 degrees).

The peer is VGGT-Long's chunk alignment (its numba path: all pixels, float32, Huber 0.1, 5
iterations), measured on data made by the same description, but in another run.

    python scripts/benchmark_alignment.py
    python scripts/benchmark_alignment.py --images 8 --height 96 --width 128 --seed 3
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.from_pointmaps import NUM_PIXELS, align_pointmaps
from smust3r_colmap.config import AlignmentConfig
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import SegmentPiece

FloatArray = npt.NDArray[np.float64]
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
DEFAULT = AlignmentConfig()
CAUCHY_ALONE = AlignmentConfig(confidence_weighting="off")
TUKEY_ALONE = AlignmentConfig(confidence_weighting="off", robust_kernel="tukey")
PAPER_HUBER = AlignmentConfig(confidence_weighting="off", robust_kernel="huber")
CASES = (
    *(("default", overlap, DEFAULT) for overlap in OVERLAPS),
    ("cauchy alone", BLOB_30, CAUCHY_ALONE),
    ("tukey alone", BLOB_30, TUKEY_ALONE),
    *(("paper's huber", overlap, PAPER_HUBER) for overlap in OVERLAPS),
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """What one alignment cost and how far it is off, in metres of the room."""

    cpu_s: float
    rotation_deg: float
    scale_percent: float
    map_cm: float
    relative_residual: float


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
    """`DenseMaps` of one piece."""

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


def as_piece(room: Room, segment: int) -> SegmentPiece:
    """The room's cameras as a piece; the alignment by pointmaps asks only which images it has."""
    n = len(room.room_from_cam)
    return SegmentPiece(
        segment=segment,
        piece=0,
        images=tuple(range(n)),
        seg_from_cam=room.room_from_cam,
        intrinsics=(room.camera,) * n,
        method="synthetic",
        reprojection_error_px=float("nan"),
        tracks=None,
        descriptors=np.ones((n, 1), dtype=np.float32),
    )


def score(room: Room, overlap: Overlap, settings: AlignmentConfig, *, num_pixels: int, seed: int) -> Score:
    """Make both segments, align them, compare with the truth."""
    rng = np.random.default_rng(seed)
    target_from_room = Sim3(
        scale=np.array(overlap.unit), rotation=np.eye(3), translation=np.full(3, overlap.far_m * overlap.unit)
    )
    source_from_room = SOURCE_FROM_TARGET @ target_from_room
    target_maps = maps_in_segment(target_from_room, *segment_points(room, overlap.outliers, overlap.share, rng))
    source_maps = maps_in_segment(source_from_room, *segment_points(room, "none", 0.0, rng))
    began = time.process_time()
    fit = align_pointmaps(
        as_piece(room, 0), as_piece(room, 1), target_maps, source_maps, settings, num_pixels=num_pixels
    )
    cpu_s = time.process_time() - began
    error = target_from_room.inverse() @ fit.estimate.b_from_a @ source_from_room
    exact = room.room_from_cam[:, None, None, :, 3] + room.depth_m[..., None] * room.rays_room
    exact = exact[:, ::16, ::16].reshape(-1, 3)
    return Score(
        cpu_s=cpu_s,
        rotation_deg=float(np.rad2deg(Rotation.from_matrix(error.rotation).magnitude())),
        scale_percent=100 * abs(float(error.scale) - 1),
        map_cm=100 * float(np.linalg.norm(error.apply(exact) - exact, axis=1).mean()),
        relative_residual=fit.relative_residual,
    )


def maps_in_segment(seg_from_room: Sim3, points_room: FloatArray, depth_m: FloatArray) -> MapsInMemory:
    """One segment's maps in its own gauge, in single precision as backbones give them."""
    return MapsInMemory(
        points_seg=seg_from_room.apply(points_room.reshape(-1, 3)).reshape(points_room.shape).astype(np.float32),
        depth_seg=(float(seg_from_room.scale) * depth_m).astype(np.float32),
        equal_confidence=np.full(depth_m.shape[1:], 3.0, dtype=np.float32),
    )


def main() -> None:
    """Run every case and print the table."""
    parser = argparse.ArgumentParser(description="Accuracy and cost of the alignment on a synthetic room.")
    parser.add_argument("--images", type=int, default=30, help="images shared by both segments")
    parser.add_argument("--height", type=int, default=384, help="rows of each map")
    parser.add_argument("--width", type=int, default=512, help="columns of each map")
    parser.add_argument("--seed", type=int, default=0, help="of noise and outliers")
    parser.add_argument("--all-pixels", action="store_true", help="give the paper's Huber every pixel, as the peer")
    arguments = parser.parse_args()
    room = walk_through_room(arguments.images, arguments.height, arguments.width)
    print(f"{arguments.images} x {arguments.height} x {arguments.width}, seed {arguments.seed}; peer at 30 x 384 x 512")
    columns = f"{'cpu s':>7} {'rot deg':>8} {'scale %':>8} {'map cm':>7}"
    print(f"{'':38} {'ours':^33} {'':>12} | {'peer':^33}")
    print(f"{'case':38} {columns} {'resid/depth':>12} | {columns}")
    for name, overlap, settings in CASES:
        dense = arguments.all_pixels and settings is PAPER_HUBER
        num_pixels = room.depth_m.size if dense else NUM_PIXELS
        ours = score(room, overlap, settings, num_pixels=num_pixels, seed=arguments.seed)
        line = f"{ours.cpu_s:7.3f} {ours.rotation_deg:8.3f} {ours.scale_percent:8.3f} {ours.map_cm:7.2f}"
        peer = "{:7.1f} {:8.3f} {:8.2f} {:7.2f}".format(*overlap.peer)
        print(f"{name + ': ' + overlap.label:38} {line} {ours.relative_residual:12.4f} | {peer}", flush=True)


if __name__ == "__main__":
    main()

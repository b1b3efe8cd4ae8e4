"""How fast is the MUSt3R network here, what memory does it take, and what do its modes cost in accuracy?

Every stage of a segment is measured, in images per second, wall seconds, CPU seconds of all threads, and memory:

    preprocess  file to pixels           add      a keyframe into the memory    cameras  pointmaps to cameras
    encode      pixels to features       render   an image against the memory   maps     depth of the whole image

Modes:
    published   float32, as the published drivers go about it, but with our code: what the network says is computed
                whenever an image is shown, images go one by one, and cameras are fitted to all pixels
    float32     what the backbone does in float32 on this device
    bfloat16    the same in bfloat16
    norm_y      float32 with the leaner memory, which makes keys and values anew each time

The ratio is the time over that of the first mode asked for, "published" by default: CPU seconds on a processor, wall
seconds on a card. Errors are those against "float32", else against the first mode: over the root mean square for
features, over the distance of the point for pointmaps, over confidence - 1 for confidences, over the median depth
for camera centres; focal lengths and poses are those of the published procedure in all modes.

Each mode runs in a process of its own, which first runs once on a tiny image, so that the weights are in memory and
libraries are loaded; then the stages are measured. Repeats go through the modes in changing order, and the fastest
time of each stage is kept, for machines are noisy. The peak is the largest memory of the process up to the end of
the stage, weights included; on a card, that of torch's tensors on the card.

Without --weights the network has random weights, the same on every machine: speed and memory are those of the
published one, the geometry means nothing, and so that cameras have something to be fitted to they are fitted to
a made-up surface. Without --images the network looks at a rendered room.

The published implementation took, in float32 at 512 x 384 on an idle machine with two cores, in CPU seconds per image:
encode 4.7, add 2.6 to 3.0, render 2.5, cameras 0.2, together about 10.2; and 3.0 GiB at its peak with 4 images.

    OMP_NUM_THREADS=1 python scripts/benchmark_must3r.py
    python scripts/benchmark_must3r.py --images FOLDER --weights MUSt3R_512.pth --num-images 20
    python scripts/benchmark_must3r.py --device cuda --lengths 60 200 --modes float32 bfloat16
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, get_args

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from smust3r_colmap.backbones.must3r import Network, Pointmaps, activate, encode, load_checkpoint, render, update_memory
from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    MemoryMode,
    Rope,
)
from smust3r_colmap.backbones.must3r.backbone import ENCODED_AT_ONCE_ON_CARD
from smust3r_colmap.backbones.must3r.cameras import Sighting, estimate_focal, fit_cameras, register_camera, sight
from smust3r_colmap.backbones.must3r.checkpoint import write_safetensors_checkpoint
from smust3r_colmap.backbones.must3r.drivers import Remembered, predict, remember
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.full_image import to_full_image
from smust3r_colmap.backbones.must3r.keyframes import EvenlySpread
from smust3r_colmap.backbones.must3r.memory_plan import MemoryModel, memory_budget, plan_memory
from smust3r_colmap.backbones.must3r.network import init_memory
from smust3r_colmap.backbones.must3r.precision import choose_device, choose_precision, prepare
from smust3r_colmap.backbones.must3r.preprocessing import NetworkImage, preprocess
from smust3r_colmap.config import CameraConfig, CameraFit, Device, Precision
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.importers.image_folder import import_image_folder
from smust3r_colmap.importers.images import load_rgb
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.synthetic.must3r_weights import random_network_weights
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

STAGES = ("preprocess", "encode", "add", "render", "cameras", "maps")
NETWORK_STAGES = ("encode", "add", "render", "cameras")
"""What the total adds up, for the published implementation ends there."""
SEED = 4242
"""Of the random weights."""
DEMO_ROUND = 120
"""Images of a round of the demo room, of which the first are taken."""
DEMO_WIDTH, DEMO_HEIGHT = 512, 384
REMADE_AT_ONCE = 4
"""Images that share the keys and values made anew; as ``memory_plan`` has it."""
FEATURE_STEP, PIXEL_STEP = 4, 4
"""Every so many features and pixels are compared."""
GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One way to run the network; see the top of this file."""

    precision: Precision = "float32"
    memory: MemoryMode = "kv"
    as_published: bool = False

    @property
    def camera_fit(self) -> CameraFit:
        """The published cameras belong to the published drivers."""
        return "upstream" if self.as_published else "robust"


MODES: Mapping[str, Mode] = {
    "published": Mode(as_published=True),
    "float32": Mode(),
    "bfloat16": Mode(precision="bfloat16"),
    "norm_y": Mode(memory="norm_y"),
}


# --------------------------------------------------------------------------- what is measured
@dataclass(frozen=True, kw_only=True)
class Task:
    """What a process is to measure.

    Args:
        mode: name of the mode.
        weights: a checkpoint. images: a folder. outputs: file for what the network said.
        num_images, num_keyframes: of the segment. size: longer side of the network's images.
        has_geometry: the weights are trained, so that cameras can be fitted to what the network says.
    """

    mode: str
    weights: Path
    images: Path
    outputs: Path
    num_images: int
    num_keyframes: int
    size: int
    device: Device
    has_geometry: bool


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """What a stage took.

    Args:
        images: that went through it.
        wall_s, cpu_s: of all of them; CPU seconds are those of all threads, in user and in system mode.
        peak_bytes: of the process up to the end of the stage, or of the card within it.
    """

    images: int
    wall_s: float
    cpu_s: float
    peak_bytes: int


Costs = Mapping[str, StageCost]


@dataclass(kw_only=True)
class Stopwatch:
    """Adds up what each stage costs; a stage may be entered many times."""

    device: torch.device
    costs: dict[str, StageCost] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str, images: int) -> Iterator[None]:
        """Everything within is of this stage, and lets so many images through."""
        self._settle()
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
        wall_s, cpu_s = time.perf_counter(), time.process_time()
        yield
        self._settle()
        wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
        old = self.costs.get(name, StageCost(images=0, wall_s=0, cpu_s=0, peak_bytes=0))
        self.costs[name] = StageCost(
            images=old.images + images,
            wall_s=old.wall_s + wall_s,
            cpu_s=old.cpu_s + cpu_s,
            peak_bytes=max(old.peak_bytes, peak_bytes(self.device)),
        )

    def _settle(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def peak_bytes(device: torch.device) -> int:
    """Of torch's tensors on a card since the last reset, or of this process since it began."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
    except OSError:  # not Linux
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Not ru_maxrss, which a child inherits from its parent.
    return next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def measure(task: Task) -> dict[str, StageCost]:
    """Run a segment in this process and write what the network said."""
    mode, device = MODES[task.mode], choose_device(task.device)
    network = load_checkpoint(task.weights, image_size=task.size, memory_mode=mode.memory, device=device)
    network = prepare(network, choose_precision(mode.precision, device).dtype)
    collection = import_image_folder(task.images, CameraConfig())
    watch = Stopwatch(device=device)
    warm_up(network)

    images: list[NetworkImage] = []
    for source in collection.images[: task.num_images]:
        with watch.stage("preprocess", 1):
            images.append(preprocess(load_rgb(source), task.size))
    encoded = encode_all(network, images, watch, mode)
    remembered = add_keyframes(network, encoded, watch, mode, task.num_keyframes)
    batch = images_at_once(network, images, mode, task.num_keyframes)
    predictions = predict(network, encoded, remembered, range(len(images)), batch_size=batch)
    sightings, depths = [], []
    said: list[dict[str, npt.NDArray[Any]]] = []
    while True:
        with watch.stage("render", 1 if len(said) < len(images) else 0):
            prediction = next(predictions, None)
        if prediction is None:
            break
        window = images[prediction.index].window
        with watch.stage("cameras", 0):
            pointmaps = activate(prediction.raw, network.architecture.decoder.activation)
        surface = pointmaps if task.has_geometry else made_up_surface(pointmaps, prediction.index)
        with watch.stage("cameras", 1):
            sightings.append(sight(surface, window, camera_fit=mode.camera_fit))
        depths.append((pointmaps.points_cam[..., 2].cpu().numpy(), pointmaps.confidence.cpu().numpy()))
        said.append(outputs_of(encoded[prediction.index], pointmaps))
        del prediction, pointmaps, surface  # so that they are not there beside the next
    fit(sightings, collection, watch, mode)
    for (depth, confidence), image in zip(depths, images, strict=True):
        with watch.stage("maps", 1):
            to_full_image(depth, confidence, image.window)
    np.savez(task.outputs, allow_pickle=False, **{name: np.stack([one[name] for one in said]) for name in said[0]})
    return watch.costs


def warm_up(network: Network) -> None:
    """Everything once, on two patches by two."""
    side = 2 * network.architecture.encoder.patch_size
    tiny = encode(network, [torch.zeros(3, side, side)])
    memory = update_memory(network, init_memory(network, tiny).memory, tiny).memory
    render(network, memory, tiny)


def encode_all(
    network: Network, images: Sequence[NetworkImage], watch: Stopwatch, mode: Mode
) -> tuple[EncodedImage, ...]:
    """As the backbone does: one by one on a processor, many at once on a card."""
    at_once = ENCODED_AT_ONCE_ON_CARD if network.device.type == "cuda" and not mode.as_published else 1
    with watch.stage("encode", len(images)):
        return encode(network, [image.pixels for image in images], batch_size=at_once)


def add_keyframes(
    network: Network, encoded: Sequence[EncodedImage], watch: Stopwatch, mode: Mode, num_keyframes: int
) -> Remembered:
    """The memory of keyframes spread evenly, made by the backbone's own driver."""
    keyframes = EvenlySpread(most=num_keyframes).keyframes(len(encoded))
    updates = remember(network, encoded, keyframes, keyframes=keyframes, keep_predictions=mode.as_published)
    with watch.stage("add", len(keyframes)):
        while True:
            try:
                next(updates)
            except StopIteration as stop:
                remembered: Remembered = stop.value
                return remembered


def images_at_once(network: Network, images: Sequence[NetworkImage], mode: Mode, num_keyframes: int) -> int:
    """How many images the backbone would render together."""
    if mode.as_published:
        return 1
    on_card = network.device.type == "cuda"
    if mode.memory != "kv" and not on_card:
        return min(REMADE_AT_ONCE, len(images))
    patch = network.architecture.encoder.patch_size
    tokens = max(image.window.width * image.window.height for image in images) // patch**2
    plan = plan_memory(
        MemoryModel(architecture=network.architecture, tokens=tokens, dtype=network.dtype),
        num_images=len(images),
        wanted_keyframes=num_keyframes,
        budget_bytes=memory_budget(network.device, "auto"),
        on_card=on_card,
    )
    return plan.render_batch


def fit(sightings: Sequence[Sighting], collection: ImageCollection, watch: Stopwatch, mode: Mode) -> None:
    """Cameras of the whole segment."""
    owners = [image.camera for image in collection.images[: len(sightings)]]
    with watch.stage("cameras", 0):
        fit_cameras(sightings, owners, collection.cameras, camera_fit=mode.camera_fit)


def outputs_of(encoded: EncodedImage, pointmaps: Pointmaps) -> dict[str, npt.NDArray[Any]]:
    """What is compared between the modes: some features and pixels, and the camera of all pixels."""
    grid = slice(None, None, PIXEL_STEP)
    return {
        "features": encoded.features[::FEATURE_STEP, ::FEATURE_STEP].float().cpu().numpy(),
        "points_world": pointmaps.points_world[grid, grid].reshape(-1, 3).cpu().numpy(),
        "points_cam": pointmaps.points_cam[grid, grid].reshape(-1, 3).cpu().numpy(),
        "confidence": pointmaps.confidence[grid, grid].flatten().cpu().numpy(),
        "focal_net": np.array(estimate_focal(pointmaps.points_cam, dtype=np.float64)),
        "world_from_cam": register_camera(pointmaps.points_cam, pointmaps.points_world, pointmaps.confidence),
    }


def made_up_surface(like: Pointmaps, seed: int) -> Pointmaps:
    """A wavy surface 2 to 4 deep, seen by a camera of the demo, with 1 % of noise: as a trained network has it."""
    height, width = like.confidence.shape
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    focal = demo_intrinsics(width, height).focal_px
    rays_cam = torch.stack(((x - width / 2) / focal, (y - height / 2) / focal, torch.ones_like(x)), dim=-1)
    depth = 3 + torch.sin(x / 40) * torch.cos(y / 30)
    points_cam, points_world = (
        rays_cam * depth[..., None] * (1 + 0.01 * torch.randn(height, width, 1, generator=generator)) for _ in range(2)
    )
    shift = torch.tensor([0.1 * seed, 0.0, 0.0])
    return Pointmaps(
        points_world=(points_world + shift).to(like.points_world),
        points_cam=points_cam.to(like.points_cam),
        confidence=(2 + torch.rand(height, width, generator=generator)).to(like.confidence),
    )


# ---------------------------------------------------------------------------------- the errors
@dataclass(frozen=True, kw_only=True)
class Errors:
    """Of a mode against another; see the top of this file. Of cameras it is the worst image."""

    features_rms: float
    features_max: float
    points_median: float
    points_95: float
    confidence_median: float
    confidence_95: float
    focal_percent: float
    rotation_deg: float
    centre: float


Outputs = Mapping[str, npt.NDArray[Any]]


def errors(found: Outputs, reference: Outputs) -> Errors:
    """How far the outputs of one mode are from those of another."""
    size = rms(reference["features"])
    points = np.concatenate(
        [distance_ratios(found[name], reference[name]) for name in ("points_world", "points_cam")], axis=None
    )
    certainty = np.abs(found["confidence"] - reference["confidence"]) / (reference["confidence"] - 1)
    pose, true = (outputs["world_from_cam"].astype(np.float64) for outputs in (found, reference))
    moved = np.linalg.norm(pose[:, :3, 3] - true[:, :3, 3], axis=1)
    depth = np.median(np.abs(reference["points_cam"][..., 2]), axis=1)
    return Errors(
        features_rms=rms(found["features"] - reference["features"]) / size,
        features_max=float(np.abs(found["features"] - reference["features"]).max()) / size,
        points_median=float(np.median(points)),
        points_95=float(np.quantile(points, 0.95)),
        confidence_median=float(np.median(certainty)),
        confidence_95=float(np.quantile(certainty, 0.95)),
        focal_percent=100 * float(np.abs(found["focal_net"] / reference["focal_net"] - 1).max()),
        rotation_deg=float(turns_deg(pose[:, :3, :3], true[:, :3, :3]).max()),
        centre=float((moved / depth).max()),
    )


def rms(values: npt.NDArray[Any]) -> float:
    """Root mean square, in float64."""
    return float(np.sqrt(np.square(values, dtype=np.float64).mean()))


def distance_ratios(found: npt.NDArray[Any], reference: npt.NDArray[Any]) -> FloatArray:
    """Distance between points over that of the reference from the origin."""
    ratios: FloatArray = np.linalg.norm(found - reference, axis=-1) / np.linalg.norm(reference, axis=-1)
    return ratios


def turns_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angles between rotations (N, 3, 3), exact for small ones: |a - b| is sqrt(8) times the sine of half the angle."""
    chord = np.linalg.norm(a - b, axis=(1, 2)) / np.sqrt(8)
    angles: FloatArray = np.rad2deg(2 * np.arcsin(np.minimum(chord, 1)))
    return angles


# -------------------------------------------------------------------------------- the modes
@dataclass(frozen=True, kw_only=True)
class Row:
    """What came of a mode on a segment of some length.

    Args:
        costs: of every stage, the best of all repeats. errors: None for the mode that is compared with.
    """

    mode: str
    num_images: int
    num_keyframes: int
    costs: Costs
    errors: Errors | None


def in_own_process(task: Task) -> Costs:
    """So that its peak is its own and nothing lingers."""
    with ProcessPoolExecutor(max_workers=1, mp_context=get_context("spawn")) as pool:
        try:
            return pool.submit(measure, task).result()
        except BrokenProcessPool:
            raise SystemExit(
                f"the process of mode {task.mode} died, of memory most likely: take fewer images"
            ) from None


def compare(
    tasks: Sequence[Task], *, repeats: int, rng: random.Random, measured_by: Callable[[Task], Costs] = in_own_process
) -> tuple[Row, ...]:
    """Measure every task some times in changing order; one row each, in the order given."""
    best: dict[str, Costs] = {}
    for _ in range(repeats):
        for task in rng.sample(tasks, len(tasks)):
            costs = measured_by(task)
            best[task.mode] = cheapest(best.get(task.mode, costs), costs)
    reference = next((task for task in tasks if task.mode == "float32"), tasks[0])
    return tuple(
        Row(
            mode=task.mode,
            num_images=task.num_images,
            num_keyframes=task.num_keyframes,
            costs=best[task.mode],
            errors=None if task is reference else errors(read_outputs(task), read_outputs(reference)),
        )
        for task in tasks
    )


def cheapest(a: Costs, b: Costs) -> dict[str, StageCost]:
    """Stage by stage the smaller times, and the larger peak."""
    return {
        name: StageCost(
            images=a[name].images,
            wall_s=min(a[name].wall_s, b[name].wall_s),
            cpu_s=min(a[name].cpu_s, b[name].cpu_s),
            peak_bytes=max(a[name].peak_bytes, b[name].peak_bytes),
        )
        for name in a
    }


def read_outputs(task: Task) -> Outputs:
    """What the network said in the last run of a mode."""
    with np.load(task.outputs) as stored:
        return dict(stored)


# ------------------------------------------------------------------------------- the tables
@dataclass(frozen=True, kw_only=True)
class PerImage:
    """What a stage takes for one image, and the peak in GiB."""

    wall_s: float
    cpu_s: float
    peak_gib: float


def per_image(row: Row, stages: Sequence[str]) -> PerImage:
    """Of some stages together, each divided by the images that went through it."""
    costs = [row.costs[name] for name in stages]
    return PerImage(
        wall_s=sum(cost.wall_s / cost.images for cost in costs),
        cpu_s=sum(cost.cpu_s / cost.images for cost in costs),
        peak_gib=max(cost.peak_bytes for cost in costs) / GIB,
    )


def cost_table(rows: Sequence[Row], *, on_card: bool) -> str:
    """Every stage of every mode, and the network's stages together; ratios are those to the first mode."""
    lines = [["stage", "mode", "images/s", "wall s", "CPU s", "ratio", "peak GiB"]]
    for label, stages in [*((name, (name,)) for name in STAGES), ("total", NETWORK_STAGES)]:
        first = per_image(rows[0], stages)
        for row in rows:
            own = per_image(row, stages)
            ratio = own.wall_s / first.wall_s if on_card else own.cpu_s / first.cpu_s
            figures = (f"{1 / own.wall_s:.3g}", f"{own.wall_s:.3f}", f"{own.cpu_s:.3f}", f"{ratio:.3f}")
            lines.append([label, row.mode, *figures, f"{own.peak_gib:.2f}"])
    return table(lines)


def error_table(rows: Sequence[Row]) -> str:
    """Every mode that was compared with another; one line per figure."""
    compared = [(row.mode, asdict(row.errors)) for row in rows if row.errors is not None]
    names = [one.replace("_", " ") for one in Errors.__dataclass_fields__]
    columns = [[mode, *(f"{value:.2g}" for value in figures.values())] for mode, figures in compared]
    return table([list(line) for line in zip(["error", *names], *columns, strict=True)])


def table(lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, padded to be read as it stands; the first line is the header."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    head, *body = (
        "| " + " | ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in lines
    )
    return "\n".join([head, "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|", *body])


# ------------------------------------------------------------------------------- the script
def architecture_of(name: str, size: int) -> Architecture:
    """The published one, or one so small that it runs in no time."""
    rope = Rope(trained_size=size, size=size)
    if name == "full":
        return Architecture(
            encoder=EncoderArchitecture(rope=rope),
            decoder=DecoderArchitecture(rope=rope, feedback="single_mlp", memory_mode="kv"),
        )
    return Architecture(
        encoder=EncoderArchitecture(width=64, depth=3, num_heads=4, rope=rope),
        decoder=DecoderArchitecture(
            encoder_width=64, width=48, depth=4, num_heads=3, rope=rope, feedback="single_mlp", memory_mode="kv"
        ),
    )


def write_random_weights(path: Path, architecture: Architecture) -> None:
    """In our own form, which is mapped into memory as the backbone would map it."""
    network = random_network_weights(architecture, SEED)
    write_safetensors_checkpoint(path, architecture, network.encoder.state_dict(), network.decoder.state_dict())


def write_demo_images(folder: Path, num_images: int) -> None:
    """The first views of a round through the demo room."""
    folder.mkdir()
    scene, camera = DemoScene(), demo_intrinsics(DEMO_WIDTH, DEMO_HEIGHT)
    for k, world_from_cam in enumerate(scene.camera_path(max(DEMO_ROUND, num_images))[:num_images]):
        rgb, _ = scene.render(world_from_cam, camera)
        Image.fromarray(rgb).save(folder / f"{k:06d}.png")


def tasks_of(arguments: argparse.Namespace, work: Path, num_images: int) -> list[Task]:
    """One per mode."""
    most = arguments.keyframes or arguments.max_keyframes
    return [
        Task(
            mode=mode,
            weights=arguments.weights or work / "random.safetensors",
            images=arguments.images or work / "images",
            outputs=work / f"{mode}-{num_images}.npz",
            num_images=num_images,
            num_keyframes=min(most, num_images),
            size=arguments.size,
            device=arguments.device,
            has_geometry=arguments.weights is not None,
        )
        for mode in arguments.modes
    ]


def default_modes(device: torch.device) -> list[str]:
    """All, but bfloat16 only where the hardware has it."""
    fast = choose_precision("auto", device).dtype == torch.bfloat16
    return [name for name in MODES if fast or name != "bfloat16"]


def parse_arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=Path, metavar="DIR", help="photographs; the demo room without it")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="a checkpoint; random weights without it")
    parser.add_argument("--num-images", type=int, default=4, help="of the segment (%(default)s)")
    parser.add_argument("--lengths", type=int, nargs="+", metavar="N", help="segments of these lengths instead")
    parser.add_argument("--keyframes", type=int, metavar="N", help="that are remembered; by default all, up to")
    parser.add_argument("--max-keyframes", type=int, default=50, help="this many (%(default)s)")
    parser.add_argument("--size", type=int, default=512, help="longer side of the network's images (%(default)s)")
    parser.add_argument("--device", choices=get_args(Device), default="cpu", help="(%(default)s)")
    parser.add_argument("--modes", nargs="+", choices=list(MODES), help="all; bfloat16 only where the hardware has it")
    parser.add_argument("--architecture", choices=["full", "tiny"], default="full", help="(%(default)s)")
    parser.add_argument("--repeats", type=int, default=1, help="of each mode (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the order of the modes (%(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    arguments = parser.parse_args(words)
    arguments.lengths = arguments.lengths or [arguments.num_images]
    if min(*arguments.lengths, arguments.repeats, arguments.keyframes or 1, arguments.max_keyframes) < 1:
        parser.error("images, keyframes and repeats: 1 at least")
    arguments.modes = arguments.modes or default_modes(choose_device(arguments.device))
    return arguments


def main(words: Sequence[str] | None = None) -> None:
    """Measure every length in every mode."""
    arguments = parse_arguments(words)
    on_card = choose_device(arguments.device).type == "cuda"
    rng = random.Random(arguments.seed)
    report: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if arguments.weights is None:
            write_random_weights(work / "random.safetensors", architecture_of(arguments.architecture, arguments.size))
        if arguments.images is None:
            write_demo_images(work / "images", max(arguments.lengths))
        for length in arguments.lengths:
            rows = compare(tasks_of(arguments, work, length), repeats=arguments.repeats, rng=rng)
            print(
                f"\n{length} images, {rows[0].num_keyframes} keyframes, {arguments.architecture} network at "
                f"{arguments.size} px on {arguments.device}, {torch.get_num_threads()} threads, torch "
                f"{torch.__version__}, best of {arguments.repeats}; per image:\n\n{cost_table(rows, on_card=on_card)}"
            )
            if len(rows) > 1:
                print(f"\n{error_table(rows)}", flush=True)
            report.extend(rows)
            if arguments.json is not None:
                arguments.json.write_text(json.dumps([asdict(row) for row in report], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()

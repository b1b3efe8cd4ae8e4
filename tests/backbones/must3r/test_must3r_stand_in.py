"""The trained stand-in: a tiny network whose pointmaps of the demo's room are true geometry.

Bounds are about twice what the checkpoint in ``tests/data`` reaches, and a lower bound stands where a figure
that is too good would mean that truth leaked into the measurement.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import torch
import train_stand_in as training
from torch import Tensor

from smust3r_colmap.backbones.must3r import (
    EncodedImage,
    Memory,
    Network,
    Pointmaps,
    activate,
    encode,
    init_memory,
    load_checkpoint,
    render,
    update_memory,
)
from smust3r_colmap.backbones.must3r.cameras import estimate_focal, register_camera
from smust3r_colmap.backbones.must3r.decoder import Decoder
from smust3r_colmap.backbones.must3r.preprocessing import preprocess
from smust3r_colmap.geometry.camera import pointmap_from_depth
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.so3 import angles_between
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

STAND_IN = Path(__file__).parents[2] / "data" / "must3r_stand_in.safetensors"
NUM_IMAGES = 120
"""Of the usual demo; none but the first is among the training views."""
LARGER = 5
"""Times the size of the network at which photographs are rendered here; training had another."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Room:
    """Photographs of the demo's room, as the network takes and encodes them, and the truth.

    Args:
        world_from_cam: (N, 3, 4).
        depth: (N, H, W) in metres at the network's pixels.
    """

    world_from_cam: npt.NDArray[np.float64]
    depth: npt.NDArray[np.float32]
    encoded: tuple[EncodedImage, ...]

    def ref_from_cam(self, k: int, reference: int) -> npt.NDArray[np.float64]:
        """(3, 4) true pose of image k in the camera frame of another."""
        ref_from_world = invert_rigid(self.world_from_cam[reference])
        rotation, centre = self.world_from_cam[k, :, :3], self.world_from_cam[k, :, 3:]
        pose: npt.NDArray[np.float64] = ref_from_world @ np.block([[rotation, centre], [np.zeros(3), 1]])
        return pose

    def points_ref(self, k: int, reference: int) -> npt.NDArray[np.float32]:
        """(H, W, 3) true points of image k in the camera frame of another."""
        intrinsics = demo_intrinsics(training.WIDTH, training.HEIGHT)
        return pointmap_from_depth(self.depth[k], intrinsics, self.ref_from_cam(k, reference))

    def descriptors(self) -> npt.NDArray[np.float32]:
        """(N, C) mean features of unit length."""
        means = np.stack([image.features.mean(dim=0).numpy() for image in self.encoded])
        unit: npt.NDArray[np.float32] = means / np.linalg.norm(means, axis=1, keepdims=True)
        return unit


def photograph(network: Network, seed: int, numbers: Sequence[int]) -> Room:
    """Some images of the usual demo, or of a room with other textures."""
    scene = DemoScene(seed)
    world_from_cam = scene.camera_path(NUM_IMAGES)[list(numbers)]
    rendered = [
        scene.render(pose, demo_intrinsics(LARGER * training.WIDTH, LARGER * training.HEIGHT))
        for pose in world_from_cam
    ]
    middle = slice(LARGER // 2, None, LARGER)
    return Room(
        world_from_cam=world_from_cam,
        depth=np.stack([depth[middle, middle] for _, depth in rendered]),
        encoded=encode(network, [preprocess(rgb, training.WIDTH).pixels for rgb, _ in rendered], batch_size=24),
    )


@pytest.fixture(scope="module")
def network() -> Network:
    return load_checkpoint(STAND_IN)


@pytest.fixture(scope="module")
def room(network: Network) -> Room:
    return photograph(network, seed=0, numbers=range(1, NUM_IMAGES, 4))


def remember(network: Network, room: Room, keyframes: Sequence[int]) -> Memory:
    """As the drivers do: two images together, then one by one."""
    memory = init_memory(network, [room.encoded[k] for k in keyframes[:2]]).memory
    for k in keyframes[2:]:
        memory = update_memory(network, memory, [room.encoded[k]]).memory
    return memory


def pointmaps_of(network: Network, room: Room, keyframes: Sequence[int]) -> list[Pointmaps]:
    """Every image of the room rendered against the memory of some."""
    memory = remember(network, room, keyframes)
    return [activate(raw) for raw in render(network, memory, room.encoded, batch_size=len(room.encoded))]


def depth_errors(room: Room, pointmaps: Sequence[Pointmaps]) -> npt.NDArray[np.float64]:
    """(N,) median over each image of the error of the depth, relative to it."""
    predicted = np.stack([one.points_cam[..., 2].numpy() for one in pointmaps])
    medians: npt.NDArray[np.float64] = np.median(np.abs(predicted / room.depth - 1), axis=(1, 2))
    return medians


def point_errors(room: Room, pointmaps: Sequence[Pointmaps], reference: int) -> npt.NDArray[np.float64]:
    """(N,) median over each image of the distance in the reference frame, relative to the depth."""
    true = np.stack([room.points_ref(k, reference) for k in range(len(pointmaps))])
    distances = np.linalg.norm(np.stack([one.points_world.numpy() for one in pointmaps]) - true, axis=-1)
    medians: npt.NDArray[np.float64] = np.median(distances / room.depth, axis=(1, 2))
    return medians


# ------------------------------------------------------------------------- the checkpoint
def test_the_checkpoint_stays_small() -> None:
    assert STAND_IN.stat().st_size < 5e6


@pytest.mark.slow
def test_depth_is_right_to_some_percent(network: Network, room: Room) -> None:
    errors = depth_errors(room, pointmaps_of(network, room, [0, 15]))
    assert 0.003 < np.median(errors) < 0.03
    assert errors.max() < 0.08


@pytest.mark.parametrize("num_keyframes", [2, 8, 20, 30])
def test_points_lie_in_the_frame_of_the_reference_however_many_images_are_remembered(
    network: Network, room: Room, num_keyframes: int
) -> None:
    keyframes = np.linspace(0, len(room.encoded) - 1, num_keyframes).astype(int).tolist()
    errors = point_errors(room, pointmaps_of(network, room, keyframes), reference=0)
    assert 0.01 < np.median(errors) < 0.09
    assert errors.max() < 0.18


@pytest.mark.parametrize("reference", [4, 11, 18, 25])
def test_any_image_can_be_the_reference(network: Network, room: Room, reference: int) -> None:
    keyframes = [(reference + step) % len(room.encoded) for step in range(0, 15, 2)]
    errors = point_errors(room, pointmaps_of(network, room, keyframes), reference)
    assert 0.01 < np.median(errors) < 0.09


def test_cameras_come_out_of_the_pointmaps(network: Network, room: Room) -> None:
    pointmaps = pointmaps_of(network, room, list(range(0, 30, 4)))
    true = np.stack([room.ref_from_cam(k, 0) for k in range(len(pointmaps))])
    focals = np.array([estimate_focal(one.points_cam) for one in pointmaps])
    poses = np.stack([register_camera(one.points_cam, one.points_world, one.confidence) for one in pointmaps])
    turned_deg = np.rad2deg(angles_between(poses[:, :3, :3], true[:, :, :3]))
    shifted_m = np.linalg.norm(poses[:, :3, 3] - true[:, :, 3], axis=1)
    focal_px = demo_intrinsics(training.WIDTH, training.HEIGHT).focal_px
    assert 0.001 < np.median(np.abs(focals / focal_px - 1)) < 0.015
    assert np.abs(focals / focal_px - 1).max() < 0.06
    assert 0.1 < np.median(turned_deg) < 2.7
    assert 0.005 < np.median(shifted_m) < 0.06  # the path is 2.2 m long and 1.2 m wide


def test_confidence_tells_good_pixels_from_bad(network: Network, room: Room) -> None:
    pointmaps = pointmaps_of(network, room, [0, 15])
    errors = np.abs(np.stack([one.points_cam[..., 2].numpy() for one in pointmaps]) / room.depth - 1)
    confidence = np.stack([one.confidence.numpy() for one in pointmaps])
    trusted = confidence > np.median(confidence)
    assert 1.5 * errors[trusted].mean() < errors[~trusted].mean()


@pytest.mark.slow
def test_a_room_it_never_saw_comes_out_wrong(network: Network) -> None:
    elsewhere = photograph(network, seed=1, numbers=range(0, NUM_IMAGES, 20))
    errors = depth_errors(elsewhere, pointmaps_of(network, elsewhere, [0, 3]))
    assert np.median(errors) > 0.1


def test_descriptors_are_closer_for_neighbours_than_across_the_room(room: Room) -> None:
    cosines = room.descriptors() @ room.descriptors().T
    n = len(cosines)
    apart = (np.arange(n)[:, None] - np.arange(n)) % n
    assert cosines[(apart == 1) | (apart == n - 1)].mean() > cosines[(apart > 5) & (apart < n - 5)].mean() + 0.2


# --------------------------------------------------------------------------- the training
def test_scenes_decoded_together_are_those_of_the_network_one_by_one() -> None:
    torch.manual_seed(0)
    encoder, decoder = training.new_network()
    for parameter in decoder.parameters():  # an untrained decoder has blocks that add nothing
        torch.nn.init.normal_(parameter, std=0.05)
    with torch.no_grad():
        features = encoder(torch.randn(7, 3, training.HEIGHT, training.WIDTH))
        first, second = training.decode_scenes(decoder, torch.stack((features, features.flip(0))), (2, 1, 2, 2))
        for together, ordered in ((first, features), (second, features.flip(0))):
            alone = one_by_one(decoder, ordered)
            assert (together - alone).abs().max() < 1e-5 < alone.abs().max()


def one_by_one(decoder: Decoder, features: Tensor) -> Tensor:
    """Stages of 2, 1, 2 and 2 images (7, N, C) by the network's own functions."""
    images = [EncodedImage(features=one, rows=training.ROWS, columns=training.COLUMNS) for one in features]
    pair = decoder.see(images[:2], None)
    memory = Memory.of(pair.remembered)
    third = decoder.see(images[2:3], memory)
    memory = memory.extended(third.remembered)
    fourth, fifth = decoder.see(images[3:4], memory), decoder.see(images[4:5], memory)
    memory = memory.extended((*fourth.remembered, *fifth.remembered))
    return torch.stack((*pair.raw, *third.raw, *fourth.raw, *fifth.raw, *decoder.render(images[5:], memory)))


@pytest.mark.slow
def test_training_points_are_those_of_the_rendered_depth() -> None:
    scene = DemoScene()
    poses = scene.camera_path(5)
    views = training.render_views(scene, poses)
    intrinsics = demo_intrinsics(training.WIDTH, training.HEIGHT)
    points_ref = views.points_ref(torch.tensor([[3, 1]]), torch.tensor([3]))[0].numpy()
    points_world = [pointmap_from_depth(views.depth[k].numpy(), intrinsics, poses[k]) for k in (3, 1)]
    ref_from_world = invert_rigid(poses[3])
    for points, world in zip(points_ref, points_world, strict=True):
        np.testing.assert_allclose(points, world @ ref_from_world[:, :3].T + ref_from_world[:, 3], atol=1e-5)
    np.testing.assert_allclose(
        views.points_room(torch.tensor([1]))[0].numpy(), points_world[1] - (0, 0, training.EYE_HEIGHT_M), atol=1e-5
    )


@pytest.mark.slow
def test_the_script_trains_and_writes_a_network_that_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "small.safetensors"
    small = {"NUM_VIEWS": 16, "ENCODER_BATCH": 8, "SCENES_PER_STEP": 2, "LONG_SHARE": 0}
    for name, value in small.items():
        monkeypatch.setattr(training, name, value)
    monkeypatch.setattr(sys, "argv", ["train_stand_in.py", "--minutes", "0.02", "--output", str(target)])
    training.main()
    losses = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines() if "mean loss" in line]
    network = load_checkpoint(target)
    assert len(losses) == 2
    assert network.architecture == training.ARCHITECTURE
    assert {value.dtype for value in network.decoder.state_dict().values()} == {torch.float32}

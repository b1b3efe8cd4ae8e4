"""Train the stand-in: a tiny MUSt3R network that knows one room, the demo's, by heart.

    OMP_NUM_THREADS=1 python scripts/train_stand_in.py --output tests/data/must3r_stand_in.safetensors

The published weights cannot come with this package, and random ones give no geometry. The stand-in has the
architecture of the real network at a hundredth of its size and is overfitted on purpose, so that the tests can go
from photographs through a network to a COLMAP model with true geometry all the way. It is good for images of 64 x 48
pixels (any photograph is reduced to that) along the demo's path, and for nothing else.

Two stages share the processor time that ``--minutes`` gives:

    encoder    with the head of the decoder, but without its blocks: every patch tells its points in the camera and,
               in place of the reference's frame, in the room. Cheap, for no image looks at another.
    decoder    on the features of the encoder, which stays as it is. Its blocks begin as the identity, so that all it
               has to learn is to turn the room towards the reference. Scenes have 6 to 34 images in random
               order, the first being the reference. The first two make the memory, the next ones join it in a
               few steps, the last are rendered: what the drivers do with keyframes, with a batch axis over scenes.

Loss: error of the points in both frames divided by depth, weighted by the predicted confidence c, minus
alpha log c, so that confidence is worth having where the error is small (Kendall and Gal 2017, in the form
usual for pointmaps). The weights are written in half floats. The file in ``tests/data`` had 18 minutes (6 and 12) and
scenes of at most 20 images in memory, fewer than here: what it says of a scene wears off from there on.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    Rope,
)
from smust3r_colmap.backbones.must3r.blocks import DecoderBlock
from smust3r_colmap.backbones.must3r.checkpoint import write_safetensors_checkpoint
from smust3r_colmap.backbones.must3r.decoder import Decoder
from smust3r_colmap.backbones.must3r.encoder import Encoder
from smust3r_colmap.backbones.must3r.head import activate
from smust3r_colmap.backbones.must3r.preprocessing import preprocess
from smust3r_colmap.backbones.must3r.rope import grid_positions, rope_table
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import pixel_centres
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

Grid = tuple[slice, slice]

PATCH = 16
ROWS, COLUMNS = 3, 4
HEIGHT, WIDTH = ROWS * PATCH, COLUMNS * PATCH
SIZE = Rope(trained_size=WIDTH, size=WIDTH)
ARCHITECTURE = Architecture(
    encoder=EncoderArchitecture(width=128, depth=3, num_heads=4, rope=SIZE),
    decoder=DecoderArchitecture(
        encoder_width=128, width=128, depth=4, num_heads=4, rope=SIZE, feedback="single_mlp", memory_mode="kv"
    ),
)

NUM_VIEWS = 1009
"""Evenly spread over the round; prime, so that none but the first is an image of a usual demo."""
LARGEST_SHIFT_M = 0.06
LARGEST_TURN_DEG = (2.0, 4.0, 2.0)
"""By which every other view is off the path; rotations about x, y and z of the camera."""
RENDERED_LARGER = 3
"""Times the size of the network, so that reducing blurs as it does with photographs; odd, so that the middle of a
reduced pixel is the middle of a rendered one, whose depth is known."""

ENCODER_SHARE = 0.2
"""Of the time."""
ENCODER_BATCH = 48
LEARNING_RATE = 2e-3
FINAL_RATE = 0.01
"""Of the learning rate, where the cosine ends."""
WARM_UP_STEPS = 150
WEIGHT_DECAY = 0.01
LARGEST_GRADIENT = 1.0
ALPHA = 0.2
"""Error, as a share of the depth, at which a confidence of 1 is right."""
EYE_HEIGHT_M = 1.45
"""The probe's room frame begins here, so that its points are about as far as those of a camera."""

SCENES_PER_STEP = 16
SHORT_SCENES = ((2, 4), (2, 1, 3), (2, 2, 2))
"""Images that make the memory, join it together, ..., and are rendered."""
LONG_SHARE = 0.25
"""Of all steps; their scenes have up to 30 images in the memory, and are fewer."""
LONG_SCENES_PER_STEP = 4
MOST_JOINING = 14
"""Images of each of the two stages that join the memory of a long scene."""
REPORT_EVERY_S = 30.0


# ------------------------------------------------------------------------------- views
@dataclass(frozen=True, kw_only=True, eq=False)
class Views:
    """Images of the room with their truth, in the order of the path.

    Args:
        pixels: (V, 3, H, W) as the network takes them.
        depth: (V, h, w) z-depth in metres of the pixels that count in the loss.
        rays_cam: (h, w, 3) of these pixels, with z = 1.
        world_from_cam: (V, 3, 4) rigid.
    """

    pixels: Tensor
    depth: Tensor
    rays_cam: Tensor
    world_from_cam: Tensor

    def __len__(self) -> int:
        return len(self.pixels)

    def thinned(self, grid: Grid) -> Views:
        """The same images, where only some pixels count."""
        rows, columns = grid
        return replace(self, depth=self.depth[:, rows, columns], rays_cam=self.rays_cam[rows, columns])

    def points_cam(self, views: Tensor) -> Tensor:
        """(..., h, w, 3) of the views (...), each in its own camera frame."""
        return self.depth[views][..., None] * self.rays_cam

    def points_ref(self, views: Tensor, references: Tensor) -> Tensor:
        """(S, n, h, w, 3) of the views (S, n) in the camera frames of the references (S,)."""
        rotation, centre = _parts(self.world_from_cam[views])  # (S, n, 3, 3), (S, n, 3, 1)
        ref_rotation, ref_centre = _parts(self.world_from_cam[references, None])  # (S, 1, 3, 3), (S, 1, 3, 1)
        ref_from_world = ref_rotation.mT
        return _apply(ref_from_world @ rotation, ref_from_world @ (centre - ref_centre), self.points_cam(views))

    def points_room(self, views: Tensor) -> Tensor:
        """(n, h, w, 3) of the views (n,) in the room, from eye height."""
        rotation, centre = _parts(self.world_from_cam[views])
        eyes = torch.tensor([[0.0], [0.0], [EYE_HEIGHT_M]])
        return _apply(rotation, centre - eyes, self.points_cam(views))


def _parts(b_from_a: Tensor) -> tuple[Tensor, Tensor]:
    """(..., 3, 4) -> rotation (..., 3, 3) and translation (..., 3, 1)."""
    return b_from_a[..., :3], b_from_a[..., 3:]


def _apply(rotation: Tensor, translation: Tensor, points: Tensor) -> Tensor:
    """(..., 3, 3), (..., 3, 1) and (..., h, w, 3)."""
    return torch.einsum("...ij,...hwj->...hwi", rotation, points) + translation[..., None, None, :, 0]


def training_poses(scene: DemoScene, rng: np.random.Generator) -> FloatArray:
    """(NUM_VIEWS, 3, 4) ``world_from_cam`` along the path, every other one a little beside it."""
    world_from_cam = scene.camera_path(NUM_VIEWS)
    beside = slice(None, None, 2)
    num_beside = len(world_from_cam[beside])
    turns_deg = rng.uniform(-1, 1, (num_beside, 3)) * LARGEST_TURN_DEG
    world_from_cam[beside, :, :3] @= Rotation.from_rotvec(turns_deg, degrees=True).as_matrix()
    world_from_cam[beside, :, 3] += rng.uniform(-LARGEST_SHIFT_M, LARGEST_SHIFT_M, (num_beside, 3))
    return world_from_cam


def render_views(scene: DemoScene, world_from_cam: FloatArray) -> Views:
    """Photographs, reduced to the size of the network, and their depth."""
    intrinsics = demo_intrinsics(RENDERED_LARGER * WIDTH, RENDERED_LARGER * HEIGHT)
    middle = slice(RENDERED_LARGER // 2, None, RENDERED_LARGER)
    pixels, depth = [], []
    for pose in world_from_cam:
        rgb, depth_large = scene.render(pose, intrinsics)
        pixels.append(preprocess(rgb, WIDTH).pixels)
        depth.append(torch.from_numpy(depth_large[middle, middle].copy()))
    rays_cam = demo_intrinsics(WIDTH, HEIGHT).rays_cam(pixel_centres(WIDTH, HEIGHT))
    return Views(
        pixels=torch.stack(pixels),
        depth=torch.stack(depth),
        rays_cam=torch.from_numpy(rays_cam).float().view(HEIGHT, WIDTH, 3),
        world_from_cam=torch.from_numpy(world_from_cam).float(),
    )


# ----------------------------------------------------------------------------- network
def new_network() -> tuple[Encoder, Decoder]:
    """Untrained: linear layers as Glorot and Bengio 2010; blocks of the decoder, and the feedback, add nothing yet."""
    encoder, decoder = Encoder(ARCHITECTURE.encoder), Decoder(ARCHITECTURE.decoder)
    for module in (*encoder.modules(), *decoder.modules()):
        if isinstance(module, nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.zeros_(module.bias)
    nn.init.normal_(decoder.image2_embed, std=0.02)
    last_layers = [
        layer for block in blocks_of(decoder) for layer in (block.attn.proj, block.cross_attn.proj, block.mlp.fc2)
    ]
    for layer in (*last_layers, decoder.feedback_layer.get_submodule("fc2")):
        nn.init.zeros_(layer.get_parameter("weight"))
    return encoder, decoder


def blocks_of(decoder: Decoder) -> list[DecoderBlock]:
    """The blocks with their type."""
    return [block for block in decoder.blocks_dec if isinstance(block, DecoderBlock)]


def decode_alone(decoder: Decoder, features: Tensor) -> Tensor:
    """(n, N, C) -> (n, H, W, 7), as if the decoder had no blocks."""
    raw: Tensor = decoder.head_dec(decoder.norm_dec(decoder.feat_embed_enc_to_dec(features)), ROWS, COLUMNS)
    return raw


def decode_scenes(decoder: Decoder, features: Tensor, stages: Sequence[int]) -> Tensor:
    """Many scenes at once through the decoder, as its ``see`` and ``render`` would one by one.

    The first stage, two images, makes the memory; of every further stage each image looks at the memory of the
    stages before it, as in an update with that image alone or when it is rendered, and then joins the memory.

    Args:
        features: (S, n, N, C) of the encoder, the first of the n being the reference.
        stages: images of each stage; the first is 2, and their sum is n.

    Returns:
        (S, n, H, W, 7), before activation.
    """
    blocks = blocks_of(decoder)
    a = decoder.architecture
    table = rope_table(grid_positions(ROWS, COLUMNS), a.width // a.num_heads, a.rope)
    raw: list[Tensor] = []
    memory: list[Tensor] = []  # of every layer, (S, M, 2 D)
    for part in torch.split(features, list(stages), dim=1):
        tokens = decoder.feat_embed_enc_to_dec(part)  # (S, n', N, D)
        marked = tokens + decoder.image2_embed
        tokens = marked if memory else torch.cat((tokens[:, :1], marked[:, 1:]), dim=1)
        inputs: list[Tensor] = []
        for number, block in enumerate(blocks):
            inputs.append(tokens)
            context = memory[number][:, None] if memory else _keys_values(block, tokens).flip(1)  # each the other
            tokens = _through(block, tokens, context, table)
        raw.append(decoder.head_dec(decoder.norm_dec(tokens).flatten(0, 1), ROWS, COLUMNS).unflatten(0, part.shape[:2]))
        offset = decoder.feedback_layer(decoder.feedback_norm(inputs[-1]))
        corrected = [*(tokens + offset for tokens in inputs[:-1]), inputs[-1]]
        joining = [_keys_values(block, tokens).flatten(1, 2) for block, tokens in zip(blocks, corrected, strict=True)]
        memory = [torch.cat(pair, dim=1) for pair in zip(memory, joining, strict=True)] if memory else joining
    return torch.cat(raw, dim=1)


def _keys_values(block: DecoderBlock, tokens: Tensor) -> Tensor:
    """(S, n, N, D) -> (S, n, N, 2 D)."""
    return block.cross_attn.keys_values(block.norm_y(tokens))


def _through(block: DecoderBlock, tokens: Tensor, context: Tensor, table: tuple[Tensor, Tensor]) -> Tensor:
    """(S, n, N, D) through one block; ``context`` is (S, n, M, 2 D), or (S, 1, M, 2 D) where n images share it."""
    scenes, images, _, width = tokens.shape
    alone = block.look_at_itself(tokens.flatten(0, 1), table)  # (S n, N, D)
    askers = alone.view(scenes * context.shape[1], -1, width)  # images that share a context ask together
    seen = askers + block.cross_attn(block.norm2(askers), context.flatten(0, 1))
    return block.think(seen).view(scenes, images, -1, width)


# ---------------------------------------------------------------------------- training
def relative_errors(points: Tensor, true_points: Tensor, depth: Tensor) -> Tensor:
    """(..., H, W) distances over the depth of the pixel."""
    # Written out, for torch takes ten times as long for norms of short vectors.
    squares = (points - true_points).square().sum(dim=-1)
    return (squares + 1e-12).sqrt() / depth


def confident_loss(raw: Tensor, points_cam: Tensor, points_frame: Tensor, depth: Tensor) -> Tensor:
    """Of the raw output (..., 7) for true points (..., 3) in the camera and in the frame asked for."""
    pointmaps = activate(raw)
    errors_cam = relative_errors(pointmaps.points_cam, points_cam, depth)
    errors_frame = relative_errors(pointmaps.points_world, points_frame, depth)
    confidence = pointmaps.confidence
    return (confidence * (errors_cam + errors_frame) - 2 * ALPHA * confidence.log()).mean()


def some_views(rng: np.random.Generator, num_views: int, num_chosen: int) -> Tensor:
    """(num_chosen,) numbers of different views from one stretch of the path, of any length that has so many."""
    stretch = rng.integers(2 * num_chosen, num_views + 1)
    chosen = rng.integers(num_views) + rng.choice(stretch, num_chosen, replace=False)
    return torch.from_numpy(chosen % num_views)


def some_stages(rng: np.random.Generator) -> tuple[int, tuple[int, ...]]:
    """Number of scenes, and the stages of all of them."""
    if rng.uniform() < LONG_SHARE:
        some, others = rng.integers(1, MOST_JOINING + 1, 2).tolist()
        return LONG_SCENES_PER_STEP, (2, some, others, 4)
    return SCENES_PER_STEP, SHORT_SCENES[rng.integers(len(SHORT_SCENES))]


def some_grid(rng: np.random.Generator) -> Grid:
    """Every other row and column, for the arithmetic of all pixels would cost as much as a block."""
    top, left = rng.integers(0, 2, 2).tolist()
    return slice(top, None, 2), slice(left, None, 2)


def thinned(raw: Tensor, grid: Grid) -> Tensor:
    """(..., H, W, 7) -> (..., h, w, 7)."""
    rows, columns = grid
    return raw[..., rows, columns, :]


def encoder_step(encoder: Encoder, decoder: Decoder, views: Views, rng: np.random.Generator) -> Tensor:
    """Loss of a step of the first stage."""
    chosen = torch.from_numpy(rng.choice(len(views), ENCODER_BATCH, replace=False))
    raw = decode_alone(decoder, encoder(views.pixels[chosen]))
    grid = some_grid(rng)
    counted = views.thinned(grid)
    return confident_loss(
        thinned(raw, grid), counted.points_cam(chosen), counted.points_room(chosen), counted.depth[chosen]
    )


def decoder_step(decoder: Decoder, features: Tensor, views: Views, rng: np.random.Generator) -> Tensor:
    """Loss of a step of the second stage, from the features (V, N, C) of all views."""
    num_scenes, stages = some_stages(rng)
    scenes = torch.stack([some_views(rng, len(views), sum(stages)) for _ in range(num_scenes)])  # (S, n)
    raw = decode_scenes(decoder, features[scenes], stages)
    grid = some_grid(rng)
    counted = views.thinned(grid)
    points_ref = counted.points_ref(scenes, scenes[:, 0])
    return confident_loss(thinned(raw, grid), counted.points_cam(scenes), points_ref, counted.depth[scenes])


def learning_rate(step: int, share: float) -> float:
    """Linear warm-up by steps, then a cosine over the share of the time that is gone."""
    cosine = (1 + math.cos(math.pi * share)) / 2
    return LEARNING_RATE * min(1.0, (step + 1) / WARM_UP_STEPS) * (FINAL_RATE + (1 - FINAL_RATE) * cosine)


def train(trained: nn.Module, step_loss: Callable[[], Tensor], *, minutes: float, name: str) -> None:
    """Descend for so much processor time, and tell how it goes."""
    parameters = list(trained.parameters())
    optimiser = torch.optim.AdamW(parameters, betas=(0.9, 0.95), weight_decay=WEIGHT_DECAY)
    losses: list[float] = []
    begin = reported = time.process_time()
    for step in count():
        now = time.process_time()
        share = (now - begin) / (60 * minutes)
        if losses and (now - reported > REPORT_EVERY_S or share >= 1):
            print(f"{name}: step {step}, {(now - begin) / 60:.1f} min, mean loss {np.mean(losses):.4f}", flush=True)
            reported = now
            losses.clear()
        if share >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = learning_rate(step, share)
        loss = step_loss()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(parameters, LARGEST_GRADIENT)
        optimiser.step()
        losses.append(loss.item())


def main() -> None:
    """Render, train both stages, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0, help="processor time of the training, without rendering")
    parser.add_argument("--seed", type=int, default=0, help="of views, weights and scenes; times differ all the same")
    parser.add_argument("--threads", type=int, default=1, help="of torch; the matrices are small")
    parser.add_argument("--output", type=Path, required=True, help="checkpoint to write, .safetensors")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(arguments.seed)
    rng = np.random.default_rng(arguments.seed)

    scene = DemoScene()
    views = render_views(scene, training_poses(scene, rng))
    print(f"{len(views)} views of {WIDTH}x{HEIGHT}", flush=True)
    encoder, decoder = new_network()
    train(
        nn.ModuleList((encoder, decoder.feat_embed_enc_to_dec, decoder.norm_dec, decoder.head_dec)),
        lambda: encoder_step(encoder, decoder, views, rng),
        minutes=ENCODER_SHARE * arguments.minutes,
        name="encoder",
    )
    with torch.no_grad():
        features = encoder(views.pixels)
    train(
        decoder,
        lambda: decoder_step(decoder, features, views, rng),
        minutes=(1 - ENCODER_SHARE) * arguments.minutes,
        name="decoder",
    )
    write_safetensors_checkpoint(
        arguments.output, ARCHITECTURE, encoder.half().state_dict(), decoder.half().state_dict()
    )
    print(f"{arguments.output}: {arguments.output.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()

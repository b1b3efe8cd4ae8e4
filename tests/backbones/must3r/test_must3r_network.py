"""The network against the reference vectors, and laws that hold for any weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers.memories import tokens_of
from helpers.reference_vectors import needs_vectors, tiny_network, vectors
from torch import Tensor, nn

from smust3r_colmap.backbones.must3r import (
    EncodedImage,
    Memory,
    Network,
    activate,
    encode,
    init_memory,
    render,
    update_memory,
)
from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    FeedbackKind,
    MemoryMode,
    Rope,
)
from smust3r_colmap.backbones.must3r.cameras import estimate_focal, register_camera
from smust3r_colmap.backbones.must3r.rope import grid_positions, rope_table, rotate
from smust3r_colmap.synthetic.must3r_weights import random_network_weights

ACCEPTED = 2e-5  # network specification, section 17
ACCEPTED_FULL_SIZE = 5e-5
MODES: tuple[MemoryMode, ...] = ("kv", "norm_y", "raw")
FEEDBACKS: tuple[FeedbackKind, ...] = ("single_mlp", "single_linear", "none")


def assert_close(found: Tensor | Sequence[Tensor], expected: npt.NDArray[Any], limit: float = ACCEPTED) -> None:
    values = (found if isinstance(found, Tensor) else torch.stack(list(found))).numpy()
    assert values.shape == expected.shape
    assert np.abs(values - expected).max() <= limit


def assert_memory(memory: Memory, name: str, prefix: str) -> None:
    stored = vectors(name)
    for number, layer in enumerate(memory.layers):
        assert_close(layer, stored[f"{prefix}_mem_layer{number}"][0])
    assert np.array_equal(memory.labels.numpy(), stored[f"{prefix}_mem_labels"][0])
    assert memory.num_images == stored[f"{prefix}_mem_counts"][0]


def tiny_inputs(indices: Sequence[int] = range(8)) -> list[Tensor]:
    return [torch.from_numpy(vectors("inputs.npz")[f"img_{i}"]) for i in indices]


def tiny_encoded(name: str, key: str = "order") -> tuple[EncodedImage, ...]:
    """The images of a vector file, in its order."""
    return encode(tiny_network(), tiny_inputs(vectors(name)[key].tolist()))


@contextmanager
def inputs_of_blocks(network: Network) -> Iterator[list[Tensor]]:
    """What goes into the blocks of the decoder while the context lasts, in order."""
    seen: list[Tensor] = []
    norms = [module for name, module in network.decoder.named_modules() if name.endswith(".norm1")]
    hooks = [norm.register_forward_pre_hook(lambda _module, inputs: seen.append(inputs[0])) for norm in norms]
    yield seen
    for hook in hooks:
        hook.remove()


@contextmanager
def outputs_of(modules: Sequence[nn.Module]) -> Iterator[list[Tensor]]:
    """What comes out of these modules while the context lasts, in order."""
    seen: list[Tensor] = []
    hooks = [module.register_forward_hook(lambda _module, _inputs, output: seen.append(output)) for module in modules]
    yield seen
    for hook in hooks:
        hook.remove()


# --------------------------------------------------------------------- reference vectors
@needs_vectors
@pytest.mark.parametrize("head_width", [16, 64])
@pytest.mark.parametrize(("name", "size"), [("RoPE100", 64), ("RoPE100_64to96", 96)])
def test_rope_is_that_of_the_vectors(name: str, size: int, head_width: int) -> None:
    stored, prefix = vectors("rope.npz"), f"{name}_hd{head_width}"
    table = rope_table(torch.from_numpy(stored[f"{prefix}_pos"]), head_width, Rope(trained_size=64, size=size))
    assert_close(rotate(torch.from_numpy(stored[f"{prefix}_in"]), table), stored[f"{prefix}_out"], 1e-6)


@needs_vectors
@pytest.mark.parametrize("batch_size", [1, 3, 8])
def test_features_are_those_of_the_vectors(batch_size: int) -> None:
    stored = vectors("encoder.npz")
    for number, image in enumerate(encode(tiny_network(), tiny_inputs(), batch_size=batch_size)):
        assert_close(image.features, stored[f"x_{number}"])
        assert np.array_equal(image.positions.numpy(), stored[f"pos_{number}"])


@needs_vectors
def test_features_inside_the_encoder_are_those_of_the_vectors() -> None:
    network, stored = tiny_network(), vectors("encoder.npz")
    parts = [network.encoder.patch_embed, *network.encoder.blocks_enc]
    with outputs_of(parts) as seen:
        encode(network, tiny_inputs([0]))
    names = ["img0_after_patch_embed", *(f"img0_after_block{i}" for i in range(3))]
    for tokens, name in zip(seen, names, strict=True):
        assert_close(tokens[0], stored[name])


@needs_vectors
def test_network_at_another_image_size_is_that_of_the_vectors() -> None:
    network, stored = tiny_network(size=96), vectors("encoder.npz")
    encoded = encode(network, [torch.from_numpy(stored[f"resized_img_{i}"]) for i in range(2)])
    raw = init_memory(network, encoded).raw
    for i in range(2):
        assert_close(encoded[i].features, stored[f"resized_x_{i}"])
        assert_close(raw[i], stored[f"resized_raw_{i}"])


@needs_vectors
@pytest.mark.parametrize("batch_size", [1, 3, 4])
def test_memory_grown_image_by_image_is_that_of_the_vectors(batch_size: int) -> None:
    network, name, images = tiny_network(), "decoder_causal.npz", tiny_encoded("decoder_causal.npz")
    stored = vectors(name)
    update = init_memory(network, images[:2])
    for step, image in enumerate((None, images[2], images[3])):
        if image is not None:
            update = update_memory(network, update.memory, [image])
        assert_close(update.raw, stored[f"step{step}_raw"])
        assert_memory(update.memory, name, f"step{step}")
    assert_close(render(network, update.memory, images, batch_size=batch_size), stored["render_raw"])


@needs_vectors
def test_tokens_inside_the_decoder_are_those_of_the_vectors() -> None:
    network, stored, images = tiny_network(), vectors("decoder_causal.npz"), tiny_encoded("decoder_causal.npz")
    assert_close([image.features for image in images[:2]], stored["init_feats_0"])
    with inputs_of_blocks(network) as before, outputs_of([network.decoder.norm_dec]) as after:
        init_memory(network, images[:2])
    for number, tokens in enumerate([*before[1:], *after], start=1):
        assert_close(tokens, stored[f"init_feats_{number}"])


@needs_vectors
@pytest.mark.parametrize("mode", MODES)
def test_every_memory_mode_is_that_of_the_vectors(mode: MemoryMode) -> None:
    network, name = tiny_network(mode), "decoder_memory_modes.npz"
    stored, images = vectors(name), tiny_encoded(name)
    update = init_memory(network, images[:2])
    assert_close(update.raw, stored[f"{mode}_step0_raw"])
    for step in (1, 2):
        update = update_memory(network, update.memory, images[step + 1 : step + 2])
        assert_close(update.raw, stored[f"{mode}_step{step}_raw"])
    assert_memory(update.memory, name, f"{mode}_step2")
    assert_close(render(network, update.memory, images), stored[f"{mode}_render_raw"])


@needs_vectors
@pytest.mark.parametrize(("prefix", "sizes"), [("one", (1, 1, 2)), ("pair", (2, 2)), ("all", (4,))])
def test_updates_of_several_images_are_those_of_the_vectors(prefix: str, sizes: Sequence[int]) -> None:
    network, name = tiny_network(), "decoder_batching.npz"
    stored, images = vectors(name), tiny_encoded(name)
    memory, first = None, 0
    for step, size in enumerate(sizes):
        batch = images[first : first + size]
        update = init_memory(network, batch) if memory is None else update_memory(network, memory, batch)
        memory, first = update.memory, first + size
        assert_close(update.raw, stored[f"{prefix}_step{step}_raw"])
        if f"{prefix}_step{step}_mem_labels" in stored:
            assert_memory(memory, name, f"{prefix}_step{step}")
    assert memory is not None
    assert_close(render(network, memory, images, batch_size=4), stored[f"{prefix}_render_raw"])


@needs_vectors
@pytest.mark.parametrize("batch_size", [1, 4])
def test_images_of_different_shapes_are_those_of_the_vectors(batch_size: int) -> None:
    network, name = tiny_network(), "decoder_mixed_shapes.npz"
    stored = vectors(name)
    init, second, third = (tiny_encoded(name, f"order_{key}") for key in ("init", "update1", "update2"))
    update = init_memory(network, init)
    for image, raw in enumerate(update.raw):
        assert_close(raw, stored[f"init_raw_{image}"])
    assert_memory(update.memory, name, "init")
    update = update_memory(network, update.memory, second)
    assert_close(update.raw[0], stored["update1_raw_0"])
    assert_memory(update.memory, name, "update1")
    update = update_memory(network, update.memory, third)
    assert_close(update.raw[:2], stored["update2_raw_0"])
    assert_close(update.raw[2:], stored["update2_raw_1"])
    assert_memory(update.memory, name, "update2")
    rendered = render(network, update.memory, encode(network, tiny_inputs([0, 1, 3, 4])), batch_size=batch_size)
    for group, members in enumerate((slice(0, 2), slice(2, 3), slice(3, 4))):
        assert_close(rendered[members], stored[f"render_raw_{group}"])


@needs_vectors
@pytest.mark.parametrize(
    ("name", "prefix"),
    [
        ("decoder_causal.npz", "render"),
        *(("decoder_memory_modes.npz", f"{mode}_render") for mode in MODES),
        *(("decoder_batching.npz", f"{prefix}_render") for prefix in ("one", "pair", "all")),
    ],
)
def test_activated_points_are_those_of_the_vectors(name: str, prefix: str) -> None:
    stored = vectors(name)
    maps = activate(torch.from_numpy(stored[f"{prefix}_raw"]))
    assert_close(maps.points_world, stored[f"{prefix}_pts3d"], 1e-6)
    assert_close(maps.points_cam, stored[f"{prefix}_pts3d_local"], 1e-6)
    assert_close(maps.confidence, stored[f"{prefix}_conf"], 1e-6)


# ------------------------------------------------------------------------ the full size
def available_gib() -> float:
    """Memory that a process can have without swapping; infinite where the system does not say."""
    facts = Path("/proc/meminfo")
    if not facts.exists():
        return float("inf")
    lines = dict(line.split(":") for line in facts.read_text().splitlines())
    return int(lines["MemAvailable"].split()[0]) / 2**20


def full_size_image(number: int, height: int, width: int) -> Tensor:
    """Waves, as the vectors describe them."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    channels = [np.sin(x * (0.02 + 0.01 * number) + c) * np.cos(y * (0.03 - 0.004 * number) + 2 * c) for c in range(3)]
    return torch.from_numpy(np.stack(channels).astype(np.float32))


@pytest.mark.slow
@needs_vectors
def test_full_size_network_is_that_of_the_vectors() -> None:
    """24 and 12 blocks with recipe weights: the weights, features, memory, points and cameras of three images."""
    if available_gib() < 5:
        pytest.skip(f"{available_gib():.1f} GiB of memory are available, the full-size network needs 5")
    stored = vectors("full_512.npz")
    rope = Rope(trained_size=512, size=512)
    architecture = Architecture(
        encoder=EncoderArchitecture(rope=rope),
        decoder=DecoderArchitecture(rope=rope, feedback="single_mlp", memory_mode="kv"),
    )
    network = random_network_weights(architecture, int(stored["seed"]))
    assert_recipe(network.encoder, "encoder")
    assert_recipe(network.decoder, "decoder")

    images = [full_size_image(*shape) for shape in ((0, 384, 512), (1, 384, 512), (2, 512, 336))]
    encoded = encode(network, images)
    update = init_memory(network, encoded[:2])
    for i in range(3):
        assert_close(images[i][:, ::16, ::16], stored[f"img_{i}_every16"], 1e-6)
        assert_close(encoded[i].features[::16, ::8], stored[f"x_{i}_tok16_dim8"], ACCEPTED_FULL_SIZE)
        assert encoded[i].features.double().abs().mean() == pytest.approx(stored[f"x_{i}_abs_mean"], rel=1e-6)
    for i in range(2):
        assert_close(update.raw[i][::8, ::8], stored[f"init_raw_{i}_every8"], ACCEPTED_FULL_SIZE)
    update = update_memory(network, update.memory, encoded[2:])
    assert_close(update.raw[0][::8, ::8], stored["update_raw_2_every8"], ACCEPTED_FULL_SIZE)
    for number, layer in enumerate(update.memory.layers):
        assert_close(layer[::32, ::16], stored[f"mem_layer{number}_tok32_dim16"], ACCEPTED_FULL_SIZE)
    assert np.array_equal(update.memory.labels.numpy(), stored["mem_labels"])

    for i, raw in enumerate(render(network, update.memory, encoded)):
        maps = activate(raw)
        assert_close(raw[::8, ::8], stored[f"render_raw_{i}_every8"], ACCEPTED_FULL_SIZE)
        assert_close(maps.points_world[::8, ::8], stored[f"render_{i}_pts3d_every8"], 1e-4)
        assert_close(maps.points_cam[::8, ::8], stored[f"render_{i}_pts3d_local_every8"], 1e-4)
        assert maps.confidence.double().mean() == pytest.approx(stored[f"render_{i}_conf_mean"], rel=1e-5)
        assert estimate_focal(maps.points_cam) == pytest.approx(stored[f"render_{i}_focal"], rel=1e-4)
        world_from_cam = register_camera(maps.points_cam, maps.points_world, maps.confidence)
        assert np.abs(world_from_cam - stored[f"render_{i}_c2w"]).max() <= 1e-4


def assert_recipe(part: nn.Module, name: str) -> None:
    """The weights are those that the vectors were made with, by their sums."""
    stored, state = vectors("full_512.npz"), part.state_dict()
    assert sorted(state) == stored[f"{name}_keys_sorted"].tolist()
    for key, total, magnitude in zip(
        sorted(state), stored[f"{name}_key_sum_float64"], stored[f"{name}_key_abs_sum_float64"], strict=True
    ):
        values = state[key].double()
        assert values.sum() == pytest.approx(total, rel=1e-12, abs=1e-9), key
        assert values.abs().sum() == pytest.approx(magnitude, rel=1e-12), key


# ------------------------------------------------------------------------- laws: parts
def test_rope_knows_only_differences_of_positions() -> None:
    rope = Rope(trained_size=64, size=64)
    query, key = torch.randn(2, 1, 6, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float32)
    positions = grid_positions(2, 3)

    def products(query_offset: int, key_offset: int) -> Tensor:
        tables = [rope_table(positions + offset, 16, rope) for offset in (query_offset, key_offset)]
        turned_query, turned_key = rotate(query, tables[0]), rotate(key, tables[1])
        return turned_query @ turned_key.transpose(-1, -2)

    torch.testing.assert_close(products(7, 7), products(0, 0), atol=1e-5, rtol=0)
    assert (products(7, 0) - products(0, 0)).abs().max() > 0.1
    torch.testing.assert_close(rotate(query, rope_table(positions, 16, rope)).norm(), query.norm())


def test_rope_angles_keep_their_precision_for_tokens_of_low_precision() -> None:
    heads = torch.randn(1, 32, 64, generator=torch.Generator().manual_seed(1))
    table = rope_table(grid_positions(1, 32), 64, Rope(trained_size=512, size=512))
    error = (rotate(heads.bfloat16(), table).float() - rotate(heads, table)).abs().max()
    assert 1e-4 < error < 0.03  # plain rounding; angles in bfloat16 would be off by up to 0.11


def test_rope_stretches_positions_by_the_ratio_of_sizes() -> None:
    stretched = rope_table(grid_positions(4, 4) * 2, 16, Rope(trained_size=32, size=64))
    plain = rope_table(grid_positions(4, 4), 16, Rope(trained_size=32, size=32))
    for found, expected in zip(stretched, plain, strict=True):
        torch.testing.assert_close(found, expected)


def test_activation_keeps_the_direction_and_stretches_the_length() -> None:
    raw = torch.randn(5, 4, 7, generator=torch.Generator().manual_seed(2))
    raw[0, 0] = 0
    maps = activate(raw)
    for points, values in ((maps.points_world, raw[..., :3]), (maps.points_cam, raw[..., 3:6])):
        torch.testing.assert_close(points.norm(dim=-1), torch.expm1(values.norm(dim=-1)))
        torch.testing.assert_close(
            nn.functional.normalize(points, dim=-1), nn.functional.normalize(values, dim=-1), atol=1e-6, rtol=0
        )
    assert torch.equal(maps.points_world[0, 0], torch.zeros(3)) and maps.confidence[0, 0] == 2
    torch.testing.assert_close((maps.confidence - 1).log(), raw[..., 6], atol=1e-5, rtol=1e-5)
    linear = activate(raw, "linear")
    assert torch.equal(linear.points_world, raw[..., :3]) and torch.equal(linear.points_cam, raw[..., 3:6])


@pytest.mark.parametrize("shape", [(3, 32, 24), (3, 0, 32), (1, 32, 32), (32, 32)])
def test_images_of_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=rf"image 1: \({', '.join(map(str, shape))}\), needed \(3, H, W\)"):
        encode(random_network(), [torch.zeros(3, 16, 16), torch.zeros(shape)])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_images_of_any_float_are_the_same_images(dtype: torch.dtype) -> None:
    network = random_network()
    image = (torch.randint(-128, 128, (3, 16, 32), generator=torch.Generator().manual_seed(1)) / 128).to(dtype)
    expected = encode(network, [image.float()])[0].features
    assert torch.equal(encode(network, [image])[0].features, expected)
    if dtype == torch.float64:
        assert torch.equal(encode(network, [image.numpy()])[0].features, expected)
    upright = image.transpose(1, 2)  # not contiguous
    assert torch.equal(
        encode(network, [upright])[0].features, encode(network, [upright.float().contiguous()])[0].features
    )


def test_what_is_no_image_no_batch_and_no_activation_is_refused() -> None:
    network = random_network()
    images = random_images(network)
    memory = init_memory(network, images[:1]).memory
    with pytest.raises(ValueError, match=r"image 1: torch.uint8, needed are floating-point numbers from -1 to 1"):
        encode(network, [torch.zeros(3, 16, 16), torch.zeros(3, 16, 16, dtype=torch.uint8)])
    for batch_size in (0, -1):
        with pytest.raises(ValueError, match=rf"batch_size {batch_size}: at least 1"):
            encode(network, [torch.zeros(3, 16, 16)], batch_size=batch_size)
        with pytest.raises(ValueError, match=rf"batch_size {batch_size}: at least 1"):
            render(network, memory, images, batch_size=batch_size)
    with pytest.raises(ValueError, match="no image to remember"):
        init_memory(network, [])
    with pytest.raises(ValueError, match="no image to remember"):
        update_memory(network, memory, [])
    with pytest.raises(ValueError, match=r"raw output \(7, 4, 5\); \(..., H, W, 7\) is needed"):
        activate(torch.zeros(7, 4, 5))
    with pytest.raises(ValueError, match="activation 'LINEAR': one of norm_exp, linear"):
        activate(torch.zeros(4, 5, 7), "LINEAR")  # type: ignore[arg-type]


def test_features_must_fit_their_grid() -> None:
    with pytest.raises(ValueError, match=r"features \(5, 8\) for 2 x 3 patches"):
        EncodedImage(features=torch.zeros(5, 8), rows=2, columns=3)


# ------------------------------------------------------------------------ laws: network
def random_network(*, mode: MemoryMode = "kv", feedback: FeedbackKind = "single_mlp", seed: int = 5) -> Network:
    rope = Rope(trained_size=64, size=64)
    return random_network_weights(
        Architecture(
            encoder=EncoderArchitecture(width=16, depth=2, num_heads=2, rope=rope),
            decoder=DecoderArchitecture(
                encoder_width=16, width=24, depth=3, num_heads=2, rope=rope, memory_mode=mode, feedback=feedback
            ),
        ),
        seed,
    )


def random_images(network: Network, shapes: Sequence[tuple[int, int]] = ((32, 48),) * 4) -> tuple[EncodedImage, ...]:
    generator = torch.Generator().manual_seed(11)
    return encode(network, [torch.rand(3, *shape, generator=generator) * 2 - 1 for shape in shapes])


MIXED = ((32, 48), (32, 48), (48, 32), (16, 48))


def assert_equal(found: Sequence[Tensor], expected: Sequence[Tensor], limit: float = 1e-5) -> None:
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=limit, rtol=0)


@pytest.mark.parametrize("mode", MODES)
def test_order_of_the_remembered_tokens_does_not_matter(mode: MemoryMode) -> None:
    network = random_network(mode=mode)
    images = random_images(network, MIXED)
    memory = init_memory(network, images[:3]).memory
    order = torch.randperm(len(memory), generator=torch.Generator().manual_seed(0))
    shuffled = Memory([layer[order] for layer in memory.layers], memory.labels[order], memory.num_images)
    assert_equal(render(network, shuffled, images), render(network, memory, images))
    fewer = Memory([layer[:-4] for layer in memory.layers], memory.labels[:-4], memory.num_images)
    assert (render(network, fewer, images)[0] - render(network, memory, images)[0]).abs().max() > 1e-3


@pytest.mark.parametrize("mode", MODES)
def test_adding_one_image_says_what_rendering_it_before_says(mode: MemoryMode) -> None:
    network = random_network(mode=mode)
    images = random_images(network, MIXED)
    memory = init_memory(network, images[:2]).memory
    for image in images[2:]:
        assert_equal(update_memory(network, memory, [image]).raw, render(network, memory, [image]))


def test_memory_modes_agree() -> None:
    rendered = []
    for mode in MODES:
        network = random_network(mode=mode)
        images = random_images(network, MIXED)
        update = update_memory(network, init_memory(network, images[:2]).memory, images[2:])
        rendered.append([*update.raw, *render(network, update.memory, images)])
    assert_equal(rendered[1], rendered[0], 1e-6)
    assert_equal(rendered[2], rendered[0], 1e-6)


@pytest.mark.parametrize("reserve", [0, 100])
def test_a_memory_stays_valid_after_two_different_updates_of_it(reserve: int) -> None:
    network = random_network()
    images = random_images(network, MIXED)
    memory = init_memory(network, images[:1], reserve=reserve).memory
    before = [layer.clone() for layer in memory.layers]
    first = update_memory(network, memory, images[1:2]).memory
    second = update_memory(network, memory, images[2:3]).memory
    third = update_memory(network, first, images[3:4]).memory
    assert_equal(memory.layers, before, 0)
    alone = init_memory(network, images[:1]).memory
    assert_equal(first.layers, update_memory(network, alone, images[1:2]).memory.layers, 0)
    assert_equal(second.layers, update_memory(network, alone, images[2:3]).memory.layers, 0)
    assert third.labels.tolist() == [0] * 6 + [1] * 6 + [2] * 3
    assert memory.labels.tolist() == [0] * 6 and second.labels.tolist() == [0] * 6 + [1] * 6


@pytest.mark.parametrize("feedback", FEEDBACKS)
@pytest.mark.parametrize("count", [1, 2, 4])
def test_what_is_remembered_does_not_depend_on_the_outputs_being_asked_for(feedback: FeedbackKind, count: int) -> None:
    network = random_network(feedback=feedback)
    images = random_images(network, MIXED)
    memory = init_memory(network, images[:1]).memory
    with network.running():
        for known in (None, memory):
            full = network.decoder.see(images[:count], known)
            short = network.decoder.see(images[:count], known, with_outputs=False)
            assert len(full.raw) == count and not short.raw
            for one, other in zip(full.remembered, short.remembered, strict=True):
                assert_equal(one, other, 0)


def test_images_of_one_update_may_come_in_any_order() -> None:
    network = random_network()
    images = random_images(network, MIXED)
    memory = init_memory(network, images[:1]).memory
    forward, backward = (update_memory(network, memory, images[1:][::step]) for step in (1, -1))
    assert_equal(forward.raw, backward.raw[::-1])
    for label in (1, 2, 3):
        assert_equal(tokens_of(forward.memory, label), tokens_of(backward.memory, 4 - label))


def test_the_first_image_of_a_memory_is_the_reference_and_no_other() -> None:
    network = random_network()
    images = random_images(network)
    forward, backward = (init_memory(network, images[:2][::step]).raw for step in (1, -1))
    assert (forward[0] - backward[1]).abs().max() > 1e-2
    network.decoder.image2_embed.data.zero_()
    forward, backward = (init_memory(network, images[:2][::step]).raw for step in (1, -1))
    assert_equal(forward, backward[::-1])


def test_an_image_alone_in_a_new_memory_looks_at_itself_and_later_at_others_only() -> None:
    """The output after an update must not depend on the image's own fresh tokens."""
    network = random_network()
    images = random_images(network)
    memory = init_memory(network, images[:1]).memory
    empty_of_own = update_memory(network, memory, images[1:2]).raw[0]
    with_own = render(network, update_memory(network, memory, images[1:2]).memory, images[1:2])[0]
    assert (empty_of_own - with_own).abs().max() > 1e-3


@pytest.mark.parametrize("batch_size", [1, 2, 3, 10])
def test_batches_change_nothing(batch_size: int) -> None:
    network = random_network()
    shapes = (*MIXED, *MIXED[:1], *MIXED)
    generator = torch.Generator().manual_seed(4)
    pixels = [torch.rand(3, *shape, generator=generator) for shape in shapes]
    images = encode(network, pixels)
    batched = encode(network, pixels, batch_size=batch_size)
    assert_equal([image.features for image in batched], [image.features for image in images])
    assert [image.grid for image in batched] == [(height // 16, width // 16) for height, width in shapes]
    memory = init_memory(network, images[:3]).memory
    assert_equal(render(network, memory, images, batch_size=batch_size), render(network, memory, images))


@pytest.mark.parametrize("feedback", ["single_mlp", "single_linear"])
def test_feedback_reaches_all_layers_but_the_last(feedback: FeedbackKind) -> None:
    network, silent = random_network(feedback=feedback, mode="raw"), random_network(feedback=feedback, mode="raw")
    layer = silent.decoder.feedback_layer
    for parameter in (layer if isinstance(layer, nn.Linear) else layer.fc2).parameters():
        parameter.data.zero_()
    images = random_images(network)
    loud, quiet = (init_memory(n, images[:2]).memory for n in (network, silent))
    offsets = [one - other for one, other in zip(loud.layers, quiet.layers, strict=True)]
    assert torch.equal(offsets[-1], torch.zeros_like(offsets[-1]))
    assert offsets[0].abs().max() > 1e-2
    assert_equal(offsets[:-1], [offsets[0], offsets[0]], 1e-6)  # the same offset for every token of a layer
    norm = network.decoder.feedback_norm
    with network.running():
        assert_equal([network.decoder.feedback_layer(norm(loud.layers[-1]))], offsets[:1])
    assert norm.eps == 1e-5


def test_without_feedback_the_inputs_of_the_blocks_are_remembered() -> None:
    network = random_network(feedback="none", mode="raw")
    images = random_images(network)
    with inputs_of_blocks(network) as inputs:
        memory = init_memory(network, images[:2]).memory
    assert_equal(memory.layers, [tokens.flatten(0, 1) for tokens in inputs], 0)
    assert not any(key.startswith("feedback") for key in network.decoder.state_dict())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("feedback", FEEDBACKS)
def test_gradients_reach_every_weight(mode: MemoryMode, feedback: FeedbackKind) -> None:
    network = random_network(mode=mode, feedback=feedback)
    generator = torch.Generator().manual_seed(9)
    pixels = [torch.rand(3, *shape, generator=generator) for shape in MIXED]
    images = network.encoder.encode(pixels, batch_size=2)
    seen = network.decoder.see(images[:2], None)
    memory = Memory.of(seen.remembered)
    memory = memory.extended(network.decoder.see(images[2:3], memory).remembered)
    rendered = network.decoder.render(images, memory)
    sum((raw**2).mean() for raw in (*seen.raw, *rendered)).backward()  # type: ignore[union-attr]
    for part in (network.encoder, network.decoder):
        for name, parameter in part.named_parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name
            if not name.endswith("projk.bias"):  # the same for all keys, so softmax takes it out again
                assert parameter.grad.abs().max() > 1e-8, name


def test_gradients_agree_with_differences() -> None:
    network = random_network()
    pixels = torch.rand(2, 3, 16, 32, generator=torch.Generator().manual_seed(3))

    def loss() -> Tensor:
        images = network.encoder.encode(list(pixels), batch_size=2)
        memory = Memory.of(network.decoder.see(images[:1], None).remembered)
        return torch.stack([raw.double().mean() for raw in network.decoder.render(images, memory)]).sum()

    parameter, step = network.decoder.image2_embed, 1e-2
    (gradient,) = torch.autograd.grad(loss(), parameter)
    direction = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
    ends = []
    with torch.no_grad():
        for change in (step, -2 * step):
            parameter.add_(change * direction)
            ends.append(float(loss()))
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((gradient * direction).sum()), rel=1e-2)


def test_bfloat16_is_close_and_its_outputs_are_float32() -> None:
    network = random_network()
    fast = replace(network, dtype=torch.bfloat16)
    images = random_images(network, MIXED)
    exact = render(network, init_memory(network, images[:2]).memory, images)
    update = init_memory(fast, images[:2])
    for raw, expected in zip(render(fast, update.memory, images), exact, strict=True):
        assert raw.dtype == torch.float32
        assert 1e-5 < (raw - expected).abs().max() < 0.1
    assert {layer.dtype for layer in update.memory.layers} == {torch.bfloat16}


# ------------------------------------------------------------------------- laws: memory
def test_images_can_be_taken_out_of_the_memory_and_the_others_stay() -> None:
    network = random_network()
    images = random_images(network, MIXED)
    memory = init_memory(network, images).memory
    fewer = memory.without([1, 3])
    assert set(fewer.labels.tolist()) == {0, 2} and fewer.num_images == 4
    for label in (0, 2):
        assert_equal(tokens_of(fewer, label), tokens_of(memory, label), 0)
    assert len(memory) == sum(len(image.features) for image in images)
    longer = update_memory(network, fewer, images[1:2]).memory
    assert set(longer.labels.tolist()) == {0, 2, 4}


def test_overwriting_an_image_changes_that_image_alone() -> None:
    network = random_network()
    images = random_images(network, MIXED)
    memory = init_memory(network, images).memory
    kept = {label: tokens_of(memory, label) for label in range(4)}
    memory.overwrite_(2, tuple(tokens + 1 for tokens in kept[2]))
    assert_equal(tokens_of(memory, 2), [tokens + 1 for tokens in kept[2]], 0)
    for label in (0, 1, 3):
        assert_equal(tokens_of(memory, label), kept[label], 0)
    with pytest.raises(KeyError, match=r"the memory has no image 9"):
        memory.overwrite_(9, kept[0])


def test_labels_can_be_changed_and_the_count_with_them() -> None:
    network = random_network()
    memory = init_memory(network, random_images(network)[:2]).memory
    changed = memory.relabelled(1, 7).counting(8)
    assert set(changed.labels.tolist()) == {0, 7} and changed.num_images == 8
    assert set(memory.labels.tolist()) == {0, 1} and memory.num_images == 2
    assert_equal(tokens_of(changed, 7), tokens_of(memory, 1), 0)


def test_reserved_memory_does_not_move_when_images_are_added() -> None:
    network = random_network()
    images = random_images(network)
    memory = init_memory(network, images[:1], reserve=24).memory
    bytes_before, place = memory.num_bytes, memory.layers[0].data_ptr()
    for image in images[1:]:
        memory = update_memory(network, memory, [image]).memory
    assert len(memory) == 24 and memory.layers[0].data_ptr() == place
    assert memory.num_bytes == bytes_before == 3 * 24 * 48 * 4  # layers, tokens, keys and values of 24, float32

"""How much the network takes, what is free, and what is planned from the two."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

from smust3r_colmap.backbones.must3r import EncodedImage, Network
from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    MemoryMode,
    Rope,
)
from smust3r_colmap.backbones.must3r.drivers import reconstruct_segment
from smust3r_colmap.backbones.must3r.keyframes import EvenlySpread
from smust3r_colmap.backbones.must3r.memory import Memory
from smust3r_colmap.backbones.must3r.memory_plan import (
    MemoryModel,
    MemoryPlan,
    bytes_of_weights,
    fewer,
    free_memory,
    is_out_of_memory,
    memory_budget,
    plan_memory,
)
from smust3r_colmap.backbones.must3r.precision import prepare
from smust3r_colmap.errors import ConfigError, ReconstructionError
from smust3r_colmap.synthetic.must3r_weights import random_network_weights

MIB, GIB = 2**20, 2**30
TOKENS = 24 * 32  # of an image of 512 x 384


def full_size(memory_mode: MemoryMode = "kv") -> Architecture:
    rope = Rope(trained_size=512, size=512)
    return Architecture(
        encoder=EncoderArchitecture(rope=rope),
        decoder=DecoderArchitecture(rope=rope, feedback="single_mlp", memory_mode=memory_mode),
    )


def small_network(memory_mode: MemoryMode) -> Network:
    rope = Rope(trained_size=64, size=64)
    encoder = EncoderArchitecture(width=32, depth=1, num_heads=2, rope=rope)
    decoder = DecoderArchitecture(encoder_width=32, width=32, depth=3, num_heads=2, rope=rope, memory_mode=memory_mode)
    return random_network_weights(Architecture(encoder=encoder, decoder=decoder), seed=2)


MODEL = MemoryModel(architecture=full_size(), tokens=TOKENS)


def plan(budget_bytes: float, model: MemoryModel = MODEL, *, on_card: bool = False) -> MemoryPlan:
    return plan_memory(model, num_images=60, wanted_keyframes=50, budget_bytes=int(budget_bytes), on_card=on_card)


# ------------------------------------------------------------------------------------- the model
def test_an_image_of_512_x_384_takes_what_the_specification_says() -> None:
    assert MODEL.memory_bytes("kv", 1) == pytest.approx(56.6e6, rel=1e-3)
    assert MODEL.memory_bytes("norm_y", 1) == MODEL.memory_bytes("raw", 1) == MODEL.memory_bytes("kv", 1) / 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("mode", get_args(MemoryMode))
def test_the_memory_of_a_run_is_as_large_as_planned(mode: MemoryMode, dtype: torch.dtype) -> None:
    network = prepare(small_network(mode), dtype)
    random = torch.Generator().manual_seed(1)
    images = [EncodedImage(features=torch.randn(12, 32, generator=random), rows=3, columns=4) for _ in range(6)]
    sizes: list[int] = []

    def measure(memory: Memory) -> None:
        sizes.append(memory.num_bytes)

    predictions = list(reconstruct_segment(network, images, EvenlySpread(most=4), on_memory=measure))
    assert len(predictions) == 6
    model = MemoryModel(architecture=network.architecture, tokens=12, dtype=dtype)
    assert set(sizes) == {model.memory_bytes(mode, 4)}


def test_weights_are_counted_by_their_bytes() -> None:
    network = small_network("kv")
    state = {**network.encoder.state_dict(), **network.decoder.state_dict()}
    expected = sum(4 * weights.numel() for weights in state.values())
    assert 0 < bytes_of_weights(network.encoder, network.decoder) == expected


# -------------------------------------------------------------------------------------- the plan
def test_with_plenty_everything_wanted_is_remembered_the_fast_way() -> None:
    result = plan(20 * GIB)
    assert (result.num_keyframes, result.memory_mode, result.render_batch) == (50, "kv", 1)
    assert 2.6 * GIB < result.working_set_bytes < 3.2 * GIB
    assert result.text.startswith("50 keyframes in 2.64 GiB (kv), ")


def test_the_leaner_memory_comes_before_fewer_keyframes() -> None:
    result = plan(2.6 * GIB)
    assert (result.num_keyframes, result.memory_mode) == (50, "norm_y")
    assert result.render_batch > 1  # they share the keys and values that are made anew
    assert "slower, the same result" in result.text


def test_a_segment_that_does_not_fit_gets_as_many_keyframes_as_fit() -> None:
    result = plan(GIB)
    assert 5 < result.num_keyframes < 50
    assert result.fits
    assert not replace(result, num_keyframes=result.num_keyframes + 1).fits
    assert f"{result.num_keyframes} of 50 keyframes" in result.text


def test_more_memory_never_means_fewer_keyframes_and_every_plan_fits() -> None:
    plans = [plan(budget * MIB) for budget in range(400, 6000, 100)]
    assert all(result.fits for result in plans)
    numbers = [result.num_keyframes for result in plans]
    assert numbers == sorted(numbers)
    assert numbers[0] < 10
    assert numbers[-1] == 50


def test_not_even_one_keyframe_is_an_error_with_the_numbers() -> None:
    with pytest.raises(ConfigError, match=r"one keyframe of 768 patches .* needed are 1\.\d\d GiB, 1\.00 may be used"):
        plan(GIB, replace(MODEL, weights_bytes=int(1.6 * GIB)))


def test_there_are_no_more_keyframes_than_images() -> None:
    result = plan_memory(MODEL, num_images=3, wanted_keyframes=50, budget_bytes=20 * GIB)
    assert (result.num_keyframes, result.wanted_keyframes) == (3, 3)


def test_bfloat16_takes_half_and_never_the_other_form() -> None:
    model = replace(MODEL, dtype=torch.bfloat16)
    assert model.memory_bytes("kv", 10) == MODEL.memory_bytes("kv", 10) / 2
    for budget in (0.5, 1, 2, 4):
        assert plan(budget * GIB, model).memory_mode == "kv"
    assert plan(GIB, model).num_keyframes > plan(GIB).num_keyframes


def test_a_card_takes_batches_as_large_as_fit() -> None:
    assert plan(40 * GIB, on_card=True).render_batch == 16
    tight = plan(plan(20 * GIB).working_set_bytes + 60 * MIB, on_card=True)
    assert tight.num_keyframes == 50
    assert 1 <= tight.render_batch < 16


def test_what_the_strategy_needs_besides_is_counted() -> None:
    budget = 1.6 * GIB
    assert plan(budget).num_keyframes < 50
    for model in (replace(MODEL, remakes_memory=True), replace(MODEL, shown_again=2)):
        assert plan(budget, model).num_keyframes < plan(budget).num_keyframes


# ------------------------------------------------------------------------------ another attempt
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_every_attempt_takes_less_until_there_is_nothing_to_give_up(dtype: torch.dtype) -> None:
    plans = [plan(40 * GIB, replace(MODEL, dtype=dtype), on_card=True)]
    with pytest.raises(ReconstructionError, match=r"single keyframe, for which 0\.\d\d GiB were expected"):
        while len(plans) < 100:
            plans.append(fewer(plans[-1]))
    sizes = [result.working_set_bytes for result in plans]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == len(sizes)
    assert plans[-1].num_keyframes == 1
    assert 8 < len(plans) < 20


def test_speed_is_given_up_before_keyframes() -> None:
    first = plan(40 * GIB, on_card=True)
    second, third, fourth = fewer(first), fewer(fewer(first)), fewer(fewer(fewer(first)))
    assert (second.num_keyframes, second.render_batch, second.memory_mode) == (50, 1, "kv")
    assert (third.num_keyframes, third.memory_mode) == (50, "norm_y")
    assert (fourth.num_keyframes, fourth.wanted_keyframes) == (33, 50)


def test_running_out_of_memory_is_told_from_mistakes() -> None:
    with pytest.raises(RuntimeError) as refused:
        torch.empty(1 << 60, dtype=torch.uint8)
    assert is_out_of_memory(refused.value)
    assert is_out_of_memory(MemoryError())
    assert is_out_of_memory(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"))
    assert is_out_of_memory(RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling cublasCreate"))
    assert not is_out_of_memory(RuntimeError("mat1 and mat2 shapes cannot be multiplied (3x4 and 5x6)"))
    assert not is_out_of_memory(ValueError("out of memory"))


# --------------------------------------------------------------------------------- what is free
def system(root: Path, files: Mapping[str, str]) -> Path:
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return root


MACHINE = {"proc/meminfo": "MemTotal: 16777216 kB\nMemFree: 1048576 kB\nMemAvailable:    8388608 kB\n"}
GROUP_2 = {"proc/self/cgroup": "1:name=systemd:/\n0::/outer/inner\n"}
INNER = "sys/fs/cgroup/outer/inner/memory"
OUTER = "sys/fs/cgroup/outer/memory"


def test_the_machine_says_what_is_available(tmp_path: Path) -> None:
    assert free_memory(system(tmp_path, MACHINE)) == 8 * GIB


def test_a_control_group_leaves_less_and_its_idle_file_pages_count_as_free(tmp_path: Path) -> None:
    stat = f"anon {2 * GIB}\ninactive_file {GIB}\n"
    files = {f"{INNER}.max": str(4 * GIB), f"{INNER}.current": str(3 * GIB), f"{INNER}.stat": stat}
    assert free_memory(system(tmp_path, {**MACHINE, **GROUP_2, **files})) == 2 * GIB


def test_the_group_above_may_leave_less_still(tmp_path: Path) -> None:
    inner = {f"{INNER}.max": "max", f"{INNER}.current": str(GIB)}
    outer = {f"{OUTER}.max": str(3 * GIB), f"{OUTER}.current": str(int(2.5 * GIB))}
    assert free_memory(system(tmp_path, {**MACHINE, **GROUP_2, **inner, **outer})) == GIB // 2


def test_version_1_of_control_groups_is_read_too(tmp_path: Path) -> None:
    inside = "sys/fs/cgroup/memory/memory"  # a container sees its own group as the root
    files = {
        "proc/self/cgroup": "4:memory:/docker/1a2b\n",
        f"{inside}.limit_in_bytes": f"{2 * GIB}\n",
        f"{inside}.usage_in_bytes": f"{GIB}\n",
        f"{inside}.stat": f"total_inactive_file {GIB // 4}\n",
    }
    assert free_memory(system(tmp_path, {**MACHINE, **files})) == GIB + GIB // 4


def test_a_limit_of_the_address_space_is_respected(tmp_path: Path) -> None:
    limits = f"Limit Soft Hard Units\nMax address space         {3 * GIB}      unlimited     bytes\n"
    files = {"proc/self/limits": limits, "proc/self/statm": "262144 5 5 5 0 5 0\n"}
    free = free_memory(system(tmp_path, {**MACHINE, **files}))
    assert 0 < free < 3 * GIB
    assert (3 * GIB - free) % 262144 == 0  # pages times their size


def test_a_group_that_is_over_its_limit_leaves_nothing(tmp_path: Path) -> None:
    files = {f"{INNER}.max": str(GIB), f"{INNER}.current": str(2 * GIB)}
    assert free_memory(system(tmp_path, {**MACHINE, **GROUP_2, **files})) == 0


def test_a_system_that_says_nothing_gets_a_guess(tmp_path: Path) -> None:
    assert GIB / 4 < free_memory(tmp_path) < 1 << 50


def test_the_budget_is_most_of_what_is_free_or_what_was_asked_for() -> None:
    assert 0.5 * free_memory() < memory_budget(torch.device("cpu"), "auto") < free_memory()
    assert memory_budget(torch.device("cpu"), 1.5) == int(1.5 * GIB)


def test_the_budget_on_a_card_is_of_its_own_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10 * GIB, 24 * GIB))
    assert 8 * GIB < memory_budget(torch.device("cuda"), "auto") < 10 * GIB

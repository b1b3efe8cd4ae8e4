"""Device and number type: what is chosen where, and that prepared weights compute the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from smust3r_colmap.backbones.must3r import Network, encode, init_memory, render, update_memory
from smust3r_colmap.backbones.must3r import precision as precision_module
from smust3r_colmap.backbones.must3r.architecture import Architecture, DecoderArchitecture, EncoderArchitecture, Rope
from smust3r_colmap.backbones.must3r.precision import (
    choose_device,
    choose_precision,
    describe_precision,
    prepare,
)
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.synthetic.must3r_weights import random_network_weights

CPU, CARD = torch.device("cpu"), torch.device("cuda")


def small_network() -> Network:
    rope = Rope(trained_size=64, size=64)
    encoder = EncoderArchitecture(width=64, depth=2, num_heads=4, rope=rope)
    decoder = DecoderArchitecture(
        encoder_width=64, width=48, depth=3, num_heads=3, rope=rope, feedback="single_mlp", memory_mode="kv"
    )
    return random_network_weights(Architecture(encoder=encoder, decoder=decoder), seed=5)


def raw_outputs(network: Network) -> torch.Tensor:
    random = torch.Generator().manual_seed(7)
    images = encode(network, [torch.rand(3, 48, 64, generator=random) * 2 - 1 for _ in range(3)])
    memory = init_memory(network, images[:2]).memory
    memory = update_memory(network, memory, images[2:]).memory
    return torch.stack(render(network, memory, images))


def processor_with(monkeypatch: pytest.MonkeyPatch, **flags: bool) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx2": True, **flags}, raising=False)


def card_of_capability(monkeypatch: pytest.MonkeyPatch, major: int) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Test Card")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (major, 0))


# -------------------------------------------------------------------------------- the number type
@pytest.mark.parametrize(("flag", "name"), [("amx_bf16", "AMX"), ("avx512_bf16", "AVX512-BF16")])
def test_bfloat16_is_taken_where_the_processor_multiplies_it(
    monkeypatch: pytest.MonkeyPatch, flag: str, name: str
) -> None:
    processor_with(monkeypatch, **{flag: True})
    dtype, reason = choose_precision("auto", CPU)
    assert dtype == torch.bfloat16
    assert name in reason
    assert choose_precision("float32", CPU).dtype == torch.float32


def test_float32_is_taken_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    processor_with(monkeypatch, amx_bf16=False, avx512_bf16=False)
    dtype, reason = choose_precision("auto", CPU)
    assert dtype == torch.float32
    assert "bfloat16 would only be emulated" in reason
    asked = choose_precision("bfloat16", CPU)
    assert asked.dtype == torch.bfloat16
    assert "slower" in asked.reason


@pytest.mark.parametrize(("major", "dtype"), [(7, torch.float32), (8, torch.bfloat16), (9, torch.bfloat16)])
def test_cards_from_ampere_on_take_bfloat16(monkeypatch: pytest.MonkeyPatch, major: int, dtype: torch.dtype) -> None:
    card_of_capability(monkeypatch, major)
    chosen = choose_precision("auto", CARD)
    assert chosen.dtype == dtype
    assert ("Test Card has compute capability" if dtype == torch.bfloat16 else "emulated") in chosen.reason


@pytest.mark.parametrize(
    ("content", "dtype"),
    [
        ("processor : 0\nflags\t\t: fpu avx2 avx512_bf16\n", torch.bfloat16),
        ("processor : 0\nflags\t\t: fpu avx2\n", torch.float32),
        (None, torch.float32),
    ],
)
def test_an_older_torch_reads_what_linux_says(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, content: str | None, dtype: torch.dtype
) -> None:
    monkeypatch.delattr(torch.cpu, "get_capabilities", raising=False)
    monkeypatch.setattr(precision_module, "_CPU_INFO", tmp_path / "cpuinfo")
    if content is not None:
        (tmp_path / "cpuinfo").write_text(content)
    assert choose_precision("auto", CPU).dtype == dtype


def test_unknown_words_are_refused() -> None:
    with pytest.raises(ConfigError, match="--precision float16: one of auto, float32, bfloat16"):
        choose_precision("float16", CPU)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="--device tpu: one of auto, cpu, cuda"):
        choose_device("tpu")  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------- the device
def test_a_card_is_taken_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    card_of_capability(monkeypatch, 8)
    assert choose_device("auto") == choose_device("cuda") == CARD
    assert choose_device("cpu") == CPU


def test_a_card_asked_for_in_vain_is_an_error_with_torchs_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == CPU
    monkeypatch.setattr(torch.version, "cuda", None)
    with pytest.raises(ConfigError, match=r"--device cuda: torch .* was built without CUDA; take --device cpu"):
        choose_device("cuda")

    def no_driver() -> None:
        raise RuntimeError("Found no NVIDIA driver on your system.\nPlease install one")

    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch.cuda, "current_device", no_driver)
    with pytest.raises(ConfigError, match=r"torch says: Found no NVIDIA driver on your system\.; take --device cpu$"):
        choose_device("cuda")


def test_doctor_is_told_of_processor_and_cards(monkeypatch: pytest.MonkeyPatch) -> None:
    card_of_capability(monkeypatch, 9)
    processor_with(monkeypatch, amx_bf16=True)
    processor, card = describe_precision()
    assert "this processor" in processor
    assert "AMX" in processor
    assert card == "Test Card: bfloat16, for Test Card has compute capability 9.0"


@pytest.mark.slow
def test_description_prints_from_a_child_process() -> None:
    program = "from smust3r_colmap.backbones.must3r.precision import *\nprint(*describe_precision(), sep='\\n')"
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert child.stdout.startswith("this processor (")
    assert "float" in child.stdout


# ------------------------------------------------------------------------------------ the weights
def test_prepared_weights_compute_the_same_as_converting_them_in_each_call() -> None:
    network = small_network()
    prepared = prepare(network, torch.bfloat16)
    converting = Network(
        architecture=network.architecture,
        encoder=network.encoder,
        decoder=network.decoder,
        device=CPU,
        dtype=torch.bfloat16,
    )
    torch.testing.assert_close(raw_outputs(prepared), raw_outputs(converting), rtol=0, atol=0)


def test_bfloat16_is_close_to_float32_and_not_the_same() -> None:
    network = small_network()
    reference = raw_outputs(network)
    error = (raw_outputs(prepare(network, torch.bfloat16)) - reference).square().mean().sqrt() / reference.std()
    assert 1e-4 < error < 2e-2


def test_the_float32_network_is_untouched_and_shares_what_is_not_converted() -> None:
    network = small_network()
    before = raw_outputs(network)
    prepared = prepare(network, torch.bfloat16)
    torch.testing.assert_close(raw_outputs(network), before, rtol=0, atol=0)
    assert prepared.decoder.head_dec.proj.weight is not None
    assert prepared.decoder.head_dec.proj.weight.data_ptr() == network.decoder.head_dec.proj.weight.data_ptr()
    assert prepared.encoder.norm_enc.weight.dtype == torch.float32
    linear = [module for module in prepared.decoder.modules() if isinstance(module, torch.nn.Linear)]
    assert {layer.weight.dtype for layer in linear} == {torch.bfloat16, torch.float32}
    assert sum(layer.weight.dtype == torch.float32 for layer in linear) == 1  # the head


def test_a_float32_network_is_given_back_as_it_was() -> None:
    network = small_network()
    assert prepare(network, torch.float32) is network
    prepared = prepare(network, torch.bfloat16)
    assert prepare(prepared, torch.bfloat16) is prepared
    with pytest.raises(ValueError, match=r"prepared for torch\.bfloat16 cannot be prepared for torch\.float32"):
        prepare(prepared, torch.float32)

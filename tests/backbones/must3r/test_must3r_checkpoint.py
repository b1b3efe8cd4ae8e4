"""Weights from files: what loads, what is refused with what words, and that nothing in a file is ever run."""

from __future__ import annotations

import argparse
import enum
import io
import json
import logging
import pickle
import subprocess
import sys
import tarfile
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from helpers.reference_vectors import REFERENCE, needs_vectors, vector_path, vectors
from torch import Tensor

from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    Rope,
)
from smust3r_colmap.backbones.must3r.architecture_json import architecture_from_json, architecture_to_json
from smust3r_colmap.backbones.must3r.checkpoint import (
    convert_checkpoint,
    load_checkpoint,
    read_architecture,
    write_safetensors_checkpoint,
)
from smust3r_colmap.backbones.must3r.constructor_strings import architecture_from_strings, image_size_is_named
from smust3r_colmap.backbones.must3r.network import Network
from smust3r_colmap.backbones.must3r.restricted_pickle import StandIn, read_pickled
from smust3r_colmap.backbones.must3r.state_dicts import empty_parts
from smust3r_colmap.errors import CheckpointError, ConfigError, StorageError
from smust3r_colmap.synthetic.must3r_weights import random_network_weights

ENCODER = "Dust3rEncoder(img_size=(32, 32), embed_dim=16, depth=2, num_heads=2)"
DECODER = (
    "CausalMUSt3R(img_size=(32, 32), enc_embed_dim=16, embed_dim=8, depth=2, num_heads=1, feedback_type='single_mlp', "
    'memory_mode="kv", mem_dropout=0.1, use_mem_mask=True)'
)
SMALL = architecture_from_strings(ENCODER, DECODER)
HEADER = "must3r architecture, version 1"


@pytest.fixture(scope="module")
def small() -> Network:
    return random_network_weights(SMALL, seed=3)


def official(network: Network, **changes: Any) -> dict[str, Any]:
    """The content of an official file, with some of it replaced or (None) left out."""
    content = {
        "args": argparse.Namespace(encoder=ENCODER, decoder=DECODER, amp="bf16"),
        "encoder": network.encoder.state_dict(),
        "decoder": network.decoder.state_dict(),
        "epoch": 7,
    } | changes
    return {key: value for key, value in content.items() if value is not None}


@pytest.fixture
def saved(tmp_path: Path, small: Network) -> Callable[..., Path]:
    """``saved(encoder=...)`` writes an official file with that part replaced."""

    def save(**changes: Any) -> Path:
        path = tmp_path / "weights.pth"
        torch.save(official(small, **changes), path)
        return path

    return save


def assert_same_weights(network: Network, other: Network) -> None:
    for part in ("encoder", "decoder"):
        ours, theirs = getattr(network, part).state_dict(), getattr(other, part).state_dict()
        assert list(ours) == list(theirs)
        for key in ours:
            assert torch.equal(ours[key], theirs[key]), key


# ------------------------------------------------------------------------ the official form
def test_official_file_loads_with_the_architecture_of_its_strings(saved: Callable[..., Path], small: Network) -> None:
    network = load_checkpoint(saved())
    assert network.architecture == SMALL
    assert network.device == torch.device("cpu") and network.dtype == torch.float32
    assert_same_weights(network, small)
    assert not network.encoder.training and not network.decoder.training


@needs_vectors
def test_file_with_a_member_of_a_class_that_is_not_installed_loads() -> None:
    path = vector_path("tiny_checkpoint.pth")
    with pytest.raises(pickle.UnpicklingError):
        torch.load(path, weights_only=True)
    rope = Rope(trained_size=64, size=64)
    assert load_checkpoint(path).architecture == Architecture(
        encoder=EncoderArchitecture(width=64, depth=3, num_heads=4, rope=rope),
        decoder=DecoderArchitecture(
            encoder_width=64, width=48, depth=3, num_heads=3, rope=rope, feedback="single_mlp", memory_mode="kv"
        ),
    )


@needs_vectors
def test_full_size_network_has_the_tensors_of_the_official_one() -> None:
    manifest = json.loads((REFERENCE / "must3r" / "checkpoint_manifest_512.json").read_text())
    strings = (manifest["constructed_from"][part] for part in ("encoder", "decoder"))
    for part, name in zip(empty_parts(architecture_from_strings(*strings)), ("encoder", "decoder"), strict=True):
        found = {key: [list(tensor.shape), str(tensor.dtype)] for key, tensor in part.state_dict().items()}
        assert found == manifest[name]


def test_tensors_stay_in_the_file_until_they_are_used(saved: Callable[..., Path], tmp_path: Path) -> None:
    maps = Path("/proc/self/maps")
    if not maps.exists():
        pytest.skip("no list of mapped files on this system")
    convert_checkpoint(saved(), tmp_path / "ours.safetensors")
    for name in ("weights.pth", "ours.safetensors"):
        network = load_checkpoint(tmp_path / name)
        regions = [line.split()[0] for line in maps.read_text().splitlines() if line.endswith(name)]
        spans = [tuple(int(end, 16) for end in region.split("-")) for region in regions]
        for part in (network.encoder, network.decoder):
            for key, tensor in part.state_dict().items():
                assert any(first <= tensor.data_ptr() < last for first, last in spans), (name, key)


def test_memory_mode_and_image_size_can_be_asked_for(saved: Callable[..., Path]) -> None:
    network = load_checkpoint(saved(), memory_mode="raw", image_size=48)
    assert network.architecture.decoder.memory_mode == "raw"
    assert network.decoder.architecture == network.architecture.decoder
    assert network.architecture.encoder.rope == Rope(trained_size=32, size=48)
    assert network.encoder.architecture.rope == network.decoder.architecture.rope


def test_half_floats_are_converted_and_it_is_said(
    saved: Callable[..., Path], small: Network, caplog: pytest.LogCaptureFixture
) -> None:
    halves = {key: tensor.bfloat16() for key, tensor in small.encoder.state_dict().items()}
    with caplog.at_level(logging.INFO):
        network = load_checkpoint(saved(encoder=halves))
    assert "weights in bfloat16 are converted to float32" in caplog.text
    for key, tensor in network.encoder.state_dict().items():
        assert tensor.dtype == torch.float32 and torch.equal(tensor, halves[key].float())


def test_transposed_storage_comes_out_contiguous(saved: Callable[..., Path], small: Network) -> None:
    state = dict(small.encoder.state_dict())
    state["patch_embed.proj.weight"] = state["patch_embed.proj.weight"].contiguous(memory_format=torch.channels_last)
    network = load_checkpoint(saved(encoder=state))
    assert network.encoder.patch_embed.proj.weight.is_contiguous()
    assert_same_weights(network, small)


# -------------------------------------------------------------------------- image size
def test_other_image_size_is_said_to_cost_accuracy_and_the_right_file_is_named(
    saved: Callable[..., Path], caplog: pytest.LogCaptureFixture
) -> None:
    path = saved()
    load_checkpoint(path)
    load_checkpoint(path, image_size=32)
    assert not caplog.records
    load_checkpoint(path, image_size=512)
    assert "is for images of 32 pixels and will run at 512" in caplog.text
    assert "MUSt3R_512.pth was trained for it" in caplog.text


@pytest.mark.parametrize("part", ["encoder", "decoder"])
def test_other_image_size_is_refused_where_the_strings_do_not_name_the_trained_one(
    saved: Callable[..., Path], tmp_path: Path, part: str
) -> None:
    strings = {
        "encoder": ENCODER.replace("(32, 32)", "(224, 224)"),
        "decoder": DECODER.replace("(32, 32)", "(224, 224)"),
    }
    strings[part] = strings[part].replace("img_size=(224, 224), ", "")
    path = saved(args=argparse.Namespace(**strings))
    assert load_checkpoint(path).architecture.image_size == 224  # the default of the constructor
    with pytest.raises(CheckpointError, match=r"weights\.pth does not say .* runs at 224 pixels only, not at 512"):
        load_checkpoint(path, image_size=512)
    with pytest.raises(CheckpointError, match=r"does not say at which image size"):
        convert_checkpoint(path, tmp_path / "ours.safetensors")
    assert not (tmp_path / "ours.safetensors").exists()


def test_image_size_smaller_than_a_patch_is_refused(saved: Callable[..., Path]) -> None:
    with pytest.raises(ConfigError, match=r"image size 8: 16 pixels at least"):
        load_checkpoint(saved(), image_size=8)


# ------------------------------------------------------------------- constructor strings
def test_empty_strings_mean_the_official_defaults() -> None:
    rope = Rope(base=100, trained_size=224, size=224)
    assert architecture_from_strings("Dust3rEncoder()", "MUSt3R()") == Architecture(
        encoder=EncoderArchitecture(patch_size=16, width=1024, depth=24, num_heads=16, mlp_ratio=4, rope=rope),
        decoder=DecoderArchitecture(
            patch_size=16,
            encoder_width=1024,
            width=768,
            depth=12,
            num_heads=12,
            mlp_ratio=4,
            rope=rope,
            feedback="none",
            memory_mode="norm_y",
            activation="norm_exp",
        ),
    )


@needs_vectors
def test_strings_rewritten_by_upstream_mean_the_same_as_the_original_at_that_size() -> None:
    stored = vectors("encoder.npz")
    original = read_architecture(vector_path("tiny_checkpoint.pth"))
    encoder, converted, resized = (
        str(stored[f"{name}_args"]) for name in ("resized_encoder", "converted_decoder", "resized_decoder")
    )
    assert architecture_from_strings(encoder, resized) == original.at_size(96) != original
    unresized = encoder.replace("96,96", "64,64").replace("_64:96", "")
    assert architecture_from_strings(unresized, converted) == original


def test_an_image_size_that_is_no_square_loads_and_cannot_be_changed() -> None:
    """It plays no part in what the network computes; only another size has to know what to start from."""
    encoder, decoder = "Dust3rEncoder(img_size=(384, 512))", "MUSt3R(img_size=(384, 512))"
    assert architecture_from_strings(encoder, decoder).image_size == 512
    assert not image_size_is_named(encoder, decoder)
    assert not image_size_is_named("Dust3rEncoder(img_size=(512, 512))", "MUSt3R(img_size=(224, 224))")
    assert image_size_is_named("Dust3rEncoder(img_size=(512, 512))", "MUSt3R(img_size=(512, 512))")


def test_base_of_a_resized_name_is_kept_when_the_size_changes_again() -> None:
    call = "(img_size=(512, 512), pos_embed='RoPE100_224:512')"
    architecture = architecture_from_strings(f"Dust3rEncoder{call}", f"MUSt3R{call}").at_size(768)
    assert architecture.encoder.rope == architecture.decoder.rope == Rope(base=100, trained_size=224, size=768)


def test_every_accepted_keyword_is_understood() -> None:
    norm = "norm_layer=partial(nn.LayerNorm, eps=1e-6)"
    architecture = architecture_from_strings(
        f"Dust3rEncoder(img_size=[512, 512], patch_size=8, mlp_ratio=2.5, {norm}, patch_embed='ManyAR_PatchEmbed')",
        f"MUSt3R(img_size=(512, 512), patch_size=8, output_dim=448, act_layer=nn.GELU, {norm}, head='Linear', "
        "feedback_type='single_linear', memory_mode='raw', pointmaps_activation=ActivationType.LINEAR, "
        "dropout_mode=None, protected_imgs=1, "
        "mem_dropout=-0.0, use_xformers_mask=False, landscape_only=False, block_type=blocks.Cached)",
    )
    assert (architecture.encoder.patch_size, architecture.encoder.mlp_ratio) == (8, 2.5)
    assert architecture.decoder.feedback == "single_linear"
    assert architecture.decoder.memory_mode == "raw"
    assert architecture.decoder.activation == "linear"


@pytest.mark.parametrize(
    ("encoder", "decoder", "message"),
    [
        ("CroCoEncoder()", "MUSt3R()", r"the encoder is a CroCoEncoder, and only Dust3rEncoder is built here"),
        ("Dust3rEncoder()", "DUSt3R()", r"the decoder is a DUSt3R, and only MUSt3R or CausalMUSt3R is built here"),
        (
            "Dust3rEncoder(embed_dmi=64)",
            "MUSt3R()",
            r"embed_dmi of the encoder: unknown .*Dust3rEncoder\(embed_dmi=64\)",
        ),
        ("Dust3rEncoder()", "MUSt3R(head='DPT')", r"head of the decoder: DPT is not known, only Linear \(in .MUSt3R\("),
        ("Dust3rEncoder()", "MUSt3R(memory_mode='all')", r"memory_mode .* all is not known, only norm_y, kv, raw"),
        ("Dust3rEncoder()", "MUSt3R(feedback_type='big')", r"feedback_type of the decoder: big is not known"),
        ("Dust3rEncoder()", "MUSt3R(feedback_type=partial(x))", r"feedback_type of the decoder"),
        ("Dust3rEncoder()", "MUSt3R(pointmaps_activation=ActivationType.RELU)", r"ActivationType.RELU is not known"),
        ("Dust3rEncoder(patch_embed='Conv')", "MUSt3R()", r"patch_embed of the encoder: Conv is not known"),
        ("Dust3rEncoder(norm_layer=nn.LayerNorm)", "MUSt3R()", r"norm_layer of the encoder: .* eps=1e-06"),
        ("Dust3rEncoder()", "MUSt3R(norm_layer=partial(nn.LayerNorm, eps=1e-5))", r"norm_layer of the decoder"),
        ("Dust3rEncoder()", "MUSt3R(norm_layer=partial(nn.BatchNorm, eps=1e-6))", r"norm_layer of the decoder"),
        ("Dust3rEncoder()", "MUSt3R(act_layer=nn.ReLU)", r"act_layer of the decoder"),
        ("Dust3rEncoder()", "MUSt3R(output_dim=1024)", r"output_dim of the decoder: 1024, but 7 numbers .* make 1792"),
        ("Dust3rEncoder(pos_embed='cosine')", "MUSt3R()", r"pos_embed of the encoder: 'cosine' is not RoPE"),
        ("Dust3rEncoder(pos_embed='RoPE1')", "MUSt3R()", r"pos_embed of the encoder"),
        ("Dust3rEncoder(pos_embed='RoPE100_0:224')", "MUSt3R()", r"'RoPE100_0:224' does not fit"),
        ("Dust3rEncoder(img_size=(64, 64), pos_embed='RoPE100_64:96')", "MUSt3R()", r"does not fit img_size 64"),
        ("Dust3rEncoder()", "MUSt3R(img_size=224)", r"img_size of the decoder: 224 is not a pair"),
        ("Dust3rEncoder(img_size=(512, 0))", "MUSt3R()", r"img_size of the encoder: \(512, 0\) is not a pair"),
        ("Dust3rEncoder(depth=0)", "MUSt3R()", r"depth of the encoder: 0 is not a positive whole number"),
        ("Dust3rEncoder(depth=True)", "MUSt3R()", r"depth of the encoder: True is not"),
        ("Dust3rEncoder(embed_dim=64.0)", "MUSt3R()", r"embed_dim of the encoder: 64.0 is not"),
        ("Dust3rEncoder(mlp_ratio='4')", "MUSt3R()", r"mlp_ratio of the encoder: '4' is not"),
        ("Dust3rEncoder(mlp_ratio=-4)", "MUSt3R()", r"mlp_ratio of the encoder: -4 is not"),
        ("Dust3rEncoder(embed_dim=64)", "MUSt3R()", r"the encoder gives 64 numbers per patch, the decoder takes 1024"),
        ("Dust3rEncoder()", "MUSt3R(embed_dim=100, num_heads=3)", r"100 over 3 heads"),
        ("Dust3rEncoder(64)", "MUSt3R()", r"arguments without a keyword"),
        ("Dust3rEncoder(**options)", "MUSt3R()", r"arguments without a keyword"),
        ("Dust3rEncoder(depth=2, depth=3)", "MUSt3R()", r"gives a keyword twice"),
        ("Dust3rEncoder(depth=2 + 3)", "MUSt3R()", r"depth of the encoder: '2 \+ 3' is neither a literal nor a"),
        ("Dust3rEncoder(img_size=[s for s in x])", "MUSt3R()", r"neither a literal"),
        ("(lambda: 0)()", "MUSt3R()", r"is not a call of Dust3rEncoder"),
        ("Dust3rEncoder", "MUSt3R()", r"is not a call"),
        ("'Dust3rEncoder()'", "MUSt3R()", r"is not a call"),
        ("Dust3rEncoder(", "MUSt3R()", r"cannot be read"),
        ("", "MUSt3R()", r"cannot be read"),
        ("Dust3rEncoder(depth=" + "-" * 3900 + "1)", "MUSt3R()", r"cannot be read"),
        ("Dust3rEncoder(depth=" + "(" * 1900 + ")" * 1900 + ")", "MUSt3R()", r"cannot be read"),
        ("Dust3rEncoder(depth=" + "1" * 5000 + ")", "MUSt3R()", r"5021 characters"),
    ],
)
def test_wrong_constructor_strings_are_refused_with_file_string_and_keyword(
    saved: Callable[..., Path], encoder: str, decoder: str, message: str
) -> None:
    with pytest.raises(CheckpointError, match=rf"weights\.pth: .*{message}"):
        load_checkpoint(saved(args=argparse.Namespace(encoder=encoder, decoder=decoder)))


def test_constructor_strings_are_not_evaluated(saved: Callable[..., Path], tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    code = f"__import__('pathlib').Path({str(marker)!r}).touch()"
    for text in (f"Dust3rEncoder(depth={code})", code, f"Dust3rEncoder(block_type={code})"):
        with pytest.raises(CheckpointError):
            load_checkpoint(saved(args=argparse.Namespace(encoder=text, decoder=DECODER)))
        assert not marker.exists()
    eval(code)  # so the code does what it is feared to do
    assert marker.exists()


# ------------------------------------------------------------------------ hostile files
class Runs:
    """Pickles to a call of any function: what ordinary loading would make."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.reduced = function, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.reduced


class Remembers:
    """Pickles to an object whose state is set by code of its class."""

    marker: Path

    def __getstate__(self) -> dict[str, Any]:
        return {"marker": self.marker}

    def __setstate__(self, state: dict[str, Any]) -> None:
        state["marker"].touch()


def _touch(marker: Path) -> list[str]:
    return [sys.executable, "-c", f"open({str(marker)!r}, 'w')"]


def _remembering(marker: Path) -> Remembers:
    evil = Remembers()
    evil.marker = marker
    return evil


ATTACKS: dict[str, Callable[[Path], Any]] = {
    "eval": lambda marker: Runs(eval, f"open({str(marker)!r}, 'w')"),
    "exec": lambda marker: Runs(exec, f"open({str(marker)!r}, 'w')"),
    "open": lambda marker: Runs(open, str(marker), "w"),
    "import": lambda marker: Runs(__import__, "antigravity"),
    "subprocess": lambda marker: Runs(subprocess.run, _touch(marker)),
    "path": lambda marker: marker,
    "state": _remembering,
    "nested pickle": lambda marker: Runs(pickle.loads, pickle.dumps(Runs(open, str(marker), "w"))),
    "torch storage": lambda marker: Runs(torch.storage._load_from_bytes, _legacy_bytes(Runs(open, str(marker), "w"))),
    "torch load": lambda marker: Runs(torch.load, str(marker.with_suffix(".inner"))),
    "torch import": lambda marker: Runs(torch._utils._import_dotted_name, "antigravity"),
    "torch hub": lambda marker: Runs(torch.hub.set_dir, str(marker)),
}


def _legacy_bytes(content: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer, _use_new_zipfile_serialization=False)
    return buffer.getvalue()


@pytest.mark.parametrize("attack", ATTACKS)
def test_calls_in_a_file_are_not_made_and_the_weights_still_load(
    saved: Callable[..., Path], small: Network, tmp_path: Path, attack: str
) -> None:
    marker = tmp_path / "marker"
    sys.modules.pop("antigravity", None)
    hub = torch.hub.get_dir()
    evil = ATTACKS[attack](marker)
    path = saved(args=argparse.Namespace(encoder=ENCODER, decoder=DECODER, evil=evil), extra=[evil, {"k": evil}])
    network = load_checkpoint(path)
    assert_same_weights(network, small)
    args = read_pickled(path)["args"]
    assert isinstance(args, argparse.Namespace) and isinstance(args.evil, StandIn) and not vars(args.evil)
    assert not marker.exists() and "antigravity" not in sys.modules and torch.hub.get_dir() == hub


@pytest.mark.filterwarnings("ignore:Environment variable TORCH_FORCE")
def test_no_setting_of_torch_opens_the_door(
    saved: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD", "1")
    path = saved(extra=ATTACKS["open"](tmp_path / "marker"))
    load_checkpoint(path)
    assert not (tmp_path / "marker").exists()
    torch.load(path)
    assert (tmp_path / "marker").exists()


@pytest.mark.parametrize("attack", ["eval", "exec", "open", "subprocess", "state", "nested pickle", "torch storage"])
def test_the_same_files_are_dangerous_to_an_ordinary_loader(
    saved: Callable[..., Path], tmp_path: Path, attack: str
) -> None:
    marker = tmp_path / "marker"
    path = saved(extra=ATTACKS[attack](marker))
    torch.load(path, weights_only=False)
    assert marker.exists()


def _archive(path: Path, pickled: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("weights/data.pkl", pickled)
        archive.writestr("weights/version", "3\n")
    return path


def _global(name: str) -> bytes:
    module, _, attribute = name.rpartition(".")
    return b"c" + module.encode() + b"\n" + attribute.encode() + b"\n"


def _text(text: str) -> bytes:
    return b"X" + len(text).to_bytes(4, "little") + text.encode()


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (_global("posix.system") + _text("touch marker") + b"\x85R", "module posix is blocked"),
        (_global("os.system") + _text("touch marker") + b"\x85R", "module os is blocked"),
        (_global("sys.exit") + b")R", "module sys is blocked"),
        # What a stand-in gives is no function: getattr(..., 'system')('touch marker').
        (_global("builtins.getattr") + b")R" + _text("touch marker") + b"\x85R", "unrecognized function"),
        (_global("builtins.dict") + b")R" + _text("k") + b"K\x01s", "Can only SETITEM for dict"),
        (_global("builtins.list") + b")R" + b"K\x01a", "Can only append to lists"),
        # A state with __class__ in it: on a stand-in it is dropped, on a namespace it is a plain entry.
        (_global("builtins.list") + b")R}" + _text("__class__") + _global("os.system") + b"sb", "os is blocked"),
        (_text("posix") + _text("system") + b"\x93" + _text("touch marker") + b"\x85R", "Unsupported operand 147"),
        (b"\x8c\x05posix", "Unsupported operand 140"),
        (_global("torch._utils._rebuild_tensor_v2") + b")R", "required positional arguments"),
        (_global("torch._utils._rebuild_tensor_v2") + b"()K\x00))\x89}tR", "has no attribute"),
        (_global("torch.FloatStorage") + b")R", ""),
        (b"h\x07", ""),
        (b"0", ""),
        (b"", ""),
        (_text("cut")[:3], ""),
    ],
)
def test_pickles_that_cannot_be_made_harmless_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: bytes, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = _archive(tmp_path / "weights.pth", b"\x80\x02}" + _text("args") + body + b"s.")
    with pytest.raises(CheckpointError, match=rf"weights\.pth cannot be opened as weights: .*{message}"):
        load_checkpoint(path)
    assert not (tmp_path / "marker").exists()


def test_such_a_pickle_is_dangerous_to_an_ordinary_loader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pickle.loads(b"\x80\x02" + _global("os.system") + _text("touch marker") + b"\x85R.")
    assert (tmp_path / "marker").exists()


def test_state_with_a_class_in_it_does_not_change_a_namespace(tmp_path: Path) -> None:
    body = _global("argparse.Namespace") + b")\x81}" + _text("__class__") + _global("builtins.eval") + b"sb"
    args = read_pickled(_archive(tmp_path / "weights.pth", b"\x80\x02}" + _text("args") + body + b"s."))["args"]
    assert type(args) is argparse.Namespace


def test_what_the_process_trusts_is_as_before(saved: Callable[..., Path]) -> None:
    class Kind(enum.Enum):
        NORM = 1

    path = saved(extra=Runs(eval, "1"))
    with torch.serialization.safe_globals([argparse.Namespace, Kind]):
        before = set(torch.serialization.get_safe_globals())
        load_checkpoint(path)
        assert set(torch.serialization.get_safe_globals()) == before
    load_checkpoint(path)
    assert not {argparse.Namespace, Kind} & set(torch.serialization.get_safe_globals())
    with pytest.raises(pickle.UnpicklingError):
        torch.load(path, weights_only=True)


# ------------------------------------------------------------------------- wrong files
def test_old_forms_of_torch_files_are_refused_unopened(tmp_path: Path, small: Network) -> None:
    marker, old = tmp_path / "marker", tmp_path / "old.pth"
    old.write_bytes(_legacy_bytes(official(small, extra=Runs(Path.touch, marker))))
    with pytest.raises(CheckpointError, match=r"old\.pth is no checkpoint: it starts with b'\\x80"):
        load_checkpoint(old)
    with tarfile.open(old, "w") as archive:
        archive.addfile(tarfile.TarInfo("storages"))
    with pytest.raises(CheckpointError, match=r"old\.pth is no checkpoint: it starts with b'stor'"):
        load_checkpoint(old)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"is no checkpoint: it starts with b''"),
        (b"<!DOCTYPE html><html>404</html>", r"it starts with b'<!DO', where a zip archive"),
        (b"PK\x03\x04 and then nothing", r"is cut off after 21 bytes"),
        (b"\x40\0\0\0\0\0\0\0{", r"[Hh]eader"),
        (b"\x02\0\0\0\0\0\0\0{}", r"a safetensors file with nothing in its header and no 'must3r arch"),
    ],
)
def test_files_that_are_no_checkpoints_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "weights.pth"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=rf"weights\.pth.*{message}"):
        load_checkpoint(path)


def test_missing_file_and_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"absent\.pth cannot be read: No such file"):
        load_checkpoint(tmp_path / "absent.pth")
    with pytest.raises(CheckpointError, match=r"cannot be read: Is a directory"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("form", ["weights.pth", "ours.safetensors"])
def test_truncated_file_is_refused_wherever_it_is_cut(saved: Callable[..., Path], tmp_path: Path, form: str) -> None:
    convert_checkpoint(saved(), tmp_path / "ours.safetensors")
    whole = (tmp_path / form).read_bytes()
    for share in (0.1, 0.5, 0.9, 0.999):
        (tmp_path / form).write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(CheckpointError, match=form):
            load_checkpoint(tmp_path / form)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoder": None, "decoder": None}, r"it holds args, epoch, but no encoder and no decoder"),
        ({"args": None}, r"but no args"),
        ({"args": {"encoder": ENCODER}}, r"does not say what its encoder is"),
        ({"args": argparse.Namespace(encoder=ENCODER, decoder=3)}, r"args.decoder is no string"),
        ({"args": argparse.Namespace(encoder=Runs(eval, "''"), decoder=DECODER)}, r"args.encoder is no string"),
        ({"encoder": [1, 2]}, r"the encoder is a list, not a dictionary of tensors"),
        ({"decoder": {"norm_dec.weight": 3}}, r"the decoder holds 'norm_dec.weight', a int"),
        ({"decoder": {1: torch.zeros(1)}}, r"the decoder holds 1, a Tensor"),
        (
            {"args": argparse.Namespace(model="AsymmetricMASt3R()"), "model": {}, "encoder": None, "decoder": None},
            r"no MUSt3R checkpoint: .* looks like DUSt3R or MASt3R",
        ),
        (
            {"args": argparse.Namespace(nclusters=2), "model": {}, "encoder": None, "decoder": None},
            r"the head for retrieval, .*--retrieval-weights",
        ),
    ],
)
def test_files_of_other_content_are_refused_with_what_they_are(
    saved: Callable[..., Path], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(CheckpointError, match=rf"weights\.pth.*{message}"):
        load_checkpoint(saved(**changes))


def test_file_that_is_no_dictionary_is_refused(tmp_path: Path) -> None:
    torch.save([torch.zeros(2)], tmp_path / "list.pth")
    with pytest.raises(CheckpointError, match=r"list\.pth holds a list, not a dictionary"):
        load_checkpoint(tmp_path / "list.pth")


def _without(state: dict[str, Tensor], *parts: str) -> dict[str, Tensor]:
    return {key: tensor for key, tensor in state.items() if not any(part in key for part in parts)}


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        (
            "encoder",
            lambda s: _without(s, "blocks_enc.1."),
            r"the encoder does not fit its description: 12 of 28 tensors are missing \(blocks_enc.1.norm1.weight, "
            r"blocks_enc.1.norm1.bias, blocks_enc.1.attn.qkv.weight, \.\.\.\)\. Only 16 of 28 tensors are there: fetch",
        ),
        ("decoder", lambda s: _without(s, "image2_embed"), r"1 of \d+ tensors are missing \(image2_embed\)"),
        ("decoder", lambda s: _without(s, "feedback"), r"6 of \d+ tensors are missing \(feedback_norm"),
        ("decoder", lambda s: s | {"extra": torch.zeros(1)}, r"description: 1 are unexpected \(extra\)\. .* related"),
        (
            "encoder",
            lambda s: s | {"norm_enc.bias": torch.zeros(5)},
            r"1 have another shape \(norm_enc.bias \(5,\) instead of \(16,\)\)",
        ),
        ("encoder", lambda s: {f"module.{k}": v for k, v in s.items()}, r"28 of 28 .* weights of another network"),
        ("encoder", lambda s: {}, r"28 of 28 .* weights of another network"),
        ("encoder", lambda s: s | {"norm_enc.bias": torch.zeros(16, dtype=torch.int8)}, r"norm_enc.bias is torch.int8"),
        ("encoder", lambda s: s | {"norm_enc.bias": torch.zeros(16).to_sparse()}, r"torch.sparse_coo, on cpu; plain"),
    ],
)
def test_tensors_that_do_not_fit_are_refused_with_a_readable_difference(
    saved: Callable[..., Path], small: Network, part: str, change: Callable[[Any], Any], message: str
) -> None:
    state = OrderedDict(getattr(small, part).state_dict())
    with pytest.raises(CheckpointError, match=rf"weights\.pth: .*{message}"):
        load_checkpoint(saved(**{part: change(dict(state))}))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("embed_dim=16, ", "", r"The file holds an encoder of width 16, its description says 1024"),
        ("depth=2", "depth=1", r"12 are unexpected \(blocks_enc.1.*The file holds 2 blocks, its description says 1"),
        ("depth=2", "depth=3", r"12 of 40 tensors are missing \(blocks_enc.2"),
        ("depth=2", "depth=2000", r"no network has the sizes .*depth=2000"),
        ("depth=2", "depth=2, patch_size=8", r"patches of 8 and of 16 pixels"),
        ("depth=2", "depth=2, mlp_ratio=1e300", r"no network has the sizes"),
        ("depth=2", "depth=2, mlp_ratio=2", r"have another shape \(blocks_enc.0.mlp.fc1.weight \(64, 16\) instead"),
    ],
)
def test_strings_that_do_not_fit_the_tensors_are_refused(
    saved: Callable[..., Path], old: str, new: str, message: str
) -> None:
    assert old in ENCODER
    encoder, decoder = ENCODER.replace(old, new), DECODER
    if "embed_dim" in old:
        decoder = decoder.replace("enc_embed_dim=16, ", "")
    with pytest.raises(CheckpointError, match=rf"weights\.pth: .*{message}"):
        load_checkpoint(saved(args=argparse.Namespace(encoder=encoder, decoder=decoder)))


def test_cuda_without_a_card_and_unknown_memories_and_number_types_are_refused(
    saved: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"device cuda: torch finds no CUDA card here; take cpu"):
        load_checkpoint(saved(), device="cuda")
    with pytest.raises(ConfigError, match=r"device 'gpu'"):
        load_checkpoint(saved(), device="gpu")
    with pytest.raises(ConfigError, match=r"memory mode 'all': one of kv, norm_y, raw"):
        load_checkpoint(saved(), memory_mode="all")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"number type torch.float16: torch.float32 or torch.bfloat16"):
        load_checkpoint(saved(), dtype=torch.float16)


# ----------------------------------------------------------------------------- our own form
@pytest.mark.parametrize("size", [None, 48])
def test_converted_file_loads_as_the_original_does(
    saved: Callable[..., Path], tmp_path: Path, size: int | None
) -> None:
    source, target = saved(), tmp_path / "new" / "ours.safetensors"
    convert_checkpoint(source, target)
    original, converted = load_checkpoint(source, image_size=size), load_checkpoint(str(target), image_size=size)
    assert converted.architecture == original.architecture
    assert_same_weights(converted, original)
    assert read_architecture(target) == read_architecture(source) == SMALL
    assert [path.name for path in target.parent.iterdir()] == ["ours.safetensors"]
    assert target.stat().st_mode == source.stat().st_mode  # others may read it


def test_converted_file_is_read_by_somebody_elses_reader(
    saved: Callable[..., Path], tmp_path: Path, small: Network
) -> None:
    convert_checkpoint(saved(), tmp_path / "ours.safetensors")
    tensors = safetensors.torch.load_file(tmp_path / "ours.safetensors")
    parts = {"encoder": small.encoder, "decoder": small.decoder}
    expected = {f"{name}.{key}": t for name, part in parts.items() for key, t in part.state_dict().items()}
    assert tensors.keys() == expected.keys()
    assert all(torch.equal(tensors[key], expected[key]) for key in expected)


def test_our_form_can_be_converted_onto_itself_and_keeps_half_floats(small: Network, tmp_path: Path) -> None:
    path = tmp_path / "half.safetensors"
    halves = [{k: t.half() for k, t in part.state_dict().items()} for part in (small.encoder, small.decoder)]
    write_safetensors_checkpoint(path, SMALL, *halves)
    before = path.read_bytes()
    convert_checkpoint(path, path)
    assert path.read_bytes() == before
    weight = load_checkpoint(path).encoder.norm_enc.weight
    assert weight.dtype == torch.float32 and torch.equal(weight, halves[0]["norm_enc.weight"].float())


def test_every_architecture_survives_json() -> None:
    for text in ("norm_y", "raw", "kv"):
        decoder = DECODER.replace("kv", text).replace("'single_mlp'", "None")
        architecture = architecture_from_strings(ENCODER, decoder).at_size(96)
        assert architecture_from_json(architecture_to_json(architecture)) == architecture


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"depth": 2', '"depth": "2"', r"architecture.encoder.depth is '2'"),
        ('"depth": 2', '"depth": true', r"architecture.encoder.depth is True"),
        ('"depth": 2', '"depth": 2.5', r"architecture.encoder.depth is 2.5"),
        ('"depth": 2', '"depth": 0', r"architecture.encoder.depth is 0"),
        ('"depth": 2', '"depth": 99999999', r"no network has the sizes"),
        ('"depth": 2', '"height": 2', r"architecture.encoder is .*not a dictionary of depth, mlp_ratio"),
        ('"mlp_ratio": 4', '"mlp_ratio": NaN', r"architecture.encoder.mlp_ratio is nan"),
        ('"base": 100.0', '"base": Infinity', r"architecture.encoder.rope.base is inf"),
        ('"kv"', '"all"', r"architecture.decoder.memory_mode is 'all'"),
        ('"encoder_width": 16', '"encoder_width": 32', r"the encoder gives 16 numbers per patch, the decoder takes 32"),
        ("{", "[" * 3000, r"nested too deeply|Expecting|Invalid"),
    ],
)
def test_header_that_describes_no_network_is_refused(
    small: Network, tmp_path: Path, old: str, new: str, message: str
) -> None:
    path, text = tmp_path / "ours.safetensors", architecture_to_json(SMALL)
    assert old in text
    header = {HEADER: text.replace(old, new, 1)}
    safetensors.torch.save_file({f"encoder.{k}": t for k, t in small.encoder.state_dict().items()}, path, header)
    with pytest.raises(CheckpointError, match=rf"ours\.safetensors: .*({message})"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    ("header", "tensor", "message"),
    [
        ({}, "encoder.x", r"a safetensors file with nothing in its header"),
        ({"format": "pt"}, "encoder.x", r"a safetensors file with format in its header and no 'must3r architecture"),
        ({HEADER: ""}, "encoder.x", r"Expecting value"),
        ({HEADER: "null"}, "encoder.x", r"architecture is None, not a dictionary of decoder, encoder"),
        ({HEADER: architecture_to_json(SMALL)}, "head.x", r"the tensor head.x belongs neither to the encoder nor"),
    ],
)
def test_safetensors_files_of_something_else_are_refused(
    tmp_path: Path, header: dict[str, str], tensor: str, message: str
) -> None:
    safetensors.torch.save_file({tensor: torch.zeros(2)}, tmp_path / "other.safetensors", header)
    with pytest.raises(CheckpointError, match=rf"other\.safetensors: .*{message}"):
        load_checkpoint(tmp_path / "other.safetensors")


def test_failed_write_leaves_what_was_there(
    saved: Callable[..., Path], small: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "target" / "ours.safetensors"
    convert_checkpoint(saved(), target)
    before = target.read_bytes()

    def refuse(tensors: object, path: Path, metadata: object) -> None:
        path.write_bytes(b"half a file")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(safetensors.torch, "save_file", refuse)
    with pytest.raises(StorageError, match=r"ours\.safetensors: cannot be written \(No space left"):
        convert_checkpoint(tmp_path / "weights.pth", target)
    assert target.read_bytes() == before and len(list(target.parent.iterdir())) == 1


def test_target_in_a_place_that_is_no_folder_is_refused(saved: Callable[..., Path]) -> None:
    with pytest.raises(StorageError, match=r"cannot be written"):
        convert_checkpoint(saved(), saved() / "ours.safetensors")


def test_weights_of_another_architecture_are_not_written(small: Network, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"of another network"):
        write_safetensors_checkpoint(tmp_path / "x", SMALL, small.decoder.state_dict(), small.decoder.state_dict())
    with pytest.raises(CheckpointError, match=r"half\.pth: the encoder does not fit"):
        torch.save(official(small, encoder={}), tmp_path / "half.pth")
        convert_checkpoint(tmp_path / "half.pth", tmp_path / "x")
    assert not (tmp_path / "x").exists()

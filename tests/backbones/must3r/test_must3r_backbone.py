"""The MUSt3R backbone in whole runs, on a tiny network whose random weights mean nothing, and what it does when
something is wrong. `test_must3r_stand_in.py` has a network that has learnt something.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from helpers.runs import run_in

from smust3r_colmap.backbones.base import BackboneContext
from smust3r_colmap.backbones.must3r import backbone as backbone_module
from smust3r_colmap.backbones.must3r import drivers, memory_plan, network
from smust3r_colmap.backbones.must3r.architecture import (
    Architecture,
    DecoderArchitecture,
    EncoderArchitecture,
    Rope,
)
from smust3r_colmap.backbones.must3r.backbone import Must3rPredictor, make_must3r
from smust3r_colmap.backbones.must3r.checkpoint import write_safetensors_checkpoint
from smust3r_colmap.backbones.must3r.state_dicts import empty_parts
from smust3r_colmap.backbones.options import NoOptions
from smust3r_colmap.cli.main import main
from smust3r_colmap.config import CameraConfig, CameraFit, KeyframeStrategy, Must3rConfig, RunConfig
from smust3r_colmap.execution.progress import QuietReporter, StageTally
from smust3r_colmap.importers.image_folder import import_image_folder
from smust3r_colmap.products import Segment
from smust3r_colmap.storage.run_directory import RunDirectory
from smust3r_colmap.synthetic.must3r_weights import random_network_weights
from smust3r_colmap.synthetic.room import write_demo

pytestmark = pytest.mark.slow

NUM_IMAGES = 14
ROPE = Rope(trained_size=64, size=64)
TINY = Architecture(
    encoder=EncoderArchitecture(width=64, depth=2, num_heads=4, rope=ROPE),
    decoder=DecoderArchitecture(
        encoder_width=64, width=48, depth=2, num_heads=3, rope=ROPE, feedback="single_mlp", memory_mode="kv"
    ),
)
UNCALIBRATED = CameraConfig()
WEAK = 3
WRONG_USE = 2


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    write_demo(folder, num_images=NUM_IMAGES, width=128, height=96)
    return folder / "images"


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights that keep points in front of the cameras."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    made = random_network_weights(TINY, 7)
    write_safetensors_checkpoint(path, TINY, made.encoder.state_dict(), made.decoder.state_dict())
    return path


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As torch initialises layers, in the official layout: half of all points lie behind the cameras."""
    path = tmp_path_factory.mktemp("weights") / "untrained.pth"
    torch.manual_seed(0)
    encoder, decoder = (part.to_empty(device="cpu") for part in empty_parts(TINY))
    for part in (encoder, decoder):
        for module in part.modules():
            if isinstance(module, torch.nn.Linear | torch.nn.Conv2d | torch.nn.LayerNorm):
                module.reset_parameters()
    decoder.load_state_dict({"image2_embed": torch.zeros(1, 1, 48)}, strict=False)
    strings = {
        "encoder": "Dust3rEncoder(img_size=(64, 64), embed_dim=64, depth=2, num_heads=4)",
        "decoder": "CausalMUSt3R(img_size=(64, 64), enc_embed_dim=64, embed_dim=48, depth=2, num_heads=3, "
        "feedback_type='single_mlp', memory_mode='kv')",
    }
    content = {"args": argparse.Namespace(**strings), "encoder": encoder.state_dict(), "decoder": decoder.state_dict()}
    torch.save(content, path)
    return path


def reconstruct(images: Path, output: Path, weights: Path, *flags: str) -> int:
    """The command line, in this process. Tiny matrices on many threads wait for each other where cores are shared."""
    command = ["reconstruct", str(images), "--output", str(output), "--backbone", "must3r", "--weights", str(weights)]
    return main([*command, "--network-size", "64", "--workers", "1", "--quiet", *flags])


@pytest.fixture
def predictor(room: Path, weights: Path, tmp_path: Path) -> Iterator[Callable[..., Must3rPredictor]]:
    """Makes predictors with other settings than the usual ones."""
    runs: list[RunDirectory] = []

    def make(importing: CameraConfig = UNCALIBRATED, **settings: Any) -> Must3rPredictor:
        run = RunDirectory(tmp_path / f"run{len(runs)}")
        runs.append(run)
        config = RunConfig(must3r=Must3rConfig(weights=str(weights), network_size=64, **settings))
        context = BackboneContext(
            collection=import_image_folder(room, importing),
            config=config,
            run=run_in(run),
        )
        made = make_must3r(context, NoOptions()).predictor
        assert isinstance(made, Must3rPredictor)
        return made

    yield make
    for run in runs:
        run.__exit__()


def stage_of(count: int) -> StageTally:
    return StageTally("must3r", count, lambda: 0.0, lambda tally: None)


# --------------------------------------------------------------------------- whole runs
LOOPS = (
    *("--segment-length", "4", "--overlap", "2", "--loop-window", "2"),
    *("--loop-similarity", "0.8", "--loop-min-candidates", "1", "--camera-fit", "upstream"),
)


@pytest.fixture(scope="module")
def finished(room: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    output = tmp_path_factory.mktemp("run") / "out"
    return output, reconstruct(room, output, weights, *LOOPS)


def test_meaningless_geometry_ends_as_weak_with_reasons_and_without_nan(finished: tuple[Path, int]) -> None:
    output, exit_code = finished
    summary = json.loads((output / "summary.json").read_text())
    assert exit_code == WEAK
    assert any("should not be trusted" in reason for reason in summary["weak_reasons"])
    assert summary["num_registered"] == NUM_IMAGES
    models = [pycolmap.Reconstruction(path) for path in sorted((output / "sparse").iterdir())]
    assert len(models) == len(summary["models"]) >= 1
    for model in models:
        poses = np.array([image.cam_from_world().matrix() for image in model.images.values()])
        points = np.array([point.xyz for point in model.points3D.values()])
        assert np.isfinite(poses).all()
        assert np.isfinite(points).all()


def test_loop_segments_go_through_the_network_too(finished: tuple[Path, int]) -> None:
    summary = json.loads((finished[0] / "summary.json").read_text())
    kinds = [segment["kind"] for segment in summary["segments"]]
    assert kinds.count("loop") == len(summary["loops"]) >= 1
    assert all(segment["num_registered"] > 0 for segment in summary["segments"])
    assert summary["scale"] == "metres"


def test_a_second_start_neither_loads_nor_runs_the_network(
    room: Path, weights: Path, finished: tuple[Path, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backbone_module, "load_checkpoint", lambda *_, **__: pytest.fail("the weights were loaded"))
    assert reconstruct(room, finished[0], weights, *LOOPS) == WEAK


def test_every_image_is_encoded_once_though_segments_overlap(
    room: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded = count_encoded(monkeypatch)
    reconstruct(room, tmp_path / "out", weights, *LOOPS)
    assert len(encoded) == NUM_IMAGES
    encoded.clear()
    reconstruct(room, tmp_path / "without_cache", weights, "--token-cache", "0", "--no-loop-closure")
    assert len(encoded) > NUM_IMAGES, "keyframes are shown and predicted"


def count_encoded(monkeypatch: pytest.MonkeyPatch) -> list[torch.Tensor]:
    encoded: list[torch.Tensor] = []
    real = network.encode

    def counting(asked: Any, images: Any, **options: Any) -> Any:
        encoded.extend(images)
        return real(asked, images, **options)

    monkeypatch.setattr(backbone_module, "encode", counting)
    return encoded


def test_weights_without_any_training_still_end_in_a_model_that_is_doubted(
    room: Path, untrained: Path, tmp_path: Path
) -> None:
    assert reconstruct(room, tmp_path / "out", untrained) == WEAK
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert "its pointmaps gave no cameras, so these are guesses" in str(summary["weak_reasons"])
    assert (tmp_path / "out/sparse/0/cameras.bin").is_file()


# --------------------------------------------------------------------------- one segment
SEGMENT = Segment(index=0, images=(2, 3, 4, 5, 6, 7))


@pytest.mark.parametrize("keyframes", ["linspace", "retrieval", "every-kth", "overlap"])
@pytest.mark.parametrize("camera_fit", ["robust", "upstream", "pnp"])
def test_all_strategies_and_fits_predict_every_image_once(
    predictor: Callable[..., Must3rPredictor], keyframes: KeyframeStrategy, camera_fit: CameraFit
) -> None:
    stage = stage_of(6)
    made = predictor(network_keyframes=keyframes, camera_fit=camera_fit, max_keyframes=4, refinements=1)
    prediction = made.predict(SEGMENT, stage)
    spoken_of = [one.image for one in prediction.images] + [one.image for one in prediction.unregistered]
    assert sorted(spoken_of) == list(SEGMENT.images)
    assert stage.done == 6
    assert "keyframes" in prediction.method
    for one in prediction.images:
        assert one.maps.depth.shape == one.maps.confidence.shape == one.maps.rgb.shape[:2] == (48, 64)
        assert np.isfinite(one.maps.depth).all()


def test_a_segment_of_one_image_ends(predictor: Callable[..., Must3rPredictor]) -> None:
    prediction = predictor().predict(Segment(index=0, images=(5,)), stage_of(1))
    assert len(prediction.images) + len(prediction.unregistered) == 1


def test_images_of_one_camera_share_its_focal_length(predictor: Callable[..., Must3rPredictor]) -> None:
    prediction = predictor().predict(SEGMENT, stage_of(6))
    assert len({one.intrinsics.focal_px for one in prediction.images}) == 1


def test_a_calibration_is_kept(predictor: Callable[..., Must3rPredictor]) -> None:
    known = CameraConfig(camera_model="PINHOLE", camera_params="101,102,63,47")
    for image in predictor(known).predict(SEGMENT, stage_of(6)).images:
        assert image.intrinsics.params == (101, 102, 63, 47)


def test_memory_that_runs_out_in_the_middle_costs_keyframes_and_is_told(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    keyframes: list[int] = []
    real = drivers.reconstruct_segment

    def running_out(asked: Any, images: Any, choice: Any, **options: Any) -> Iterator[Any]:
        keyframes.append(choice.most)
        for number, prediction in enumerate(real(asked, images, choice, **options)):
            if choice.most > 3 and number == 2:
                raise RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")
            yield prediction

    monkeypatch.setattr(backbone_module, "reconstruct_segment", running_out)
    stage = stage_of(6)
    prediction = predictor().predict(SEGMENT, stage)
    assert keyframes[0] == 6
    assert keyframes == sorted(keyframes, reverse=True)
    assert keyframes[-1] <= 3
    assert stage.done == 6
    assert any("memory ran out" in note and "tried again with" in note for note in prediction.notes)
    assert prediction.method.endswith(f"{keyframes[-1]} keyframes")


class _Listening(QuietReporter):
    """Remembers the notes."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.notes: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)


def test_the_plan_is_said_before_the_segment_runs_and_again_when_it_changes(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    said_before: list[int] = []
    heard = _Listening()
    made = predictor()
    made._reporter = heard
    real = drivers.reconstruct_segment

    def watched(*arguments: Any, **options: Any) -> Iterator[Any]:
        said_before.append(sum("keyframes in" in note for note in heard.notes))
        return real(*arguments, **options)

    monkeypatch.setattr(backbone_module, "reconstruct_segment", watched)
    for images in (range(6), range(2, 8), range(3)):
        prediction = made.predict(replace(SEGMENT, images=tuple(images)), stage_of(len(images)))
        assert prediction.notes == ()
    assert said_before == [1, 1, 2]


def test_keyframes_that_do_not_fit_are_missed_in_the_notes(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    def scarce(*arguments: Any, **options: Any) -> memory_plan.MemoryPlan:
        return replace(memory_plan.plan_memory(*arguments, **options), num_keyframes=4)

    monkeypatch.setattr(backbone_module, "plan_memory", scarce)
    prediction = predictor().predict(SEGMENT, stage_of(6))
    assert prediction.notes == ("4 of 6 keyframes, for lack of memory",)
    assert prediction.method.endswith(" 4 keyframes")


def test_progress_moves_while_keyframes_are_remembered(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    stage, seen = stage_of(6), []
    real = drivers.reconstruct_segment

    def watched(*arguments: Any, **options: Any) -> Iterator[Any]:
        for prediction in real(*arguments, **options):
            seen.append(stage.done)
            yield prediction

    monkeypatch.setattr(backbone_module, "reconstruct_segment", watched)
    predictor().predict(SEGMENT, stage)
    assert 1 <= seen[0] <= 3, "half of the work is done before the first prediction"
    assert seen == sorted(seen)
    assert stage.done == 6


def test_an_error_that_is_no_lack_of_memory_is_not_retried(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> Iterator[Any]:
        raise RuntimeError("shapes do not match")

    monkeypatch.setattr(backbone_module, "reconstruct_segment", broken)
    with pytest.raises(RuntimeError, match="shapes do not match"):
        predictor().predict(SEGMENT, stage_of(6))


def test_whatever_changes_a_prediction_changes_its_key(predictor: Callable[..., Must3rPredictor]) -> None:
    usual = predictor().key
    assert predictor().key == usual
    changes: list[dict[str, Any]] = [
        {"network_keyframes": "every-kth"},
        {"max_keyframes": 7},
        {"refinements": 1},
        {"rerender": False},
        {"camera_fit": "pnp"},
    ]
    keys = [predictor(**change).key for change in changes]
    assert len({str(key) for key in [usual, *keys]}) == 1 + len(changes)
    assert predictor(network_memory=1.0, token_cache=1.0).key == usual


def test_descriptors_are_of_unit_length_and_tell_images_apart(predictor: Callable[..., Must3rPredictor]) -> None:
    descriptors = predictor().describe()
    assert descriptors.shape == (NUM_IMAGES, 64)
    assert np.linalg.norm(descriptors, axis=1) == pytest.approx(1, abs=1e-5)
    assert len(np.unique(descriptors.round(6), axis=0)) == NUM_IMAGES


def test_images_that_are_too_many_at_once_are_encoded_one_by_one(
    predictor: Callable[..., Must3rPredictor], monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = predictor().describe()
    sizes: list[int] = []
    real = network.encode

    def tight(asked: Any, images: Any, *, batch_size: int = 1) -> Any:
        sizes.append(batch_size)
        if batch_size > 1:
            raise torch.OutOfMemoryError("CUDA out of memory")
        return real(asked, images, batch_size=batch_size)

    monkeypatch.setattr(backbone_module, "encode", tight)
    monkeypatch.setattr(backbone_module, "_encoded_at_once", lambda device: 4)
    assert predictor().describe() == pytest.approx(expected, abs=1e-6)
    assert set(sizes) == {4, 1, 2}, "14 images are three batches of four and one of two"


# ----------------------------------------------------------------------------- refusals
@pytest.mark.skipif(torch.cuda.is_available(), reason="a card is here")
def test_a_card_that_is_not_there_is_wrong_use(
    room: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reconstruct(room, tmp_path / "out", weights, "--device", "cuda") == WRONG_USE
    assert "--device cuda: torch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:1000]), "is cut off"),
        (lambda path: path.write_bytes(b"nothing of the kind"), "is no checkpoint"),
        (lambda path: path.unlink(), "no such file"),
    ],
)
def test_weights_that_are_none_are_wrong_use_and_named(
    room: Path,
    untrained: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    spoil: Callable[[Path], object],
    message: str,
) -> None:
    spoilt = tmp_path / "spoilt.pth"
    spoilt.write_bytes(untrained.read_bytes())
    spoil(spoilt)
    assert reconstruct(room, tmp_path / "out", spoilt) == WRONG_USE
    complaint = capsys.readouterr().err
    assert "spoilt.pth" in complaint
    assert message in complaint


def test_tracks_cannot_be_had_from_a_network(
    room: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reconstruct(room, tmp_path / "out", weights, "--alignment-source", "tracks") == WRONG_USE
    assert "--alignment-source tracks: the backbone must3r has no tracks" in capsys.readouterr().err


def test_a_panorama_is_seen_in_the_middle_and_the_user_is_told(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_demo(tmp_path / "wide", num_images=3, width=320, height=32)
    reconstruct(tmp_path / "wide/images", tmp_path / "out", weights)
    assert "MUSt3R sees the middle of 3 of 3 images only" in capsys.readouterr().err


def test_memory_that_holds_no_keyframe_is_wrong_use(
    room: Path, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert reconstruct(room, tmp_path / "out", weights, "--network-memory", "0.01") == WRONG_USE
    assert "not even one keyframe" in capsys.readouterr().err

"""The settings, as values and as a TOML file."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from smust3r_colmap.backbones.classical.plane_sweep import MIN_PLANES
from smust3r_colmap.cli import main as cli
from smust3r_colmap.config import (
    AlignmentConfig,
    ClassicalConfig,
    FusionConfig,
    ImportConfig,
    LoopConfig,
    Must3rConfig,
    OutputConfig,
    RefinementConfig,
    RunConfig,
    SegmentationConfig,
)
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.storage.config_file import config_from_toml, config_to_toml, flags_from_settings, read_settings

# Every group and every type of value differs from its default.
ODD_CONFIG = RunConfig(
    importing=ImportConfig(camera_mode="per-folder", camera_model='a "quoted" \\ name, ü'),
    segmentation=SegmentationConfig(segment_length=7, overlap=3),
    alignment=AlignmentConfig(huber_delta=1e-7, robust_kernel="huber"),
    output=OutputConfig(text=True),
    workers=3,
    seed=11,
)


def _toml(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("config", [RunConfig(), ODD_CONFIG])
def test_settings_survive_the_way_through_toml(tmp_path: Path, config: RunConfig) -> None:
    assert config_from_toml(_toml(tmp_path, config_to_toml(config))) == config


def test_keys_that_are_left_out_keep_their_default(tmp_path: Path) -> None:
    config = config_from_toml(_toml(tmp_path, "overlap = 10\ntext = true\n"))

    assert config == replace(RunConfig(), segmentation=SegmentationConfig(overlap=10), output=OutputConfig(text=True))


def test_whole_numbers_are_taken_for_real_ones(tmp_path: Path) -> None:
    value = config_from_toml(_toml(tmp_path, "min_confidence = 3")).fusion.min_confidence

    assert isinstance(value, float)
    assert value == 3.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segment_lenght = 5", "unknown setting 'segment_lenght'; known are segment_length"),
        ("no_loops = true", r"unknown setting 'no_loops'; did you mean loops = false\?"),
        ("no-trainer = false", r"did you mean trainer = true\?"),
        ("no_lops = true", r"did you mean loops = false\?"),
        ("no_mesh = true", "unknown setting 'no_mesh'; known are .*mesh"),
        ("no_dense_size = 5", "unknown setting 'no_dense_size'; known are dense_size"),
        ("zzzz = 5", "unknown setting 'zzzz'; known are .*overlap.*seed"),
        ("[segmentation]\noverlap = 5", "segmentation. is a table"),
        ("overlap = 1.5", "overlap = 1.5 is a float; needed is a int"),
        ("overlap = true", "overlap = True is a bool; needed is a int"),
        ("min_confidence = true", "is a bool; needed is a float"),
        ("text = 1", "text = 1 is a int; needed is a bool"),
        ("camera_model = 1", "needed is a str"),
        ("camera_mode = 'sinlge'", "'sinlge'; choose one of 'auto', 'single'"),
        ("camera_mode = ['auto']", "choose one of"),
        ("overlap = 60", "--overlap 60 must be smaller than --segment-length 60"),
        ("overlap =", "not TOML"),
    ],
)
def test_bad_files_are_refused_by_name_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = _toml(tmp_path, text)

    with pytest.raises(ConfigError, match=message) as refusal:
        config_from_toml(path)
    assert str(refusal.value).startswith(str(path))


def test_files_that_are_not_there_or_not_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the settings"):
        read_settings(tmp_path / "absent.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not TOML"):
        read_settings(tmp_path / "binary.toml")


def test_settings_become_flags() -> None:
    flags = flags_from_settings({"segment_length": 5, "text": True, "camera_model": "-x"})

    assert flags == ["--segment-length=5", "--text", "--camera-model=-x"]
    assert flags_from_settings({"text": False}) == ["--no-text"]


@pytest.mark.parametrize(
    ("length", "overlap", "message"),
    [
        (1, 1, "a segment needs at least 2 images"),
        (5, 0, "must share at least 1 image"),
        (5, 5, "--overlap 5 must be smaller than --segment-length 5"),
        (5, 9, "--overlap 9 must be smaller than --segment-length 5"),
    ],
)
def test_windows_that_cannot_chain_are_refused(length: int, overlap: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        SegmentationConfig(segment_length=length, overlap=overlap)


def test_tightest_windows_are_accepted() -> None:
    assert SegmentationConfig(segment_length=2, overlap=1).overlap == 1


def test_negative_workers_are_refused() -> None:
    with pytest.raises(ConfigError, match="--workers -1"):
        RunConfig(workers=-1)


@pytest.mark.parametrize(
    ("group", "name", "least"),
    [
        (ClassicalConfig, "max_image_size", 32),
        (ClassicalConfig, "max_features", 1),
        (ClassicalConfig, "match_neighbours", 1),
        (ClassicalConfig, "exhaustive_below", 0),
        (ClassicalConfig, "dense_size", 32),
        (ClassicalConfig, "depth_planes", MIN_PLANES),
        (Must3rConfig, "max_keyframes", 1),
        (Must3rConfig, "keyframe_interval", 1),
        (Must3rConfig, "refinements", 0),
        (LoopConfig, "loop_min_candidates", 1),
        (LoopConfig, "loop_min_distance", 1),
        (LoopConfig, "loop_half_width", 1),
        (FusionConfig, "max_points", 1),
        (RefinementConfig, "track_neighbours", 1),
        (RunConfig, "seed", 0),
    ],
)
def test_whole_numbers_end_where_they_make_no_sense(group: Callable[..., object], name: str, least: int) -> None:
    largest = 2**31 - 1
    flag = f"--{name.replace('_', '-')}"
    for good in (least, largest):
        assert getattr(group(**{name: good}), name) == good
    for bad in (least - 1, -5):
        with pytest.raises(ConfigError, match=f"^{flag} {bad}: must be at least {least}$"):
            group(**{name: bad})
    with pytest.raises(ConfigError, match=f"^{flag} {largest + 1}: must be at most {largest}$"):
        group(**{name: largest + 1})


@pytest.mark.parametrize(
    ("group", "name"),
    [
        (Must3rConfig, "keyframe_threshold"),
        (Must3rConfig, "network_memory"),
        (Must3rConfig, "token_cache"),
        (FusionConfig, "min_confidence"),
    ],
)
def test_real_numbers_are_finite_and_not_negative(group: Callable[..., object], name: str) -> None:
    assert getattr(group(**{name: 0.0}), name) == 0.0
    for bad in (-0.1, math.inf, math.nan):
        with pytest.raises(ConfigError, match=f"^--{name.replace('_', '-')} {bad}: must be at"):
            group(**{name: bad})


@pytest.mark.parametrize("bad", [0.0, -0.1, math.inf, math.nan])
def test_hubers_delta_is_positive_and_finite(bad: float) -> None:
    with pytest.raises(ConfigError, match=f"^--huber-delta {bad}: must be above 0, and finite$"):
        AlignmentConfig(huber_delta=bad)


@pytest.mark.slow
def test_every_number_among_the_settings_refuses_nonsense() -> None:
    """What a new setting needs, too: minus a thousand is good for none of them."""
    for name in numbers_among_the_settings():
        with pytest.raises(ConfigError, match=f"--{name.replace('_', '-')} -1000"):
            cli.parse(["reconstruct", "in", "--output", "out", f"--{name.replace('_', '-')}=-1000"])


def numbers_among_the_settings() -> list[str]:
    """The keys whose default is a number."""
    table = (line.split(" = ") for line in config_to_toml(RunConfig()).splitlines() if " = " in line)
    return [key for key, value in table if value.replace(".", "").isdecimal()]

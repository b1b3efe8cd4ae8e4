"""The settings, as values and as a TOML file."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from smust3r_colmap.backbones.classical.plane_sweep import MIN_PLANES
from smust3r_colmap.cli import main as cli
from smust3r_colmap.cli.reconstruct import Reconstruct
from smust3r_colmap.cli.refine import Refine
from smust3r_colmap.config import (
    AlignmentConfig,
    CameraConfig,
    ClassicalConfig,
    FeatureConfig,
    FusionConfig,
    LoopConfig,
    ModelCameraConfig,
    ModelOutputConfig,
    Must3rConfig,
    OutputConfig,
    RefineConfig,
    RefinementConfig,
    RunConfig,
    SegmentationConfig,
    TrackConfig,
)
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.storage.config_file import config_to_toml, flags_from_settings, read_settings

# Every group and every type of value differs from its default.
ODD_CONFIG = RunConfig(
    cameras=CameraConfig(camera_mode="per-folder", camera_model='a "quoted" \\ name, ü'),
    segmentation=SegmentationConfig(segment_length=7, overlap=3),
    alignment=AlignmentConfig(huber_delta=1e-7, robust_kernel="huber"),
    output=OutputConfig(text=True, trainer_scales=(2, 4)),
    masks=Path("masks of mine"),
    workers=3,
    seed=11,
)


def _read(path: Path, *flags: str) -> RunConfig:
    command = cli.parse(["reconstruct", "in", "--output", "out", "--config", str(path), *flags])
    assert isinstance(command, Reconstruct)
    return command.settings


def _toml(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("config", [RunConfig(), ODD_CONFIG])
def test_settings_survive_the_way_through_toml(tmp_path: Path, config: RunConfig) -> None:
    assert _read(_toml(tmp_path, config_to_toml(config))) == config


def test_settings_of_refine_survive_the_way_through_toml(tmp_path: Path) -> None:
    config = RefineConfig(
        pose_tolerance=0.01,
        masks=Path("m"),
        cameras=ModelCameraConfig(camera_model="OPENCV", share_cameras=False),
        output=ModelOutputConfig(trainer_scales=(2,)),
        refinement=TrackConfig(register_missing=True),
    )
    path = _toml(tmp_path, config_to_toml(config))
    command = cli.parse(["refine", "model", "--images", "in", "--config", str(path)])
    assert isinstance(command, Refine)
    assert command.settings == config


def test_what_is_not_given_is_a_comment(tmp_path: Path) -> None:
    text = config_to_toml(RunConfig())
    absent = {"backbone_options", "masks", "camera_params", "trainer_scales", "weights", "retrieval_weights"}
    absent |= {"fps", "max_frames"}
    assert {line.split()[1] for line in text.splitlines() if line.endswith("is not given")} == absent
    assert 'workers = "auto"' in text and 'loop_similarity = "auto"' in text and 'network_memory = "auto"' in text


def test_keys_that_are_left_out_keep_their_default(tmp_path: Path) -> None:
    config = _read(_toml(tmp_path, "overlap = 10\ntext = true\n"))

    assert config == replace(RunConfig(), segmentation=SegmentationConfig(overlap=10), output=OutputConfig(text=True))


def test_whole_numbers_are_taken_for_real_ones(tmp_path: Path) -> None:
    value = read_settings(_toml(tmp_path, "min_confidence = 3"), RunConfig)["min_confidence"]

    assert isinstance(value, float)
    assert value == 3.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("segment_lenght = 5", "unknown setting 'segment_lenght'; known are segment_length"),
        ("no_loop_closure = true", r"unknown setting 'no_loop_closure'; did you mean loop_closure = false\?"),
        ("no-trainer = false", r"did you mean trainer = true\?"),
        ("no_lop_closure = true", r"did you mean loop_closure = false\?"),
        ("no_mesh = true", "unknown setting 'no_mesh'; known are .*mesh"),
        ("no_dense_size = 5", "unknown setting 'no_dense_size'; known are dense_size"),
        ("zzzz = 5", "unknown setting 'zzzz'; known are .*overlap.*seed"),
        ("preset = 'fast'", "unknown setting 'preset'"),
        ("[segmentation]\noverlap = 5", "segmentation. is a table"),
        ("overlap = 1.5", "overlap = 1.5; needed is a whole number"),
        ("overlap = true", "overlap = true; needed is a whole number"),
        ("min_confidence = true", "min_confidence = true; needed is a number"),
        ("text = 1", "text = 1; needed is true or false"),
        ("camera_model = 1", "camera_model = 1; needed is a string"),
        ("camera_mode = 'sinlge'", 'camera_mode = "sinlge"; needed is "auto" or "single" or'),
        ("camera_mode = ['auto']", r"camera_mode = \[\"auto\"\]; needed is"),
        ("workers = 'many'", 'workers = "many"; needed is a whole number or "auto"'),
        ("masks = 3", "masks = 3; needed is a path"),
        ("trainer_scales = '2,4'", 'trainer_scales = "2,4"; needed is a list of whole numbers'),
        ("trainer_scales = [2, true]", r"trainer_scales = \[2, true\]; needed is a list of whole numbers"),
        ("overlap =", "not TOML"),
    ],
)
def test_bad_files_are_refused_by_name_and_key(tmp_path: Path, text: str, message: str) -> None:
    path = _toml(tmp_path, text)

    with pytest.raises(ConfigError, match=message) as refusal:
        read_settings(path, RunConfig)
    assert str(refusal.value).startswith(f"--config {path}: ")


def test_a_file_of_reconstruct_is_none_of_refine(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"settings.toml: unknown setting 'segment_length'"):
        read_settings(_toml(tmp_path, "segment_length = 5"), RefineConfig)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("workers = 'auto'", "workers", "auto"),
        ("workers = 3", "workers", 3),
        ("loop_similarity = 0.9", "loop_similarity", 0.9),
        ("network_memory = 4", "network_memory", 4.0),
        ("masks = 'folder'", "masks", "folder"),
        ("trainer_scales = [2, 4]", "trainer_scales", (2, 4)),
    ],
)
def test_values_have_the_type_of_their_setting(tmp_path: Path, text: str, name: str, value: object) -> None:
    assert read_settings(_toml(tmp_path, text), RunConfig) == {name: value}


def test_files_that_are_not_there_or_not_text_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the settings"):
        read_settings(tmp_path / "absent.toml", RunConfig)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not TOML"):
        read_settings(tmp_path / "binary.toml", RunConfig)


def test_settings_become_flags() -> None:
    flags = flags_from_settings({"segment_length": 5, "text": True, "camera_model": "-x", "trainer_scales": (2, 4)})

    assert flags == ["--segment-length=5", "--text", "--camera-model=-x", "--trainer-scales=2,4"]
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


@pytest.mark.parametrize("group", [RunConfig, RefineConfig])
@pytest.mark.parametrize("workers", [0, -1])
def test_less_than_one_worker_is_refused(group: Callable[..., object], workers: int) -> None:
    assert group(workers=1) and group(workers="auto")
    with pytest.raises(ConfigError, match=f"--workers {workers}: must be auto or at least 1"):
        group(workers=workers)


@pytest.mark.parametrize("similarity", [0.0, 1.0, -0.5, math.nan])
def test_a_similarity_is_a_cosine_or_auto(similarity: float) -> None:
    assert LoopConfig(loop_similarity=0.95).loop_similarity == 0.95
    with pytest.raises(ConfigError, match=f"--loop-similarity {similarity}: must be auto or a cosine between 0 and 1"):
        LoopConfig(loop_similarity=similarity)


@pytest.mark.parametrize("memory", [0.0, -1.0, math.inf, math.nan])
def test_memory_of_the_network_is_positive_and_finite_or_auto(memory: float) -> None:
    assert Must3rConfig(network_memory=0.5).network_memory == 0.5
    with pytest.raises(ConfigError, match=f"--network-memory {memory}: must be auto or above 0, and finite"):
        Must3rConfig(network_memory=memory)


@pytest.mark.parametrize(("scales", "shown"), [((), ""), ((1,), "1"), ((2, 0), "2,0")])
def test_scales_are_whole_numbers_above_one(scales: tuple[int, ...], shown: str) -> None:
    assert OutputConfig(trainer_scales=(2, 4, 8)).trainer_scales == (2, 4, 8)
    with pytest.raises(ConfigError, match=f"--trainer-scales {shown}: must be whole numbers above 1, such as 2,4,8"):
        OutputConfig(trainer_scales=scales)


@pytest.mark.parametrize(
    ("group", "name", "least"),
    [
        (FeatureConfig, "max_image_size", 32),
        (FeatureConfig, "max_features", 1),
        (ClassicalConfig, "match_neighbours", 1),
        (FeatureConfig, "exhaustive_below", 0),
        (ClassicalConfig, "dense_size", 32),
        (ClassicalConfig, "depth_planes", MIN_PLANES),
        (Must3rConfig, "max_keyframes", 1),
        (Must3rConfig, "keyframe_interval", 1),
        (Must3rConfig, "refinements", 0),
        (LoopConfig, "loop_min_candidates", 1),
        (LoopConfig, "loop_min_distance", 1),
        (LoopConfig, "loop_window", 1),
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
    """The keys whose default is a number, or that may be one instead of auto."""
    table = (line.split(" = ") for line in config_to_toml(RunConfig()).splitlines() if " = " in line)
    may_be = {"workers", "loop_similarity", "network_memory"}
    return [key for key, value in table if value.replace(".", "").isdecimal() or key in may_be]

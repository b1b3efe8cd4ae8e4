"""The command line: exit codes, precedence of settings, help, progress, summary, doctor."""

import io
import json
import logging
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import pycolmap
import pytest
from helpers.room_network import install_package
from helpers.summaries import GOOD

from smust3r_colmap import __version__
from smust3r_colmap.alignment.stage import EdgeSummary
from smust3r_colmap.backbones.registry import list_backbones
from smust3r_colmap.cli import doctor
from smust3r_colmap.cli import main as cli
from smust3r_colmap.cli.fields import field_docs
from smust3r_colmap.cli.presets import PRESETS
from smust3r_colmap.cli.reconstruct import Reconstruct
from smust3r_colmap.cli.refine import Refine
from smust3r_colmap.config import (
    ClassicalConfig,
    FeatureConfig,
    LoopConfig,
    ModelOutputConfig,
    Must3rConfig,
    OutputConfig,
    RefinementConfig,
    RunConfig,
)
from smust3r_colmap.errors import CollectionError, ReconstructionError, advice_for
from smust3r_colmap.execution.progress import (
    PlainReporter,
    QuietReporter,
    Reporter,
    TerminalReporter,
    format_seconds,
    reporter_for,
)
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.refinement.statistics import SceneRefinement
from smust3r_colmap.report.summary import (
    ImageNote,
    RunSummary,
)
from smust3r_colmap.synthetic.room import demo_intrinsics

Pipeline = Callable[..., RunSummary]
PutPipeline = Callable[[Pipeline], None]


@pytest.fixture
def put_pipeline(monkeypatch: pytest.MonkeyPatch) -> PutPipeline:
    """Lets a test say what ``pipeline.reconstruct`` does."""

    def put(reconstruct: Pipeline) -> None:
        module = ModuleType("smust3r_colmap.pipeline")
        module.reconstruct = reconstruct  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)

    return put


class _Call:
    """A pipeline that remembers what it was asked for."""

    def __init__(self, summary: RunSummary = GOOD) -> None:
        self.summary = summary
        self.config = RunConfig()
        self.overwrite = False

    def __call__(
        self, images: Path, output: Path, config: RunConfig, *, overwrite: bool = False, reporter: Reporter
    ) -> RunSummary:
        self.images, self.output, self.config, self.overwrite = images, output, config, overwrite
        with reporter.stage("features", total=1) as stage:
            stage.advance()
        return self.summary


def _raise(error: BaseException) -> Pipeline:
    def reconstruct(*_: object, **__: object) -> RunSummary:
        raise error

    return reconstruct


WIDTH, MIN_TEXT_COLUMN = 100, 10
WEIGHTS_ACTIONS = ("list", "fetch", "verify", "convert", "path")
RECONSTRUCT = ["reconstruct", "photos", "--output", "out"]


# ------------------------------------------------------------------------- exit codes
def test_good_run_exits_0_with_the_summary_on_stdout(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str]
) -> None:
    call = _Call()
    put_pipeline(call)

    assert cli.main([*RECONSTRUCT, "--overwrite"]) == 0
    out, err = capsys.readouterr()
    assert "5 of 5 images have a pose" in out
    assert "features" in err
    assert (call.images, call.output, call.overwrite) == (Path("photos"), Path("out"), True)


REFINED = replace(
    SceneRefinement.failed([f"{k}.jpg" for k in range(GOOD.models[0].num_images)], ""),
    succeeded=True,
    principal_point="fixed: as requested",
)
WEAK = replace(GOOD, num_registered=4, unregistered=(ImageNote(name="a.jpg", reason="too few matches"),))


@pytest.mark.parametrize("quiet", [False, True])
def test_weak_run_exits_3_with_the_reason(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], quiet: bool
) -> None:
    put_pipeline(_Call(WEAK))

    assert cli.main([*RECONSTRUCT, *(["--quiet"] if quiet else [])]) == 3
    out, err = capsys.readouterr()
    assert "1 of 5 images got no pose" in (err if quiet else out)
    assert (out == "") == quiet


@pytest.mark.parametrize(
    ("error", "exit_code", "message"),
    [
        (CollectionError("photos: no images"), 2, "photos: no images"),
        (ReconstructionError("nothing came out"), 1, "nothing came out"),
        (KeyboardInterrupt(), 130, "same command"),
        (ZeroDivisionError("oops"), 1, "unexpected ZeroDivisionError: oops"),
    ],
)
def test_errors_exit_with_their_code_and_one_line(
    put_pipeline: PutPipeline,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    exit_code: int,
    message: str,
) -> None:
    put_pipeline(_raise(error))

    assert cli.main(RECONSTRUCT) == exit_code
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert len(err.splitlines()) == 1


def test_verbose_shows_where_an_unexpected_error_came_from(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str]
) -> None:
    put_pipeline(_raise(ZeroDivisionError("oops")))

    assert cli.main([*RECONSTRUCT, "--verbose"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["reconstruct", "photos"],
        [*RECONSTRUCT, "--no-such-flag"],
        [*RECONSTRUCT, "--segment-length", "many"],
        [*RECONSTRUCT, "--camera-mode", "none"],
        [*RECONSTRUCT, "--config"],
    ],
)
def test_bad_flags_exit_2(put_pipeline: PutPipeline, argv: list[str]) -> None:
    put_pipeline(_Call())

    with pytest.raises(SystemExit) as leaving:
        cli.main(argv)
    assert leaving.value.code == 2


@pytest.mark.parametrize(("typed", "meant"), [("reconstrct", " (did you mean reconstruct?)"), ("frobnicate", "")])
def test_an_unknown_command_exits_2_with_those_there_are(
    capsys: pytest.CaptureFixture[str], typed: str, meant: str
) -> None:
    assert cli.main([typed, "photos"]) == 2
    assert capsys.readouterr().err == (
        f"smust3r-colmap: there is no command {typed!r}{meant}; "
        "the commands are reconstruct, refine, frames, export, georeference, report, validate, evaluate, demo, "
        "doctor, weights\n"
    )


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--segment-length", "many"),
        ("--camera-mode", "none"),
        ("--workers", "several"),
        ("--loop-similarity", "high"),
        ("--network-memory", "all"),
        ("--trainer-scales", "2,x"),
        ("--preset", "slow"),
    ],
)
def test_a_bad_value_is_named_with_its_flag(capsys: pytest.CaptureFixture[str], flag: str, value: str) -> None:
    with pytest.raises(SystemExit) as leaving:
        cli.main([*RECONSTRUCT, flag, value])
    said = capsys.readouterr().err
    assert leaving.value.code == 2
    assert flag in said and value.rsplit(",", maxsplit=1)[-1] in said


@pytest.mark.parametrize("overlap", ["60", "61", "0"])
def test_overlap_that_cannot_chain_exits_2(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], overlap: str
) -> None:
    put_pipeline(_Call())

    assert cli.main([*RECONSTRUCT, "--overlap", overlap]) == 2
    assert f"--overlap {overlap}" in capsys.readouterr().err


# ------------------------------------------------------------------------------- demo
def _pipeline_with_error_m(error_m: float) -> Pipeline:
    """A pipeline that copies the truth, but for the first camera, which is off along the world's y."""

    def reconstruct(images: Path, output: Path, _: RunConfig, *, reporter: Reporter) -> RunSummary:
        truth = read_poses_txt(images.parent / "poses.txt")
        model = pycolmap.Reconstruction()
        model.add_camera_with_trivial_rig(demo_intrinsics(64, 48).colmap_camera())
        for image_id, (name, world_from_cam) in enumerate(truth.items(), start=1):
            world_from_cam[1, 3] += error_m if image_id == 1 else 0.0
            image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert_rigid(world_from_cam)))
        (output / "sparse/0").mkdir(parents=True)
        model.write_binary(output / "sparse/0")
        return replace(GOOD, output=output)

    return reconstruct


def _write_small_demo(folder: Path, *, num_images: int) -> None:
    """Cameras on a parabola and empty images, because painting the room takes seconds."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    lines = [f"{k}.jpg 1 0 0 0 {0.5 * k} {0.1 * k * k} 0" for k in range(num_images)]
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for k in range(num_images):
        (folder / "images" / f"{k}.jpg").touch()


@pytest.fixture
def small_demo(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smust3r_colmap.synthetic.room.write_demo", _write_small_demo)


@pytest.mark.usefixtures("small_demo")
def test_demo_says_how_far_from_the_truth(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    put_pipeline(_pipeline_with_error_m(0.2))

    assert cli.main(["demo", "--output", str(tmp_path), "--num-images", "5"]) == 0
    found = re.search(r"5 of 5 images: position ([\d.]+) m rms", capsys.readouterr().out)
    assert found
    # One of five cameras is off by 0.2 m; the fit takes away a part of 0.2 / sqrt(5) = 0.089 m.
    assert 0.02 < float(found[1]) < 0.089


@pytest.mark.usefixtures("small_demo")
def test_demo_far_from_the_truth_is_weak(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    put_pipeline(_pipeline_with_error_m(1.5))

    assert cli.main(["demo", "--output", str(tmp_path), "--num-images", "5"]) == 3
    assert "more than 5 %" in capsys.readouterr().err


@pytest.mark.usefixtures("small_demo")
def test_demo_touches_no_images_that_are_not_its_own(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    put_pipeline(_Call())
    (tmp_path / "images").mkdir()

    assert cli.main(["demo", "--output", str(tmp_path)]) == 2
    assert "no demo" in capsys.readouterr().err
    assert list(tmp_path.rglob("*.jpg")) == []


@pytest.mark.usefixtures("small_demo")
def test_demo_does_not_mix_with_a_longer_one(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    put_pipeline(_Call())
    _write_small_demo(tmp_path, num_images=5)

    assert cli.main(["demo", "--output", str(tmp_path), "--num-images", "3"]) == 2
    assert "2 images of another demo" in capsys.readouterr().err


# ------------------------------------------------------------------------- precedence
def test_flags_override_the_file_and_the_file_the_defaults(put_pipeline: PutPipeline, tmp_path: Path) -> None:
    # The file alone would be refused: its segments are shorter than the default overlap.
    (tmp_path / "s.toml").write_text("segment_length = 20\nseed = 5\ntext = true\n", encoding="utf-8")
    call = _Call()
    put_pipeline(call)

    assert cli.main([*RECONSTRUCT, "--overlap", "4", "--config", str(tmp_path / "s.toml"), "--seed", "6"]) == 0
    segmentation = call.config.segmentation
    assert (segmentation.segment_length, segmentation.overlap, call.config.seed) == (20, 4, 6)
    assert call.config.output.text
    assert call.config.classical == RunConfig().classical


def settings_of(*words: str) -> RunConfig:
    command = cli.parse([*RECONSTRUCT, *words])
    assert isinstance(command, Reconstruct)
    return command.settings


def test_the_default_preset_changes_nothing() -> None:
    assert settings_of() == settings_of("--preset", "default") == RunConfig()


@pytest.mark.parametrize("name", ["fast", "thorough"])
def test_a_preset_is_a_set_of_settings_that_differ_from_the_defaults(tmp_path: Path, name: str) -> None:
    lines = [f"{key} = {json.dumps(value)}" for key, value in PRESETS[name].items()]
    (tmp_path / "s.toml").write_text("\n".join(lines), encoding="utf-8")
    chosen = settings_of("--preset", name)
    assert chosen == settings_of("--config", str(tmp_path / "s.toml")) != RunConfig()
    assert settings_of(f"--preset={name}") == chosen
    for key in PRESETS[name]:
        others = [line for line in lines if not line.startswith(f"{key} =")]
        (tmp_path / "s.toml").write_text("\n".join(others), encoding="utf-8")
        assert settings_of("--config", str(tmp_path / "s.toml")) != chosen, f"{key} is the default"


def test_the_file_overrides_the_preset_and_flags_the_file(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("max_features = 3000\nmatch_neighbours = 4\n", encoding="utf-8")
    config = settings_of("--match-neighbours", "6", "--config", str(tmp_path / "s.toml"), "--preset", "fast")
    assert config.features == FeatureConfig(max_features=3000)
    assert config.classical == ClassicalConfig(match_neighbours=6)
    assert not config.output.dense


def test_what_is_not_given_is_none_or_auto() -> None:
    config = settings_of()
    assert (config.masks, config.backbone_options, config.cameras.camera_params) == (None, None, None)
    assert (config.must3r.weights, config.must3r.retrieval_weights, config.output.trainer_scales) == (None, None, None)
    assert (config.workers, config.loop_closing.loop_similarity, config.must3r.network_memory) == ("auto",) * 3


def test_none_and_auto_take_back_what_the_file_gives(tmp_path: Path) -> None:
    text = "masks = 'm'\nworkers = 3\ncamera_params = '1,2'\ntrainer_scales = [2]\nloop_similarity = 0.9\n"
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    from_file = settings_of("--config", str(tmp_path / "s.toml"))
    assert (from_file.masks, from_file.workers, from_file.cameras.camera_params) == (Path("m"), 3, "1,2")
    words = "--masks None --workers auto --camera-params None --trainer-scales None --loop-similarity auto"
    assert settings_of("--config", str(tmp_path / "s.toml"), *words.split()) == RunConfig()


@pytest.mark.parametrize("words", [["2,4,8"], ["2", "4", "8"], ["2,4", "8"]])
def test_scales_are_given_with_commas_or_blanks(words: list[str]) -> None:
    assert settings_of("--trainer-scales", *words).output.trainer_scales == (2, 4, 8)


@pytest.mark.slow
@pytest.mark.parametrize("command", [RECONSTRUCT, ["refine", "model", "--images", "photos"]])
def test_the_same_switches_have_the_same_spelling_and_default(command: list[str]) -> None:
    def output_of(*words: str) -> ModelOutputConfig:
        parsed = cli.parse([*command, *words])
        assert isinstance(parsed, Reconstruct | Refine)
        return parsed.settings.output

    assert output_of().trainer
    assert not output_of("--no-trainer").trainer
    assert output_of("--no-trainer", "--trainer", "--no-text").trainer
    for gone in ("--fresh", "--complete", "--no-loops", "--tracks=features", "--loop-half-width=3"):
        with pytest.raises(SystemExit):
            output_of(gone)


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("--no-loop-closure", {"loop_closing": LoopConfig(loop_closure=False)}),
        ("--loop-window 3", {"loop_closing": LoopConfig(loop_window=3)}),
        ("--register-missing", {"refinement": RefinementConfig(register_missing=True)}),
        ("--track-source both", {"refinement": RefinementConfig(track_source="both")}),
        ("--masks m", {"masks": Path("m")}),
        ("--workers 2", {"workers": 2}),
        ("--network-memory 1.5", {"must3r": Must3rConfig(network_memory=1.5)}),
    ],
)
def test_flags_reach_their_setting(words: str, changed: dict[str, Any]) -> None:
    assert settings_of(*words.split()) == replace(RunConfig(), **changed)


def test_unknown_key_of_the_file_exits_2(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "s.toml").write_text("seeed = 5\n", encoding="utf-8")
    put_pipeline(_Call())

    assert cli.main([*RECONSTRUCT, f"--config={tmp_path / 's.toml'}"]) == 2
    assert "unknown setting 'seeed'; known are seed" in capsys.readouterr().err


# ------------------------------------------------------------------------------- help
def test_help_names_every_setting_with_its_reason(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        cli.main(["reconstruct", "--help"])
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())

    assert leaving.value.code == 0
    for part in ("--segment-length", "--overlap", "--camera-mode", "--max-points", "--text", "--seed", "IMAGES"):
        assert part in text
    assert "Images per segment" in text
    assert "--segmentation" not in text


HELP = [[], *([name] for name in cli.COMMANDS), *(["weights", name] for name in WEIGHTS_ACTIONS)]


def help_of(words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    with pytest.raises(SystemExit) as leaving:
        cli.main([*words, "--help"])
    assert leaving.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("words", HELP, ids=" ".join)
def test_no_line_of_help_is_broken_by_the_source(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the column of texts, a line ends where the next word does not fit any more."""
    lines = [line.rstrip("│ ") for line in help_of(words, monkeypatch, capsys).splitlines()]
    for line, following in pairwise(lines):
        start = len(following) - len(following.lstrip("│ "))
        if start >= MIN_TEXT_COLUMN and re.fullmatch(r"  [^ ].*", line[start - 2 :]):
            assert len(line) + 1 + len(following.lstrip("│ ").split()[0]) > WIDTH - 4, f"broken after: {line}"


@pytest.mark.parametrize("name", ["reconstruct", "refine"])
def test_what_most_people_need_comes_first(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = help_of([name], monkeypatch, capsys)
    flags = re.findall(r"^\W* (--[a-z][a-z0-9-]*)", text, re.M)
    titles = re.findall(r"^\W* ((?:[a-z0-9-]+ )?(?:arguments|options)) ", text, re.M)
    assert titles[:4] == ["positional arguments", "options", "cameras options", "output options"]
    general = {"--output", "--config", "--overwrite", "--workers", "--masks", "--camera-model", "--trainer"}
    assert general <= set(flags[: flags.index("--max-image-size")])


def test_the_docstrings_of_inherited_fields_are_found() -> None:
    docs = field_docs(OutputConfig)
    assert docs["text"] == "Write the COLMAP model as .txt beside the .bin files."
    assert docs.keys() == {"text", "trainer", "trainer_scales", "report", "dense", "mesh"}


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"smust3r-colmap {__version__}\n"


def test_library_warnings_reach_the_user_and_debug_only_if_verbose(
    put_pipeline: PutPipeline, capsys: pytest.CaptureFixture[str]
) -> None:
    def reconstruct(*_: object, **__: object) -> RunSummary:
        logging.getLogger("smust3r_colmap.features").warning("blurred")
        logging.getLogger("smust3r_colmap.features").debug("detail")
        return GOOD

    put_pipeline(reconstruct)

    cli.main(RECONSTRUCT)
    silent = capsys.readouterr().err
    cli.main([*RECONSTRUCT, "--verbose"])
    talkative = capsys.readouterr().err
    assert silent == "warning: blurred\n"
    assert talkative == "warning: blurred\ndetail\n"


@pytest.mark.parametrize("level", [logging.NOTSET, logging.INFO])
def test_logging_is_left_as_it_was_found(put_pipeline: PutPipeline, level: int) -> None:
    put_pipeline(lambda *_, **__: GOOD)
    logger = logging.getLogger("smust3r_colmap")
    before = (logger.level, tuple(logger.handlers), logger.propagate)
    try:
        logger.setLevel(level)
        cli.main(RECONSTRUCT)
        assert (logger.level, tuple(logger.handlers), logger.propagate) == (level, *before[1:])
    finally:
        logger.setLevel(before[0])


# --------------------------------------------------------------------------- progress
class _Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_plain_progress_is_sparse_and_estimates_the_rest() -> None:
    stream, clock = io.StringIO(), _Clock()
    with PlainReporter(stream, clock=clock).stage("features", total=100) as stage:
        for _ in range(100):
            clock.now_s += 1.0
            stage.advance()
    lines = stream.getvalue().splitlines()

    assert lines[0] == "features: 100 to do"
    assert lines[1] == "features: 10/100, about 1 min 30 s left"
    assert lines[-1] == "features: 100/100 in 1 min 40 s"
    assert len(lines) == 11


def test_plain_progress_of_a_fast_stage_is_two_lines() -> None:
    stream = io.StringIO()
    with PlainReporter(stream, clock=_Clock()).stage("features", total=1000) as stage:
        for _ in range(1000):
            stage.advance()

    assert stream.getvalue() == "features: 1000 to do\nfeatures: 1000/1000 in 0.0 s\n"


@pytest.mark.parametrize("reporter_type", [PlainReporter, TerminalReporter])
def test_work_of_an_earlier_run_is_told_apart(reporter_type: Any) -> None:
    stream = io.StringIO()
    reporter = reporter_type(stream, clock=_Clock())
    with reporter.stage("a", total=0):
        pass
    with reporter.stage("b", total=3) as stage:
        stage.skip(3)
    with reporter.stage("c", total=3) as stage:
        stage.skip(1)
        stage.advance(2)
    text = stream.getvalue()

    assert "a: nothing to do" in text
    assert "b: already done" in text
    assert "c: 3/3 in 0.0 s, 1 of them already done" in text


@pytest.mark.parametrize("reporter_type", [PlainReporter, TerminalReporter])
def test_a_stage_left_by_an_error_says_where_it_stopped(reporter_type: Any) -> None:
    stream = io.StringIO()
    with (
        pytest.raises(KeyboardInterrupt),
        reporter_type(stream, clock=_Clock()).stage("features", total=9) as stage,
    ):
        stage.advance(4)
        raise KeyboardInterrupt

    assert "features: stopped at 4/9 after 0.0 s" in stream.getvalue()


def test_earlier_work_does_not_shorten_the_estimate() -> None:
    stream, clock = io.StringIO(), _Clock()
    with PlainReporter(stream, clock=clock).stage("features", total=100) as stage:
        stage.skip(80)
        clock.now_s += 10.0
        stage.advance(10)

    assert "features: 90/100, about 10 s left" in stream.getvalue()


def test_names_with_brackets_are_printed_as_they_are() -> None:
    stream = io.StringIO()
    reporter = TerminalReporter(stream)
    reporter.warn("photo[1].jpg: [red] is no markup")

    assert "photo[1].jpg: [red] is no markup" in stream.getvalue()


def test_quiet_lets_only_warnings_through() -> None:
    stream = io.StringIO()
    reporter = reporter_for(stream, quiet=True)
    with reporter.stage("features", total=1) as stage:
        stage.advance()
    reporter.note("by the way")
    reporter.warn("look")

    assert isinstance(reporter, QuietReporter)
    assert stream.getvalue() == "warning: look\n"


def test_a_file_gets_plain_lines_and_a_terminal_bars() -> None:
    class _Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    assert isinstance(reporter_for(io.StringIO(), quiet=False), PlainReporter)
    assert isinstance(reporter_for(_Terminal(), quiet=False), TerminalReporter)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.04, "0.0 s"),
        (9.94, "9.9 s"),
        (9.96, "10 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (3599.6, "1 h 00 min"),
        (7620, "2 h 07 min"),
    ],
)
def test_durations_read_well(seconds: float, text: str) -> None:
    assert format_seconds(seconds) == text


# ---------------------------------------------------------------------------- summary
def test_good_summary_has_no_weak_reason_and_says_that_the_scale_is_arbitrary() -> None:
    assert GOOD.weak_reasons == ()
    assert GOOD.exit_code == 0
    text = GOOD.render_text()
    assert "Scale: arbitrary" in text
    assert "sparse/0: 5 images, 100 points, segments 0, 1" in text
    assert "reused from an earlier run: alignment" in text
    assert "1.5 GiB" in text
    assert "weak" not in text


def test_metric_needs_every_model() -> None:
    metric = replace(GOOD.models[0], metric=True)

    assert replace(GOOD, models=(metric,)).scale_statement == "metres"
    assert "arbitrary" in replace(GOOD, models=(metric, GOOD.models[0])).scale_statement


@pytest.mark.parametrize(
    ("summary", "reason"),
    [
        (WEAK, "1 of 5 images got no pose"),
        (replace(GOOD, rejected=(ImageNote(name="x.jpg", reason="truncated"),)), "1 of 6 files could not be used"),
        (
            replace(GOOD, models=(replace(GOOD.models[0], num_images=3), replace(GOOD.models[0], num_images=2))),
            "2 models that could not be connected; the largest has 3 of 5 images",
        ),
        (
            replace(GOOD, segments=(replace(GOOD.segments[0], index=7, num_submodels=0, num_registered=0),)),
            "nothing came out of segment 7",
        ),
        (
            replace(GOOD, refinements=(replace(REFINED, warnings=("no bundle adjustment accepted",)),)),
            "sparse/0: no bundle adjustment accepted",
        ),
        (
            replace(GOOD, refinements=(replace(REFINED, succeeded=False, reason="no point"),)),
            "the largest model has no tracks: no point",
        ),
        (replace(GOOD, refinements=(replace(REFINED, weak=("a.jpg",)),)), "1 images have too few observations"),
    ],
)
def test_each_shortcoming_makes_the_result_weak(summary: RunSummary, reason: str) -> None:
    assert summary.exit_code == 3
    assert len(summary.weak_reasons) == 1
    assert reason in summary.weak_reasons[0]
    assert f"{summary.verdict.level}: {summary.weak_reasons[0]}; " in summary.render_text()


def test_long_lists_are_cut_in_the_text_but_whole_in_the_json() -> None:
    notes = tuple(ImageNote(name=f"{k}.jpg", reason="blurred") for k in range(8))
    summary = replace(GOOD, num_images=13, unregistered=notes)

    assert "4.jpg (blurred)" in summary.render_text()
    assert "5.jpg" not in summary.render_text()
    assert "3 more, see summary.json" in summary.render_text()
    assert len(summary.to_json_dict()["unregistered"]) == 8


def test_summary_is_plain_json_that_does_not_name_its_folder() -> None:
    edge = EdgeSummary(
        target="0", source="1", evidence="poses", relative_residual=float("nan"), accepted=False, reason="too few"
    )
    facts = replace(GOOD, edges=(edge,)).to_json_dict()

    assert json.loads(json.dumps(facts, allow_nan=False)) == facts
    assert facts["edges"][0]["relative_residual"] is None
    assert facts["models"][0]["segments"] == ["0", "1"]
    assert "output" not in facts


def test_counts_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="4 registered and 0 unregistered images do not make 5"):
        replace(GOOD, num_registered=4)
    with pytest.raises(ValueError, match="without a model"):
        replace(GOOD, models=())


# ----------------------------------------------------------------------------- doctor
@pytest.mark.parametrize(
    ("stderr", "advice"),
    [
        (
            "ImportError: libusb-1.0.so.0: cannot open shared object file: No such file or directory",
            "libusb-1.0.so.0 is missing; install the system package libusb-1.0-0",
        ),
        ("ImportError: libGL.so.1: cannot open shared object file", "install the system package libgl1"),
        ("OSError: libodd.so.3: cannot open shared object file", "libodd.so.3 is missing; install the package that"),
        ("ModuleNotFoundError: No module named 'cv2'", "cv2 is not installed; pip install opencv-python-headless"),
        ("ModuleNotFoundError: No module named 'open3d'", "open3d is not installed; pip install open3d"),
        ("Traceback ...\nValueError: odd", "cannot be imported: ValueError: odd"),
        (
            "ModuleNotFoundError: No module named 'net'\nsmust3r_colmap.errors.MissingDependencyError: fetch net.zip",
            "fetch net.zip",
        ),
        ("", "cannot be imported: no message"),
    ],
)
def test_doctor_says_what_to_install(stderr: str, advice: str) -> None:
    assert advice in advice_for(stderr)


def _small_doctor(monkeypatch: pytest.MonkeyPatch, packages: tuple[tuple[str, str], ...]) -> None:
    monkeypatch.setattr(doctor, "_PACKAGES", packages)
    monkeypatch.setattr(doctor, "_PARTS", (("exporter", "PLY cloud", "smust3r_colmap.exporters.ply"),))
    monkeypatch.setattr(doctor, "list_backbones", tuple)


@pytest.mark.slow
def test_doctor_survives_packages_that_abort_hang_or_are_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_IMPORT_TIMEOUT_S", 2.0)
    _small_doctor(
        monkeypatch,
        (
            ("pillow", "print('a card')"),
            ("rich", "import os; os.abort()"),
            ("tyro", "import time; time.sleep(60)"),
            ("open3d", "import no_such_package"),
        ),
    )

    assert cli.main(["doctor", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    checks = {check["name"]: check for check in facts["checks"]}
    assert not facts["healthy"]
    assert facts["cores"] >= 1
    assert checks["pillow"]["works"]
    assert checks["pillow"]["devices"] == ["a card"]
    assert "signal 6" in checks["rich"]["advice"]
    assert "longer than 2 s" in checks["tyro"]["advice"]
    assert "pip install no_such_package" in checks["open3d"]["advice"]


def test_doctor_is_content_without_open3d(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    _small_doctor(monkeypatch, (("open3d", "import no_such_package"),))
    monkeypatch.setattr(doctor, "_PARTS", ())

    assert cli.main(["doctor"]) == 0
    out = capsys.readouterr().out
    assert "not usable, not needed" in out
    assert "Everything needed works." in out
    assert "accelerators: none" in out


@pytest.mark.slow
def test_doctor_says_of_every_backbone_what_it_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install_package(tmp_path, "other-net", "[smust3r_colmap.backbones]\nothernet = other_net:make\n")
    (tmp_path / "other_net.py").write_text("import no_such_package", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(doctor, "_PACKAGES", (("pillow", "import PIL"),))
    monkeypatch.setattr(doctor, "_PARTS", (("exporter", "PLY cloud", "smust3r_colmap.exporters.ply"),))
    monkeypatch.setattr(doctor, "_MORE_OF_BACKBONE", {"classical": "print('fast')\nprint('and sound')"})
    monkeypatch.setattr(
        doctor,
        "list_backbones",
        lambda: [known for known in list_backbones() if known.name in ("classical", "othernet")],
    )

    assert cli.main(["doctor"]) == 0, "no more than the classical backbone is needed"
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines[3:-1]] == [
        ["package", "pillow"],
        ["backbone", "classical"],
        ["fast"],
        ["and", "sound"],
        ["backbone", "othernet"],
        ["exporter", "PLY"],
    ]
    assert lines[4].endswith("works")
    assert "othernet (of other-net) 1.0" in lines[7]
    assert "not usable, not needed: backbone othernet of the package other-net" in lines[7]
    assert "No module named 'no_such_package'" in lines[7]


@pytest.mark.slow
def test_doctor_says_whether_must3r_has_its_weights(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_PACKAGES", (("pillow", "import PIL"),))
    monkeypatch.setattr(doctor, "_PARTS", (("exporter", "PLY cloud", "smust3r_colmap.exporters.ply"),))
    monkeypatch.setattr(
        doctor, "list_backbones", lambda: [known for known in list_backbones() if known.name == "must3r"]
    )
    monkeypatch.setenv("SMUST3R_CACHE", str(tmp_path))
    monkeypatch.delenv("SMUST3R_WEIGHTS", raising=False)
    weights = tmp_path / "network.pth"
    weights.touch()

    notes = []
    for named in ("", str(weights)):
        monkeypatch.setenv("SMUST3R_WEIGHTS", named)
        assert cli.main(["doctor", "--json"]) == 0
        (check,) = [one for one in json.loads(capsys.readouterr().out)["checks"] if one["kind"] == "backbone"]
        assert check["works"], check["advice"]
        notes.append(check["notes"])
    assert all(re.search("float32|bfloat16", one[0]) for one in notes)
    assert notes[0][-1].startswith("no weights for --network-size 512")
    assert notes[1][-1] == f"weights: {weights}"

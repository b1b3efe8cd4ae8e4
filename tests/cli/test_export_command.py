"""``smust3r-colmap export``: a finished run is written again as it was, elsewhere, otherwise, or refused."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pycolmap
import pytest
import tyro
from helpers.finished_runs import NAMES, NUM_PLACED, Example, content
from helpers.summaries import GOOD
from PIL import Image

from smust3r_colmap.cli.export import Export, FormatName, run_export
from smust3r_colmap.cli.fields import REGISTRY
from smust3r_colmap.errors import (
    CollectionError,
    ConfigError,
    ImageError,
    InputError,
    MissingDependencyError,
    RunDirectoryError,
    RunLockedError,
)
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.stage_clock import StageClock
from smust3r_colmap.exporters import registry as exports
from smust3r_colmap.exporters.dense_workspace import DenseReport
from smust3r_colmap.exporters.finished_run import FinishedRun, open_finished
from smust3r_colmap.exporters.registry import FORMATS, FormatSettings, Written, write_where_possible
from smust3r_colmap.storage.run_directory import RunDirectory


def export(*arguments: str | Path) -> int:
    command = tyro.cli(Export, args=[str(argument) for argument in arguments], registry=REGISTRY)
    return run_export(command)


@pytest.fixture
def run(finished_example: Example, tmp_path: Path) -> Path:
    """A copy that a test may change; its images are where the run knows them."""
    return Path(shutil.copytree(finished_example.root, tmp_path / "run"))


@pytest.fixture
def own_images(run: Path, finished_example: Example, tmp_path: Path) -> Path:
    """A copy of the images, too, and a run that knows them there."""
    images = Path(shutil.copytree(finished_example.images, tmp_path / "images"))
    facts = json.loads((run / "work/finished.json").read_text())
    (run / "work/finished.json").write_text(json.dumps({**facts, "images": str(images)}))
    return images


# ------------------------------------------------------------------------------ formats
@pytest.mark.slow
def test_what_was_deleted_is_written_again_byte_by_byte(run: Path) -> None:
    before = content(run)
    for name in ("sparse", "database.db", "points.ply"):
        (shutil.rmtree if (run / name).is_dir() else os.remove)(run / name)
    assert export(run, "--format", "ply", "sparse", "database", "sparse") == 0
    assert content(run) == before


def test_text_glb_and_trajectory_are_added_on_demand(run: Path) -> None:
    assert export(run, "--format", "glb", "tum") == 0
    assert (run / "scene.glb").stat().st_size > 1000
    lines = (run / "trajectory_tum.txt").read_text().splitlines()
    assert len([line for line in lines if not line.startswith("#")]) == NUM_PLACED
    with pytest.raises(InputError, match="view 00"):  # the names have blanks, which text cannot hold
        export(run, "--format", "sparse", "--text")


@pytest.mark.slow
def test_a_training_dataset_is_made_with_masks_scales_and_notes(
    run: Path, finished_example: Example, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    move_a_point_far_away(run)
    for name in NAMES[1:NUM_PLACED]:
        mask = tmp_path / "masks" / f"{name}.png"
        mask.parent.mkdir(parents=True, exist_ok=True)
        Image.new("L", (320, 240), 255).save(mask)
    arguments: list[str | Path] = [run, "--format", "trainer", "--trainer-scales", "2", "--masks", tmp_path / "masks"]
    assert export(*arguments) == 0
    said = capsys.readouterr().out.splitlines()
    assert said == [
        str(run / "trainer"),
        "  0 cameras and 1 points far from all others left out",
        f"  without a mask: {NAMES[0]}",
    ]
    assert len(list((run / "trainer/images_2").iterdir())) == NUM_PLACED
    num_points = pycolmap.Reconstruction(run / "trainer/sparse/0").num_points3D()
    assert export(*arguments, "--keep-outliers") == 0
    assert "far from" not in capsys.readouterr().out
    assert pycolmap.Reconstruction(run / "trainer/sparse/0").num_points3D() == num_points + 1


def move_a_point_far_away(run: Path) -> None:
    model = pycolmap.Reconstruction(run / "work/refined/0/model")
    point = max(model.points3D.values(), key=lambda point: point.track.length())
    centre = model.image(point.track.elements[0].image_id).projection_center()
    point.xyz = centre + 1e4 * (point.xyz - centre)
    model.write(run / "work/refined/0/model")


def test_every_format_is_listed_with_a_line(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert set(get_args(FormatName)) == {*FORMATS, "list"}
    assert export(run, "--format", "list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(FORMATS)
    assert all(len(line.split()) > 3 for line in lines)


@pytest.mark.parametrize("arguments", [("--format", "list"), ("--format=list",), ("--format", "ply", "list")])
def test_formats_are_listed_without_a_run(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert export(*arguments) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(FORMATS)


def test_a_run_that_is_missing_is_said_to_be_and_one_behind_the_formats_is_found(run: Path) -> None:
    for names in (["ply"], ["sparse", "ply"]):
        with pytest.raises(ConfigError, match=f"RUN is missing: 'ply' .* `export RUN --format {' '.join(names)}`"):
            export("--format", *names)
    assert export("--format", "ply", run) == 0
    assert export("--format", "ply", run.rename(run.with_name("sparse"))) == 0


def test_help_names_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        export("--help")
    said = capsys.readouterr().out
    assert all(f"{name} (" in said for name in FORMATS)


def test_quiet_prints_nothing(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(run, "--format", "ply", "--quiet") == 0
    assert capsys.readouterr().out == ""


# ------------------------------------------------------------------------------- places
def test_another_folder_gets_the_result_and_the_run_stays(run: Path, tmp_path: Path) -> None:
    before = content(run)
    assert export(run, "--format", "sparse", "database", "--output", tmp_path / "else/where") == 0
    assert content(run) == before
    assert content(tmp_path / "else/where") == {
        name: data for name, data in before.items() if name.split("/")[0] in ("sparse", "database.db")
    }


@pytest.mark.parametrize("name", ["sparse", "database", "ply", "glb", "tum"])
def test_every_format_makes_the_folder_that_is_not_there(name: str, run: Path, tmp_path: Path) -> None:
    assert export(run, "--format", name, "--output", tmp_path / "else/where") == 0
    assert [path.name for path in (tmp_path / "else/where").iterdir()] == [FORMATS[name].result]


def test_results_of_others_are_not_replaced(run: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/database.db").write_text("mine")
    with pytest.raises(InputError, match=r"mine/database\.db: is there already"):
        export(run, "--format", "ply", "database", "--output", tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["database.db"]
    with pytest.raises(ConfigError, match="is a file; name a folder"):
        export(run, "--format", "ply", "--output", tmp_path / "mine/database.db")


def replace_writer(
    monkeypatch: pytest.MonkeyPatch, name: str, write: Callable[[FinishedRun, FormatSettings], Written]
) -> list[str]:
    """In place of a format's own work; the list gets the names that it says it has written."""
    written: list[str] = []

    def noted(finished: FinishedRun, settings: FormatSettings) -> Written:
        written.append(write(finished, settings).name)
        return write(finished, settings)

    monkeypatch.setitem(FORMATS, name, replace(FORMATS[name], write=noted))
    return written


def test_images_that_moved_are_found_with_their_new_place(
    run: Path, own_images: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = own_images.rename(tmp_path / "moved")
    with pytest.raises(CollectionError, match="not there any more; say with --images"):
        export(run, "--format", "trainer")
    for path in moved.rglob("*.png"):
        os.utime(path)  # as after copying; the content decides
    read = replace_writer(monkeypatch, "trainer", lambda finished, _: Written(name=finished.images.name))
    assert export(run, "--format", "trainer", "--images", moved) == 0
    assert read == ["moved"]
    with pytest.raises(ConfigError, match="lies inside the image folder"):
        export(run, "--format", "trainer", "--images", moved, "--output", moved / "out")


# ----------------------------------------------------------------------------- refusals
def change_a_pixel(image: Path) -> None:
    data = bytearray(image.read_bytes())
    data[-20] ^= 1
    image.write_bytes(bytes(data))


@pytest.mark.parametrize(
    ("harm", "match"),
    [
        (change_a_pixel, r"view 02\.png: has changed since the run"),
        (lambda image: image.write_bytes(b"x"), r"has changed since the run \(\d+ bytes then, 1 now\)"),
        (lambda image: image.unlink(), r"view 02\.png: is not in .* any more"),
    ],
)
def test_images_that_changed_are_refused_before_anything_is_written(
    harm: Callable[[Path], None], match: str, run: Path, own_images: Path
) -> None:
    harm(own_images / NAMES[2])
    before = content(run)
    with pytest.raises(ImageError, match=match):
        export(run, "--format", "sparse", "trainer")
    assert content(run) == before
    assert export(run, "--format", "sparse") == 0  # which needs no images


def test_a_folder_that_is_no_finished_run_is_refused_and_left_alone(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: there is no such folder; give .* of reconstruct or refine"):
        export(tmp_path / "nowhere", "--format", "ply")
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "photos").mkdir()
    with pytest.raises(InputError, match="photos: is no run of this program"):
        export(tmp_path / "photos", "--format", "ply")
    assert not any((tmp_path / "photos").iterdir())
    (run / "work/finished.json").unlink()
    with pytest.raises(InputError, match="not finished; start the reconstruct or refine that made it again"):
        export(run, "--format", "ply")


def test_a_run_of_another_version_is_refused(run: Path) -> None:
    (run / "work/finished.json").write_text('{"images": "photos"}')
    with pytest.raises(RunDirectoryError, match="written by another version"):
        export(run, "--format", "ply")


def test_a_run_that_is_being_written_is_refused(run: Path) -> None:
    with RunDirectory(run), pytest.raises(RunLockedError):
        export(run, "--format", "ply")


def without(run: Path, **parts: object) -> None:
    facts = json.loads((run / "work/finished.json").read_text())
    (run / "work/finished.json").write_text(json.dumps({**facts, **parts}))


@pytest.mark.parametrize("name", ["database", "trainer", "dense"])
def test_a_run_without_tracks_has_no_format_that_needs_them(name: str, run: Path) -> None:
    without(run, with_tracks=[False])
    with pytest.raises(InputError, match="no tracks"):
        export(run, "--format", name)
    assert export(run, "--format", "sparse") == 0
    assert pycolmap.Reconstruction(run / "sparse/0").compute_num_observations() == 0


def test_a_dense_workspace_needs_depth_and_a_mesh_the_workspace(run: Path) -> None:
    shutil.rmtree(run / "dense")
    with pytest.raises(InputError, match="write the format dense, too"):
        export(run, "--format", "mesh")
    without(run, with_maps=False)
    with pytest.raises(InputError, match="no depth maps"):
        export(run, "--format", "dense")


def test_settings_that_make_no_sense_are_refused(run: Path) -> None:
    with pytest.raises(ConfigError, match="whole numbers above 1"):
        export(run, "--format", "trainer", "--trainer-scales", "1")
    with pytest.raises(ConfigError, match="at least one format"):
        export(run, "--format")
    with pytest.raises(SystemExit):
        export(run, "--format", "obj")


# --------------------------------------------------------------------- within a pipeline
def test_a_format_that_fails_costs_itself_only_and_remarks_are_collected(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Written:
        raise MissingDependencyError("install open3d")

    replace_writer(monkeypatch, "mesh", fail)
    replace_writer(monkeypatch, "trainer", lambda *_: Written(name="trainer", notes=("3 cameras left out",)))
    clock = StageClock(QuietReporter(sys.stderr))
    with RunDirectory(run) as held:
        outputs = write_where_possible(open_finished(held), ("mesh", "trainer", "ply"), FormatSettings(), clock)
    assert [(one.name, one.reason) for one in outputs.missing] == [("mesh", "install open3d")]
    assert outputs.notes == ("trainer: 3 cameras left out",)
    assert [stage.name for stage in clock.stages] == ["mesh", "trainer", "ply"]
    summary = replace(GOOD, notes=outputs.notes)
    assert summary.to_json_dict()["notes"] == list(outputs.notes)
    assert outputs.notes[0] in summary.render_text()
    assert summary.exit_code == 0


def test_dense_says_what_is_not_there(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report = DenseReport(num_images=9, without_map=NAMES[:5], borrowed_scale=NAMES[7:8], coverage=0.5, num_points=0)
    asked: list[object] = []

    def write(*arguments: object, **_: object) -> DenseReport:
        asked.extend(arguments)
        return report

    monkeypatch.setattr(exports, "write_dense_workspace", write)
    with RunDirectory(run) as held:
        finished = open_finished(held, output=tmp_path / "out")
        written = FORMATS["dense"].write(finished, FormatSettings())
    assert asked[1:] == [finished.images, finished.maps, tmp_path / "out/dense"]
    assert written == Written(
        name="dense",
        notes=(
            f"without depth: {NAMES[0]}, {NAMES[1]}, {NAMES[2]} and 2 more",
            f"depth scaled as the whole model, for lack of points: {NAMES[7]}",
            "the fused cloud is empty",
        ),
    )

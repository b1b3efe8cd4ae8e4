"""The whole page: of a run, of a model alone, of what is unfinished or broken; nothing in it leaves the file."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from helpers.finished_runs import NAMES, NUM_PLACED, Example, content
from helpers.runs import run_in
from helpers.summaries import GOOD
from helpers.tracked_scenes import (
    arc,
    ball,
    make_collection,
    make_world,
    rig_from_world,
    true_matches,
    write_features,
)
from PIL import Image

from smust3r_colmap.cli.main import main
from smust3r_colmap.config import OutputConfig
from smust3r_colmap.errors import ReconstructionError
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.products import RejectedImage
from smust3r_colmap.refinement.global_refinement import RESULTS, UNCERTAINTIES
from smust3r_colmap.refinement.model_uncertainty import summarise_uncertainty
from smust3r_colmap.report import facts
from smust3r_colmap.report.html import failure_reported, write_report
from smust3r_colmap.report.summary import ImageNote
from smust3r_colmap.storage.run_directory import RunDirectory, write_json

pytestmark = pytest.mark.usefixtures("quiet_pycolmap")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NASTY = "<img src=x onerror=\"alert('1')\">&.png"
VOID = {"img", "meta", "br"}


class Page(HTMLParser):
    """The elements of a page with their attributes, its text, and whether its tags match."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self._open: list[str] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def all_of(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def targets(self) -> Iterator[str]:
        """Whatever an element names that a browser would load, or go to."""
        for _, attributes in self.elements:
            yield from (attributes[name] for name in ("src", "href", "srcset", "action", "data") if name in attributes)


def write_summary(root: Path, **changes: Any) -> None:
    """That of the example: nine images are placed, one has no features and one no matches."""
    results = RESULTS.read(root / "work/refined")
    (uncertainty,) = UNCERTAINTIES.read(root / "work/refined")
    (model,) = GOOD.models
    summary = replace(
        GOOD,
        num_images=len(NAMES),
        num_registered=NUM_PLACED,
        models=(replace(model, num_images=NUM_PLACED, uncertainty=summarise_uncertainty(uncertainty)),),
        unregistered=tuple(ImageNote(name=name, reason="matches <none> of the others") for name in NAMES[NUM_PLACED:]),
        rejected=(ImageNote(name="broken.jpg", reason="the file is empty"),),
        refinements=results,
        **changes,
    )
    write_json(root / "summary.json", summary.to_json_dict())


@pytest.fixture(scope="module")
def run(finished_example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with a summary; tests that change something copy it."""
    root = tmp_path_factory.mktemp("report") / "run"
    shutil.copytree(finished_example.root, root)
    (root / "work/features").mkdir()
    (root / "work/features.db").rename(root / "work/features/database.db")
    write_json(root / "work/segments.json", [list(range(6)), list(range(4, NUM_PLACED))])
    write_summary(root)
    return root


@pytest.fixture(scope="module")
def page(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Page:
    target = tmp_path_factory.mktemp("page") / "report.html"
    assert main(["report", str(run), "--output", str(target)]) == 0
    return Page(target)


# ---------------------------------------------------------------------------- what it says
def test_every_image_has_its_state_and_its_reason(page: Page) -> None:
    assert "9 of 12" in page.text  # with the file that could not be used
    assert "3 images with a problem" in page.text
    assert page.text.count("no pose: matches <none> of the others") == 2
    assert "unusable file: the file is empty" in page.text
    assert "11 thumbnails" in page.text
    cards = [attributes for attributes in page.all_of("li") if attributes.get("id", "").startswith("image-")]
    assert len(cards) == 11


def test_the_sections_are_in_the_order_of_the_questions(page: Page) -> None:
    sections = [attributes["id"] for attributes in page.all_of("section")]
    assert sections == [
        "verdict", "images", "plan", "matrix", "links", "cameras", "histograms", "models", "cost", "products",
        "settings",
    ]  # fmt: skip


def test_the_verdict_is_that_of_the_summary(page: Page) -> None:
    assert ("p", {"class": "level weak"}) in page.elements
    assert "2 of 11 images got no pose" in page.text
    assert "Add images between them and their neighbours, or try --register-missing." in page.text


def test_the_matches_of_all_pairs_are_compared_with_the_model(page: Page) -> None:
    assert "0 of 30 pairs of images at most 5 apart contradict the model" in page.text
    assert "and 0 of 6 pairs farther apart" in page.text
    assert "folded or torn between" not in page.text


def test_files_beside_the_page_are_linked(page: Page) -> None:
    links = [attributes["href"] for attributes in page.all_of("a") if not attributes["href"].startswith("#")]
    assert links == ["sparse/0", "points.ply", "database.db", "dense", "summary.json"]


def test_links_inside_of_the_page_lead_somewhere(page: Page) -> None:
    anchors = {attributes["id"] for _, attributes in page.elements if "id" in attributes}
    inside = {target[1:] for target in page.targets() if target.startswith("#")}
    assert inside
    assert inside <= anchors


# --------------------------------------------------------------------- nothing leaves it
def test_nothing_is_loaded_and_nothing_runs(page: Page) -> None:
    policy = next(one["content"] for one in page.all_of("meta") if one.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    assert "script-src" not in policy
    for kind in ("script", "link", "iframe", "object", "embed", "base", "form"):
        assert not page.all_of(kind), kind
    assert not [name for _, attributes in page.elements for name in attributes if name.startswith("on")]
    assert not re.search(r"(https?:)?//|url\(|@import", re.sub(r'"data:image/[^"]*"', "", page.source))
    assert all(target.startswith(("data:image/", "#")) or "//" not in target for target in page.targets())


def test_the_same_run_gives_the_same_bytes_and_nothing_else_changes(run: Path, page: Page, tmp_path: Path) -> None:
    before = content(run)
    assert main(["report", str(run), "--output", str(tmp_path / "again.html")]) == 0
    assert (tmp_path / "again.html").read_text(encoding="utf-8") == page.source
    assert content(run) == before


def test_names_with_markup_are_text(run: Path, finished_example: Example, tmp_path: Path) -> None:
    model, images = pycolmap.Reconstruction(run / "sparse/0"), tmp_path / "images"
    model.image(3).name = NASTY
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    images.mkdir()
    Image.new("RGB", (320, 240), (1, 2, 3)).save(images / NASTY)
    target = tmp_path / "out.html"
    assert main(["report", str(tmp_path / "model"), "--images", str(images), "--output", str(target)]) == 0
    page = Page(target)
    assert NASTY in page.text
    assert not [attributes for attributes in page.all_of("img") if "onerror" in attributes or attributes["src"] == "x"]
    assert "1 thumbnails" in page.text


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here; on Debian: apt install chromium")
@pytest.mark.parametrize("width", [390, 1200])
def test_a_browser_shows_it_without_a_complaint(page: Page, tmp_path: Path, width: int) -> None:
    """In a frame, because windows of Chromium are at least 500 wide; forbidden requests would be in its console."""
    assert CHROMIUM is not None
    (tmp_path / "report.html").write_text(page.source, encoding="utf-8")
    frame = f'<body style="margin:0"><iframe src="report.html" style="width:{width}px;height:3000px;border:0"></iframe>'
    (tmp_path / "frame.html").write_text(frame, encoding="utf-8")
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--enable-logging=stderr"]
    command += ["--disable-background-networking", "--disable-component-update", "--disable-sync"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={max(width, 500)},3000"]
    command += [f"--screenshot={tmp_path / 'shot.png'}", (tmp_path / "frame.html").as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "CONSOLE" not in done.stderr
    with Image.open(tmp_path / "shot.png") as opened:
        shot = np.asarray(opened.convert("RGB"))[:, :width]
    assert len(np.unique(shot.reshape(-1, 3), axis=0)) > 100
    # nothing is cut off on the right: there is a margin along the whole page
    assert (shot[:, -8:] == shot[0, -1]).all()


# ------------------------------------------------------------------ less than a whole run
def test_without_work_the_matches_of_the_database_are_taken(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    shutil.rmtree(tmp_path / "run/work")
    assert main(["report", str(tmp_path / "run")]) == 0
    page = Page(tmp_path / "run/report.html")
    assert "These are the matches of database.db, which agree with the model" in page.text
    assert "No thumbnails: it is not known where the images are (--images)." in page.text


def test_a_report_replaces_a_report_and_nothing_else(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "report.html"
    target.write_text("<html>mine</html>")
    assert main(["report", str(run), "--output", str(target)]) == 2
    assert "report.html: is there already, and no report of ours" in capsys.readouterr().err
    assert target.read_text() == "<html>mine</html>"
    target.unlink()
    assert main(["report", str(run), "--output", str(target)]) == 0
    assert main(["report", str(run), "--output", str(target)]) == 0


def test_a_run_without_tracks_is_shown(run: Path, tmp_path: Path) -> None:
    root = tmp_path / "run"
    shutil.copytree(run, root)
    model = pycolmap.Reconstruction(root / "sparse/0")
    for point in list(model.points3D):
        model.delete_point3D(point)
    model.write(root / "sparse/0")
    (result,) = RESULTS.read(root / "work/refined")
    RESULTS.write(root / "work/refined", (replace(result, succeeded=False, reason="too few matches"),))
    write_summary(root)
    assert main(["report", str(root)]) == 0
    page = Page(root / "report.html")
    assert ("p", {"class": "level failed"}) in page.elements
    assert "the largest model has no tracks: too few matches" in page.text
    assert "The model has no tracks, hence no residuals." in page.text


def test_a_run_that_is_not_finished_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run/work/finished.json").unlink()
    assert main(["report", str(tmp_path / "run")]) == 2
    assert "the run is not finished; start the reconstruct or refine that made it again" in capsys.readouterr().err
    assert not (tmp_path / "run/report.html").exists()


@pytest.mark.slow
def test_a_run_that_goes_on_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, tmp_path / "run")
    with RunDirectory(tmp_path / "run"):
        assert main(["report", str(tmp_path / "run")]) == 1
    assert "another process is writing here; wait for it or stop it" in capsys.readouterr().err


def test_a_summary_of_another_version_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, tmp_path / "run")
    write_json(tmp_path / "run/summary.json", {"schema_version": 1})
    assert main(["report", str(tmp_path / "run")]) == 2
    assert "summary.json: was written by another version of this program" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["RUN", "--images", "nowhere"], "--images nowhere: no such folder"),
        (["RUN", "--database", "x.db"], "--database x.db: is for models"),
        (["RUN", "--output", "."], "--output .: is a folder; name a file"),
    ],
)
def test_wrong_use_is_refused(run: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", *(str(run) if word == "RUN" else word for word in words)]) == 2
    assert message in capsys.readouterr().err


def test_where_the_model_is_on_earth_is_shown(run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    accuracy = {"count": 6, "mean": [0, 0, 0], "rmse": [0.004, 0.008, None], "horizontal": 0.009, "spatial": None}
    geo = {
        "crs": {"name": "ETRS89 / UTM zone 32N", "epsg": 25832, "vertical": "unknown"},
        "metres_per_unit": 7.301256,
        "basis": "control points",
        "accuracy_m": {"control_leave_one_out": {**accuracy, "ce90": 0.013, "le90": None}},
        "faults": [],
        "warnings": ["heights <were> not used"],
    }
    (tmp_path / "run/geo").mkdir()
    write_json(tmp_path / "run/geo/geo.json", geo)
    assert main(["report", str(tmp_path / "run")]) == 0
    page = Page(tmp_path / "run/report.html")
    assert "EPSG:25832 (ETRS89 / UTM zone 32N), vertical datum: unknown." in page.text
    assert "One unit of the model is 7.30126 m. Placed by control points." in page.text
    assert "control leave one out60.0040.008-0.009-0.013-" in page.text
    assert "Heights <were> not used." in page.text
    assert {"href": "geo/geo.json"} in page.all_of("a")


# ------------------------------------------------------------------------- a model alone
def test_a_model_with_its_database_has_a_verdict(run: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.html"
    words = ["report", str(run / "sparse/0"), "--database", str(run / "work/features/database.db")]
    assert main([*words, "--output", str(target)]) == 0
    page = Page(target)
    assert "0 of 30 pairs of images at most 5 apart" in page.text
    assert "predicted error" in page.text
    assert "No thumbnails" in page.text
    assert "9 of 9" in page.text


def test_a_model_without_points_has_no_uncertainty_and_says_so(run: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(run / "sparse/0")
    for point in list(model.points3D):
        model.delete_point3D(point)
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    target = tmp_path / "out.html"
    words = ["report", str(tmp_path / "model"), "--database", str(run / "work/features/database.db")]
    assert main([*words, "--output", str(target)]) == 0
    page = Page(target)
    assert ("p", {"class": "level weak"}) in page.elements
    assert "has no tracks, so its residuals and uncertainties are not known" in page.text
    assert "0 of 30 pairs of images at most 5 apart contradict the model" in page.text


def test_what_is_no_database_is_refused(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["report", str(run / "sparse/0"), "--output", str(tmp_path / "out.html")]
    assert main([*words, "--database", str(run / "summary.json")]) == 2
    assert "summary.json: is no COLMAP database" in capsys.readouterr().err
    assert main([*words, "--database", str(run)]) == 2
    assert "no such file" in capsys.readouterr().err


def test_of_many_images_some_have_a_thumbnail_those_with_a_problem_first(
    run: Path, finished_example: Example, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(facts, "MAX_THUMBNAILS", 5)
    target = tmp_path / "out.html"
    assert main(["report", str(run), "--output", str(target)]) == 0
    page = Page(target)
    assert "5 of 11 images have a thumbnail, those with a problem first." in page.text
    cards = [attributes["id"] for attributes in page.all_of("li") if "id" in attributes]
    shown = [bytes.fromhex(one.removeprefix("image-")).decode() for one in cards]
    assert shown == [NAMES[k] for k in (0, 3, 6, 9, 10)]


def test_two_halves_that_contradict_each_other_are_named(run: Path, tmp_path: Path) -> None:
    """Half of the cameras is moved, so that both halves agree inside, but not with each other."""
    model = pycolmap.Reconstruction(run / "sparse/0")
    for image_id in range(5, NUM_PLACED + 1):
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 0.5])), np.array([0.0, 1.0, 0.0]))
        model.frame(image_id).rig_from_world = rig_from_world(model, image_id) * moved
    (tmp_path / "model").mkdir()
    model.write(tmp_path / "model")
    target = tmp_path / "out.html"
    words = ["report", str(tmp_path / "model"), "--database", str(run / "work/features/database.db")]
    assert main([*words, "--output", str(target)]) == 0
    text = Page(target).text
    assert "The images fall into groups of 5, 4 that agree inside and contradict each other" in text
    assert f"{NAMES[0]} to {NAMES[3]}" in text
    assert f"{NAMES[4]} to {NAMES[8]}" in text


def test_a_broken_model_is_refused_by_file_and_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 zero 1 a.jpg\n\n")
    assert main(["report", str(tmp_path), "--output", str(tmp_path / "out.html")]) == 2
    assert "images.txt" in capsys.readouterr().err
    assert not (tmp_path / "out.html").exists()


# ------------------------------------------------------------------ at the end of a run
def test_where_no_model_comes_out_the_page_says_what_the_images_have_in_common(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    world = make_world(arc(3), ball(60, rng), rng)
    collection = replace(
        make_collection(tmp_path, 3, names={1: NASTY}),
        rejected=(RejectedImage(name="z.jpg", reason="the file is empty"),),
    )
    with RunDirectory(tmp_path / "out") as folder:
        (folder.work / "features").mkdir()
        matches = true_matches(world, (0, 1))[:25]
        write_features(folder.work / "features/database.db", collection, world, verified={(0, 1): matches})
        with pytest.raises(ReconstructionError), failure_reported(run_in(folder), collection, OutputConfig()):
            raise ReconstructionError("nothing came out.")
    page = Page(tmp_path / "out/report.html")
    assert ("p", {"class": "level failed"}) in page.elements
    assert "nothing came out. Look for images without matches below" in page.text
    counts = [len(one) for one in world.keypoints]
    assert page.text.count(f"no pose: {counts[0]} features, 25 verified matches with 1 images") == 1
    assert page.text.count(f"no pose: {counts[2]} features, 0 verified matches with 0 images") == 1
    assert "unusable file: the file is empty" in page.text
    assert NASTY in page.text
    assert "0 of 4" in page.text
    assert "3 thumbnails" in page.text


def test_a_failure_leaves_no_report_where_none_is_wanted(tmp_path: Path) -> None:
    collection = make_collection(tmp_path, 2)
    with RunDirectory(tmp_path / "out") as folder:
        options = OutputConfig(report=False)
        with pytest.raises(ReconstructionError), failure_reported(run_in(folder), collection, options):
            raise ReconstructionError("nothing came out")
    assert not (tmp_path / "out/report.html").exists()


class _Warnings(QuietReporter):
    """A reporter that keeps the warnings."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        self.warnings.append(text)


@pytest.mark.slow
def test_a_report_that_fails_is_one_warning(run: Path, finished_example: Example, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    reporter = _Warnings()
    with RunDirectory(tmp_path / "run") as folder:
        write_report(run_in(folder, reporter), finished_example.images, OutputConfig())
        assert reporter.warnings == []
        assert "11 thumbnails" in Page(tmp_path / "run/report.html").text
        write_json(tmp_path / "run/summary.json", {"schema_version": 1})
        write_report(run_in(folder, reporter), finished_example.images, OutputConfig())
        (tmp_path / "run/summary.json").unlink()
        write_report(run_in(folder, reporter), finished_example.images, OutputConfig())
    assert len(reporter.warnings) == 2
    assert all(one.startswith("no report.html: ") for one in reporter.warnings)


def test_no_report_is_written_where_none_is_wanted(run: Path, finished_example: Example, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    with RunDirectory(tmp_path / "run") as folder:
        write_report(run_in(folder), finished_example.images, OutputConfig(report=False))
    assert not (tmp_path / "run/report.html").exists()

"""The ablation script: what it changes, what it measures, what it writes."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, replace
from pathlib import Path

import ablate
import numpy as np
import plot_trajectory
import pytest
from helpers.scenes import rotation_about_y
from PIL import Image

from smust3r_colmap.config import RunConfig
from smust3r_colmap.errors import DegenerateAlignmentError, InputError
from smust3r_colmap.exporters.colmap_sparse import write_colmap_sparse
from smust3r_colmap.exporters.tum_trajectory import write_tum
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.geometry.world_frame import WorldFrame
from smust3r_colmap.products import EMPTY_CLOUD, Scene
from smust3r_colmap.synthetic.settings import PRESETS, REFERENCE_LENGTH
from smust3r_colmap.synthetic.truth import TrueScene

pytestmark = pytest.mark.slow

BASE = ablate.with_length(RunConfig(), 16)
NUM_IMAGES = 60


@pytest.fixture(scope="module")
def room() -> ablate.SimulatedSet:
    return ablate.SimulatedSet(truth=TrueScene.from_demo(NUM_IMAGES, 24, 32), errors=PRESETS["network"])


def asked(question: str, *, metric: bool = True, simulated: bool = True) -> dict[str, ablate.Configuration]:
    every = ablate.questions(BASE, num_images=NUM_IMAGES, lengths=(20, 40, 80), metric=metric, simulated=simulated)
    return {one.label: one for one in every if one.question == question}


# ----------------------------------------------------------------------------- questions
def test_every_question_changes_one_setting_and_has_the_default_among_its_answers() -> None:
    own = {
        "lengths": {"segment_length", "overlap"},
        "overlaps": {"overlap"},
        "groups": {"transform_group"},
        "loops": {"loop_closure", "loop_kernel"},
        "edges": {"alignment_edges"},
        "weighting": {"confidence_weighting", "alignment_source"},
    }
    assert tuple(own) == ablate.QUESTIONS
    for question, settings in own.items():
        answers = asked(question)
        for one in answers.values():
            changed = {
                name
                for section in ("segmentation", "alignment", "loop_closing", "classical", "fusion", "cameras")
                for name, value in asdict(getattr(one.config, section)).items()
                if value != asdict(getattr(BASE, section))[name]
            }
            assert changed <= settings, one.label
        if question != "lengths":
            defaults = [
                one
                for one in answers.values()
                if replace(one.config, alignment=replace(one.config.alignment, alignment_source="auto")) == BASE
            ]
            assert defaults, question


def test_segments_longer_than_the_set_are_not_asked_about() -> None:
    assert list(asked("lengths")) == ["l = 20, p = 10", "l = 40, p = 20"]


def test_what_a_backbone_cannot_do_is_not_asked_of_it() -> None:
    assert list(asked("groups")) == ["sim3", "se3", "affine3", "sl4"]
    assert list(asked("groups", metric=False)) == ["sim3", "affine3", "sl4"]
    assert len(asked("loops")) == 5
    assert len(asked("loops", simulated=False)) == 3


# ------------------------------------------------------------------------------ outcomes
def test_closing_a_loop_is_seen_in_the_figures(room: ablate.SimulatedSet) -> None:
    loops = asked("loops")
    (off, _), (on, trajectories) = (room.run(loops[label], 0) for label in ("off", "on"))
    assert (off.found, off.closed) == (0, 0)
    assert (on.found, on.closed, on.found_false) == (1, 1, 0)
    assert on.placed == off.placed == NUM_IMAGES
    assert on.ape < 0.9 * on.ape_before
    assert on.ape_before == pytest.approx(off.ape_before, rel=1e-9)
    assert 0.05 < on.ape_percent < 1
    assert on.edges > off.edges
    truth = np.array([pose[:, 3] for pose in trajectories["truth"].values()])
    closed = np.array([trajectories["with loop closing"][name][:, 3] for name in trajectories["truth"]])
    assert np.sqrt(((closed - truth) ** 2).sum(axis=1).mean()) == pytest.approx(on.ape, rel=1e-6)


def test_false_loops_are_injected_and_told_apart() -> None:
    room = ablate.SimulatedSet(truth=TrueScene.from_demo(160, 24, 32), errors=PRESETS["network"])
    assert room.num_false_loops(BASE, 0.0) == 0
    loops = asked("loops")
    clean, _ = room.run(loops["on"], 0)
    spoilt, _ = room.run(loops["on, 30% false"], 0)
    assert room.num_false_loops(BASE, 0.3) == math.ceil(clean.found * 0.3 / 0.7) >= 1
    assert clean.found_false == 0
    assert spoilt.found_false >= 1
    assert spoilt.closed_false == 0
    assert spoilt.closed >= 1
    assert spoilt.ape < 1.1 * clean.ape


def test_as_many_false_loops_as_the_scene_has_are_taken(room: ablate.SimulatedSet) -> None:
    wanted = room.num_false_loops(BASE, 0.99)
    assert wanted < 99
    assert len(room._backbone(BASE, wanted).false_loops) == wanted


def test_drift_of_segments_is_the_same_at_the_end_of_every_segment() -> None:
    short, same = (ablate.with_drift_of_segments(PRESETS["network"], length) for length in (15, REFERENCE_LENGTH))
    assert same == PRESETS["network"]
    assert short.drift_rotation_deg * math.sqrt(15 / REFERENCE_LENGTH) == pytest.approx(same.drift_rotation_deg)
    assert short.chain_scale * 15 / REFERENCE_LENGTH == pytest.approx(same.chain_scale)
    assert short.depth_distortion == same.depth_distortion


def test_a_group_that_bends_leaves_a_residual_of_rigid_cameras(room: ablate.SimulatedSet) -> None:
    groups = asked("groups")
    assert room.run(groups["sim3"], 0)[0].residual_px == 0
    assert 0.001 < room.run(groups["affine3"], 0)[0].residual_px < 1


# -------------------------------------------------------------------------------- tables
def an_outcome(ape: float) -> ablate.Outcome:
    figures = dict.fromkeys(ablate.Outcome.__dataclass_fields__, 1.0)
    return ablate.Outcome(**{**figures, "ape": ape, "found_false": math.nan})


def a_set(ways: dict[float, str]) -> ablate.AblatedSet:
    """A set whose runs give the APE of their seed, or fail for the reason given."""

    def run(configuration: ablate.Configuration, seed: int) -> tuple[ablate.Outcome, plot_trajectory.Trajectories]:
        if reason := list(ways.values())[seed]:
            raise DegenerateAlignmentError(reason)
        return an_outcome(list(ways)[seed]), {}

    return ablate.AblatedSet(name="set", unit="m", num_images=60, metric=True, seeds=tuple(range(len(ways))), run=run)


def test_a_row_is_the_mean_over_seeds_and_names_the_runs_that_gave_nothing() -> None:
    configuration = asked("loops")["on"]
    row = ablate.run_all(a_set({1.0: "", 2.0: "a camera at infinity", 4.0: ""}), configuration, None)
    assert row.mean("ape") == 2.5
    shown = ablate.table("loops", [row], "m")
    header, _, line = ([cell.strip() for cell in row.strip("|").split("|")] for row in shown.splitlines())
    cells = dict(zip(header, line, strict=True))
    assert cells["APE m"] == "2.5"
    assert cells["false found"] == "-"
    assert cells["not run"] == "seed 1: a camera at infinity"


def test_a_configuration_that_never_runs_still_has_its_line() -> None:
    row = ablate.run_all(a_set({1.0: "nothing came out"}), asked("groups")["sl4"], None)
    shown = ablate.table("groups", [row], "m")
    assert "sl4" in shown
    assert "nothing came out" in shown
    assert "not run" not in ablate.table("groups", [ablate.run_all(a_set({1.0: ""}), row.configuration, None)], "m")


def test_tables_are_written_as_markdown_and_every_seed_as_json(tmp_path: Path) -> None:
    one = a_set({1.0: "", 3.0: ""})
    one.rows.extend(ablate.run_all(one, each, None) for each in asked("edges").values())
    ablate.write_report(tmp_path / "t.md", [one], "two seeds")
    text = (tmp_path / "t.md").read_text(encoding="utf-8")
    assert text.startswith("## set: 60 images, two seeds\n\n|")
    assert [label in text for label in ("both", "points", "poses")] == [True] * 3
    ablate.write_report(tmp_path / "t.json", [one], "two seeds")
    rows = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))["set"]["edges"]
    assert [[outcome["ape"] for outcome in row["outcomes"]] for row in rows] == [[1.0, 3.0]] * 3
    assert rows[0]["outcomes"][0]["found_false"] is None


# ------------------------------------------------------------------------------ pictures
def test_the_level_frame_looks_down_on_the_path() -> None:
    tilt = rotation_about_y(30.0) @ np.array([[1.0, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    angles = np.linspace(0, 2 * np.pi, 50, endpoint=False)
    path = {
        f"{k}": np.column_stack([rotation_about_y(np.degrees(a)), [3 * np.cos(a), 0.1 * np.sin(5 * a), np.sin(a)]])
        for k, a in enumerate(angles)
    }
    level = plot_trajectory.level_frame({name: tilt @ pose for name, pose in path.items()})
    np.testing.assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1)
    centres = np.array([level @ tilt @ pose[:, 3] for pose in path.values()])
    np.testing.assert_allclose(np.ptp(centres, axis=0), [6, 0.2, 2], atol=0.02)


def a_scene(num_images: int) -> Scene:
    camera = Intrinsics(model="PINHOLE", width=64, height=48, params=(50.0, 50.0, 32.0, 24.0))
    world_from_cam = np.array(
        [np.column_stack([rotation_about_y(10.0 * k), [k, 0.1 * k, k**2]]) for k in range(num_images)]
    )
    return Scene(
        image_indices=tuple(range(1, num_images + 1)),
        image_names=tuple(f"{k}.jpg" for k in range(1, num_images + 1)),
        camera_indices=(0,) * num_images,
        cameras={0: camera},
        cam_from_world=invert_rigid(world_from_cam),
        points=EMPTY_CLOUD,
        frame=WorldFrame(metric=False),
        segments=("0",),
    )


def test_a_run_is_read_by_name_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = a_scene(12)
    (tmp_path / "sparse").mkdir()
    write_colmap_sparse(scene, tmp_path / "sparse" / "0", text=False)
    for name in ("trajectory_tum.txt", "trajectory_without_loops_tum.txt"):
        write_tum(scene, tmp_path / name, None)
    found = plot_trajectory.read_tum_by_name(tmp_path, tmp_path / "trajectory_tum.txt")
    assert list(found) == list(scene.image_names)
    np.testing.assert_allclose(np.array(list(found.values())), invert_rigid(scene.cam_from_world), atol=1e-9)

    picture = tmp_path / "picture.png"
    command = ["plot_trajectory.py", str(tmp_path), str(picture), "--truth", str(tmp_path / "sparse" / "0")]
    monkeypatch.setattr(sys, "argv", command)
    assert plot_trajectory.main() == 0
    with Image.open(picture) as opened:
        colours = {tuple(colour) for colour in np.asarray(opened.convert("RGB")).reshape(-1, 3)[::7].tolist()}
        assert opened.width > 800
    assert any(red > blue + 50 for red, _, blue in colours)  # the path after loop closing


def test_a_run_with_refinement_has_one_trajectory_more(tmp_path: Path) -> None:
    scene = a_scene(5)
    (tmp_path / "sparse").mkdir()
    write_colmap_sparse(scene, tmp_path / "sparse" / "0", text=False)
    for name in ("trajectory_tum.txt", "trajectory_stitched_tum.txt"):
        write_tum(scene, tmp_path / name, None)
    assert list(plot_trajectory.read_run(tmp_path)) == ["with loop closing", "with bundle adjustment"]
    (tmp_path / "trajectory_stitched_tum.txt").unlink()
    assert list(plot_trajectory.read_run(tmp_path)) == ["with loop closing"]
    (tmp_path / "trajectory_tum.txt").unlink()
    with pytest.raises(InputError, match=r"no trajectory_tum\.txt"):
        plot_trajectory.read_run(tmp_path)


def test_exaggerated_errors_grow_from_the_truth() -> None:
    truth = {"a": np.zeros(3), "b": np.array([1.0, 0, 0])}
    found = {"a": np.array([0, 0, 0.1]), "b": np.array([1.0, -0.2, 0]), "c": np.ones(3)}
    np.testing.assert_allclose(plot_trajectory.exaggerated(found, truth, 10), [[0, 0, 1], [1, -2, 0]])
    np.testing.assert_allclose(plot_trajectory.exaggerated(found, None, 10), list(found.values()))


def test_a_trajectory_of_other_images_is_refused(tmp_path: Path) -> None:
    scene = a_scene(5)
    (tmp_path / "sparse").mkdir()
    write_colmap_sparse(scene, tmp_path / "sparse" / "0", text=False)
    write_tum(scene, tmp_path / "t.txt", [float(k) for k in range(100, 105)])
    with pytest.raises(InputError, match="not a trajectory of the models"):
        plot_trajectory.read_tum_by_name(tmp_path, tmp_path / "t.txt")
    with pytest.raises(InputError, match="not a trajectory of the models"):
        plot_trajectory.read_tum_by_name(tmp_path, tmp_path / "missing.txt")

"""The benchmark of the network: what it times, what it compares, on a network that runs in no time."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import benchmark_must3r as benchmark
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from smust3r_colmap.backbones.must3r import EncodedImage, Memory, Pointmaps, estimate_focal, register_camera
from smust3r_colmap.backbones.must3r.decoder import Decoder, Seen

CPU = torch.device("cpu")
SIZE, NUM_IMAGES = 64, 3


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights and images."""
    folder = tmp_path_factory.mktemp("benchmark")
    benchmark.write_random_weights(folder / "random.safetensors", benchmark.architecture_of("tiny", SIZE))
    benchmark.write_demo_images(folder / "images", NUM_IMAGES)
    return folder


@pytest.fixture(scope="module")
def rows(work: Path) -> dict[str, benchmark.Row]:
    tasks = tasks_for(work, "--modes", *benchmark.MODES, "--keyframes", "2")
    found = benchmark.compare(tasks, repeats=1, rng=random.Random(0), measured_by=benchmark.measure)
    return {row.mode: row for row in found}


def tasks_for(work: Path, *words: str) -> list[benchmark.Task]:
    arguments = benchmark.parse_arguments(["--architecture", "tiny", "--size", str(SIZE), *words])
    return benchmark.tasks_of(arguments, work, NUM_IMAGES)


def cost(*, images: int = 2, wall_s: float = 4.0, cpu_s: float = 6.0, peak_bytes: int = 100) -> benchmark.StageCost:
    return benchmark.StageCost(images=images, wall_s=wall_s, cpu_s=cpu_s, peak_bytes=peak_bytes)


# ---------------------------------------------------------------------------------- timing
def test_stopwatch_tells_working_from_waiting() -> None:
    watch = benchmark.Stopwatch(device=CPU)
    with watch.stage("waits", 1):
        time.sleep(0.2)
    for _ in range(2):
        with watch.stage("works", 3):
            until = time.process_time() + 0.1
            while time.process_time() < until:
                pass
    waits, works = watch.costs["waits"], watch.costs["works"]
    assert 0.2 <= waits.wall_s < 2 and waits.cpu_s < 0.1
    assert 0.2 <= works.cpu_s < 0.4 and works.images == 6


@pytest.mark.slow
def test_peak_is_that_of_this_process() -> None:
    before = benchmark.peak_bytes(CPU)
    taken = np.ones(before + 64 * 2**20, dtype=np.uint8)
    grown = benchmark.peak_bytes(CPU) - before
    assert 32 * 2**20 < grown < len(taken) + 256 * 2**20


def test_best_of_repeats_takes_the_fastest_times_and_the_largest_peak() -> None:
    best = benchmark.cheapest({"add": cost(wall_s=1.0)}, {"add": cost(cpu_s=2.0, peak_bytes=300)})
    assert best == {"add": cost(wall_s=1.0, cpu_s=2.0, peak_bytes=300)}


def test_stages_are_divided_by_their_own_number_of_images() -> None:
    row = benchmark.Row(
        mode="float32", num_images=4, num_keyframes=2, costs={"add": cost(), "render": cost(images=4)}, errors=None
    )
    both = benchmark.per_image(row, ("add", "render"))
    assert (both.wall_s, both.cpu_s) == (4 / 2 + 4 / 4, 6 / 2 + 6 / 4)


# ------------------------------------------------------------------------------- the modes
@pytest.mark.slow
def test_every_mode_measures_every_stage_of_every_image(rows: dict[str, benchmark.Row]) -> None:
    assert tuple(rows) == tuple(benchmark.MODES)
    for row in rows.values():
        images = {name: one.images for name, one in row.costs.items()}
        assert images == {**dict.fromkeys(benchmark.STAGES, NUM_IMAGES), "add": 2}
        assert all(one.cpu_s > 0 and one.wall_s > 0 and one.peak_bytes > 2**27 for one in row.costs.values())


@pytest.mark.slow
def test_float32_modes_say_the_same_and_bfloat16_nearly(rows: dict[str, benchmark.Row]) -> None:
    assert rows["float32"].errors is None
    for mode in ("published", "norm_y"):
        same = rows[mode].errors
        assert same is not None
        assert max(same.features_max, same.points_95, same.confidence_95, same.centre) < 1e-4
    rough = rows["bfloat16"].errors
    assert rough is not None
    assert 1e-4 < rough.features_rms < 0.05
    assert 1e-4 < rough.points_median < rough.points_95 < 0.05
    assert 1e-4 < rough.focal_percent < 1 and 1e-4 < rough.rotation_deg < 1 and 1e-5 < rough.centre < 0.05


@pytest.mark.slow
def test_published_mode_asks_for_all_outputs_and_others_do_not(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []
    see = Decoder.see

    def watched(
        decoder: Decoder, images: Sequence[EncodedImage], memory: Memory | None, *, with_outputs: bool = True
    ) -> Seen:
        asked.append(with_outputs)
        return see(decoder, images, memory, with_outputs=with_outputs)

    monkeypatch.setattr(Decoder, "see", watched)
    for mode in ("published", "float32"):
        benchmark.measure(tasks_for(work, "--modes", mode)[0])
    warming_up = [True, True]
    assert asked == [*warming_up, True, True, *warming_up, False, False]


# ------------------------------------------------------------------------------ the errors
def outputs() -> benchmark.Outputs:
    rng = np.random.default_rng(0)
    pose = np.eye(4)[None].repeat(2, axis=0)
    return {
        "features": rng.normal(size=(2, 5, 4)),
        "points_world": rng.normal(size=(2, 50, 3)),
        "points_cam": np.abs(rng.normal(size=(2, 50, 3))) + np.array([0.0, 0.0, 2.0]),
        "confidence": 1 + rng.uniform(0.5, 2, size=(2, 50)),
        "focal_net": np.array([400.0, 500.0]),
        "world_from_cam": pose,
    }


def test_errors_are_those_that_were_put_in() -> None:
    reference = outputs()
    pose = reference["world_from_cam"].copy()
    pose[1, :3, :3] = Rotation.from_rotvec([0, 0, 1e-4]).as_matrix()
    pose[1, :3, 3] = 0.01 * np.median(reference["points_cam"][1, :, 2]) * np.array([0.6, 0.8, 0.0])
    found = {
        "features": reference["features"] * 1.02,
        "points_world": reference["points_world"] * 1.01,
        "points_cam": reference["points_cam"] * 1.01,
        "confidence": 1 + (reference["confidence"] - 1) * 1.03,
        "focal_net": reference["focal_net"] * np.array([1.001, 0.996]),
        "world_from_cam": pose,
    }
    e = benchmark.errors(found, reference)
    assert e.features_rms == pytest.approx(0.02)
    assert e.features_max == pytest.approx(
        0.02 * np.abs(reference["features"]).max() / benchmark.rms(reference["features"])
    )
    assert (e.points_median, e.points_95) == pytest.approx((0.01, 0.01))
    assert (e.confidence_median, e.confidence_95) == pytest.approx((0.03, 0.03))
    assert e.focal_percent == pytest.approx(0.4)
    assert e.rotation_deg == pytest.approx(np.rad2deg(1e-4))
    assert e.centre == pytest.approx(0.01)


def test_made_up_surface_is_one_that_cameras_can_be_fitted_to() -> None:
    nothing = torch.zeros(48, 64, 3)
    surface = benchmark.made_up_surface(
        Pointmaps(points_world=nothing, points_cam=nothing, confidence=torch.zeros(48, 64)), seed=2
    )
    focal = estimate_focal(surface.points_cam)
    pose = register_camera(surface.points_cam, surface.points_world, surface.confidence)
    assert focal == pytest.approx(0.75 * 64, rel=0.01)
    assert pose[:3, 3] == pytest.approx([0.2, 0.0, 0.0], abs=0.01)


# ------------------------------------------------------------------------------ the script
@pytest.mark.slow
def test_ratios_are_those_to_the_first_mode(rows: dict[str, benchmark.Row]) -> None:
    twice = {
        name: replace(one, wall_s=3 * one.wall_s, cpu_s=2 * one.cpu_s) for name, one in rows["published"].costs.items()
    }
    pair = [rows["published"], replace(rows["float32"], costs=twice)]
    for on_card, ratio in ((False, "2.000"), (True, "3.000")):
        lines = benchmark.cost_table(pair, on_card=on_card).splitlines()[2:]
        ratios = [line.split("|")[6].strip() for line in lines]
        assert ratios == ["1.000", ratio] * (len(benchmark.STAGES) + 1)


@pytest.mark.slow
def test_script_measures_in_a_process_of_its_own_and_writes_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    words = "--architecture tiny --size 64 --num-images 2 --modes float32 --json"
    benchmark.main([*words.split(), str(report)])
    (row,) = json.loads(report.read_text())
    assert (row["mode"], row["num_images"], row["num_keyframes"], row["errors"]) == ("float32", 2, 2, None)
    assert list(row["costs"]) == list(benchmark.STAGES)
    printed = capsys.readouterr().out
    assert "2 images, 2 keyframes, tiny network at 64 px on cpu" in printed
    assert f"{row['costs']['encode']['cpu_s'] / 2:.3f}" in printed


@pytest.mark.slow
def test_table_of_errors_leaves_out_the_mode_that_others_are_compared_with(rows: dict[str, benchmark.Row]) -> None:
    header, _, *lines = benchmark.error_table(list(rows.values())).splitlines()
    assert [cell.strip() for cell in header.split("|")[1:-1]] == ["error", "published", "bfloat16", "norm_y"]
    assert len(lines) == len(benchmark.Errors.__dataclass_fields__)


def test_numbers_below_one_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        benchmark.parse_arguments(["--keyframes", "-1"])
    assert "1 at least" in capsys.readouterr().err

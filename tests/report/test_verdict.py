"""The verdict: its level, its reasons in order of weight, and the exit code."""

from __future__ import annotations

from dataclasses import replace

import pytest
from helpers.summaries import GOOD

from smust3r_colmap.refinement.model_uncertainty import NamedLink, UncertaintySummary
from smust3r_colmap.report.summary import ImageNote, RunSummary
from smust3r_colmap.report.verdict import FAILED_PERCENT, MAX_REASONS, WEAK_IMAGE_PERCENT, WEAK_PERCENT

FIRM = NamedLink(
    before="a.jpg",
    after="b.jpg",
    num_smaller=40,
    num_points=200,
    num_scale_points=90.0,
    scale_percent=0.1,
    rotation_deg=0.02,
    translation_percent=0.02,
    side_percent=0.05,
)
CERTAIN = UncertaintySummary(
    num_images=5,
    extent=3.0,
    noise_px=0.3,
    predicted_error_percent=0.2,
    max_position_percent=0.4,
    least_certain="c.jpg",
    median_rotation_deg=0.1,
    undetermined=(),
    contradicted=(),
    contradicted_stretches=(),
    weak_links=(FIRM,),
)


def with_uncertainty(found: UncertaintySummary) -> RunSummary:
    return replace(GOOD, models=(replace(GOOD.models[0], uncertainty=found),))


def test_a_certain_model_is_good() -> None:
    summary = with_uncertainty(CERTAIN)
    assert (summary.verdict.level, summary.verdict.reasons, summary.exit_code) == ("good", (), 0)
    assert "sparse/0: predicted error 0.2 % of the extent (rms), 0.4 % at c.jpg" in summary.render_text()
    assert "good" in summary.render_text().splitlines()


@pytest.mark.parametrize(
    ("change", "level", "reason"),
    [
        ({"predicted_error_percent": WEAK_PERCENT}, "weak", "predicted error 1 %"),
        ({"predicted_error_percent": FAILED_PERCENT}, "failed", "predicted error 10 %"),
        ({"max_position_percent": WEAK_IMAGE_PERCENT}, "weak", "3 % at c.jpg"),
        (
            {"contradicted": ("b.jpg", "c.jpg"), "contradicted_stretches": ("b.jpg to c.jpg",)},
            "weak",
            "most matches contradict 2 of 5 images (b.jpg to c.jpg)",
        ),
        ({"undetermined": ("d.jpg",)}, "weak", "no observations determine the pose of 1 images (d.jpg)"),
        (
            {"weak_links": (replace(FIRM, num_scale_points=9.0, scale_percent=14.0, side_percent=3.0),)},
            "weak",
            "between a.jpg and b.jpg the scale rests on 9 of 200 points, +-14 %",
        ),
    ],
)
def test_each_doubt_makes_the_result_weak(change: dict[str, object], level: str, reason: str) -> None:
    summary = with_uncertainty(replace(CERTAIN, **change))  # type: ignore[arg-type]
    assert (summary.verdict.level, summary.exit_code) == (level, 3)
    (found,) = summary.verdict.reasons
    assert reason in found.text
    assert f"{level}: {found.text}; {found.advice}" in summary.render_text()


@pytest.mark.parametrize(
    "change",
    [
        {"predicted_error_percent": 0.99},
        {"max_position_percent": 2.9},
        {"weak_links": (replace(FIRM, side_percent=0.99),)},
    ],
)
def test_what_is_just_certain_enough_is_good(change: dict[str, object]) -> None:
    assert with_uncertainty(replace(CERTAIN, **change)).exit_code == 0  # type: ignore[arg-type]


def test_the_heaviest_reasons_come_first_and_the_others_are_counted() -> None:
    links = tuple(replace(FIRM, before=f"{k}.jpg", side_percent=float(k)) for k in range(1, 6))
    summary = with_uncertainty(replace(CERTAIN, predicted_error_percent=8.0, weak_links=links))
    summary = replace(summary, num_images=6, unregistered=(ImageNote(name="z.jpg", reason="blur"),))
    verdict = summary.verdict
    assert len(summary.weak_reasons) == 7
    assert len(verdict.reasons) == MAX_REASONS
    assert "predicted error" in verdict.reasons[0].text
    assert "between 5.jpg" in verdict.reasons[1].text
    weights = [reason.weight for reason in verdict.reasons]
    assert weights == sorted(weights, reverse=True)
    assert "weak: 2 more reasons, see summary.json" in summary.render_text()
    assert [one["text"] for one in summary.to_json_dict()["verdict"]["reasons"]] == [r.text for r in verdict.reasons]

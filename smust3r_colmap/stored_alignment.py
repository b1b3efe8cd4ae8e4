"""Alignments on disk, as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from smust3r_colmap.alignment.edges import Edges, TriedAlignment
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import SegmentAlignment, Sim3Estimate
from smust3r_colmap.run_directory import read_json, write_json

_FILE = "edges.json"


def write_edges(folder: Path, edges: Edges) -> None:
    """Write all alignments into an existing folder."""
    facts = {
        "alignments": [_plain(edge) for edge in edges.alignments],
        "failures": [asdict(failure) for failure in edges.failures],
    }
    write_json(folder / _FILE, facts)


def read_edges(folder: Path) -> Edges:
    """What ``write_edges`` wrote."""
    facts = read_json(folder / _FILE)
    return Edges(
        alignments=tuple(_edge(one) for one in facts["alignments"]),
        failures=tuple(TriedAlignment(**one) for one in facts["failures"]),
    )


def _plain(edge: SegmentAlignment) -> dict[str, Any]:
    estimate = edge.estimate
    return {
        "target": edge.target,
        "source": edge.source,
        "target_from_source": {
            "scale": float(estimate.b_from_a.scale),
            "rotation": estimate.b_from_a.rotation.tolist(),
            "translation": estimate.b_from_a.translation.tolist(),
        },
        "num_points": estimate.num_points,
        "num_inliers": estimate.num_inliers,
        "rms": _number(estimate.rms),
        "residual_sigma": _number(estimate.residual_sigma),
        "iterations": estimate.iterations,
        "stop_reason": estimate.stop_reason,
        "information": estimate.information.tolist(),
        "evidence": edge.evidence,
        "relative_residual": _number(edge.relative_residual),
        "accepted": edge.accepted,
        "reason": edge.reason,
    }


def _edge(facts: dict[str, Any]) -> SegmentAlignment:
    transform = facts["target_from_source"]
    estimate = Sim3Estimate(
        b_from_a=Sim3(
            scale=np.asarray(transform["scale"]),
            rotation=np.asarray(transform["rotation"]),
            translation=np.asarray(transform["translation"]),
        ),
        num_points=facts["num_points"],
        num_inliers=facts["num_inliers"],
        rms=_or_nan(facts["rms"]),
        residual_sigma=_or_nan(facts["residual_sigma"]),
        iterations=facts["iterations"],
        stop_reason=facts["stop_reason"],
        information=np.asarray(facts["information"]),
    )
    return SegmentAlignment(
        target=facts["target"],
        source=facts["source"],
        estimate=estimate,
        evidence=facts["evidence"],
        relative_residual=_or_nan(facts["relative_residual"]),
        accepted=facts["accepted"],
        reason=facts["reason"],
    )


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value

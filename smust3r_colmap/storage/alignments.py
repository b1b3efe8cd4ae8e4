"""Alignments on disk, as JSON."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.products import Edges, SegmentAlignment, TransformEstimate, TriedAlignment
from smust3r_colmap.storage.run_directory import read_json, write_json

_FILE = "edges.json"
_NAMES = {group: name for name, group in GROUPS.items()}


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
        "group": _NAMES[type(estimate.b_from_a)],
        "target_from_source": estimate.b_from_a.matrix.tolist(),
        "num_points": estimate.num_points,
        "num_inliers": estimate.num_inliers,
        "rms": _number(estimate.rms),
        "residual_sigma": _number(estimate.residual_sigma),
        "iterations": estimate.iterations,
        "stop_reason": estimate.stop_reason,
        "estimate_information": estimate.information.tolist(),
        "evidence": edge.evidence,
        "relative_residual": _number(edge.relative_residual),
        "information": edge.information.tolist(),
        "accepted": edge.accepted,
        "reason": edge.reason,
        "fallback": edge.fallback,
    }


def _edge(facts: dict[str, Any]) -> SegmentAlignment:
    estimate = TransformEstimate(
        b_from_a=GROUPS[facts["group"]].from_matrix(facts["target_from_source"]),
        num_points=facts["num_points"],
        num_inliers=facts["num_inliers"],
        rms=_or_nan(facts["rms"]),
        residual_sigma=_or_nan(facts["residual_sigma"]),
        iterations=facts["iterations"],
        stop_reason=facts["stop_reason"],
        information=np.asarray(facts["estimate_information"]),
    )
    return SegmentAlignment(
        target=facts["target"],
        source=facts["source"],
        estimate=estimate,
        evidence=facts["evidence"],
        relative_residual=_or_nan(facts["relative_residual"]),
        information=np.asarray(facts["information"]),
        accepted=facts["accepted"],
        reason=facts["reason"],
        fallback=facts["fallback"],
    )


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value

"""Mapped segments on disk: arrays as safetensors, all else as JSON."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from smust3r_colmap.backbones.classical.mapped_model import MappedModel
from smust3r_colmap.backbones.classical.mapping import MappedSegment
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import Tracks, UnregisteredImage
from smust3r_colmap.storage.run_directory import read_arrays, read_json, write_arrays, write_json

_FACTS = "segment.json"


def write_mapped(folder: Path, mapped: MappedSegment) -> None:
    """Write a mapped segment into an existing folder."""
    models = []
    for number, model in enumerate(mapped.models):
        write_arrays(
            folder / f"model_{number}.safetensors",
            {
                "seg_from_cam": model.seg_from_cam,
                "points_seg": model.tracks.points_seg,
                "point_of_observation": model.tracks.point_of_observation,
                "image_of_observation": model.tracks.image_of_observation,
                "feature_of_observation": model.tracks.feature_of_observation,
            },
        )
        models.append(
            {
                "images": model.images,
                "intrinsics": [asdict(intrinsics) for intrinsics in model.intrinsics],
                "reprojection_error_px": model.reprojection_error_px,
                "method": model.method,
            }
        )
    facts = {
        "segment": mapped.segment,
        "attempts": mapped.attempts,
        "unregistered": [asdict(one) for one in mapped.unregistered],
        "models": models,
    }
    write_json(folder / _FACTS, facts)


def read_mapped(folder: Path) -> MappedSegment:
    """What ``write_mapped`` wrote."""
    facts = read_json(folder / _FACTS)
    models = []
    for number, model in enumerate(facts["models"]):
        arrays = read_arrays(folder / f"model_{number}.safetensors")
        seg_from_cam = arrays.pop("seg_from_cam")
        models.append(
            MappedModel(
                images=tuple(model["images"]),
                seg_from_cam=seg_from_cam,
                intrinsics=tuple(Intrinsics(**one) for one in model["intrinsics"]),
                tracks=Tracks(**arrays),
                reprojection_error_px=model["reprojection_error_px"],
                method=model["method"],
            )
        )
    return MappedSegment(
        segment=facts["segment"],
        models=tuple(models),
        attempts=tuple(facts["attempts"]),
        unregistered=tuple(UnregisteredImage(**one) for one in facts["unregistered"]),
    )

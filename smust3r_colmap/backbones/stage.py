"""Every segment reconstructed alone (paper III-A), by the backbone that the settings name.

The next module to read is ``base``.
"""

from __future__ import annotations

from dataclasses import dataclass

from smust3r_colmap.backbones.base import Backbone, BackboneContext, BackboneFactory, BackboneResult
from smust3r_colmap.backbones.masked_maps import without_masked_depth
from smust3r_colmap.config import AlignmentConfig, RunConfig
from smust3r_colmap.errors import ConfigError, ReconstructionError
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.segmentation.stage import Segments

_ATTEMPTS_SHOWN = 3


@dataclass(frozen=True, kw_only=True)
class SegmentSummary:
    """What a backbone made of a segment.

    Args:
        index: of the segment in the plan.
        kind: ``"window"``, ``"cluster"`` or ``"loop"``.
        num_images: images it was given.
        num_submodels: connected submodels that came out; 0 when nothing did.
        num_registered: images with a pose, over all its submodels.
        method: how its largest submodel was made, in words; empty when nothing came out.
        warnings: why its geometry should not be trusted.
    """

    index: int
    kind: str
    num_images: int
    num_submodels: int
    num_registered: int
    method: str
    warnings: tuple[str, ...] = ()


def make(run: Run, factory: BackboneFactory, collection: ImageCollection, config: RunConfig) -> Backbone:
    """The backbone of this run.

    Raises:
        ConfigError: a setting makes no sense for it.
        MissingDependencyError, CheckpointError: see ``BackboneFactory``.
    """
    backbone = factory(BackboneContext(collection=collection, config=config, run=run))
    if config.alignment.alignment_source == "tracks" and not backbone.has_tracks:
        raise ConfigError(f"--alignment-source tracks: the backbone {backbone.name} has no tracks; take pointmaps")
    return backbone


def reconstruct(
    backbone: Backbone, segments: Segments, collection: ImageCollection, alignment: AlignmentConfig
) -> BackboneResult:
    """All segments, without depth where images are masked.

    Raises:
        ReconstructionError: no segment gave a single submodel.
    """
    with_maps = _segments_with_maps(backbone, segments, alignment)
    result = backbone.reconstruct(segments.all, segments.view_graph, with_maps=with_maps)
    result = without_masked_depth(result, collection)
    if not result.submodels:
        attempts = [f"segment {one.segment}: {'; '.join(one.attempts)}" for one in result.reconstructions]
        raise ReconstructionError(
            f"none of the {len(result.reconstructions)} segments ({len(collection)} images) could be reconstructed. "
            f"{'. '.join(attempts[:_ATTEMPTS_SHOWN])}. Do the images overlap, did the camera move, and are neighbours "
            "in name order neighbours in space?"
        )
    return result


def _segments_with_maps(backbone: Backbone, segments: Segments, alignment: AlignmentConfig) -> frozenset[int]:
    """Windows make the cloud; loops only tie the graph, and need maps where the edges are made of them."""
    source = alignment.alignment_source
    edges_from_maps = source == "pointmaps" or (source == "auto" and not backbone.has_tracks)
    return frozenset(segment.index for segment in segments.all if segment.kind != "loop" or edges_from_maps)


def summarise_segments(segments: Segments, result: BackboneResult) -> tuple[SegmentSummary, ...]:
    """One per segment, in the order of the plan."""
    return tuple(
        SegmentSummary(
            index=segment.index,
            kind=segment.kind,
            num_images=len(segment.images),
            num_submodels=len(one.submodels),
            num_registered=len({image for submodel in one.submodels for image in submodel.images}),
            method=one.submodels[0].method if one.submodels else "",
            warnings=one.warnings,
        )
        for segment, one in zip(segments.all, result.reconstructions, strict=True)
    )

"""What every backbone is to the pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from smust3r_colmap.products import (
    DenseMaps,
    FeatureLinks,
    ImageCollection,
    RejectedImage,
    Segment,
    SegmentPiece,
    SegmentReconstruction,
)
from smust3r_colmap.progress import Reporter
from smust3r_colmap.run_directory import RunDirectory


@dataclass(frozen=True, kw_only=True, eq=False)
class BackboneResult:
    """All segments of a run.

    Args:
        reconstructions: one per segment, in order.
        dense: maps of every piece, in the order in which ``pieces`` lists them.
        dense_key: hash of all that the maps were made from.
        links: verified matches, where the backbone has features.
        rejected: images that the backbone could not use at all.
    """

    reconstructions: tuple[SegmentReconstruction, ...]
    dense: tuple[DenseMaps, ...]
    dense_key: str
    links: FeatureLinks | None
    rejected: tuple[RejectedImage, ...]

    def __post_init__(self) -> None:
        if len(self.dense) != len(self.pieces):
            raise ValueError(f"{len(self.dense)} sets of maps for {len(self.pieces)} pieces")

    @property
    def pieces(self) -> tuple[SegmentPiece, ...]:
        """Every piece of every segment: the nodes of the pose graph."""
        return tuple(piece for reconstruction in self.reconstructions for piece in reconstruction.pieces)


class Backbone(Protocol):
    """Reconstructs every segment alone; keeps what it finished in the run directory."""

    name: str
    metric: bool

    def reconstruct(
        self, collection: ImageCollection, segments: Sequence[Segment], run: RunDirectory, reporter: Reporter
    ) -> BackboneResult:
        """All segments. Geometry that does not come out is recorded in the result, never raised."""

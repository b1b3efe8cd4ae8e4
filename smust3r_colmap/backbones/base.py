"""The interface between the pipeline and a backbone, which reconstructs every segment alone.

``options`` parses the options of one backbone, ``registry`` finds backbones by name. ``feed_forward`` makes one from a
network: it keeps predictions on disk and turns them into submodels. The next module to read is ``registry``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from smust3r_colmap.config import RunConfig
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.products import (
    DenseMaps,
    ImageCollection,
    InterSegmentMatches,
    RejectedImage,
    RunFeatures,
    Segment,
    SegmentReconstruction,
    Submodel,
)
from smust3r_colmap.segmentation.view_graph import ViewGraph


@dataclass(frozen=True, kw_only=True, eq=False)
class BackboneResult:
    """All segments of a run.

    Args:
        reconstructions: one per segment, in order.
        dense: maps of every submodel, in the order in which ``submodels`` lists them.
        dense_key: hash of all that the maps were made from.
        matches: verified matches, where the backbone has features.
        rejected: images that the backbone could not use at all.
        features: where the backbone has SIFT features of all images.
    """

    reconstructions: tuple[SegmentReconstruction, ...]
    dense: tuple[DenseMaps, ...]
    dense_key: str
    matches: InterSegmentMatches | None
    rejected: tuple[RejectedImage, ...]
    features: RunFeatures | None = None

    def __post_init__(self) -> None:
        if len(self.dense) != len(self.submodels):
            raise ValueError(f"{len(self.dense)} sets of maps for {len(self.submodels)} submodels")

    @property
    def submodels(self) -> tuple[Submodel, ...]:
        """Every submodel of every segment: the nodes of the pose graph."""
        return tuple(submodel for reconstruction in self.reconstructions for submodel in reconstruction.submodels)


class Backbone(Protocol):
    """Reconstructs every segment of one collection alone; made for one run, and stores finished segments there."""

    name: str
    metric: bool
    has_tracks: bool
    """Submodels come with feature tracks, so that they can be aligned without maps."""

    def describe(self) -> npt.NDArray[np.float32]:
        """(N, D) one vector of unit length per image of the collection; zero where an image gave none.

        Cosines between them tell which images may show one place (paper section III-F).
        """

    def reconstruct(
        self, segments: Sequence[Segment], view_graph: ViewGraph, *, with_maps: Collection[int]
    ) -> BackboneResult:
        """All segments. Failed geometry is recorded in the result, never raised.

        Args:
            segments: of the run, windows and loops; ``segments[k].index == k``.
            view_graph: of the images of the run: their order, and which may see the same place.
            with_maps: indices of the segments whose dense maps will be read; those of the others may be empty.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class BackboneContext:
    """All that a backbone is made from.

    Args:
        collection: the images of the run.
        config: every setting.
        run: where finished work is kept, how tasks run, who is told about every stage.
    """

    collection: ImageCollection
    config: RunConfig
    run: Run


BackboneFactory = Callable[[BackboneContext], Backbone]
"""Makes the backbone of one run.

Raises:
    ConfigError: a setting or an option makes no sense.
    MissingDependencyError: a package is not installed.
    CheckpointError: the weights cannot be used.
"""

OptionsT = TypeVar("OptionsT")


@dataclass(frozen=True, kw_only=True)
class BackbonePlugin(Generic[OptionsT]):
    """What an entry point of the group ``smust3r_colmap.backbones`` names.

    Args:
        make: the backbone of one run, from its context and its options. Raises what ``BackboneFactory`` raises.
        options: dataclass of its ``--backbone-options``; see ``options.parse_options`` for the types of its fields.
    """

    make: Callable[[BackboneContext, OptionsT], Backbone]
    options: type[OptionsT]

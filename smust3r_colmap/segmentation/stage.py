"""Which images are reconstructed together: windows of the sequence, and a segment for each loop (paper III-B, III-F).

The next module to read is ``view_graph``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

from smust3r_colmap.config import LoopConfig, SegmentationConfig
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.arrays import Float32Array, Pair
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.loop_segments import LoopPlan, plan_loops
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.codec import Codec

NOT_LOOKED_FOR = LoopPlan(threshold=None, weak_threshold=None, neighbours=0, statistics=None)

_LOOPS: Codec[LoopPlan] = Codec(LoopPlan, "plan")


@dataclass(frozen=True, kw_only=True, eq=False)
class Segments:
    """The segments of a run.

    Args:
        view_graph: which images may see the same place; the ends of every planned loop are a pair in it.
        windows: of its sequences, ``windows[k].index == k``.
        loops: that were planned; their segments are numbered on from the windows.
    """

    view_graph: ViewGraph
    windows: tuple[Segment, ...]
    loops: LoopPlan

    def __post_init__(self) -> None:
        for loop in self.loops.loops:
            if not self.view_graph.are_neighbours(loop.image_a, loop.image_b):
                raise ValueError(f"Segments: loop ({loop.image_a}, {loop.image_b}) is no pair of the view graph")

    @classmethod
    def of(cls, graph: ViewGraph, windows: tuple[Segment, ...], loops: LoopPlan) -> Segments:
        """Windows and loops of the images of a graph, to which the ends of the loops are added."""
        ends = [(loop.image_a, loop.image_b) for loop in loops.loops]
        known = graph.with_pairs(ends, "retrieval", weights=[loop.similarity for loop in loops.loops])
        return cls(view_graph=known, windows=windows, loops=loops)

    @property
    def all(self) -> tuple[Segment, ...]:
        """Windows and loop segments, each at its index."""
        return (*self.windows, *(loop.segment for loop in self.loops.loops))

    @property
    def loop_indices(self) -> frozenset[int]:
        """Indices of the loop segments."""
        return frozenset(loop.segment.index for loop in self.loops.loops)

    @property
    def next_windows(self) -> frozenset[Pair]:
        """Indices of every window and the next one of the same sequence, with which it shares images."""
        return frozenset(
            (one.index, after.index)
            for one, after in pairwise(self.windows)
            if not set(one.images).isdisjoint(after.images)
        )


def plan(
    run: Run,
    num_images: int,
    describe: Callable[[], Float32Array],
    segmentation: SegmentationConfig,
    loop_closing: LoopConfig,
) -> Segments:
    """Windows, and the loops among images that look alike though far apart in the sequence.

    Args:
        describe: (N, D) unit vectors, one per image; called where loops are wanted.
    """
    graph = ViewGraph.chain(num_images)
    windows = plan_windows(graph, segment_length=segmentation.segment_length, overlap=segmentation.overlap)
    if not loop_closing.loop_closure:
        return Segments.of(graph, windows, NOT_LOOKED_FOR)
    descriptors = describe()

    def compute(progress: Stage) -> LoopPlan:
        planned = plan_loops(
            descriptors,
            graph,
            windows,
            similarity=loop_closing.loop_similarity,
            min_candidates=loop_closing.loop_min_candidates,
            min_distance=loop_closing.loop_min_distance,
            half_width=loop_closing.loop_window,
        )
        progress.advance()
        return planned

    inputs = (descriptors, graph, windows, loop_closing)
    return Segments.of(graph, windows, run.cached("loops", inputs, compute, _LOOPS))

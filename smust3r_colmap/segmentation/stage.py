"""Which images are reconstructed together: windows of the sequence, and a segment for each loop (paper III-B, III-F).

The next module to read is ``windows``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from smust3r_colmap.config import LoopConfig, SegmentationConfig
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.geometry.arrays import Float32Array
from smust3r_colmap.products import Segment
from smust3r_colmap.segmentation.loop_segments import LoopPlan, plan_loops
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.codec import Codec

NOT_LOOKED_FOR = LoopPlan(threshold=None, weak_threshold=None, neighbours=0, statistics=None)

_LOOPS: Codec[LoopPlan] = Codec(LoopPlan, "plan")


@dataclass(frozen=True, kw_only=True)
class Segments:
    """The segments of a run.

    Args:
        windows: of the sequence, ``windows[k].index == k``.
        loops: that were planned; their segments are numbered on from the windows.
    """

    windows: tuple[Segment, ...]
    loops: LoopPlan

    @property
    def all(self) -> tuple[Segment, ...]:
        """Windows and loop segments, each at its index."""
        return (*self.windows, *(loop.segment for loop in self.loops.loops))

    @property
    def loop_indices(self) -> frozenset[int]:
        """Indices of the loop segments."""
        return frozenset(loop.segment.index for loop in self.loops.loops)


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
    windows = plan_windows(num_images, segment_length=segmentation.segment_length, overlap=segmentation.overlap)
    if not loop_closing.loops:
        return Segments(windows=windows, loops=NOT_LOOKED_FOR)
    descriptors = describe()

    def compute(progress: Stage) -> LoopPlan:
        planned = plan_loops(
            descriptors,
            windows,
            similarity=loop_closing.loop_similarity,
            min_candidates=loop_closing.loop_min_candidates,
            min_distance=loop_closing.loop_min_distance,
            half_width=loop_closing.loop_half_width,
        )
        progress.advance()
        return planned

    return Segments(windows=windows, loops=run.cached("loops", (descriptors, windows, loop_closing), compute, _LOOPS))

"""Which images are reconstructed together: windows of a sequence and a segment for each loop (paper III-B, III-F), or
clusters of the view graph where the images are in no order.

The next module to read is ``view_graph``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

from smust3r_colmap.config import LoopConfig, RunConfig, SegmentationConfig
from smust3r_colmap.errors import CollectionError
from smust3r_colmap.execution.progress import Stage
from smust3r_colmap.execution.run_context import Run
from smust3r_colmap.features.pairs import alike_pairs, further_pairs, near_pairs
from smust3r_colmap.features.stage import features_of_run, look_alike_pairs, verified_pairs
from smust3r_colmap.geometry.arrays import Float32Array, Pair
from smust3r_colmap.products import ImageCollection, RunFeatures, Segment
from smust3r_colmap.segmentation.cover import MIN_COMPONENT_IMAGES, Cover, plan_cover
from smust3r_colmap.segmentation.keyframes import choose_keyframes, pairs_with_keyframes
from smust3r_colmap.segmentation.loop_segments import LoopPlan, plan_loops
from smust3r_colmap.segmentation.order import decide_order
from smust3r_colmap.segmentation.view_graph import Reason, ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.storage.codec import Codec

NOT_LOOKED_FOR = LoopPlan(threshold=None, weak_threshold=None, neighbours=0, statistics=None)
IN_VIEW_GRAPH = replace(NOT_LOOKED_FOR, note="pairs of images that look alike are in the view graph")

_LOOPS: Codec[LoopPlan] = Codec(LoopPlan, "plan")
_COVER: Codec[Cover] = Codec(Cover, "cover")
_KEYFRAMES: Codec[tuple[int, ...]] = Codec(tuple[int, ...], "keyframes")


@dataclass(frozen=True, kw_only=True, eq=False)
class Segments:
    """The segments of a run.

    Args:
        view_graph: which images may see the same place; the ends of every planned loop are a pair in it.
        windows: of its sequence, or clusters of images in no order; ``windows[k].index == k``.
        loops: that were planned; their segments are numbered on from the windows.
        others: images that are no keyframes: in no segment, and registered to the refined model.
        order: whether the images are a sequence, and why.
        unconnected: images that are in no segment, because they match too few others.
    """

    view_graph: ViewGraph
    windows: tuple[Segment, ...]
    loops: LoopPlan
    others: tuple[int, ...] = ()
    order: str = ""
    unconnected: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for loop in self.loops.loops:
            if not self.view_graph.are_neighbours(loop.image_a, loop.image_b):
                raise ValueError(f"Segments: loop ({loop.image_a}, {loop.image_b}) is no pair of the view graph")

    @classmethod
    def of(
        cls, graph: ViewGraph, windows: tuple[Segment, ...], loops: LoopPlan, *, others: tuple[int, ...] = ()
    ) -> Segments:
        """Windows and loops of the images of a graph, to which the ends of the loops are added."""
        ends = [(loop.image_a, loop.image_b) for loop in loops.loops]
        known = graph.with_pairs(ends, "retrieval", weights=[loop.similarity for loop in loops.loops])
        return cls(view_graph=known, windows=windows, loops=loops, others=others)

    @property
    def pairs_of_others(self) -> tuple[Pair, ...]:
        """Pairs of the images that are no keyframes with the keyframes beside them."""
        return pairs_with_keyframes(self.view_graph.num_images, self.others)

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


def with_keyframes(run: Run, collection: ImageCollection, config: RunConfig, *, overwrite: bool) -> ImageCollection:
    """The collection that says which images are keyframes: all of them where nothing would register the others.

    Args:
        overwrite: what an earlier run chose is not read; it is deleted once all input was checked.
    """
    options = config.segmentation
    if not config.refinement.refine:
        return collection

    def compute(progress: Stage) -> tuple[int, ...]:
        chosen = choose_keyframes(collection.images, options.keyframes, segment_length=options.segment_length)
        progress.advance()
        return chosen

    inputs = ([image.digest for image in collection.images], options.keyframes, options.segment_length)
    if overwrite:
        with run.clock.stage("keyframes", total=1) as progress:
            keyframes = compute(progress)
    else:
        keyframes = run.cached("keyframes", inputs, compute, _KEYFRAMES)
    if len(keyframes) < len(collection):
        run.clock.note(f"{len(keyframes)} of {len(collection)} images are keyframes; the others are registered to them")
    chosen = set(keyframes)
    images = (replace(image, is_keyframe=k in chosen) for k, image in enumerate(collection.images))
    return replace(collection, images=tuple(images))


def plan(
    run: Run,
    collection: ImageCollection,
    describe: Callable[[], Float32Array],
    config: RunConfig,
) -> Segments:
    """Windows of a sequence and its loops, or a cover of the view graph where there is no single sequence.

    Args:
        describe: (N, D) unit vectors, one per image; called where loops or the order of many images are asked for.

    Raises:
        CollectionError: no three images match each other.
    """
    keyframes = [k for k, image in enumerate(collection.images) if image.is_keyframe]
    others = collection.others
    describe = cache(describe)
    options = config.segmentation
    is_long = options.order == "auto" and len(keyframes) > config.features.exhaustive_below
    names = [image.name for image in collection.images]
    order = decide_order(names, keyframes, _without(describe(), others) if is_long else None, options.order)
    run.clock.note(f"order: {order.reason}")
    if order.is_one_sequence:
        segments = _of_sequence(run, order.chain, others, describe, options, config.loop_closing)
    else:
        segments = _of_view_graph(run, collection, order.chain, others, describe, config)
    return replace(segments, order=order.reason)


def _without(descriptors: Float32Array, others: Sequence[int]) -> Float32Array:
    """The descriptors with zero rows for images that take no part."""
    kept: Float32Array = descriptors.copy()
    kept[list(others)] = 0
    return kept


def _of_sequence(
    run: Run,
    chain: ViewGraph,
    others: tuple[int, ...],
    describe: Callable[[], Float32Array],
    options: SegmentationConfig,
    loop_closing: LoopConfig,
) -> Segments:
    """Windows, and the loops among images that look alike though far apart in the sequence."""
    windows = plan_windows(chain, segment_length=options.segment_length, overlap=options.overlap)
    if not loop_closing.loop_closure:
        return Segments.of(chain, windows, NOT_LOOKED_FOR, others=others)
    descriptors = _without(describe(), others)

    def compute(progress: Stage) -> LoopPlan:
        planned = plan_loops(
            descriptors,
            chain,
            windows,
            similarity=loop_closing.loop_similarity,
            min_candidates=loop_closing.loop_min_candidates,
            min_distance=loop_closing.loop_min_distance,
            half_width=loop_closing.loop_window,
        )
        progress.advance()
        return planned

    inputs = (descriptors, chain, windows, loop_closing)
    loops = run.cached("loops", inputs, compute, _LOOPS)
    return Segments.of(chain, windows, loops, others=others)


def _of_view_graph(
    run: Run,
    collection: ImageCollection,
    chain: ViewGraph,
    others: tuple[int, ...],
    describe: Callable[[], Float32Array],
    config: RunConfig,
) -> Segments:
    """Clusters of images that match each other; the other passes of a place are in the graph, so there are no loops."""
    options = config.segmentation
    features = features_of_run(run, collection, config.features)
    graph = verified_view_graph(
        run,
        features,
        collection,
        sequences=[sequence.tolist() for sequence in chain.sequences],
        descriptors=_without(describe(), others),
        near=config.classical.match_neighbours,
        alike=options.retrieval_neighbours,
        exhaustive_below=config.features.exhaustive_below,
    )

    def compute(progress: Stage) -> Cover:
        cover = plan_cover(graph, segment_length=options.segment_length, overlap=options.overlap)
        progress.advance()
        return cover

    cover = run.cached("cover", (graph, options.segment_length, options.overlap), compute, _COVER)
    if not cover.segments:
        raise CollectionError(
            f"no {MIN_COMPONENT_IMAGES} of the {len(collection)} images match each other. Do they show the same place, "
            "and do neighbours overlap by half?"
        )
    return Segments(
        view_graph=graph,
        windows=cover.segments,
        loops=IN_VIEW_GRAPH,
        others=others,
        unconnected=tuple(sorted({*cover.left_out} - {*others})),
    )


def verified_view_graph(
    run: Run,
    features: RunFeatures,
    collection: ImageCollection,
    *,
    sequences: Sequence[Sequence[int]],
    descriptors: Float32Array,
    near: int,
    alike: int,
    exhaustive_below: int,
) -> ViewGraph:
    """The pairs that have enough verified matches, of those that order and likeness suggest, and their partners.

    Without look-alikes, whose rotation all others contradict.

    Args:
        sequences: images that follow each other; near ones are matched.
        descriptors: (N, D) unit rows.
        near: images that each image is matched with in its sequence.
        alike: most similar images that it is matched with; half as many are tried for common partners.
        exhaustive_below: up to so many images every pair is tried.
    """
    in_order = [pair for sequence in sequences for pair in near_pairs(sequence, near)]
    likely = alike_pairs(descriptors, 0, per_image=alike, exhaustive_below=exhaustive_below)
    first = sorted({*in_order, *likely})
    verified = verified_pairs(run, features, first, title="matching")
    more = further_pairs(verified, first, per_image=alike // 2)
    verified |= verified_pairs(run, features, more, title="matching of common partners")
    run.clock.note(
        f"view graph: {len(in_order)} pairs by order, {len(likely)} by likeness, {len(more)} by common partners; "
        f"{len(verified)} have verified matches"
    )
    for pair in look_alike_pairs(run, features, collection, verified):
        del verified[pair]
    graph = ViewGraph.without_pairs(len(features.usable))
    steps = {(a, b) for sequence in sequences for a, b in pairwise(sequence)} & verified.keys()
    by_reason: dict[Reason, Collection[Pair]] = {"order": steps, "retrieval": verified.keys() - steps}
    for reason, pairs in by_reason.items():
        chosen = sorted(pairs)
        graph = graph.with_pairs(chosen, reason, weights=[verified[pair] for pair in chosen])
    return graph

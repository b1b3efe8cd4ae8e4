import numpy as np
from helpers.scenes import some_sim3

from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import SegmentAlignment, TransformEstimate
from smust3r_colmap.stitching.spanning_tree import chain_submodels


def edge(
    target: int, source: int, transform: Sim3, *, inliers: int = 100, residual: float = 0.001, accepted: bool = True
) -> SegmentAlignment:
    estimate = TransformEstimate(
        b_from_a=transform,
        num_points=inliers,
        num_inliers=inliers,
        rms=residual,
        residual_sigma=residual,
        iterations=3,
        stop_reason="converged",
        information=np.eye(7),
    )
    return SegmentAlignment(
        target=target,
        source=source,
        estimate=estimate,
        evidence="tracks",
        relative_residual=residual,
        information=np.eye(7),
        accepted=accepted,
    )


def exact_edges(world_from_seg: list[Sim3], pairs: list[tuple[int, int]]) -> list[SegmentAlignment]:
    return [edge(t, s, world_from_seg[t].inverse() @ world_from_seg[s]) for t, s in pairs]


def test_a_chain_gives_back_the_frames_it_was_made_from() -> None:
    rng = np.random.default_rng(0)
    truth = [Sim3.identity(), *[some_sim3(rng) for _ in range(4)]]
    (part,) = chain_submodels(range(5), exact_edges(truth, [(0, 1), (1, 2), (2, 3), (3, 4)]))
    assert part.submodels == (0, 1, 2, 3, 4)
    for found, wanted in zip(part.world_from_seg, truth, strict=True):
        np.testing.assert_allclose(found.matrix, wanted.matrix, rtol=0, atol=1e-9)


def test_an_edge_may_point_either_way() -> None:
    rng = np.random.default_rng(1)
    truth = [Sim3.identity(), some_sim3(rng), some_sim3(rng)]
    (part,) = chain_submodels(range(3), exact_edges(truth, [(1, 0), (2, 1)]))
    for found, wanted in zip(part.world_from_seg, truth, strict=True):
        np.testing.assert_allclose(found.matrix, wanted.matrix, rtol=0, atol=1e-9)


def test_submodels_without_an_accepted_edge_stay_apart() -> None:
    rng = np.random.default_rng(2)
    truth = [Sim3.identity(), some_sim3(rng), Sim3.identity(), some_sim3(rng)]
    edges = [
        edge(0, 1, truth[1]),
        edge(1, 2, some_sim3(rng), accepted=False),
        edge(2, 3, truth[3]),
    ]
    first, second = chain_submodels(range(4), edges)
    assert (first.submodels, second.submodels) == ((0, 1), (2, 3))
    np.testing.assert_allclose(second.world_from_seg[0].matrix, np.eye(4))
    np.testing.assert_allclose(second.world_from_seg[1].matrix, truth[3].matrix, atol=1e-9)


def test_the_chain_prefers_edges_with_more_and_better_inliers() -> None:
    rng = np.random.default_rng(3)
    truth = [Sim3.identity(), some_sim3(rng), some_sim3(rng)]
    good = exact_edges(truth, [(0, 1), (1, 2)])
    weak = edge(0, 2, some_sim3(rng), inliers=20)
    loose = edge(0, 2, some_sim3(rng), inliers=110, residual=0.04)
    (part,) = chain_submodels(range(3), [weak, *good, loose])
    assert part.edges == (1, 2)
    np.testing.assert_allclose(part.world_from_seg[2].matrix, truth[2].matrix, atol=1e-9)


def test_a_single_submodel_is_its_own_world() -> None:
    (part,) = chain_submodels(range(1), [])
    assert part.submodels == (0,)
    np.testing.assert_array_equal(part.world_from_seg[0].matrix, np.eye(4))


def test_the_chain_runs_through_a_loop_only_where_nothing_else_connects() -> None:
    rng = np.random.default_rng(4)
    truth = [Sim3.identity(), *[some_sim3(rng) for _ in range(4)]]
    weak = edge(0, 1, truth[1], inliers=20, residual=0.04)
    strong = [edge(0, 4, truth[4], inliers=5000), edge(1, 4, some_sim3(rng), inliers=5000)]
    (part,) = chain_submodels([0, 1, 4], [weak, *strong], loops={4})
    np.testing.assert_allclose(part.world_from_seg[1].matrix, truth[1].matrix, atol=1e-9)
    (bridged,) = chain_submodels([0, 1, 4], strong, loops={4})
    assert bridged.submodels == (0, 1, 4)


def test_submodels_that_take_no_part_leave_no_trace() -> None:
    rng = np.random.default_rng(5)
    edges = [edge(0, 1, some_sim3(rng)), edge(1, 2, some_sim3(rng))]
    first, second = chain_submodels([0, 2], edges)
    assert (first.submodels, second.submodels) == ((0,), (2,))

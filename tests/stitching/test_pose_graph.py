"""The pose graph: laws of its parts, and what it does to rings with drift, true loops and wrong ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.contract import contract
from smust3r_colmap.stitching.pose_graph.graph import ODOMETRY, PoseGraph
from smust3r_colmap.stitching.pose_graph.levenberg import levenberg_marquardt, quadratic
from smust3r_colmap.stitching.pose_graph.linearise import (
    NormalEquations,
    edge_errors,
    inverse_right_jacobian,
    linearise,
    squared_distances,
)
from smust3r_colmap.stitching.pose_graph.loop_selection import leave_one_out
from smust3r_colmap.stitching.pose_graph.normalise import Normalisation
from smust3r_colmap.stitching.pose_graph.optimise import optimise
from smust3r_colmap.stitching.pose_graph.start import linear_part, only_linear, part_of

SIGMAS = np.array([0.01] * 3 + [np.deg2rad(0.3)] * 3 + [0.01])
"""Of a Sim(3) edge: 1 cm on steps of half a unit, 0.3 degrees, 1 % of scale."""


# ------------------------------------------------------------------------------- rings
def ring(num_nodes: int) -> Sim3:
    """True world_from_node of segments on a circle, half a unit apart, the last where the first is."""
    angle = np.linspace(0.0, 2 * np.pi, num_nodes)
    radius = 0.5 * (num_nodes - 1) / (2 * np.pi)
    turn = np.zeros((num_nodes, 7))
    turn[:, 5] = angle
    centres = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(num_nodes)], axis=1)
    return Sim3(scale=np.ones(num_nodes), rotation=Sim3.exp(turn).rotation, translation=centres)


def between(world: Transform, target: IntArray, source: IntArray) -> Transform:
    return world[target].inverse() @ world[source]


def chained(measured: Transform) -> Transform:
    """World_from_node by accumulation of the edges k -> k + 1."""
    matrices = [np.eye(4)]
    for step in measured.matrix:
        matrices.append(matrices[-1] @ step)
    return type(measured).from_matrix(np.array(matrices))


def measured_ring(
    num_nodes: int, num_loops: int, num_wrong: int = 0, *, seed: int = 0
) -> tuple[Sim3, PoseGraph, Transform, IntArray]:
    """Truth, graph, accumulated start and numbers of the wrong loops (40 degrees, 30 % of scale, 3 units)."""
    rng = np.random.default_rng(seed)
    world = ring(num_nodes)
    steps = np.arange(num_nodes - 1)
    pairs = np.sort(rng.integers(0, num_nodes, (4 * num_loops + 8, 2)), axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= num_nodes // 10][:num_loops]
    target, source = np.concatenate([steps, pairs[:, 0]]), np.concatenate([steps + 1, pairs[:, 1]])
    noise = rng.normal(size=(len(target), 7)) * SIGMAS
    measured = between(world, target, source) @ Sim3.exp(noise)
    wrong = np.sort(rng.choice(num_loops, num_wrong, replace=False))
    directions = rng.normal(size=(num_wrong, 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    scale = np.log(1.3) * rng.choice([-1.0, 1.0], (num_wrong, 1))
    errors = np.concatenate([3 * directions[:, 0], np.deg2rad(40) * directions[:, 1], scale], axis=1)
    matrices = measured.matrix
    matrices[num_nodes - 1 + wrong] = (measured[num_nodes - 1 + wrong] @ Sim3.exp(errors)).matrix
    graph = PoseGraph(
        num_nodes=num_nodes,
        target=target,
        source=source,
        target_from_source=Sim3.from_matrix(matrices),
        information=np.broadcast_to(np.diag(SIGMAS**-2), (len(target), 7, 7)),
        loop=np.concatenate([np.full(num_nodes - 1, -1), np.arange(num_loops)]),
    )
    return world, graph, chained(graph.target_from_source[steps]), wrong


def without_loops(graph: PoseGraph, loops: IntArray) -> PoseGraph:
    return graph.with_edges(np.flatnonzero(~np.isin(graph.loop, loops)))[0]


def joined(*graphs: PoseGraph) -> PoseGraph:
    """The edges of all graphs over the nodes of the first; loop numbers are kept."""
    first = graphs[0]
    return replace(
        first,
        target=np.concatenate([graph.target for graph in graphs]),
        source=np.concatenate([graph.source for graph in graphs]),
        target_from_source=stacked([graph.target_from_source for graph in graphs]),
        information=np.concatenate([graph.information for graph in graphs]),
        loop=np.concatenate([graph.loop for graph in graphs]),
    )


def stacked(transforms: list[Transform]) -> Transform:
    return type(transforms[0]).from_matrix(np.concatenate([transform.matrix for transform in transforms]))


def ate(truth: Transform, found: Transform) -> float:
    """Root mean square distance of the nodes' origins after the best Sim(3) (Umeyama)."""
    a, b = (transform.apply(np.zeros((1, 3)))[:, 0] for transform in (found, truth))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = (values * signs).sum() / (a**2).sum()
    return float(np.sqrt(((b - scale * a @ rotation.T) ** 2).sum(axis=1).mean()))


def distances(graph: PoseGraph, state: Transform) -> FloatArray:
    return squared_distances(edge_errors(graph, state).residual, graph.information)


def largest_difference(a: Transform, b: Transform) -> float:
    return float(np.abs(a.matrix - b.matrix).max())


# -------------------------------------------------------------------------------- laws
@pytest.mark.parametrize("name", sorted(GROUPS))
@pytest.mark.parametrize("size", [1e-3, 0.1, 0.7])
def test_jacobians_equal_differences(name: str, size: float) -> None:
    group, rng = GROUPS[name], np.random.default_rng(3)
    state = group.exp(rng.normal(size=(2, group.DOF)) * 0.5)
    ends = np.array([0]), np.array([1])
    measured = between(state, *ends) @ group.exp(size * rng.normal(size=(1, group.DOF)))
    graph = PoseGraph(
        num_nodes=2,
        target=ends[0],
        source=ends[1],
        target_from_source=measured,
        information=np.eye(group.DOF)[None],
        loop=np.array([-1]),
    )
    at = linearise(edge_errors(graph, state))
    step = 1e-6
    for node, jacobian in ((0, at.by_target), (1, at.by_source)):
        columns = []
        for direction in np.eye(group.DOF):
            delta = np.zeros((2, 2, group.DOF))
            delta[:, node] = np.array([[step], [-step]]) * direction
            ahead, behind = (edge_errors(graph, state @ group.exp(moves)).residual[0] for moves in delta)
            columns.append((ahead - behind) / (2 * step))
        np.testing.assert_allclose(jacobian[0], np.stack(columns, axis=1), atol=2e-7 * max(np.abs(jacobian).max(), 1))


@pytest.mark.parametrize("name", sorted(GROUPS))
def test_small_and_large_tangents_share_one_jacobian(name: str) -> None:
    """J_r^-1(r) r = r, and the branches of series and inverse meet."""
    group, rng = GROUPS[name], np.random.default_rng(0)
    directions = rng.normal(size=(20, group.DOF))
    sizes = np.geomspace(1e-9, 1.0, 20)[:, None]
    jacobians = inverse_right_jacobian(group, sizes * directions)
    np.testing.assert_allclose((jacobians @ directions[..., None])[..., 0], directions, atol=1e-6)


def test_normal_equations_equal_dense_ones() -> None:
    _, graph, start, _ = measured_ring(12, 3)
    held = np.arange(12) == 4
    equations = NormalEquations(graph, held)
    at = linearise(edge_errors(graph, start))
    weights = np.linspace(0.5, 2.0, len(graph))
    hessian, gradient = equations.assemble(at, weights)
    step = equations.factorise(hessian, np.zeros(len(gradient))).solve(-gradient)
    moved = equations.move(start, step)
    dense = np.zeros((7 * len(graph), 7 * 12))
    for k in range(len(graph)):
        root = np.sqrt(weights[k]) * np.diag(1 / SIGMAS)
        dense[7 * k : 7 * k + 7, 7 * graph.target[k] :][:, :7] = root @ at.by_target[k]
        dense[7 * k : 7 * k + 7, 7 * graph.source[k] :][:, :7] = root @ at.by_source[k]
    whitened = (np.sqrt(weights)[:, None] * at.residual / SIGMAS).ravel()
    free = np.repeat(~held, 7)
    expected = np.zeros(7 * 12)
    expected[free] = np.linalg.lstsq(dense[:, free], -whitened, rcond=None)[0]
    np.testing.assert_allclose(
        between(stacked([start, moved]), np.arange(12), np.arange(12, 24)).log(), expected.reshape(12, 7), atol=1e-9
    )


def test_contracted_graph_has_the_minimum_of_the_whole() -> None:
    _, graph, start, _ = measured_ring(61, 3)
    graph = joined(graph, graph.with_edges(np.arange(60))[0])  # two edges per neighbours
    held = np.arange(61) == 0
    whole = levenberg_marquardt(graph, start, held, quadratic(np.ones(3)), max_iterations=50, relative_decrease=1e-12)
    small = contract(graph, whole.world_from_node, held)
    assert len(small.nodes) <= 7
    again = levenberg_marquardt(
        small.graph,
        start[small.nodes],
        held[small.nodes],
        quadratic(np.ones(3)),
        max_iterations=50,
        relative_decrease=1e-12,
    )
    expanded = small.expand(again.world_from_node)
    assert largest_difference(expanded, whole.world_from_node) < 1e-4
    # Expanding what did not move gives each stretch the shape of least cost, which it has at the minimum.
    assert largest_difference(small.expand(whole.world_from_node[small.nodes]), whole.world_from_node) < 1e-6


def test_distance_of_a_loop_is_what_it_adds_to_the_minimum() -> None:
    _, graph, start, _ = measured_ring(41, 6, seed=2)
    held = np.arange(41) == 0

    def minimum(of: PoseGraph) -> tuple[Transform, float]:
        end = levenberg_marquardt(
            of, start, held, quadratic(np.ones(of.num_loops)), max_iterations=50, relative_decrease=1e-13
        )
        return end.world_from_node, end.cost

    state, cost = minimum(graph)
    kept = leave_one_out(graph, state, np.ones(6), NormalEquations(graph, held))
    falls = [cost - minimum(without_loops(graph, np.array([loop])))[1] for loop in range(6)]
    np.testing.assert_allclose(kept.distance, falls, rtol=0.02)
    assert (kept.freedom == 7).all()
    # And the same of a loop that is left out already, from the other side.
    out_state, _ = minimum(without_loops(graph, np.array([0])))
    weights = np.array([1e-12, 1, 1, 1, 1, 1])
    out = leave_one_out(graph, out_state, weights, NormalEquations(graph, held))
    assert out.distance[0] == pytest.approx(falls[0], rel=0.05)


@pytest.mark.parametrize("name", sorted(GROUPS))
def test_normalised_coordinates_leave_every_distance(name: str) -> None:
    group, rng = GROUPS[name], np.random.default_rng(1)
    state = group.exp(0.2 * rng.normal(size=(5, group.DOF)))
    steps = np.arange(4)
    root = rng.normal(size=(4, group.DOF, group.DOF))
    graph = PoseGraph(
        num_nodes=5,
        target=steps,
        source=steps + 1,
        target_from_source=between(state, steps, steps + 1) @ group.exp(0.05 * rng.normal(size=(4, group.DOF))),
        information=root @ np.swapaxes(root, 1, 2),
        loop=np.full(4, -1),
    )
    normal = Normalisation(centre=np.array([3.0, -2.0, 1.0]), radius=20.0)
    unit = normal.state(state)
    np.testing.assert_allclose(distances(normal.graph(graph), unit), distances(graph, state), rtol=1e-6)
    assert largest_difference(normal.undone(unit), state) < 1e-9


def test_part_of_a_graph_has_the_marginal_information() -> None:
    _, graph, _, _ = measured_ring(5, 0)
    root = np.random.default_rng(0).normal(size=(4, 7, 7))
    graph = replace(graph, information=root @ np.swapaxes(root, 1, 2))
    part = part_of(graph, linear_part(Sim3), only_linear(graph.target_from_source)).information
    covariance = np.linalg.inv(graph.information)[:, 3:, 3:]
    np.testing.assert_allclose(part[:, 3:, 3:] @ covariance, np.broadcast_to(np.eye(4), (4, 4, 4)), atol=1e-8)
    assert (part[:, :3] == 0).all() and (part[:, :, :3] == 0).all()


# ---------------------------------------------------------------------------- recovery
def test_optimum_is_gtsams() -> None:
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed; it only cross-checks")
    world, graph, start, _ = measured_ring(201, 4)
    found = optimise(graph, start, kernel="none", relative_decrease=1e-10)
    theirs, cost = _gtsam_optimum(gtsam, graph, start)
    assert found.cost_after == pytest.approx(cost, rel=1e-4)
    assert ate(world, found.world_from_node) == pytest.approx(ate(world, theirs), rel=1e-4)
    assert found.improved and found.stop_reason.startswith("converged")


def _gtsam_optimum(gtsam, graph: PoseGraph, start: Transform) -> tuple[Sim3, float]:  # type: ignore[no-untyped-def]
    """Of the same squared distances; gtsam maps x to s (R x + t), and its tangent is (rotation, translation, scale)."""

    def similarity(matrix: FloatArray):  # type: ignore[no-untyped-def]
        scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
        return gtsam.Similarity3(gtsam.Rot3(matrix[:3, :3] / scale), matrix[:3, 3] / scale, scale)

    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = np.concatenate([SIGMAS[3:6], SIGMAS[:3], SIGMAS[6:]])
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    for target, source, matrix in zip(graph.target, graph.source, graph.target_from_source.matrix, strict=True):
        factors.add(gtsam.BetweenFactorSimilarity3(int(target), int(source), similarity(matrix), noise))
    tight = gtsam.noiseModel.Isotropic.Sigma(7, 1e-9)
    factors.add(gtsam.PriorFactorSimilarity3(0, similarity(start.matrix[0]), tight))
    for node, matrix in enumerate(start.matrix):
        values.insert(node, similarity(matrix))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    result = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    nodes = np.array([result.atSimilarity3(node).matrix() for node in range(graph.num_nodes)])
    nodes /= nodes[:, 3:, 3:]
    return Sim3.from_matrix(nodes), 2 * factors.error(result)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["cauchy", "gnc"])
@pytest.mark.parametrize("seed", range(3))
def test_12_wrong_loops_of_40_are_rejected_and_no_true_one(kernel: str, seed: int) -> None:
    world, graph, start, wrong = measured_ring(201, 40, 12, seed=seed)
    found = optimise(graph, start, kernel=kernel)  # type: ignore[arg-type]
    reference = optimise(without_loops(graph, wrong), start, kernel="none")
    assert found.rejected_loops.tolist() == wrong.tolist()
    assert ate(world, found.world_from_node) < 1.1 * ate(world, reference.world_from_node)
    assert (found.loop_weights[wrong] == 0).all() and (np.delete(found.loop_weights, wrong) > 0.4).all()
    # No loop costs more than its rejection, and the start has no other cost.
    assert found.cost_before <= 40.01 * found.information_scale * chi2.ppf(1 - 1e-5, 7)
    naive = optimise(graph, start, kernel="none")
    assert ate(world, naive.world_from_node) > 5 * ate(world, found.world_from_node)


@pytest.mark.slow
def test_long_chain_with_drift_of_a_sixth_of_its_size_keeps_its_true_loops() -> None:
    world, graph, start, _ = measured_ring(2001, 60)
    found = optimise(graph, start)
    reference = optimise(graph, start, kernel="none")
    assert ate(world, start) > 20
    assert len(found.rejected_loops) == 0
    assert ate(world, found.world_from_node) < 1.1 * ate(world, reference.world_from_node) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1 / 9, 9.0])
def test_information_wrong_by_a_factor_of_nine_changes_no_decision(factor: float) -> None:
    _, graph, start, wrong = measured_ring(201, 40, 12)
    found = optimise(replace(graph, information=factor * graph.information), start)
    assert found.rejected_loops.tolist() == wrong.tolist()
    assert found.information_scale == pytest.approx(factor * optimise(graph, start).information_scale, rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("num_nodes", [201, 2001])
def test_wrong_loops_that_agree_with_each_other_are_rejected(num_nodes: int) -> None:
    """Five places on one side of the ring look like five across: a false fold against 40 true loops."""
    world, graph, start, _ = measured_ring(num_nodes, 40)
    here = num_nodes // 4 + np.arange(5)
    there = here + num_nodes // 2
    same_place = world[np.full(5, here[0])] @ world[np.full(5, there[0])].inverse()
    noise = np.random.default_rng(0).normal(size=(5, 7)) * SIGMAS
    fold = replace(
        graph,
        target=here,
        source=there,
        target_from_source=world[here].inverse() @ same_place @ world[there] @ Sim3.exp(noise),
        information=graph.information[:5],
        loop=np.arange(5),
    )
    folded = joined(graph, _renumbered(fold, 40))
    assert optimise(folded, start).rejected_loops.tolist() == [40, 41, 42, 43, 44]


def _renumbered(graph: PoseGraph, first: int) -> PoseGraph:
    """The same edges with loop numbers from ``first`` on; only to be joined to a graph that has the others."""
    graph.__dict__["loop"] = np.where(graph.loop >= 0, graph.loop + first, graph.loop)
    return graph


@pytest.mark.parametrize("name", ["se3", "affine3", "sl4"])
def test_other_groups_close_a_ring(name: str) -> None:
    group, rng = GROUPS[name], np.random.default_rng(0)
    truth, base, _, _ = measured_ring(101, 6)
    world = group.from_matrix(truth.matrix)
    sigmas = np.full(group.DOF, 0.005)
    sigmas[12:] = 1e-4  # a projective row per unit of length
    measured = between(world, base.target, base.source) @ group.exp(rng.normal(size=(106, group.DOF)) * sigmas)
    graph = replace(
        base, target_from_source=measured, information=np.broadcast_to(np.diag(sigmas**-2), (106, *2 * (group.DOF,)))
    )
    start = chained(measured[np.arange(100)])
    found = optimise(graph, start)
    assert found.stop_reason.startswith("converged") and found.improved
    assert len(found.rejected_loops) == 0
    assert ate(world, found.world_from_node) < 0.8 * ate(world, start)
    redundant = 6 * group.DOF  # each loop adds as many equations as it has degrees of freedom
    assert 0.4 * redundant < distances(graph, found.world_from_node).sum() < 1.8 * redundant


# -------------------------------------------------------------------------- invariants
def test_first_node_is_held_exactly() -> None:
    _, graph, start, _ = measured_ring(31, 3)
    world_from_other = Sim3.exp(np.array([5.0, -3.0, 2.0, 0.3, 0.2, -0.4, 0.5]))
    found = optimise(graph, type(start).from_matrix(world_from_other.matrix @ start.matrix))
    assert found.improved
    assert np.abs(found.world_from_node.matrix[0] - world_from_other.matrix).max() < 1e-12


@pytest.mark.slow
def test_world_gauge_moves_the_result_along() -> None:
    _, graph, start, _ = measured_ring(61, 8, 2)
    found = optimise(graph, start)
    other_from_world = Sim3.exp(np.array([40.0, -7.0, 2.0, 0.3, 1.2, -0.4, 2.0]))
    moved = optimise(graph, Sim3.from_matrix(other_from_world.matrix @ start.matrix))
    expected = other_from_world.matrix @ found.world_from_node.matrix
    np.testing.assert_allclose(moved.world_from_node.matrix, expected, atol=1e-4 * np.abs(expected).max())
    assert moved.rejected_loops.tolist() == found.rejected_loops.tolist()


@pytest.mark.slow
def test_unit_of_length_does_not_matter() -> None:
    _, graph, start, _ = measured_ring(61, 8, 2)
    found = optimise(graph, start)
    kilo = np.diag([1000.0, 1000.0, 1000.0, 1.0])
    to_unit = np.diag([1e-3] * 3 + [1.0] * 4)
    rescaled = replace(
        graph,
        target_from_source=Sim3.from_matrix(kilo @ graph.target_from_source.matrix @ np.linalg.inv(kilo)),
        information=to_unit @ graph.information @ to_unit,
    )
    large = optimise(rescaled, Sim3.from_matrix(kilo @ start.matrix @ np.linalg.inv(kilo)))
    back = np.linalg.inv(kilo) @ large.world_from_node.matrix @ kilo
    np.testing.assert_allclose(back, found.world_from_node.matrix, atol=1e-5)
    assert large.cost_after == pytest.approx(found.cost_after, rel=1e-6)


@pytest.mark.slow
def test_numbering_of_nodes_does_not_matter() -> None:
    _, graph, start, wrong = measured_ring(81, 10, 2)
    found = optimise(graph, start)
    new = np.concatenate([[0], 1 + np.random.default_rng(0).permutation(80)])
    shuffled = replace(graph, target=new[graph.target], source=new[graph.source])
    other = optimise(shuffled, start[np.argsort(new)])
    np.testing.assert_allclose(other.world_from_node.matrix[new], found.world_from_node.matrix, atol=1e-4)
    assert other.rejected_loops.tolist() == found.rejected_loops.tolist() == wrong.tolist()


def test_parallel_edges_are_weighted_by_their_information() -> None:
    strong, weak = np.diag([4.0] * 7), np.diag([1.0] * 7)
    offsets = np.zeros((2, 7))
    offsets[:, 0] = [0.0, 0.01]  # so small that the group is flat
    graph = PoseGraph(
        num_nodes=2,
        target=np.array([0, 0]),
        source=np.array([1, 1]),
        target_from_source=Sim3.exp(offsets),
        information=np.stack([strong, weak]),
        loop=np.array([-1, -1]),
    )
    found = optimise(graph, Sim3.identity((2,)))
    assert found.world_from_node.matrix[1, 0, 3] == pytest.approx(0.002, rel=1e-4)
    assert found.cost_after == pytest.approx(4 * 0.002**2 + 0.008**2, rel=1e-4)


@pytest.mark.slow
def test_all_edges_of_a_loop_share_one_weight() -> None:
    """A loop segment between nodes 10 and 50, two kinds of edges to each side; one side is false in both kinds."""
    world, graph, start, _ = measured_ring(61, 8)
    loop_node = world[np.array([10])] @ Sim3.exp(np.full((1, 7), 0.1))
    ends = np.array([10, 10, 50, 50])
    rng = np.random.default_rng(5)
    measured = world[ends].inverse() @ loop_node[np.zeros(4, dtype=int)] @ Sim3.exp(rng.normal(size=(4, 7)) * SIGMAS)
    false = Sim3.exp(np.array([1.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.2]))
    for last, is_false in ((measured, False), (stacked([measured[:2], measured[2:] @ false]), True)):
        loop_edges = replace(
            graph,
            num_nodes=62,
            target=ends,
            source=np.full(4, 61),
            target_from_source=last,
            information=graph.information[:4],
            loop=np.zeros(4, dtype=int),
        )
        whole = joined(replace(graph, num_nodes=62), _renumbered(loop_edges, 8))
        begin = Sim3.from_matrix(np.concatenate([start.matrix, start.matrix[10:11]]))
        found = optimise(whole, begin)
        assert found.loop_weights.shape == (9,)
        assert found.rejected_loops.tolist() == ([8] if is_false else [])
        # A rejected loop segment still has a place: where its own edges would have it.
        assert np.isfinite(found.world_from_node.matrix).all()


# ------------------------------------------------------------------- nothing, and less
def test_no_loops_leave_the_chain_as_it_is() -> None:
    _, graph, start, _ = measured_ring(31, 0)
    found = optimise(graph, start)
    assert not found.improved and found.stop_reason == "nothing to do"
    assert found.world_from_node is start
    assert len(found.loop_weights) == len(found.rejected_loops) == 0


def test_contradictory_sequence_edges_meet_in_the_middle() -> None:
    graph = PoseGraph(
        num_nodes=3,
        target=np.array([0, 0, 1]),
        source=np.array([1, 1, 2]),
        target_from_source=Sim3.exp(np.array([[0.0] * 7, [0.02] + [0.0] * 6, [0.01] + [0.0] * 6])),
        information=np.broadcast_to(np.eye(7), (3, 7, 7)),
        loop=np.full(3, -1),
    )
    found = optimise(graph, Sim3.identity((3,)))
    assert found.improved and found.stop_reason.startswith("converged")
    assert found.cost_after == pytest.approx(2e-4, rel=1e-3)
    np.testing.assert_allclose(found.world_from_node.matrix[:, 0, 3], [0.0, 0.01, 0.02], atol=1e-5)


def test_a_loop_that_alone_joins_two_parts_is_accepted() -> None:
    _, graph, start, _ = measured_ring(20, 1)
    last = graph.target[-1]  # of the part before the cut, where the loop begins
    cut = graph.with_edges(np.flatnonzero((graph.target != last) | (graph.loop >= 0)))[0]
    assert (cut.components() == 0).all() and len(cut) == 19
    begin = start.matrix
    begin[last + 1 :] = Sim3.exp(np.full(7, 0.3)).matrix @ begin[last + 1 :]
    found = optimise(cut, Sim3.from_matrix(begin))
    assert len(found.rejected_loops) == 0 and found.cost_after < 1e-6


@pytest.mark.slow
def test_components_are_solved_as_if_alone() -> None:
    _, first, start_first, wrong = measured_ring(61, 10, 2, seed=1)
    _, second, start_second, _ = measured_ring(41, 4, seed=2)
    total = 61 + 41 + 1  # and a node without any edge
    moved = replace(second, num_nodes=total, target=second.target + 61, source=second.source + 61)
    whole = joined(replace(first, num_nodes=total), _renumbered(moved, 10))
    start = Sim3.from_matrix(np.concatenate([start_first.matrix, start_second.matrix, np.eye(4)[None]]))
    found = optimise(whole, start)
    alone = [optimise(first, start_first), optimise(second, start_second)]
    parts = [found.world_from_node[np.arange(61)], found.world_from_node[np.arange(61, 102)]]
    for part, solution in zip(parts, alone, strict=True):
        assert largest_difference(part, solution.world_from_node) < 1e-9
    np.testing.assert_array_equal(found.world_from_node.matrix[102], np.eye(4))
    assert found.rejected_loops.tolist() == wrong.tolist()
    assert found.cost_after == pytest.approx(sum(solution.cost_after for solution in alone))


def test_a_worse_state_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The descent is made to end somewhere bad; the start comes back and the reason says so."""
    from smust3r_colmap.stitching.pose_graph import optimise as module  # noqa: PLC0415  (a function has its name)

    _, graph, start, _ = measured_ring(31, 3)
    real = levenberg_marquardt

    def spoiled(*args: object, **options: object):  # type: ignore[no-untyped-def]
        end = real(*args, **options)  # type: ignore[arg-type]
        bent = end.world_from_node @ Sim3.exp(np.random.default_rng(0).normal(size=(31, 7)))
        return replace(end, world_from_node=bent)

    monkeypatch.setattr(module, "levenberg_marquardt", spoiled)
    found = optimise(graph, start)
    assert not found.improved and found.stop_reason == "worse than the start"
    assert found.world_from_node is start
    assert found.cost_after == found.cost_before


@pytest.mark.parametrize("seed", range(3))
def test_a_lone_wrong_loop_leaves_the_chain_as_it_is(seed: int) -> None:
    _, graph, start, _ = measured_ring(201, 1, 1, seed=seed)
    found = optimise(graph, start)
    assert found.rejected_loops.tolist() == [0] and found.stop_reason == "no loop accepted"
    assert not found.improved and found.world_from_node is start
    assert found.loop_distances[0] > 9 * chi2.ppf(1 - 1e-5, 7)  # the sequence may be three times worse than it says


def test_iteration_limit_is_said() -> None:
    _, graph, start, _ = measured_ring(201, 40)
    assert optimise(graph, start, max_iterations=1).stop_reason == "iteration limit"


def test_singular_information_leaves_the_rest_to_the_others() -> None:
    """Every second kind of edge knows nothing of the scale, as camera poses on a straight path do."""
    world, graph, start, _ = measured_ring(61, 5)
    blind = graph.information.copy()
    blind[:, 6, 6] = 0.0
    found = optimise(joined(graph, replace(graph, information=blind)), start)
    assert found.improved and len(found.rejected_loops) == 0
    assert ate(world, found.world_from_node) < 0.5 * ate(world, start)


def test_chosen_edges_keep_their_loops_under_new_numbers() -> None:
    _, graph, _, _ = measured_ring(20, 5)
    chain = np.flatnonzero(graph.loop == ODOMETRY)
    some, loops = graph.with_edges(np.concatenate([chain, np.flatnonzero(np.isin(graph.loop, [1, 4]))]))
    assert (some.num_nodes, some.num_loops, loops.tolist()) == (20, 2, [1, 4])
    assert some.loop[len(chain) :].tolist() == [0, 1]
    np.testing.assert_array_equal(some.target[-1], graph.target[np.flatnonzero(graph.loop == 4)[0]])
    only_loops, loops = graph.with_edges(np.flatnonzero(graph.loop >= 3))
    assert (only_loops.loop.tolist(), loops.tolist()) == ([0, 1], [3, 4])


# ---------------------------------------------------------------------------- refusals
def test_bad_graphs_are_refused() -> None:
    _, graph, start, _ = measured_ring(11, 1)
    with pytest.raises(ValueError, match=r"target of edge 0 is node 11 of 11"):
        replace(graph, target=np.where(graph.target == 0, 11, graph.target))
    with pytest.raises(ValueError, match="edge 3 joins node 3 to itself"):
        replace(graph, source=np.where(np.arange(11) == 3, 3, graph.source))
    with pytest.raises(ValueError, match=r"11 targets, but source \(10,\)"):
        replace(graph, source=graph.source[:-1])
    with pytest.raises(ValueError, match="numbered from 0 without gaps"):
        replace(graph, loop=np.where(graph.loop == 0, 2, graph.loop))
    with pytest.raises(ValueError, match="must be a list of integers"):
        replace(graph, loop=graph.loop + 0.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="information of edge 0 is not symmetric positive semidefinite"):
        replace(graph, information=-graph.information)
    with pytest.raises(ValueError, match="information of edge 0 is not finite"):
        replace(graph, information=graph.information * np.nan)
    with pytest.raises(ValueError, match="a start in Affine3, edges in Sim3"):
        optimise(graph, Affine3.from_matrix(start.matrix))
    with pytest.raises(ValueError, match=r"a start of shape \(10,\) for 11 nodes"):
        optimise(graph, start[np.arange(10)])
    with pytest.raises(ValueError, match="kernel 'huber'"):
        optimise(graph, start, kernel="huber")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"tolerance 0.5 at least 1"):
        optimise(graph, start, tolerance=0.5)

"""How well are segments aligned and loops closed, and what does it cost? Beside peers' figures.

Alignment is that of ``benchmark_alignment.py``. The graphs are rings of segments, half a unit apart,
whose last lies where the first does; consecutive ones are joined by edges with 1 cm, 0.3 degrees (per
axis) and 1 % of scale of noise, and so are random pairs, the loops. A wrong loop is off by 3 units, 40
degrees and 30 % of scale on top. The start accumulates the edges. The error (ATE) is the root mean
square distance to the truth after the best Sim(3).

Sections:
    alignment   two segments of a room in every group: noise, outliers, planes; time and memory
    rings       beside VGGT-Long's loop optimiser and gtsam (Levenberg-Marquardt, no kernel unless named)
    sl4         the same rings embedded in SL(4), beside VGGT-SLAM's pose graph
    sizes       20 to 20,000 segments: time, memory, true loops kept
    wrong       wrong loops over many seeds, translations only, places elsewhere, a false fold, wrong information

Figures of peers were measured on rings made by the same description, but with other random numbers,
and with one sigma (0.01) for all parts of an edge; ours here have the information of the noise.

    OMP_NUM_THREADS=1 python scripts/benchmark_stitching.py
    python scripts/benchmark_stitching.py --only sizes --largest 2000
"""

from __future__ import annotations

import argparse
import logging
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import benchmark_alignment
import numpy as np

from smust3r_colmap.estimators.similarity import fit_similarity
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.geometry.sl4 import SL4
from smust3r_colmap.geometry.so3 import angles_between, nearest_rotation
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.stitching.pose_graph.graph import PoseGraph
from smust3r_colmap.stitching.pose_graph.optimise import GraphSolution, Kernel, optimise

STEP = 0.5
SIGMAS = np.array([0.01] * 3 + [np.deg2rad(0.3)] * 3 + [0.01])
SL4_SIGMA = 0.01
"""Of every part of an SL(4) edge, lengths in steps of the ring's unit."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Ring:
    """A measured ring: truth, edges, where to start, and which loops are wrong."""

    world: Sim3
    graph: PoseGraph
    start: Transform
    wrong: IntArray

    def without_wrong(self) -> PoseGraph:
        """The graph of the true loops."""
        true = np.flatnonzero(~np.isin(self.graph.loop, self.wrong))
        return self.graph.with_edges(true)[0]


Errors = Callable[[np.random.Generator, int], FloatArray]


def far_off(rng: np.random.Generator, count: int) -> FloatArray:
    """Tangents (count, 7) of 3 units, 40 degrees and 30 % of scale."""
    directions = rng.normal(size=(count, 2, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    scale = np.log(1.3) * rng.choice([-1.0, 1.0], (count, 1))
    return np.concatenate([3 * directions[:, 0], np.deg2rad(40) * directions[:, 1], scale], axis=1)


def displaced(rng: np.random.Generator, count: int) -> FloatArray:
    """Tangents (count, 7) of 3 units in each direction and nothing else, the hardest to see."""
    return np.concatenate([rng.normal(0, 3, (count, 3)), np.zeros((count, 4))], axis=1)


def elsewhere(rng: np.random.Generator, count: int) -> FloatArray:
    """Tangents (count, 7) to anywhere."""
    return np.concatenate([rng.normal(0, 10, (count, 3)), rng.normal(0, [1.5] * 3 + [0.5], (count, 4))], axis=1)


def measured_ring(
    num_nodes: int, num_loops: int, num_wrong: int = 0, *, seed: int = 0, errors: Errors = far_off, fold: int = 0
) -> Ring:
    """A ring with random loops, some of them wrong.

    Args:
        fold: so many more wrong loops that agree with each other: a stretch on one side of the ring is
            taken for the one across.
    """
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2 * np.pi, num_nodes)
    turn = np.zeros((num_nodes, 7))
    turn[:, 5] = angle
    radius = STEP * (num_nodes - 1) / (2 * np.pi)
    centres = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(num_nodes)], axis=1)
    world = Sim3(scale=np.ones(num_nodes), rotation=Sim3.exp(turn).rotation, translation=centres)
    steps = np.arange(num_nodes - 1)
    pairs = np.sort(rng.integers(0, num_nodes, (8 * num_loops + 8, 2)), axis=1)
    pairs = pairs[pairs[:, 1] - pairs[:, 0] >= num_nodes // 10][:num_loops]
    across = num_nodes // 4 + np.arange(fold)[:, None] + np.array([0, num_nodes // 2])
    target, source = np.concatenate([np.stack([steps, steps + 1], axis=1), pairs, across]).T
    true = world[target].inverse() @ world[source] @ Sim3.exp(rng.normal(size=(len(target), 7)) * SIGMAS)
    wrong = np.sort(rng.choice(num_loops, num_wrong, replace=False))
    matrices = true.matrix
    at = num_nodes - 1 + wrong
    matrices[at] = (true[at] @ Sim3.exp(errors(rng, num_wrong))).matrix
    if fold:
        one_place = (world[across[0, 0]] @ world[across[0, 1]].inverse()).matrix
        folded = world[across[:, 0]].inverse().matrix @ one_place @ world[across[:, 1]].matrix
        matrices[-fold:] = folded @ Sim3.exp(rng.normal(size=(fold, 7)) * SIGMAS).matrix
    graph = PoseGraph(
        num_nodes=num_nodes,
        target=target,
        source=source,
        target_from_source=Sim3.from_matrix(matrices),
        information=np.broadcast_to(np.diag(SIGMAS**-2), (len(target), 7, 7)),
        loop=np.concatenate([np.full(num_nodes - 1, -1), np.arange(num_loops + fold)]),
    )
    wrong = np.concatenate([wrong, np.arange(num_loops, num_loops + fold)])
    return Ring(world=world, graph=graph, start=accumulated(graph), wrong=wrong)


def accumulated(graph: PoseGraph) -> Transform:
    """World_from_node of the edges k -> k + 1, which come first."""
    matrices = [np.eye(4)]
    for step in graph.target_from_source.matrix[: graph.num_nodes - 1]:
        matrices.append(matrices[-1] @ step)
    return type(graph.target_from_source).from_matrix(np.array(matrices))


def ate(truth: Transform, found: Transform) -> float:
    """Root mean square distance of the nodes' origins after the best Sim(3) (Umeyama)."""
    a, b = (transform.apply(np.zeros((1, 3)))[:, 0] for transform in (found, truth))
    return float(np.sqrt(((b - fit_similarity(a, b).apply(a)) ** 2).sum(axis=1).mean()))


def mean_turn_deg(truth: Sim3, found: Transform) -> float:
    """Mean angle between true and found orientations, both relative to the first node's."""
    rotation = nearest_rotation(found.matrix[:, :3, :3])
    relative = np.swapaxes(rotation[:1], 1, 2) @ rotation
    true = np.swapaxes(truth.rotation[:1], 1, 2) @ truth.rotation
    return float(np.rad2deg(angles_between(relative, true)).mean())


def timed(graph: PoseGraph, start: Transform, kernel: Kernel) -> tuple[GraphSolution, float]:
    """The solution and its CPU seconds."""
    before = time.process_time()
    solution = optimise(graph, start, kernel=kernel)
    return solution, time.process_time() - before


def peak_mib() -> float:
    """Largest memory of the process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def decision(ring: Ring, solution: GraphSolution) -> str:
    """How many wrong loops were rejected, and how many true ones."""
    right = int(np.isin(solution.rejected_loops, ring.wrong).sum())
    return f"{right}/{len(ring.wrong)} wrong and {len(solution.rejected_loops) - right} true rejected"


# ---------------------------------------------------------------------------- sections
PEERS_RINGS = {
    (21, 2, 0): "VGGT-Long 0.7-1.1 s, 0.088 -> 0.039; gtsam 0.002 s, 0.039",
    (201, 4, 0): "VGGT-Long 1.9 s, 2.22 -> 0.168; gtsam 0.011 s, 0.188",
    (201, 40, 0): "VGGT-Long 1.5 s, 2.22 -> 0.194",
    (201, 40, 2): "VGGT-Long 4.3 s, 2.22 -> 0.534 (turns worse); gtsam 0.521, Cauchy 0.173",
    (201, 40, 12): "VGGT-Long 2.8 s, 2.22 -> 2.48 (worse); gtsam 2.83, Cauchy 0.165, GNC 0.136 in 0.28 s",
    (2001, 20, 0): "VGGT-Long 16.7 s, 50.2 -> 14.4; gtsam 0.13 s, 11.6",
    (2001, 200, 20): "gtsam 1.98, Cauchy 1.405 in 1.4 s, GNC 1.33 in 15.8 s",
}
PEERS_SL4 = {
    (21, 2, 0): "0.005 s, 0.088 -> 0.040",
    (201, 4, 0): "1.1 s, 2.22 -> 1.87 (iteration limit)",
    (201, 40, 0): "0.5 s, 2.22 -> 1.53",
    (201, 40, 2): "0.2 s, 2.22 -> 1.67",
    (2001, 20, 0): "0.2 s, 50.2 -> 50.2 (stops at once, silently)",
}


def rings(args: argparse.Namespace) -> None:
    """Section 2 of the peers' measurements."""
    for shape, peers in PEERS_RINGS.items():
        ring = measured_ring(*shape, seed=args.seed)
        print(f"{shape[0]} segments, {shape[1]} loops, {shape[2]} wrong    peers: {peers}")
        for kernel in ("none", "cauchy", "gnc"):
            solution, seconds = timed(ring.graph, ring.start, kernel)
            print(
                f"    {kernel:6s} {seconds:5.2f} s  ATE {ate(ring.world, ring.start):.3f} -> "
                f"{ate(ring.world, solution.world_from_node):.3f}  turn {mean_turn_deg(ring.world, ring.start):.2f} -> "
                f"{mean_turn_deg(ring.world, solution.world_from_node):.2f} deg  {decision(ring, solution)}, "
                f"{solution.stop_reason} after {solution.iterations}"
            )


def sl4(args: argparse.Namespace) -> None:
    """Section 4 of the peers' measurements."""
    for shape, peers in PEERS_SL4.items():
        ring = measured_ring(*shape, seed=args.seed)
        graph = replace(
            ring.graph,
            target_from_source=SL4.from_matrix(ring.graph.target_from_source.matrix),
            information=np.broadcast_to(np.eye(15) / SL4_SIGMA**2, (len(ring.graph), 15, 15)),
        )
        start = SL4.from_matrix(ring.start.matrix)
        solution, seconds = timed(graph, start, "cauchy")
        singular = np.linalg.svd(solution.world_from_node.matrix[:, :3, :3], compute_uv=False)
        anisotropy = (singular[:, 0] / singular[:, 2]).max()
        print(
            f"{shape[0]} segments, {shape[1]} loops, {shape[2]} wrong    VGGT-SLAM: {peers}\n"
            f"    cauchy {seconds:5.2f} s  ATE {ate(ring.world, start):.3f} -> "
            f"{ate(ring.world, solution.world_from_node):.3f}  anisotropy {anisotropy:.2f}  "
            f"{decision(ring, solution)}, {solution.stop_reason} after {solution.iterations}"
        )


def sizes(args: argparse.Namespace) -> None:
    """From 20 to 20,000 segments, beside the solve with all true loops and no kernel."""
    for steps, loops, wrong in (
        (20, 2, 0),
        (200, 20, 0),
        (2000, 20, 0),
        (2000, 200, 0),
        (2000, 200, 20),
        (20000, 200, 0),
        (20000, 200, 20),
        (20000, 200, 60),
    ):
        if steps > args.largest:
            continue
        ring = measured_ring(steps + 1, loops, wrong, seed=args.seed)
        solution, seconds = timed(ring.graph, ring.start, "cauchy")
        mib = peak_mib()
        reference, plain = timed(ring.without_wrong(), ring.start, "none")
        ours, theirs = ate(ring.world, solution.world_from_node), ate(ring.world, reference.world_from_node)
        print(
            f"{steps} segments, {loops} loops, {wrong} wrong: {seconds:.2f} s, {mib:.0f} MiB, "
            f"ATE {ate(ring.world, ring.start):.2f} -> {ours:.4f} ({ours / theirs:.3f} of the solve of the true loops "
            f"without kernel, {plain:.2f} s), {decision(ring, solution)}, {solution.stop_reason}"
        )


def wrong(args: argparse.Namespace) -> None:
    """Wrong loops of several kinds."""
    for kernel in ("cauchy", "gnc"):
        missed, lost, ratios = 0, 0, []
        for seed in range(args.seeds):
            ring = measured_ring(201, 40, 12, seed=seed)
            solution, _ = timed(ring.graph, ring.start, kernel)
            reference, _ = timed(ring.without_wrong(), ring.start, "none")
            right = int(np.isin(solution.rejected_loops, ring.wrong).sum())
            missed, lost = missed + 12 - right, lost + len(solution.rejected_loops) - right
            ratios.append(ate(ring.world, solution.world_from_node) / ate(ring.world, reference.world_from_node))
        print(
            f"201 segments, 12 of 40 wrong, {args.seeds} seeds, {kernel}: {missed} wrong ones kept, {lost} true ones "
            f"rejected, ATE over that without the wrong ones {np.mean(ratios):.3f} (worst {max(ratios):.3f})"
        )
    for title, options in (
        ("12 of 40 anywhere", {"num_wrong": 12, "errors": elsewhere}),
        ("12 of 40 displaced by 3 units only", {"num_wrong": 12, "errors": displaced}),
        ("a false fold of 5 beside 40 true", {"fold": 5}),
    ):
        for num_nodes in (201, 2001):
            ring = measured_ring(num_nodes, 40, seed=args.seed, **options)
            _report_wrong(f"{num_nodes} segments, {title}", ring, ring.graph)
    ring = measured_ring(201, 40, 12, seed=args.seed)
    for factor in (1 / 9, 9.0, 100.0):
        graph = replace(ring.graph, information=factor * ring.graph.information)
        _report_wrong(f"201 segments, 12 of 40 wrong, information times {factor:.2f}", ring, graph)


def _report_wrong(title: str, ring: Ring, graph: PoseGraph) -> None:
    solution, seconds = timed(graph, ring.start, "cauchy")
    reference, _ = timed(ring.without_wrong(), ring.start, "none")
    ratio = ate(ring.world, solution.world_from_node) / ate(ring.world, reference.world_from_node)
    print(
        f"{title}: {decision(ring, solution)}, ATE ratio {ratio:.3f}, {seconds:.2f} s, scale found "
        f"{solution.information_scale:.2f}, {solution.stop_reason}"
    )


def alignment(args: argparse.Namespace) -> None:
    """Two segments of a room, beside VGGT-Long's alignment and VGGT-SLAM's solver."""
    benchmark_alignment.main(["--seed", str(args.seed), "--seeds", str(args.seeds)])


SECTIONS: dict[str, Callable[[argparse.Namespace], None]] = {
    "alignment": alignment,
    "rings": rings,
    "sl4": sl4,
    "sizes": sizes,
    "wrong": wrong,
}


def main() -> None:
    """Run the sections that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=sorted(SECTIONS), help="one section; all without it")
    parser.add_argument("--seed", type=int, default=0, help="of the rings")
    parser.add_argument("--seeds", type=int, default=20, help="rings with wrong loops")
    parser.add_argument("--largest", type=int, default=20000, help="segments of the longest ring")
    args = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    measured_ring(21, 2)  # imports and caches are no part of the figures
    for name, section in SECTIONS.items():
        if args.only in (None, name):
            print(f"== {name}")
            section(args)


if __name__ == "__main__":
    main()

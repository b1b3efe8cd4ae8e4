from dataclasses import replace

import numpy as np
import pytest
from helpers.scenes import make_submodel, points_ahead, rotation_about_y, some_sim3, walk

from smust3r_colmap.alignment.from_tracks import point_depths
from smust3r_colmap.alignment.pairwise import align_submodels, candidate_pairs, disagreement_sigmas
from smust3r_colmap.config import AlignmentConfig, AlignmentEdges, TransformGroup
from smust3r_colmap.geometry.affine3 import Affine3
from smust3r_colmap.geometry.groups import GROUPS
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import Edges, InterSegmentMatches, Submodel
from smust3r_colmap.storage.codec import Codec


class Counter:
    def __init__(self) -> None:
        self.count = 0

    def __call__(self, more: int) -> None:
        self.count += more


def two_submodels(
    images_a: range, images_b: range, *, noise: float = 0.0, seed: int = 0
) -> tuple[Submodel, Submodel, Sim3]:
    """Two views of one world in frames of their own, and the true a_from_b."""
    rng = np.random.default_rng(seed)
    world_from_cam, points = walk(20), points_ahead(400, rng)
    a_from_world, b_from_world = some_sim3(rng), some_sim3(rng)
    a = make_submodel(world_from_cam, tuple(images_a), points, a_from_world)
    noisy = points * (1 + noise * rng.normal(size=(len(points), 1)))
    b = make_submodel(world_from_cam, tuple(images_b), noisy, b_from_world, segment=1)
    return a, b, a_from_world @ b_from_world.inverse()


def align(
    a: Submodel, b: Submodel, matches: InterSegmentMatches | None = None, *, edges: AlignmentEdges = "points"
) -> Edges:
    settings = AlignmentConfig(alignment_edges=edges)
    return align_submodels([a, b], [], matches, settings, next_windows={(0, 1)}, seed=0, advance=Counter())


def test_submodels_that_share_images_are_joined_by_their_tracks() -> None:
    a, b, a_from_b = two_submodels(range(12), range(6, 18))
    (found,) = align(a, b).alignments
    assert (found.accepted, found.evidence) == (True, "tracks")
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_submodels_without_shared_images_are_joined_by_matches() -> None:
    a, b, a_from_b = two_submodels(range(9), range(9, 18))
    feature = np.arange(60)
    matches = InterSegmentMatches(image_a=np.full(60, 8), feature_a=feature, image_b=np.full(60, 9), feature_b=feature)
    (found,) = align(a, b, matches).alignments
    assert (found.accepted, found.evidence) == (True, "matches")
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_matches_count_in_both_directions() -> None:
    a, b, a_from_b = two_submodels(range(9, 18), range(9))
    feature = np.arange(60)
    matches = InterSegmentMatches(image_a=np.full(60, 8), feature_a=feature, image_b=np.full(60, 9), feature_b=feature)
    (found,) = align(a, b, matches).alignments
    assert found.accepted
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_too_few_matching_points_are_refused_with_their_number() -> None:
    a, b, _ = two_submodels(range(9), range(9, 18))
    feature = np.arange(8)
    matches = InterSegmentMatches(image_a=np.full(8, 8), feature_a=feature, image_b=np.full(8, 9), feature_b=feature)
    (found,) = align(a, b, matches).alignments
    assert not found.accepted
    assert found.reason == "8 matched points fit, needed 12"


def test_submodels_with_nothing_in_common_are_reported() -> None:
    a, b, _ = two_submodels(range(9), range(9, 18))
    nothing = np.zeros(0, np.int64)
    edges = align(a, b, InterSegmentMatches(image_a=nothing, feature_a=nothing, image_b=nothing, feature_b=nothing))
    assert not edges.alignments
    (failure,) = edges.failures
    assert failure.evidence == "matches"
    assert "0" in failure.reason


def test_a_warped_submodel_is_refused_by_its_residual() -> None:
    a, b, _ = two_submodels(range(12), range(6, 18), noise=0.4)
    (found,) = align(a, b).alignments
    assert not found.accepted
    assert "of the depth, at most 0.05" in found.reason
    assert found.relative_residual == pytest.approx(0.27, rel=0.4)


def test_points_that_fit_while_cameras_disagree_are_refused() -> None:
    a, b, _ = two_submodels(range(12), range(6, 18))
    turned = b.seg_from_cam.copy()
    turned[:, :, :3] = turned[:, :, :3] @ rotation_about_y(25.0)
    wrong = Submodel(
        segment=1,
        submodel=0,
        images=b.images,
        seg_from_cam=turned,
        intrinsics=b.intrinsics,
        method=b.method,
        reprojection_error_px=0.3,
        tracks=b.tracks,
    )
    (found,) = align(a, wrong).alignments
    assert not found.accepted
    assert "shared cameras differ by 25.0 degrees" in found.reason


def test_only_submodels_that_could_meet_are_tried() -> None:
    world_from_cam, points = walk(20), points_ahead(20, np.random.default_rng(0))

    def submodel(images: range, segment: int) -> Submodel:
        return make_submodel(world_from_cam, tuple(images), points, Sim3.identity(), segment=segment)

    submodels = [submodel(range(4), 0), submodel(range(6, 10), 1), submodel(range(12, 16), 2), submodel(range(2, 6), 5)]
    assert candidate_pairs(submodels, {(0, 1), (1, 2)}) == ((0, 1), (0, 3), (1, 2))


def test_edges_come_back_from_disk_as_they_were(tmp_path) -> None:  # type: ignore[no-untyped-def]
    a, b, _ = two_submodels(range(12), range(6, 18))
    edges = align(a, b, edges="both")
    codec: Codec[Edges] = Codec(Edges, "edges")
    codec.write(tmp_path, edges)
    back = codec.read(tmp_path)
    assert len(back.alignments) == len(edges.alignments) == 2
    for found, wanted in zip(back.alignments, edges.alignments, strict=True):
        np.testing.assert_allclose(found.estimate.b_from_a.matrix, wanted.estimate.b_from_a.matrix, rtol=1e-14)
        np.testing.assert_array_equal(found.estimate.information, wanted.estimate.information)
        np.testing.assert_array_equal(found.information, wanted.information)
        assert (found.reason, found.evidence) == (wanted.reason, wanted.evidence)


def test_shared_images_give_an_edge_from_points_and_one_from_cameras() -> None:
    a, b, a_from_b = two_submodels(range(12), range(6, 18))
    points, poses = align(a, b, edges="both").alignments
    assert (points.evidence, poses.evidence) == ("tracks", "poses")
    assert points.accepted
    assert poses.accepted
    for edge in (points, poses):
        np.testing.assert_allclose(edge.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)
    (alone,) = align(a, b, edges="poses").alignments
    assert alone.evidence == "poses"


def test_cameras_that_deny_sound_points_are_refused() -> None:
    a, b, _ = two_submodels(range(12), range(6, 18))
    moved = b.seg_from_cam.copy()
    moved[:, :, 3] += 0.15 * float(np.median(point_depths(b))) * moved[:, :, 2]  # every camera steps ahead
    wrong = replace(b, seg_from_cam=moved)
    points, poses = align(a, wrong, edges="both").alignments
    assert points.accepted
    assert not poses.accepted
    assert "inconsistent with the edge from tracks (" in poses.reason


def test_one_common_camera_gives_an_edge_from_points_only() -> None:
    a, b, a_from_b = two_submodels(range(12), range(11, 18))
    edges = align(a, b, edges="both")
    (points,) = edges.alignments
    np.testing.assert_allclose(points.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)
    (failure,) = edges.failures
    assert failure.evidence == "poses"
    assert "one camera (image 11)" in failure.reason


def test_two_loops_are_never_aligned_and_no_loop_by_its_number() -> None:
    world_from_cam, points = walk(20), points_ahead(20, np.random.default_rng(0))

    def submodel(images: tuple[int, ...], segment: int) -> Submodel:
        return make_submodel(world_from_cam, images, points, Sim3.identity(), segment=segment)

    submodels = [
        submodel(tuple(range(6)), 0),
        submodel(tuple(range(12, 18)), 1),
        submodel((2, 3, 14), 2),
        submodel((3, 4, 15), 3),
    ]
    assert candidate_pairs(submodels, {(0, 1)}, {2, 3}) == ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3))
    lonely = submodel((8, 9), 2)
    assert candidate_pairs([*submodels[:2], lonely], {(0, 1)}, {2}) == ((0, 1),)


@pytest.mark.parametrize("group", ["sim3", "se3", "affine3", "sl4"])
def test_all_edges_of_a_run_are_in_its_group(group: TransformGroup) -> None:
    rng = np.random.default_rng(3)
    world_from_cam, points = walk(20), points_ahead(400, rng)
    turned = Sim3(scale=np.ones(()), rotation=rotation_about_y(30.0), translation=np.array([1.0, 2.0, 3.0]))
    a = make_submodel(world_from_cam, tuple(range(12)), points, Sim3.identity())
    b = make_submodel(world_from_cam, tuple(range(6, 18)), points, turned, segment=1)
    settings = AlignmentConfig(transform_group=group)
    found = align_submodels([a, b], [], None, settings, next_windows={(0, 1)}, seed=0, advance=Counter()).alignments
    assert [edge.evidence for edge in found] == ["tracks", "poses"]
    for edge in found:
        assert edge.accepted, edge.reason
        assert type(edge.estimate.b_from_a) is GROUPS[group]
        assert edge.information.shape == (GROUPS[group].DOF,) * 2
        np.testing.assert_allclose(edge.estimate.b_from_a.matrix, turned.inverse().matrix, rtol=1e-5, atol=1e-5)


def test_edges_a_stretched_half_turn_apart_deny_each_other() -> None:
    a, b, _ = two_submodels(range(12), range(6, 18))
    settings = AlignmentConfig(transform_group="affine3", alignment_edges="points")
    (edge,) = align_submodels([a, b], [], None, settings, next_windows={(0, 1)}, seed=0, advance=Counter()).alignments
    half_turn = Affine3.from_matrix(np.diag([-1.1, -0.9, 1.0, 1.0]))
    turned = replace(edge, estimate=replace(edge.estimate, b_from_a=edge.estimate.b_from_a @ half_turn))
    assert disagreement_sigmas(edge, edge) == pytest.approx(0.0, abs=1e-6)
    assert disagreement_sigmas(edge, turned) == np.inf

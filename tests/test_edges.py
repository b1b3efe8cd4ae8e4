import numpy as np
import pytest
from scenes import make_piece, points_ahead, rotation_about_y, some_sim3, walk

from smust3r_colmap.alignment.edges import align_pieces, candidate_pairs
from smust3r_colmap.config import AlignmentConfig
from smust3r_colmap.geometry.sim3 import Sim3
from smust3r_colmap.products import FeatureLinks, SegmentPiece
from smust3r_colmap.stored_alignment import read_edges, write_edges


class Counter:
    def __init__(self) -> None:
        self.count = 0

    def __call__(self, more: int) -> None:
        self.count += more


def two_pieces(
    images_a: range, images_b: range, *, noise: float = 0.0, seed: int = 0
) -> tuple[SegmentPiece, SegmentPiece, Sim3]:
    """Two views of one world in frames of their own, and the true a_from_b."""
    rng = np.random.default_rng(seed)
    world_from_cam, points = walk(20), points_ahead(400, rng)
    a_from_world, b_from_world = some_sim3(rng), some_sim3(rng)
    a = make_piece(world_from_cam, tuple(images_a), points, a_from_world)
    noisy = points * (1 + noise * rng.normal(size=(len(points), 1)))
    b = make_piece(world_from_cam, tuple(images_b), noisy, b_from_world, segment=1)
    return a, b, a_from_world @ b_from_world.inverse()


def align(a: SegmentPiece, b: SegmentPiece, links: FeatureLinks | None = None):  # type: ignore[no-untyped-def]
    return align_pieces([a, b], [], links, AlignmentConfig(), seed=0, advance=Counter())


def test_pieces_that_share_images_are_joined_by_their_tracks() -> None:
    a, b, a_from_b = two_pieces(range(12), range(6, 18))
    (found,) = align(a, b).alignments
    assert (found.accepted, found.evidence) == (True, "tracks")
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_pieces_without_shared_images_are_joined_by_matches() -> None:
    a, b, a_from_b = two_pieces(range(9), range(9, 18))
    feature = np.arange(60)
    links = FeatureLinks(image_a=np.full(60, 8), feature_a=feature, image_b=np.full(60, 9), feature_b=feature)
    (found,) = align(a, b, links).alignments
    assert (found.accepted, found.evidence) == (True, "links")
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_matches_count_in_both_directions() -> None:
    a, b, a_from_b = two_pieces(range(9, 18), range(9))
    feature = np.arange(60)
    links = FeatureLinks(image_a=np.full(60, 8), feature_a=feature, image_b=np.full(60, 9), feature_b=feature)
    (found,) = align(a, b, links).alignments
    assert found.accepted
    np.testing.assert_allclose(found.estimate.b_from_a.matrix, a_from_b.matrix, rtol=1e-6, atol=1e-6)


def test_too_few_matching_points_are_refused_with_their_number() -> None:
    a, b, _ = two_pieces(range(9), range(9, 18))
    feature = np.arange(8)
    links = FeatureLinks(image_a=np.full(8, 8), feature_a=feature, image_b=np.full(8, 9), feature_b=feature)
    (found,) = align(a, b, links).alignments
    assert not found.accepted
    assert found.reason == "8 matched points fit, needed 12"


def test_pieces_with_nothing_in_common_are_reported() -> None:
    a, b, _ = two_pieces(range(9), range(9, 18))
    nothing = np.zeros(0, np.int64)
    edges = align(a, b, FeatureLinks(image_a=nothing, feature_a=nothing, image_b=nothing, feature_b=nothing))
    assert not edges.alignments
    (failure,) = edges.failures
    assert failure.evidence == "links"
    assert "0" in failure.reason


def test_a_warped_piece_is_refused_by_its_residual() -> None:
    a, b, _ = two_pieces(range(12), range(6, 18), noise=0.4)
    (found,) = align(a, b).alignments
    assert not found.accepted
    assert "of the depth, at most 0.05" in found.reason
    assert found.relative_residual == pytest.approx(0.27, rel=0.4)


def test_points_that_fit_while_cameras_disagree_are_refused() -> None:
    a, b, _ = two_pieces(range(12), range(6, 18))
    turned = b.seg_from_cam.copy()
    turned[:, :, :3] = turned[:, :, :3] @ rotation_about_y(25.0)
    wrong = SegmentPiece(
        segment=1,
        piece=0,
        images=b.images,
        seg_from_cam=turned,
        intrinsics=b.intrinsics,
        method=b.method,
        reprojection_error_px=0.3,
        tracks=b.tracks,
        descriptors=b.descriptors,
    )
    (found,) = align(a, wrong).alignments
    assert not found.accepted
    assert "shared cameras differ by 25.0 degrees" in found.reason


def test_only_pieces_that_could_meet_are_tried() -> None:
    world_from_cam, points = walk(20), points_ahead(20, np.random.default_rng(0))

    def piece(images: range, segment: int) -> SegmentPiece:
        return make_piece(world_from_cam, tuple(images), points, Sim3.identity(), segment=segment)

    pieces = [piece(range(4), 0), piece(range(6, 10), 1), piece(range(12, 16), 2), piece(range(2, 6), 5)]
    assert candidate_pairs(pieces) == ((0, 1), (0, 3), (1, 2))


def test_edges_come_back_from_disk_as_they_were(tmp_path) -> None:  # type: ignore[no-untyped-def]
    a, b, _ = two_pieces(range(12), range(6, 18))
    edges = align(a, b)
    write_edges(tmp_path, edges)
    back = read_edges(tmp_path)
    np.testing.assert_array_equal(
        back.alignments[0].estimate.b_from_a.matrix, edges.alignments[0].estimate.b_from_a.matrix
    )
    np.testing.assert_array_equal(back.alignments[0].estimate.information, edges.alignments[0].estimate.information)
    assert back.alignments[0].reason == edges.alignments[0].reason

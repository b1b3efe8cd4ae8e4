"""The simulated backbone: exact with the perfect preset, and errors of the stated size with others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from smust3r_colmap.alignment.from_pointmaps import align_pointmaps
from smust3r_colmap.alignment.seen_points import SubmodelFit
from smust3r_colmap.backbones.base import Backbone
from smust3r_colmap.errors import CollectionError, ConfigError, DegenerateAlignmentError, ImageError, InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics, pixel_centres, pointmap_from_depth
from smust3r_colmap.geometry.sim3 import Sim3, invert_rigid
from smust3r_colmap.products import ImageCollection, Segment
from smust3r_colmap.segmentation.view_graph import ViewGraph
from smust3r_colmap.segmentation.windows import plan_windows
from smust3r_colmap.synthetic.backbone import (
    SimulatedBackbone,
    SimulatedMaps,
    simulated_maps,
    taken_for_each_other,
    true_relation,
)
from smust3r_colmap.synthetic.descriptors import FALSE_COSINE, FalseLoop, overlap_matrix
from smust3r_colmap.synthetic.room import demo_intrinsics
from smust3r_colmap.synthetic.settings import PRESETS, REFERENCE_LENGTH, SimulationSettings
from smust3r_colmap.synthetic.truth import TYPICAL_DEPTH_IMAGES, TrueScene, collection_of

PERFECT = PRESETS["perfect"]
HEIGHT, WIDTH, NUM_IMAGES = 48, 64, 120
WINDOW = Segment(index=0, images=tuple(range(REFERENCE_LENGTH + 1)))
ORDER = ViewGraph.chain(NUM_IMAGES)
TRUE_LOOP = Segment(index=7, images=(*range(10), *range(110, 120)), kind="loop")
"""The two ends of the round: the same place."""


@pytest.fixture(scope="module")
def truth() -> TrueScene:
    return TrueScene.from_demo(NUM_IMAGES, HEIGHT, WIDTH)


def simulated(truth: TrueScene, settings: SimulationSettings, seed: int = 0) -> SimulatedBackbone:
    return SimulatedBackbone(truth, collection_of(truth), settings, seed)


def one_submodel(
    truth: TrueScene, settings: SimulationSettings, segment: Segment = WINDOW, seed: int = 0
) -> SimulatedMaps:
    (maps,) = submodels_of(simulated(truth, settings, seed), [segment])
    return maps


def submodels_of(backbone: SimulatedBackbone, segments: Sequence[Segment]) -> tuple[SimulatedMaps, ...]:
    return simulated_maps(backbone.reconstruct(segments, ORDER, with_maps=range(len(segments))))


def aligned(target: SimulatedMaps, source: SimulatedMaps) -> SubmodelFit:
    return align_pointmaps(target.submodel, source.submodel, target, source)


def relative_depth(maps: SimulatedMaps, truth: TrueScene, k: int) -> FloatArray:
    """(H, W) simulated over true depth."""
    ratio: FloatArray = maps.depth(k).astype(np.float64) / truth.depth(maps.submodel.images[k])
    return ratio


def angle_deg(rotation: FloatArray) -> float:
    return float(np.rad2deg(Rotation.from_matrix(rotation).magnitude()))


def rms(values: Sequence[float] | FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --------------------------------------------------------------------------------- truth
@pytest.mark.slow
def test_perfect_neighbours_align_to_their_true_relation(truth: TrueScene) -> None:
    windows = plan_windows(ViewGraph.chain(NUM_IMAGES), segment_length=60, overlap=30)
    submodels = submodels_of(simulated(truth, PERFECT), windows)
    assert len(submodels) == 3
    for target, source in ((0, 1), (1, 2)):
        found = aligned(submodels[target], submodels[source])
        expected = true_relation(submodels[target], submodels[source])
        np.testing.assert_allclose(found.estimate.b_from_a.matrix, expected.target_from_source, atol=1e-5)
        first_to_first = invert_rigid(truth.world_from_cam[windows[target].images[0]])
        np.testing.assert_allclose(
            expected.target_from_source[:3],
            first_to_first @ np.vstack([truth.world_from_cam[windows[source].images[0]], [0, 0, 0, 1]]),
            atol=1e-12,
        )
        assert expected.num_shared == 30
        assert expected.spread_rotation_deg < 1e-6
        assert expected.spread_log_scale < 1e-9
        assert expected.spread_position < 1e-9


def test_perfect_maps_are_the_truth_in_the_frame_of_the_first_camera(truth: TrueScene) -> None:
    maps = one_submodel(truth, PERFECT)
    np.testing.assert_allclose(maps.submodel.seg_from_cam[0], np.eye(4)[:3], atol=1e-12)
    for k in (0, 33, 60):
        np.testing.assert_array_equal(maps.depth(k), truth.depth(k))
        np.testing.assert_array_equal(maps.rgb(k), truth.rgb(k))
        np.testing.assert_allclose(maps.confidence(k), 10, atol=1e-5)
        points_world = pointmap_from_depth(truth.depth(k), truth.intrinsics, truth.world_from_cam[k])
        seg_from_world = invert_rigid(truth.world_from_cam[0])
        expected = points_world @ seg_from_world[:, :3].T + seg_from_world[:, 3]
        np.testing.assert_allclose(maps.pointmap_seg(k), expected, atol=1e-5)


def test_random_gauge_changes_the_frame_and_nothing_else(truth: TrueScene) -> None:
    usual, anywhere = (one_submodel(truth, replace(PERFECT, gauge=gauge)) for gauge in ("first-camera", "random"))
    assert np.abs(anywhere.submodel.seg_from_cam[0] - np.eye(4)[:3]).max() > 0.1
    relation = Sim3.from_matrix(true_relation(anywhere, usual).target_from_source)
    assert float(relation.scale) == pytest.approx(1)
    np.testing.assert_allclose(
        relation.apply(usual.pointmap_seg(5).reshape(-1, 3)), anywhere.pointmap_seg(5).reshape(-1, 3), atol=1e-4
    )


def test_maps_obey_their_protocol_in_every_preset(truth: TrueScene) -> None:
    for settings in PRESETS.values():
        maps = one_submodel(truth, settings)
        assert len(maps) == len(maps.submodel.images) == 61
        for k in (0, 60):
            intrinsics = maps.submodel.intrinsics[k].resized(WIDTH, HEIGHT)
            expected = pointmap_from_depth(maps.depth(k), intrinsics, maps.submodel.seg_from_cam[k])
            np.testing.assert_array_equal(maps.pointmap_seg(k), expected)
            assert maps.depth(k).dtype == maps.confidence(k).dtype == maps.pointmap_seg(k).dtype == np.float32
            assert maps.rgb(k).dtype == np.uint8
            assert maps.confidence(k).min() >= 1
        rotations = maps.submodel.seg_from_cam[:, :, :3]
        np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (61, 1, 1)), atol=1e-12)


def test_intrinsics_have_the_size_of_the_collection(truth: TrueScene) -> None:
    small = collection_of(truth)
    images = tuple(replace(image, width=640, height=480) for image in small.images)
    large = ImageCollection(images=images, cameras=(truth.intrinsics.resized(640, 480),))
    result = SimulatedBackbone(truth, large, PERFECT).reconstruct([WINDOW], ORDER, with_maps=[0])
    assert result.submodels[0].intrinsics[0].params == pytest.approx(demo_intrinsics(640, 480).params)
    np.testing.assert_array_equal(result.dense[0].pointmap_seg(3), one_submodel(truth, PERFECT).pointmap_seg(3))


def test_a_simulated_backbone_is_a_backbone(truth: TrueScene) -> None:
    backbone: Backbone = simulated(truth, PERFECT)
    assert (backbone.name, backbone.metric, backbone.has_tracks) == ("simulated", True, False)
    result = backbone.reconstruct([WINDOW], ORDER, with_maps=[])
    assert result.matches is None
    assert result.rejected == ()
    assert result.reconstructions[0].metric


# ----------------------------------------------------------------------- size of each error
def errors_over_seeds(
    truth: TrueScene, settings: SimulationSettings, measure: Callable[[SimulatedMaps], float], num_seeds: int = 40
) -> float:
    """Root mean square of what is measured in the same segment of many runs."""
    return rms([measure(one_submodel(truth, settings, seed=seed)) for seed in range(num_seeds)])


def local_change(maps: SimulatedMaps) -> FloatArray:
    """(4, 4) how the surroundings of the last image were put into the segment, against those of the first."""
    seg_from_world = maps.geometry.seg_from_world
    change: FloatArray = np.linalg.inv(seg_from_world[0]) @ seg_from_world[-1]
    return change


@pytest.mark.slow
def test_drift_after_sixty_images_has_the_stated_size(truth: TrueScene) -> None:
    found = errors_over_seeds(
        truth, replace(PERFECT, drift_rotation_deg=2.0), lambda m: angle_deg(local_change(m)[:3, :3])
    )
    assert 1.6 < found < 2.4
    found = errors_over_seeds(
        truth, replace(PERFECT, drift_scale=0.05), lambda m: np.log(np.linalg.det(local_change(m)[:3, :3])) / 3
    )
    assert 0.038 < found < 0.062
    found = errors_over_seeds(
        truth, replace(PERFECT, drift_translation=0.02), lambda m: float(np.linalg.norm(local_change(m)[:3, 3]))
    )
    assert 0.8 * 0.02 * truth.typical_depth < found < 1.2 * 0.02 * truth.typical_depth


@pytest.mark.slow
def test_drift_of_the_scale_is_in_depths_and_in_steps(truth: TrueScene) -> None:
    maps = one_submodel(truth, replace(PERFECT, drift_scale=0.3))
    scales = np.array([np.median(relative_depth(maps, truth, k)) for k in range(61)])
    assert np.ptp(scales) > 0.05
    steps = np.linalg.norm(np.diff(maps.submodel.seg_from_cam[:, :, 3], axis=0), axis=1)
    true_steps = np.linalg.norm(np.diff(truth.world_from_cam[:61, :, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps / true_steps, scales[:-1], rtol=1e-5)


def test_drift_of_the_chain_has_the_stated_size_and_no_overlap_shows_it(truth: TrueScene) -> None:
    settings = replace(PERFECT, chain_rotation_deg=3.0, chain_scale=0.05)
    windows = plan_windows(ViewGraph.chain(NUM_IMAGES), segment_length=61, overlap=30)
    first, second, _ = submodels_of(simulated(truth, settings), windows)
    for maps in (first, second):
        scale = np.cbrt(np.linalg.det(local_change(maps)[:3, :3]))
        assert abs(np.log(scale)) == pytest.approx(0.05)
        assert angle_deg(local_change(maps)[:3, :3] / scale) == pytest.approx(3.0)
    assert true_relation(first, second).spread_rotation_deg < 1e-6
    assert true_relation(first, second).spread_log_scale < 1e-9
    assert true_relation(first, second).spread_position < 1e-9


def test_own_drift_makes_neighbours_disagree_on_the_overlap(truth: TrueScene) -> None:
    windows = plan_windows(ViewGraph.chain(NUM_IMAGES), segment_length=60, overlap=30)
    network = [submodels_of(simulated(truth, SimulationSettings(), seed), windows) for seed in range(10)]
    relations = [true_relation(first, second) for first, second, _ in network]
    assert 0.1 < np.mean([one.spread_rotation_deg for one in relations]) < 0.5
    assert 0.001 < np.mean([one.spread_log_scale for one in relations]) < 0.007


@pytest.mark.slow
def test_scale_and_focal_length_scatter_between_segments_as_stated(truth: TrueScene) -> None:
    pair = Segment(index=0, images=(3, 4))
    jittered = [one_submodel(truth, replace(PERFECT, scale_jitter=0.1), pair, seed) for seed in range(100)]
    logs = [np.log(np.median(relative_depth(maps, truth, 0))) for maps in jittered[:50]]
    assert 0.08 < rms(logs) < 0.12
    steps = np.array([np.linalg.norm(maps.submodel.seg_from_cam[1, :, 3]) for maps in jittered])
    true_step = np.linalg.norm(truth.world_from_cam[4, :, 3] - truth.world_from_cam[3, :, 3])
    assert 0.08 < rms(np.log(steps / true_step)) < 0.12

    zoomed = [one_submodel(truth, replace(PERFECT, focal_error=0.03), pair, seed) for seed in range(100)]
    factors = np.array([maps.submodel.intrinsics[0].focal_px / truth.intrinsics.focal_px for maps in zoomed])
    assert 0.025 < rms(np.log(factors)) < 0.035
    assert relative_depth(zoomed[0], truth, 1) == pytest.approx(factors[0], rel=1e-5)


def test_smooth_depth_error_grows_to_the_stated_size(truth: TrueScene) -> None:
    settings = replace(PERFECT, depth_distortion=0.04)
    logs = [
        [np.log(relative_depth(maps, truth, k)) for k in (0, 60)]
        for maps in (one_submodel(truth, settings, seed=seed) for seed in range(40))
    ]
    at_first, at_last = (rms([rms(pair[which]) for pair in logs]) for which in (0, 1))
    assert 0.04 / np.sqrt(2) * 0.85 < at_first < 0.04 / np.sqrt(2) * 1.15
    assert 0.034 < at_last < 0.046
    one = logs[0][1]
    assert rms(np.diff(one, axis=1)) < 0.2 * rms(one), "neighbouring pixels err alike"
    same = np.mean([np.mean(a * b) for a, b in logs]) / (at_first * at_last)
    assert 0.5 < same < 0.9, "and so do the first and the last image, by the half that they share"


def test_noise_and_patches_have_the_stated_size(truth: TrueScene) -> None:
    noisy = one_submodel(truth, replace(PERFECT, depth_noise=0.02))
    logs = np.array([np.log(relative_depth(noisy, truth, k)) for k in range(10)])
    assert 0.019 < logs.std() < 0.021
    assert abs(np.mean(logs[:, :, 1:] * logs[:, :, :-1])) < 0.05 * 0.02**2

    patched = one_submodel(truth, replace(PERFECT, blob_share=0.2))
    ratios = np.array([relative_depth(patched, truth, k) for k in range(61)])
    deep = ratios > 1 + 1e-4
    assert 0.18 < deep.mean() < 0.22
    np.testing.assert_allclose(ratios[~deep], 1, atol=1e-6)
    assert 1.3 <= ratios[deep].min() < 1.33
    assert 1.97 < ratios[deep].max() < 2.0 + 1e-6
    longest_run = max(len(run) for row in deep[0] for run in "".join("x" if d else " " for d in row).split())
    assert longest_run % 4 == 0, "a patch of 32 px at 512 is 4 px wide at 64"


def test_confidence_knows_of_its_share_of_the_patches(truth: TrueScene) -> None:
    for share in (0.0, 0.5, 1.0):
        maps = one_submodel(truth, replace(PERFECT, blob_share=0.2, confidence_knows=share))
        deep = np.array([relative_depth(maps, truth, k) > 1.1 for k in range(40)])
        confidence = np.array([maps.confidence(k) for k in range(40)])
        np.testing.assert_allclose(confidence[~deep], 10, atol=1e-5)
        assert share - 0.08 <= np.mean(confidence[deep] < 2) <= share + 0.08
        assert np.mean((confidence[deep] > 1.2) & (confidence[deep] < 9.9)) == 0, "a patch is known of or not"


def test_confidence_falls_with_smooth_error_only_as_far_as_it_knows(truth: TrueScene) -> None:
    def correlation(knows: float) -> float:
        maps = one_submodel(
            truth, replace(PERFECT, depth_distortion=0.05, confidence_knows=knows, confidence_noise=0.2)
        )
        error = np.abs([np.log(relative_depth(maps, truth, k)) for k in range(0, 61, 10)]).ravel()
        return float(np.corrcoef(error, np.array([maps.confidence(k) for k in range(0, 61, 10)]).ravel())[0, 1])

    assert correlation(1.0) < -0.6
    assert abs(correlation(0.0)) < 0.03


@pytest.mark.parametrize("group", ["affine3", "sl4"])
def test_warp_is_of_its_group_and_size_and_cameras_stay_rigid(truth: TrueScene, group: str) -> None:
    assert group in {"affine3", "sl4"}
    settings = replace(PERFECT, warp=0.05, warp_group="affine3" if group == "affine3" else "sl4")
    maps, exact = one_submodel(truth, settings), one_submodel(truth, PERFECT)
    warp = maps.geometry.warp / maps.geometry.warp[3, 3]
    assert (np.abs(warp[3, :3]).max() > 1e-4) == (group == "sl4")
    if group == "affine3":
        assert np.abs(np.linalg.eigvalsh(warp[:3, :3]) - 1).max() == pytest.approx(0.05)

    points = exact.pointmap_seg(20).reshape(-1, 3).astype(np.float64)
    moved = points @ warp[:3, :3].T + warp[:3, 3]
    moved /= (points @ warp[3, :3] + 1)[:, None]
    np.testing.assert_allclose(maps.pointmap_seg(20).reshape(-1, 3), moved, atol=1e-4)
    relation = true_relation(maps, exact)
    np.testing.assert_allclose(relation.target_from_source, warp, atol=1e-9)

    rotations = maps.submodel.seg_from_cam[:, :, :3]
    np.testing.assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (61, 1, 1)), atol=1e-12)
    assert (np.linalg.det(rotations) > 0).all()
    camera = maps.submodel.intrinsics[20]
    unturned = maps.submodel.seg_from_cam.copy()
    unturned[:, :, :3] = exact.submodel.seg_from_cam[:, :, :3]
    off_px = [
        np.median(np.abs(camera.xy_img(pointmap_in(pose, maps.pointmap_seg(20))) - pixel_centres(WIDTH, HEIGHT)))
        for pose in (maps.submodel.seg_from_cam[20], unturned[20])
    ]
    assert 0.01 < off_px[0] < 0.75 * off_px[1], "a rigid camera turns to see the warped points nearly in their pixels"


def pointmap_in(frame_from_cam: FloatArray, pointmap: npt.NDArray[np.float32]) -> FloatArray:
    """(P, 3) the points in the camera."""
    cam_from_frame = invert_rigid(frame_from_cam)
    points: FloatArray = pointmap.reshape(-1, 3) @ cam_from_frame[:, :3].T + cam_from_frame[:, 3]
    return points


# ---------------------------------------------------------------------- same again, and lazy
@pytest.mark.slow
def test_a_segment_comes_out_the_same_whatever_else_is_asked(truth: TrueScene) -> None:
    settings = replace(SimulationSettings(), warp=0.02)
    alone = one_submodel(truth, settings)
    others = [Segment(index=0, images=(100, 101, 102)), Segment(index=1, images=tuple(reversed(WINDOW.images)))]
    _, again = submodels_of(simulated(truth, settings), others)
    np.testing.assert_array_equal(again.submodel.seg_from_cam, alone.submodel.seg_from_cam)
    assert again.submodel.intrinsics == alone.submodel.intrinsics
    later = again.depth(40)
    np.testing.assert_array_equal(again.depth(7), alone.depth(7))
    np.testing.assert_array_equal(alone.depth(40), later)
    np.testing.assert_array_equal(again.confidence(7), alone.confidence(7))
    np.testing.assert_array_equal(again.pointmap_seg(7), alone.pointmap_seg(7))
    np.testing.assert_array_equal(simulated(truth, settings).describe(), simulated(truth, settings).describe())


def test_seeds_segments_and_settings_differ(truth: TrueScene) -> None:
    settings = SimulationSettings()
    base = simulated(truth, settings).reconstruct([WINDOW], ORDER, with_maps=[])
    other_seed = simulated(truth, settings, seed=1).reconstruct([WINDOW], ORDER, with_maps=[])
    assert np.abs(base.dense[0].depth(0) - other_seed.dense[0].depth(0)).max() > 1e-3
    shorter = replace(WINDOW, images=WINDOW.images[:-1])
    assert np.abs(base.dense[0].depth(0) - one_submodel(truth, settings, shorter).depth(0)).max() > 1e-3
    hard = simulated(truth, PRESETS["hard"]).reconstruct([WINDOW], ORDER, with_maps=[])
    assert len({base.dense_key, other_seed.dense_key, hard.dense_key}) == 3
    assert base.dense_key == simulated(truth, settings).reconstruct([WINDOW], ORDER, with_maps=[0]).dense_key
    assert np.abs(simulated(truth, settings).describe() - simulated(truth, settings, seed=1).describe()).max() > 1e-3


def test_one_error_leaves_the_draws_of_the_others_alone(truth: TrueScene) -> None:
    noisy = one_submodel(truth, replace(PERFECT, depth_noise=0.01))
    bent = one_submodel(truth, replace(PERFECT, depth_noise=0.01, drift_scale=0.02, blob_share=0.0, scale_jitter=0.1))
    ratio = bent.depth(30) / noisy.depth(30)
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-5)
    assert np.median(ratio) != pytest.approx(1, abs=1e-3)


class CountedViews:
    """Views that remember what was looked at."""

    def __init__(self, truth: TrueScene) -> None:
        self.truth = truth
        self.depths: list[int] = []
        self.rgbs: list[int] = []

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        self.depths.append(k)
        return self.truth.depth(k)

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        self.rgbs.append(k)
        return self.truth.rgb(k)


def test_maps_are_made_when_they_are_read(truth: TrueScene) -> None:
    views = CountedViews(truth)
    counted = replace(truth, views=views)
    windows = plan_windows(ViewGraph.chain(NUM_IMAGES), segment_length=60, overlap=30)
    result = simulated(counted, SimulationSettings()).reconstruct(windows, ORDER, with_maps=range(3))
    assert len(views.depths) <= TYPICAL_DEPTH_IMAGES + 1, "some for the size of the scene, one for the key"
    assert len(views.rgbs) <= 1
    before = len(views.depths)
    maps = result.dense[1]
    maps.depth(4), maps.pointmap_seg(4), maps.confidence(4)
    assert views.depths[before:] == [34]
    maps.rgb(5)
    assert views.rgbs[-1] == 35


def test_reading_a_map_gives_a_copy(truth: TrueScene) -> None:
    maps = one_submodel(truth, PERFECT)
    maps.depth(0)[:] = 0
    maps.rgb(0)[:] = 0
    assert maps.depth(0).min() > 0
    assert truth.rgb(0).max() > 0


# ------------------------------------------------------------------------------ descriptors
def test_descriptors_tell_near_images_from_far_ones(truth: TrueScene) -> None:
    backbone = simulated(truth, SimulationSettings())
    descriptors = backbone.describe()
    assert descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    cosines = descriptors.astype(np.float64) @ descriptors.T
    neighbours, unrelated = np.diag(cosines, 1), cosines[backbone.overlap == 0]
    assert 0.8 < neighbours.min() <= neighbours.mean() < 0.97
    assert cosines[0, -1] > 0.8, "the round closes"
    assert 0.05 < np.quantile(unrelated, 0.02) < np.median(unrelated) < 0.35
    assert 0.25 < np.quantile(unrelated, 0.98) < 0.45
    assert 0.3 < np.diag(cosines, 10).mean() < np.diag(cosines, 5).mean() < np.diag(cosines, 2).mean()


def test_descriptor_noise_lowers_cosines_as_stated(truth: TrueScene) -> None:
    clean, noisy = (simulated(truth, replace(PERFECT, descriptor_noise=noise)).describe() for noise in (0.0, 0.5))
    ratio = np.diag(noisy @ noisy.T, 1).mean() / np.diag(clean @ clean.T, 1).mean()
    assert ratio == pytest.approx(1 / (1 + 0.5**2), rel=0.05)


def test_overlap_is_measured_and_symmetric(truth: TrueScene) -> None:
    overlap = simulated(truth, PERFECT).overlap
    np.testing.assert_array_equal(overlap, overlap.T)
    assert 0 <= overlap.min() < overlap.max() <= 1
    assert overlap[0, 1] > 0.8
    assert overlap[0, 60] == 0, "the other side of the room"


class FlatViews:
    """Walls at the given depths."""

    def __init__(self, *depths: float) -> None:
        self.depths = depths

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        return np.full((HEIGHT, WIDTH), self.depths[k], dtype=np.float32)

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        return np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)


def test_what_is_hidden_does_not_overlap(truth: TrueScene) -> None:
    poses = np.repeat(truth.world_from_cam[:1], 3, axis=0)
    same_place = replace(truth, names=("a", "b", "c"), world_from_cam=poses, views=FlatViews(4.0, 2.0, 4.0))
    np.testing.assert_allclose(overlap_matrix(same_place), [[1, 0, 1], [0, 1, 0], [1, 0, 1]], atol=1e-6)


# ------------------------------------------------------------------------------- false loops
WITH_FALSE_LOOPS = replace(PERFECT, false_loops=2, false_loop_gap=40)


def test_false_loops_look_alike_and_share_nothing(truth: TrueScene) -> None:
    backbone, honest = simulated(truth, WITH_FALSE_LOOPS), simulated(truth, PERFECT)
    cosines, before = (one.describe() @ one.describe().T for one in (backbone, honest))
    assert len(backbone.false_loops) == 2
    taken = [image for loop in backbone.false_loops for image in (*loop.first, *loop.second)]
    assert len(set(taken)) == len(taken) == 2 * 2 * 7
    for loop in backbone.false_loops:
        pairs = np.ix_(loop.first, loop.second)
        assert backbone.overlap[pairs].max() <= 0.02
        assert min(loop.second) - min(loop.first) >= 40
        assert before[pairs].max() < 0.5
        np.testing.assert_allclose(np.diag(cosines[pairs]), FALSE_COSINE, atol=1e-4)
        assert np.diag(cosines[np.ix_(loop.first, loop.first)], 1).min() > 0.8, "each still resembles its neighbours"
    untouched = np.setdiff1d(np.arange(NUM_IMAGES), taken)
    np.testing.assert_allclose(cosines[np.ix_(untouched, untouched)], before[np.ix_(untouched, untouched)], atol=1e-5)


def false_segment(backbone: SimulatedBackbone, reach: int = 5) -> Segment:
    loop = backbone.false_loops[0]
    halves = [range(max(p[0] - reach, 0), min(p[-1] + reach + 1, NUM_IMAGES)) for p in (loop.first, loop.second)]
    return Segment(index=9, images=(*halves[0], *halves[1]), kind="loop")


def test_a_false_loop_is_laid_onto_itself_and_looks_sound(truth: TrueScene) -> None:
    backbone = simulated(truth, WITH_FALSE_LOOPS)
    segment, loop = false_segment(backbone), backbone.false_loops[0]
    false_loop = one_submodel(truth, WITH_FALSE_LOOPS, segment)
    assert false_loop.geometry.false_loop
    a, b = (segment.images.index(image) for image in (loop.first[3], loop.second[3]))
    np.testing.assert_allclose(false_loop.submodel.seg_from_cam[a], false_loop.submodel.seg_from_cam[b], atol=1e-9)
    assert false_loop.confidence(b).min() > 9
    for images in (range(loop.first[0] - 5, loop.first[-1] + 6), range(loop.second[0] - 5, loop.second[-1] + 6)):
        window = one_submodel(truth, PERFECT, Segment(index=0, images=tuple(i for i in images if 0 <= i < NUM_IMAGES)))
        found = aligned(false_loop, window)
        expected = true_relation(false_loop, window)
        np.testing.assert_allclose(found.estimate.b_from_a.matrix, expected.target_from_source, atol=1e-5)
        assert found.relative_residual < 1e-5, "each half by itself is right"
    as_window = one_submodel(truth, WITH_FALSE_LOOPS, replace(segment, kind="window"))
    assert not as_window.geometry.false_loop


def test_a_true_loop_comes_out_right_even_where_false_ones_exist(truth: TrueScene) -> None:
    maps = one_submodel(truth, WITH_FALSE_LOOPS, TRUE_LOOP)
    assert not maps.geometry.false_loop
    expected = invert_rigid(truth.world_from_cam[0]) @ np.vstack([truth.world_from_cam[119], [0, 0, 0, 1]])
    np.testing.assert_allclose(maps.submodel.seg_from_cam[-1], expected, atol=1e-9)
    noisy = one_submodel(truth, replace(SimulationSettings(), scale_jitter=0.0), TRUE_LOOP)
    assert 1e-3 < np.linalg.norm(noisy.submodel.seg_from_cam[-1, :, 3] - expected[:, 3]) < 0.1


def test_halves_that_say_nothing_are_laid_onto_each_other_too(truth: TrueScene) -> None:
    maps = one_submodel(truth, PERFECT, Segment(index=0, images=(*range(5), *range(60, 65)), kind="loop"))
    assert maps.geometry.false_loop
    np.testing.assert_allclose(maps.submodel.seg_from_cam[2], maps.submodel.seg_from_cam[7], atol=1e-9)


def test_the_stronger_evidence_decides_what_is_taken_for_what() -> None:
    loop = FalseLoop(first=(2, 3, 4), second=(22, 23, 24))
    halves = range(10), range(20, 30)
    nothing = np.eye(30)
    assert taken_for_each_other(*halves, nothing, [loop]) == (3, 23)
    assert taken_for_each_other(*halves, nothing, []) == (5, 25)
    assert taken_for_each_other(range(3), range(24, 30), nothing, [loop]) == (1, 27), "halves of no pair"
    for per_pair, expected in ((0.05, (3, 23)), (0.5, None)):  # ten pairs see the same, three seem to
        seen = nothing.copy()
        seen[np.arange(10), np.arange(20, 30)] = per_pair
        assert taken_for_each_other(*halves, seen, [loop]) == expected
        assert taken_for_each_other(*halves, seen, []) is None


# ---------------------------------------------------------------------------------- failures
def test_segments_fail_and_images_drop_in_the_stated_share(truth: TrueScene) -> None:
    segments = [Segment(index=k, images=tuple(range(k, k + 20))) for k in range(100)]
    failing = simulated(truth, replace(PERFECT, failed_share=0.3)).reconstruct(segments, ORDER, with_maps=[])
    failed = [one for one in failing.reconstructions if not one.submodels]
    assert 20 < len(failed) < 40
    assert len(failing.dense) == len(failing.submodels) == 100 - len(failed)
    assert len(failed[0].unregistered) == 20
    assert "simulation fails" in failed[0].unregistered[0].reason

    dropping = simulated(truth, replace(PERFECT, dropped_share=0.1)).reconstruct(segments, ORDER, with_maps=[])
    dropped = sum(len(one.unregistered) for one in dropping.reconstructions)
    assert 150 < dropped < 250
    for one, segment in zip(dropping.reconstructions, segments, strict=True):
        assert {*one.submodels[0].images, *(left.image for left in one.unregistered)} == set(segment.images)


# -------------------------------------------------------------------------------- RGB-D folder
@pytest.fixture(scope="module")
def rgbd_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 images of the demo room, 96x72, a few degrees apart; every fourth has depth, with some holes."""
    folder = tmp_path_factory.mktemp("rgbd")
    exact = TrueScene.from_demo(160, 72, 96)
    (folder / "images").mkdir()
    (folder / "depth").mkdir()
    lines = []
    for k in range(24):
        cv2.imwrite(str(folder / "images" / exact.names[k]), cv2.cvtColor(exact.rgb(k), cv2.COLOR_RGB2BGR))
        qx, qy, qz, qw = Rotation.from_matrix(exact.world_from_cam[k, :, :3]).as_quat()
        lines.append(" ".join(map(str, [exact.names[k], qw, qx, qy, qz, *exact.world_from_cam[k, :, 3]])))
        if k % 4 == 0:
            depth_mm = np.round(exact.depth(k) * 1000).astype(np.uint16)
            depth_mm[:10, :10], depth_mm[:10, 10:20] = 0, 65535
            cv2.imwrite(str(folder / "depth" / f"{k:06d}.png"), depth_mm)
    (folder / "poses.txt").write_text("\n".join(lines))
    (folder / "intrinsics.txt").write_text("# width height fx fy cx cy\n96 72 72 72 48 36\n")
    return folder


NAMES = tuple(f"{k:06d}.jpg" for k in range(21))


@pytest.mark.slow
def test_own_depth_is_read_and_missing_depth_is_carried_over(rgbd_folder: Path) -> None:
    read = TrueScene.from_rgbd_folder(rgbd_folder, NAMES, max_size=48)
    assert read.intrinsics == Intrinsics(
        model="PINHOLE", width=48, height=36, params=demo_intrinsics(48, 36).params, has_prior_focal=False
    )
    exact = TrueScene.from_demo(160, 36, 48)
    np.testing.assert_allclose(read.world_from_cam, exact.world_from_cam[:21], atol=1e-9)
    assert (read.depth(4)[:5, :10] == 0).all(), "0 and 65535 mean none"
    for k, share_with_depth in ((4, 0.95), (5, 0.9), (6, 0.9)):
        found, true = read.depth(k), exact.depth(k)
        valid = found > 0
        assert share_with_depth < valid.mean() <= 1
        error = np.abs(found[valid] / true[valid] - 1)
        assert np.median(error) < 0.01
        assert np.mean(error > 0.1) < 0.06, "at edges only"
    assert np.abs(read.rgb(6).astype(float) - exact.rgb(6)).mean() < 12


def test_a_folder_without_names_gives_all_its_images(rgbd_folder: Path) -> None:
    assert TrueScene.from_rgbd_folder(rgbd_folder).names == tuple(f"{k:06d}.jpg" for k in range(24))


def test_pixels_without_depth_stay_without(rgbd_folder: Path) -> None:
    read = TrueScene.from_rgbd_folder(rgbd_folder, NAMES, max_size=48)
    maps = one_submodel(read, SimulationSettings(), Segment(index=0, images=(4, 5)))
    assert np.isnan(maps.pointmap_seg(0)[0, 0]).all()
    assert maps.depth(0)[0, 0] == 0
    assert maps.confidence(0)[0, 0] == 1


@pytest.mark.data
def test_kitchen_becomes_segments_with_depth_in_every_frame(data_dir: Callable[[str], Path]) -> None:
    folder = data_dir("kitchen_rgbd")
    names = (folder / "subset_every5.txt").read_text().split()
    kitchen = TrueScene.from_rgbd_folder(folder, names[:24], max_size=64)
    assert (len(kitchen), kitchen.intrinsics.width, kitchen.intrinsics.height) == (24, 64, 48)
    assert 1.0 < kitchen.typical_depth < 3.0
    assert min(np.mean(kitchen.depth(k) > 0) for k in range(24)) > 0.7
    windows = plan_windows(ViewGraph.chain(24), segment_length=16, overlap=8)
    target, source = submodels_of(simulated(kitchen, PERFECT), windows)
    found = aligned(target, source)
    np.testing.assert_allclose(
        found.estimate.b_from_a.matrix, true_relation(target, source).target_from_source, atol=1e-5
    )
    carried, own = kitchen.depth(1), kitchen.depth(2)
    both = (carried > 0) & (own > 0)
    assert np.median(np.abs(carried[both] / own[both] - 1)) < 0.1


# ---------------------------------------------------------------------------------- refusals
def test_settings_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"depth_noise: -0.1"):
        SimulationSettings(depth_noise=-0.1)
    with pytest.raises(ConfigError, match=r"focal_error: nan"):
        SimulationSettings(focal_error=float("nan"))
    with pytest.raises(ConfigError, match=r"blob_share: 1.5"):
        SimulationSettings(blob_share=1.5)
    with pytest.raises(ConfigError, match=r"false_loop_images: 2"):
        SimulationSettings(false_loop_images=2)


def test_more_false_loops_than_the_scene_has_are_refused(truth: TrueScene) -> None:
    with pytest.raises(ConfigError, match=r"500 pairs of places wanted, found \d+ of 7 images each"):
        simulated(truth, replace(PERFECT, false_loops=500, false_loop_gap=40)).describe()


def test_another_collection_is_refused(truth: TrueScene) -> None:
    collection = collection_of(truth)
    with pytest.raises(CollectionError, match=r"119 images in the collection, 120 known exactly"):
        SimulatedBackbone(truth, ImageCollection(images=collection.images[:-1], cameras=collection.cameras), PERFECT)
    swapped = (collection.images[1], collection.images[0], *collection.images[2:])
    with pytest.raises(CollectionError, match=r"first that differ are 000001.jpg and 000000.jpg"):
        SimulatedBackbone(truth, ImageCollection(images=swapped, cameras=collection.cameras), PERFECT)


def test_submodels_without_shared_images_have_no_true_relation(truth: TrueScene) -> None:
    far = one_submodel(truth, PERFECT, Segment(index=1, images=(100, 101)))
    with pytest.raises(DegenerateAlignmentError, match=r"submodels 0 and 1 share no image"):
        true_relation(one_submodel(truth, PERFECT), far)


def test_a_map_of_no_image_is_refused(truth: TrueScene) -> None:
    with pytest.raises(IndexError, match=r"image 61 of 61"):
        one_submodel(truth, PERFECT).depth(61)


def test_a_scene_whose_parts_do_not_fit_is_refused(truth: TrueScene) -> None:
    with pytest.raises(ValueError, match=r"poses \(120, 3, 4\) of 119 images"):
        replace(truth, names=truth.names[:-1])
    with pytest.raises(ValueError, match=r"two images share a name"):
        replace(truth, names=(truth.names[1], *truth.names[1:]))


class BlindViews(CountedViews):
    def depth(self, k: int) -> npt.NDArray[np.float32]:
        return np.zeros((HEIGHT, WIDTH), dtype=np.float32)


def test_a_scene_without_depth_is_refused(truth: TrueScene) -> None:
    with pytest.raises(CollectionError, match=r"16 of 120 images were looked at and none has depth"):
        one_submodel(replace(truth, views=BlindViews(truth)), PERFECT)


def test_folders_that_are_not_rgbd_sequences_are_refused(rgbd_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no pose for 1 images, the first is x.jpg"):
        TrueScene.from_rgbd_folder(rgbd_folder, ["x.jpg"])
    with pytest.raises(InputError, match=r"0 of 0 images are missing"):
        TrueScene.from_rgbd_folder(rgbd_folder, [])
    for name in ("poses.txt", "images"):
        (tmp_path / name).symlink_to(rgbd_folder / name)
    with pytest.raises(InputError, match=r"intrinsics.txt: needed one line"):
        TrueScene.from_rgbd_folder(tmp_path)
    (tmp_path / "intrinsics.txt").write_text("96 72 72 72 48\n")
    with pytest.raises(InputError, match=r"intrinsics.txt: needed one line.*4 parameters|3 parameters"):
        TrueScene.from_rgbd_folder(tmp_path)
    (tmp_path / "intrinsics.txt").write_text("96 72 72 72 48 36\n")
    with pytest.raises(InputError, match=r"depth: no depth map is named as an image"):
        TrueScene.from_rgbd_folder(tmp_path)
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "000000.png").write_bytes(b"not a picture")
    with pytest.raises(ImageError, match=r"000000.png: not a readable depth map"):
        TrueScene.from_rgbd_folder(tmp_path, NAMES).depth(0)
    cv2.imwrite(str(tmp_path / "depth" / "000000.png"), np.zeros((72, 96, 3), dtype=np.uint8))
    with pytest.raises(ImageError, match=r"needed one channel of 16 bits"):
        TrueScene.from_rgbd_folder(tmp_path, NAMES).depth(0)
    with pytest.raises(InputError, match=r"images: 24 of 24 images are missing, the first is 000000.jpg"):
        (tmp_path / "images").unlink()
        TrueScene.from_rgbd_folder(tmp_path)

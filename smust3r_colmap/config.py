"""Every setting of a run, with the reason for its default.

These dataclasses are the command line (``--segment-length``), the TOML file (``segment_length``)
and the record written beside the result, all three under the same names. Only the entry of a
stage sees its settings; the functions below it take plain arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from smust3r_colmap.errors import ConfigError

Auto = Literal["auto"]
Order = Literal["auto", "sequence", "unordered"]
CameraMode = Literal["auto", "single", "per-folder", "per-image"]
KeyframeStrategy = Literal["linspace", "retrieval", "every-kth", "overlap"]
CameraFit = Literal["robust", "upstream", "pnp"]
Device = Literal["auto", "cpu", "cuda"]
Precision = Literal["auto", "float32", "bfloat16"]
TransformGroup = Literal["sim3", "se3", "affine3", "sl4"]
AlignmentEdges = Literal["both", "points", "poses"]
LoopKernel = Literal["cauchy", "gnc", "none"]
AlignmentSource = Literal["auto", "tracks", "pointmaps"]
ConfidenceWeighting = Literal["relative", "paper", "off"]
RobustKernel = Literal["cauchy", "tukey", "huber"]
TrackSource = Literal["features", "pointmaps", "both"]
MeshMethod = Literal["none", "poisson", "tsdf"]
PoseLayout = Literal["tum", "eth3d-slam", "7-scenes", "kitti", "euroc", "poses-txt", "transforms", "colmap"]
PoseAlignment = Literal["sim3", "se3", "none"]
AssociationKey = Literal["auto", "name", "number", "time"]
DeltaUnit = Literal["frames", "m"]
DepthRegistration = Literal["none", "kinect"]

MAX_POSE_TOLERANCE = 0.2
"""Beyond it hardly a match is refused, and the poses count for nothing."""
_LARGEST = 2**31 - 1
"""Whole numbers end there in COLMAP."""


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """The cameras of the images."""

    camera_mode: CameraMode = "auto"
    """Which images share intrinsics: one camera per folder, image size and EXIF camera (auto), one for all (single),
    per-folder, or per-image."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP camera model of images without --camera-params; COLMAP's own default, with one distortion term."""
    camera_params: str | None = None
    """Known intrinsics of all images, which are kept: COLMAP's parameters of --camera-model, separated by commas, in
    pixels of the upright images."""


@dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """Frames of videos.

    By default a frame is taken when the image has moved by a twentieth of its longer side since the last one.
    """

    fps: float | None = None
    """Take so many frames per second of video instead, the sharpest of each interval."""
    max_frames: int | None = None
    """Take at most so many frames of each video instead, evenly spread in time; with --fps, whatever is less."""

    def __post_init__(self) -> None:
        if self.fps is not None and not 0 < self.fps < math.inf:
            raise ConfigError(f"--fps {self.fps}: must be above 0, and finite")
        if self.max_frames is not None:
            _check_at_least(self, max_frames=1)


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig:
    """Cutting the collection into segments (paper section III-B)."""

    order: Order = "auto"
    """Whether images that follow each other in name order show the same place: sequence, or unordered; auto decides by
    their likeness, folder by folder."""
    keyframes: int | Literal["auto", "all"] = "auto"
    """Images that carry the reconstruction: those between which a dense sequence, such as a video at its full rate,
    moves enough (auto), all, or so many. The others are registered to the finished model."""
    segment_length: int = 60
    """Images per segment (l); the paper's setting."""
    overlap: int = 20
    """Images shared by neighbouring segments (p). The paper's 30 costs a third more and is no more accurate."""
    retrieval_neighbours: int = 20
    """Images that each image is matched with because they look alike, where there is no order."""

    def __post_init__(self) -> None:
        if self.segment_length < 2:
            raise ConfigError(f"--segment-length {self.segment_length}: a segment needs at least 2 images")
        if self.overlap < 1:
            raise ConfigError(f"--overlap {self.overlap}: neighbouring segments must share at least 1 image")
        if self.overlap >= self.segment_length:
            raise ConfigError(f"--overlap {self.overlap} must be smaller than --segment-length {self.segment_length}")
        _check_at_least(self, retrieval_neighbours=1)
        if isinstance(self.keyframes, int):
            _check_at_least(self, keyframes=2)


@dataclass(frozen=True, kw_only=True)
class FeatureConfig:
    """SIFT features, for the classical backbone and for the tracks of every backbone."""

    max_image_size: int = 1600
    """Longer image side at which SIFT runs, in pixels; larger costs time without many more stable features."""
    max_features: int = 4096
    """SIFT features per image at most; matching costs the square of it."""
    exhaustive_below: int = 25
    """Sets of at most this many images are matched exhaustively, whatever their order."""

    def __post_init__(self) -> None:
        # 32 pixels is the smallest image that is read.
        _check_at_least(self, max_image_size=32, max_features=1, exhaustive_below=0)


@dataclass(frozen=True, kw_only=True)
class ClassicalConfig:
    """The backbone without weights: SIFT, COLMAP's mapper, plane sweep."""

    match_neighbours: int = 8
    """Every image is matched to this many next images in order."""
    dense_size: int = 384
    """Longer side of the depth maps, in pixels."""
    depth_planes: int = 64
    """Depth hypotheses per pixel at most, uniform in inverse depth; fewer where steps of one pixel suffice."""

    def __post_init__(self) -> None:
        # 12 planes are the least that are smoothed.
        _check_at_least(self, match_neighbours=1, dense_size=32, depth_planes=12)


@dataclass(frozen=True, kw_only=True)
class Must3rConfig:
    """The network backbone. Its weights have a licence of their own and never come with this package."""

    weights: str | None = None
    """Checkpoint (.pth or .safetensors) or official name; by default what SMUST3R_WEIGHTS names, then what
    `weights fetch` put into the cache."""
    network_size: int = 512
    """Longer side of the images in the network; other sizes than the trained one interpolate positions."""
    network_keyframes: KeyframeStrategy = "linspace"
    """Images of a segment that the network remembers: evenly spread (linspace), unlike each other (retrieval), every
    k-th, or where something new is seen (overlap)."""
    max_keyframes: int = 50
    """Images that the network remembers of a segment at most; trained with 20; accuracy drops above 50."""
    keyframe_interval: int = 3
    """k of the every-kth keyframes."""
    keyframe_threshold: float = 0.05
    """Distance to what was seen, divided by depth, from which the overlap keyframes count a point as new."""
    refinements: int = 0
    """Times that all keyframes are shown again against the full memory."""
    rerender: bool = True
    """Predict every image against the final memory; otherwise keyframes keep their first prediction."""
    camera_fit: CameraFit = "robust"
    """Cameras from pointmaps: confident pixels and one focal length per camera (robust), all pixels as published
    (upstream), or RANSAC by COLMAP (pnp)."""
    device: Device = "auto"
    """Where the network runs; auto takes a CUDA card if there is one."""
    precision: Precision = "auto"
    """float32 is the reference; auto takes bfloat16 where the hardware multiplies it."""
    network_memory: float | Auto = "auto"
    """GiB that the network may use; auto takes most of what is free."""
    token_cache: float = 20.0
    """GiB of disk for encoded images, so that none is encoded twice; 3 MiB each at 512 x 384."""
    retrieval_weights: str | None = None
    """Trained retrieval head for image descriptors; without it they are the mean of the encoder's tokens."""

    def __post_init__(self) -> None:
        if self.network_size < 32 or self.network_size % 16:
            raise ConfigError(f"--network-size {self.network_size}: a multiple of 16, 32 or more")
        _check_at_least(self, max_keyframes=1, keyframe_interval=1, refinements=0)
        _check_at_least(self, keyframe_threshold=0, token_cache=0)
        if self.network_memory != "auto" and not 0 < self.network_memory < math.inf:
            raise ConfigError(f"--network-memory {self.network_memory}: must be auto or above 0, and finite")


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig:
    """Putting neighbouring segments together (paper sections III-C and III-E)."""

    transform_group: TransformGroup = "sim3"
    """Group of the transforms between segments (paper section III-D): sim3; se3 for metric backbones; affine3 and sl4
    also bend the geometry, and are less stable."""
    alignment_edges: AlignmentEdges = "both"
    """What edges between two segments are made of: shared points, the poses of shared cameras, or both."""
    alignment_source: AlignmentSource = "auto"
    """Correspondences between segments; auto takes tracks where the backbone has them (as exact as dense pixels at a
    twentieth of the cost), pointmaps otherwise."""
    confidence_weighting: ConfidenceWeighting = "relative"
    """Paper eq. 1 with the depth difference divided by the depth (relative), as printed (paper), or off."""
    robust_kernel: RobustKernel = "cauchy"
    """Robust loss; cauchy and tukey take their scale from the residuals, huber is the paper's, with a fixed delta."""
    huber_delta: float = 0.1
    """Residual where the huber loss turns linear, in segment units; for --robust-kernel huber only."""

    def __post_init__(self) -> None:
        if not 0 < self.huber_delta < math.inf:
            raise ConfigError(f"--huber-delta {self.huber_delta}: must be above 0, and finite")


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Finding places that the camera came back to, and closing the loops (paper section III-F)."""

    loop_closure: bool = True
    """Look for loops and close them."""
    loop_similarity: float | Auto = "auto"
    """Cosine similarity from which two images may show one place (the paper's sigma, 0.95 there for MUSt3R); auto
    takes it from the similarities of the collection."""
    loop_min_candidates: int = 3
    """Image pairs that two segments must have before a loop between them is tried (the paper's k_min)."""
    loop_min_distance: int = 3
    """Two segments closer than this in order are no loop; the paper asks for more than 2."""
    loop_window: int = 10
    """Images before and after each end of a loop that form the loop segment, inside their segments."""
    loop_kernel: LoopKernel = "cauchy"
    """Loss that keeps a false loop from bending the graph: cauchy and gnc reject loops that the rest contradicts,
    cauchy also gives less weight to poor ones; none believes all."""

    def __post_init__(self) -> None:
        # auto: four robust standard deviations above images that are far apart, two for the best few
        if self.loop_similarity != "auto" and not 0 < self.loop_similarity < 1:
            raise ConfigError(f"--loop-similarity {self.loop_similarity}: must be auto or a cosine between 0 and 1")
        _check_at_least(self, loop_min_candidates=1, loop_min_distance=1, loop_window=1)


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Making one cloud of all depth maps."""

    max_points: int = 1_000_000
    """Points of the fused cloud of each model at most; as many as a laptop viewer and a splat trainer digest."""
    min_confidence: float = 2.0
    """Pixels with less are left out; 1 is no confidence, and each view that agrees adds up to 1."""

    def __post_init__(self) -> None:
        _check_at_least(self, max_points=1, min_confidence=0)


@dataclass(frozen=True, kw_only=True)
class TrackConfig:
    """Tracks across the whole scene, and bundle adjustment to them."""

    track_neighbours: int = 12
    """Images that each image is matched with for tracks, chosen by how much of the same surface they see."""
    principal_point: bool = True
    """Let the principal point leave the image centre where two halves of the points agree on a place and fit better."""
    register_missing: bool = False
    """Let COLMAP's incremental mapper try the images that have no pose, on the adjusted model."""

    def __post_init__(self) -> None:
        _check_at_least(self, track_neighbours=1)


@dataclass(frozen=True, kw_only=True)
class RefinementConfig(TrackConfig):
    """Tracks across the whole scene, and bundle adjustment to them."""

    refine: bool = True
    """Find tracks and adjust cameras and points to them, where that makes the model better."""
    track_source: TrackSource = "features"
    """What tracks are made of: SIFT features, the backbone's pointmaps (for scenes where SIFT fails), or both."""


@dataclass(frozen=True, kw_only=True)
class ModelOutputConfig:
    """What is written."""

    text: bool = False
    """Write the COLMAP model as .txt beside the .bin files."""
    trainer: bool = True
    """Write OUT/trainer, for splat and NeRF trainers: undistorted images, model, points and, if there is any, depth."""
    trainer_scales: tuple[int, ...] | None = None
    """Smaller copies of the trainer's images, such as 2,4,8 for images_2, images_4 and images_8."""
    report: bool = True
    """Write OUT/report.html, a page that shows what the result is worth."""

    def __post_init__(self) -> None:
        if self.trainer_scales is not None and (not self.trainer_scales or min(self.trainer_scales) < 2):
            shown = ",".join(map(str, self.trainer_scales))
            raise ConfigError(f"--trainer-scales {shown}: must be whole numbers above 1, such as 2,4,8")

    @property
    def large_formats(self) -> tuple[str, ...]:
        """The formats of ``exporters.registry`` that are wanted and take long."""
        return ("trainer",) if self.trainer else ()


@dataclass(frozen=True, kw_only=True)
class OutputConfig(ModelOutputConfig):
    """What is written."""

    dense: bool = True
    """Write OUT/dense, COLMAP's workspace of depth and normal maps, and the fused cloud."""
    mesh: MeshMethod = "none"
    """Also make a mesh of the dense workspace: poisson closes holes, tsdf keeps to what was seen."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mesh != "none" and not self.dense:
            raise ConfigError(f"--mesh {self.mesh}: is made of the dense workspace; leave --no-dense out")

    @property
    def large_formats(self) -> tuple[str, ...]:
        """The formats of ``exporters.registry`` that are wanted and take long."""
        wanted = (("dense", self.dense), ("mesh", self.mesh != "none"))
        return (*super().large_formats, *(name for name, chosen in wanted if chosen))


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """All settings of ``reconstruct``: first what most people need, then stage by stage."""

    backbone: str = "classical"
    """What reconstructs a segment: classical needs no weights, must3r does; other packages may add more, see
    `doctor`."""
    backbone_options: str | None = None
    """Settings of a backbone from another package, as name=value,name=value."""
    masks: Path | None = None
    """Folder of masks, named IMAGE.png or STEM.png after the image and as large as it. Where they are black there are
    no features and no depth."""
    workers: int | Auto = "auto"
    """Processes; auto takes one per core that this process may use."""
    seed: int = 0
    """Of every random choice; with --workers 1, the same seed gives the same result to the last bit."""
    cameras: CameraConfig = field(default_factory=CameraConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    classical: ClassicalConfig = field(default_factory=ClassicalConfig)
    must3r: Must3rConfig = field(default_factory=Must3rConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    loop_closing: LoopConfig = field(default_factory=LoopConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)

    def __post_init__(self) -> None:
        _check_workers(self.workers)
        _check_at_least(self, seed=0)


@dataclass(frozen=True, kw_only=True)
class ModelCameraConfig:
    """What becomes of the cameras of the model."""

    share_cameras: bool = True
    """Make one camera of those that have one image each and nearly the same focal length."""
    camera_model: str | None = None
    """COLMAP camera model of the result; by default the one that the model has, but SIMPLE_RADIAL for pinholes."""
    calibrated: bool = False
    """The cameras are known: leave their parameters as they are."""


@dataclass(frozen=True, kw_only=True)
class RefineConfig:
    """All settings of ``refine``: first what most people need, then stage by stage."""

    masks: Path | None = None
    """Folder of masks, named IMAGE.png or STEM.png after the image and as large as it. Where they are black there are
    no features."""
    pose_tolerance: float = 0.03
    """Distance of a match from its epipolar line that is accepted at first, as a fraction of the longer image side.
    Enough for cameras that are 3 degrees and 3 % of the extent off; less is better for repeated structure."""
    workers: int | Auto = "auto"
    """Processes; auto takes one per core that this process may use."""
    seed: int = 0
    """Of every random choice; with --workers 1, the same seed gives the same result to the last bit."""
    cameras: ModelCameraConfig = field(default_factory=ModelCameraConfig)
    output: ModelOutputConfig = field(default_factory=ModelOutputConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    refinement: TrackConfig = field(default_factory=TrackConfig)

    def __post_init__(self) -> None:
        if not 0 < self.pose_tolerance <= MAX_POSE_TOLERANCE:
            raise ConfigError(
                f"--pose-tolerance {self.pose_tolerance}: must be above 0 and at most {MAX_POSE_TOLERANCE}, as a "
                "fraction of the image side"
            )
        _check_workers(self.workers)
        _check_at_least(self, seed=0)


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """How an estimate is compared with a reference."""

    align: PoseAlignment = "sim3"
    """What brings the estimate into the frame of the reference: a fit of the camera centres, with scale or without."""
    associate: AssociationKey = "auto"
    """How poses are matched: by image name, frame number or time; auto takes the first that both sides have."""
    max_time_difference: float = 0.01
    """Seconds between two poses that are matched by time; evo's default."""
    time_offset: float = 0.0
    """Seconds added to the times of the estimate."""
    rpe_delta: float = 1.0
    """Step of the relative pose error."""
    rpe_unit: DeltaUnit = "frames"
    """Unit of the step: compared poses, or length of the path of the reference."""
    rpe_all_pairs: bool = False
    """A step from every pose, not one step after the other."""
    reference_accuracy: float = 0.0
    """Of the positions of the reference, in its unit; for auc_colmap, shorter baselines have no direction."""
    unit: str = ""
    """Unit of length of the reference, such as m, where its layout does not say; KITTI's segments need m."""
    depth_registration: DepthRegistration = "none"
    """Where the colour camera is, seen from the depth sensor of the reference: in the same place, or a Kinect's nominal
    one. Needs metres."""
    cloud_thresholds: tuple[float, ...] = (0.01, 0.02, 0.05)
    """Distances that accuracy, completeness and F-score of clouds are given for, in the unit of the reference."""

    def __post_init__(self) -> None:
        if not 0 < self.rpe_delta < math.inf or (self.rpe_unit == "frames" and self.rpe_delta != round(self.rpe_delta)):
            raise ConfigError(f"--rpe-delta {self.rpe_delta:g}: must be above 0, and a whole number of frames")
        for name in ("max_time_difference", "reference_accuracy"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"--{name.replace('_', '-')} {getattr(self, name):g}: must be 0 or more")
        if not math.isfinite(self.time_offset):
            raise ConfigError(f"--time-offset {self.time_offset:g}: must be a number of seconds")
        if not all(0 < one < math.inf for one in self.cloud_thresholds):
            raise ConfigError(f"--cloud-thresholds {self.cloud_thresholds}: must be above 0")


def _check_at_least(settings: object, **least: int) -> None:
    """Refuse settings that are below their least value, no number, or more than COLMAP can hold."""
    for name, lowest in least.items():
        value = getattr(settings, name)
        if not lowest <= value <= _LARGEST:
            bound = f"at most {_LARGEST}" if value > _LARGEST else f"at least {lowest}"
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be {bound}")


def _check_workers(workers: int | Auto) -> None:
    if workers != "auto" and workers < 1:
        raise ConfigError(f"--workers {workers}: must be auto or at least 1")

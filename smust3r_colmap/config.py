"""Every setting of a run, with the reason for its default.

These dataclasses are the command line (``--segment-length``), the TOML file (``segment_length``)
and the record written beside the result, all three under the same names. Only the entry of a
stage sees its settings; the functions below it take plain arguments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from smust3r_colmap.errors import ConfigError

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

_LARGEST = 2**31 - 1
"""Whole numbers end there in COLMAP."""


@dataclass(frozen=True, kw_only=True)
class ImportConfig:
    """Reading the image folder."""

    camera_mode: CameraMode = "auto"
    """Which images share intrinsics: auto is one camera per folder, size, and camera model and focal length of the
    EXIF; single is one for all; per-folder and per-image as named."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP model of cameras that come without calibration; COLMAP's own default, one distortion term."""
    camera_params: str = ""
    """Known intrinsics of all images: COLMAP's parameters of the camera model, separated by commas, in pixels of
    the upright images. They are used and kept as they are."""
    masks: str = ""
    """Folder of masks, IMAGE.png after the name of the image or STEM.png without its suffix, as large as the upright
    image. Where they are black there are no features and no depth, and trainers get them."""


@dataclass(frozen=True, kw_only=True)
class SegmentationConfig:
    """Cutting the sequence (paper section III-B)."""

    segment_length: int = 60
    """Images per segment (l); the paper's setting."""
    overlap: int = 20
    """Images shared by neighbouring segments (p). The paper's 30 costs a third more and is no more accurate."""

    def __post_init__(self) -> None:
        if self.segment_length < 2:
            raise ConfigError(f"--segment-length {self.segment_length}: a segment needs at least 2 images")
        if self.overlap < 1:
            raise ConfigError(f"--overlap {self.overlap}: neighbouring segments must share at least 1 image")
        if self.overlap >= self.segment_length:
            raise ConfigError(f"--overlap {self.overlap} must be smaller than --segment-length {self.segment_length}")


@dataclass(frozen=True, kw_only=True)
class ClassicalConfig:
    """The backbone that needs no weights: SIFT, mapping by pycolmap, plane sweep."""

    max_image_size: int = 1600
    """Longer side at which SIFT runs; larger costs time without many more stable features."""
    max_features: int = 4096
    """SIFT features per image; matching costs the square of it."""
    match_neighbours: int = 8
    """Every image is matched to this many next images in order."""
    exhaustive_below: int = 25
    """Windows of at most this many images are matched exhaustively (unordered collections)."""
    dense_size: int = 384
    """Longer side of the depth maps."""
    depth_planes: int = 64
    """Depth hypotheses per pixel at most, uniform in inverse depth; fewer where steps of one pixel suffice."""

    def __post_init__(self) -> None:
        # 32 pixels is the smallest image that is read, 12 planes the least that are smoothed.
        _check_at_least(
            self,
            max_image_size=32,
            max_features=1,
            match_neighbours=1,
            exhaustive_below=0,
            dense_size=32,
            depth_planes=12,
        )


@dataclass(frozen=True, kw_only=True)
class Must3rConfig:
    """The network backbone. Its weights have a licence of their own and never come with this package."""

    weights: str = ""
    """Checkpoint, .pth as published or .safetensors as converted; by default what SMUST3R_WEIGHTS names, then what
    `weights fetch` put into the cache."""
    network_size: int = 512
    """Longer side of the images in the network; other sizes than the trained one interpolate positions."""
    keyframes: KeyframeStrategy = "linspace"
    """Which images of a segment the network remembers: evenly spread (linspace), unlike each other
    (retrieval), every k-th, or where something new is seen (overlap)."""
    max_keyframes: int = 50
    """Images that the network remembers of a segment at most; it was trained with 20 and wears off beyond 50."""
    keyframe_interval: int = 3
    """k of the every-kth keyframes."""
    keyframe_threshold: float = 0.05
    """Of the overlap keyframes: how far from what was seen, divided by depth, counts as new."""
    refinements: int = 0
    """Times that all keyframes are shown again against the full memory."""
    rerender: bool = True
    """Predict every image against the final memory, rather than keep what was said when a keyframe was new."""
    camera_fit: CameraFit = "robust"
    """Cameras from pointmaps: robust (confident pixels, one focal length per camera), upstream (all pixels, as
    published), or pnp (RANSAC by pycolmap)."""
    device: Device = "auto"
    """Where the network runs; auto takes a CUDA card if there is one."""
    precision: Precision = "auto"
    """float32 is the reference; auto takes bfloat16 where the hardware multiplies it."""
    network_memory: float = 0.0
    """GiB that the network may use; 0 takes most of what is free."""
    token_cache: float = 20.0
    """GiB of disk for encoded images, so that none is encoded twice; 3 MiB each at 512 x 384."""
    retrieval_weights: str = ""
    """Trained retrieval head for descriptors; by default they are the mean of the encoder's tokens."""

    def __post_init__(self) -> None:
        if self.network_size < 32 or self.network_size % 16:
            raise ConfigError(f"--network-size {self.network_size}: a multiple of 16, 32 or more")
        _check_at_least(self, max_keyframes=1, keyframe_interval=1, refinements=0)
        _check_at_least(self, keyframe_threshold=0, network_memory=0, token_cache=0)


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig:
    """Putting neighbouring segments together (paper sections III-C and III-E)."""

    transform_group: TransformGroup = "sim3"
    """Group of the transforms between segments (paper section III-D): sim3; se3 where the backbone is
    metric; affine3 and sl4 also bend the geometry, and are the less stable for it."""
    alignment_edges: AlignmentEdges = "both"
    """Edges between two segments: from points they share, from the poses of shared cameras, or both."""
    alignment_source: AlignmentSource = "auto"
    """Correspondences: tracks shared by two segments where the backbone has them (as exact as dense
    pixels at a twentieth of the cost), pointmaps otherwise."""
    confidence_weighting: ConfidenceWeighting = "relative"
    """Paper eq. 1 with the depth difference divided by the depth (relative), as printed (paper), or off."""
    robust_kernel: RobustKernel = "cauchy"
    """cauchy and tukey take their scale from the residuals; huber is the paper's, with a fixed delta."""
    huber_delta: float = 0.1
    """Where the paper's Huber loss turns linear, in segment units; only for the huber kernel."""

    def __post_init__(self) -> None:
        if not 0 < self.huber_delta < math.inf:
            raise ConfigError(f"--huber-delta {self.huber_delta}: must be above 0, and finite")


@dataclass(frozen=True, kw_only=True)
class LoopConfig:
    """Finding places that the camera came back to, and closing the loops (paper section III-F)."""

    loops: bool = True
    """Look for loops and close them."""
    loop_similarity: float = 0.0
    """Cosine similarity from which two images may show one place (the paper's sigma, 0.95 there for MUSt3R);
    0 takes it from the collection: four robust standard deviations above images that are far apart, two
    for the best few."""
    loop_min_candidates: int = 3
    """Image pairs that two segments must have before a loop between them is tried (the paper's k_min)."""
    loop_min_distance: int = 3
    """Two segments closer than this in order are no loop; the paper asks for more than 2."""
    loop_half_width: int = 10
    """Images before and after each end of a loop that form the loop segment, inside their segments."""
    loop_kernel: LoopKernel = "cauchy"
    """What keeps a false loop from bending the graph: cauchy and gnc reject the loops that the rest
    contradicts, and cauchy also gives less weight to those that fit less well; none believes all."""

    def __post_init__(self) -> None:
        if not 0 <= self.loop_similarity < 1:
            raise ConfigError(f"--loop-similarity {self.loop_similarity}: a cosine from 0 (automatic) to below 1")
        _check_at_least(self, loop_min_candidates=1, loop_min_distance=1, loop_half_width=1)


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """Making one cloud of all depth maps."""

    max_points: int = 1_000_000
    """Upper bound of the fused cloud of each model; what a laptop viewer and a splat trainer digest."""
    min_confidence: float = 2.0
    """Pixels below are left out; 1 is no confidence, each view that agrees adds up to one."""

    def __post_init__(self) -> None:
        _check_at_least(self, max_points=1, min_confidence=0)


@dataclass(frozen=True, kw_only=True)
class RefinementConfig:
    """Real tracks, triangulation and bundle adjustment of the stitched model."""

    refine: bool = True
    """Find tracks across the whole scene and adjust cameras and points to them, where that makes the model better."""
    tracks: TrackSource = "features"
    """Where tracks come from: SIFT features, the backbone's pointmaps (for scenes where SIFT fails), or both."""
    track_neighbours: int = 12
    """Images that each image is matched with for tracks, chosen by how much of the same surface the stitched
    geometry says they see; the pairs that the segments have matched already cost nothing more."""
    principal_point: bool = True
    """Let the principal point leave the middle where two halves of the points agree on a place and fit better there."""
    complete: bool = False
    """Let COLMAP's incremental mapper try the images that got no pose, on the adjusted model."""

    def __post_init__(self) -> None:
        _check_at_least(self, track_neighbours=1)


@dataclass(frozen=True, kw_only=True)
class OutputConfig:
    """What is written."""

    text: bool = False
    """Write the COLMAP model as .txt beside the .bin files."""
    trainer: bool = True
    """Write OUT/trainer, for splat and NeRF trainers: undistorted images, model, points, depth."""
    trainer_scales: str = ""
    """Smaller copies of the trainer's images, such as 2,4,8 for images_2, images_4 and images_8."""
    dense: bool = True
    """Write OUT/dense, COLMAP's workspace of depth and normal maps, and the fused cloud."""
    mesh: MeshMethod = "none"
    """Also make a mesh of the dense workspace: poisson closes holes, tsdf keeps to what was seen."""

    def __post_init__(self) -> None:
        if self.mesh != "none" and not self.dense:
            raise ConfigError(f"--mesh {self.mesh} is made of the dense workspace; leave --no-dense out")
        _ = self.trainer_factors

    @property
    def trainer_factors(self) -> tuple[int, ...]:
        """``trainer_scales`` as numbers."""
        factors = [part.strip() for part in self.trainer_scales.split(",") if part.strip()]
        if not all(part.isdecimal() and int(part) > 1 for part in factors):
            raise ConfigError(f"--trainer-scales {self.trainer_scales!r}: whole numbers above 1, such as 2,4,8")
        return tuple(int(part) for part in factors)

    @property
    def large_formats(self) -> tuple[str, ...]:
        """The formats of ``exports`` that are wanted and take long."""
        wanted = (("trainer", self.trainer), ("dense", self.dense), ("mesh", self.mesh != "none"))
        return tuple(name for name, chosen in wanted if chosen)


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """All of it."""

    importing: ImportConfig = field(default_factory=ImportConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    backbone: str = "classical"
    """What reconstructs a segment: classical needs no weights, must3r does, and other packages may add more
    (`doctor` lists them)."""
    backbone_options: str = ""
    """Settings of a backbone from another package, as name=value,name=value."""
    classical: ClassicalConfig = field(default_factory=ClassicalConfig)
    must3r: Must3rConfig = field(default_factory=Must3rConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    loop_closing: LoopConfig = field(default_factory=LoopConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    output: OutputConfig = field(default_factory=OutputConfig)
    workers: int = 0
    """Processes; 0 takes one per core that this process may use."""
    seed: int = 0
    """Of every random choice; the same seed on the same machine gives the same result, to the last bit with one
    worker."""

    def __post_init__(self) -> None:
        if self.workers < 0:
            raise ConfigError(f"--workers {self.workers}: give 0 (all cores) or a positive number")
        _check_at_least(self, seed=0)


def _check_at_least(settings: object, **least: int) -> None:
    """Refuse settings that are below their least value, no number, or more than COLMAP can hold."""
    for name, lowest in least.items():
        value = getattr(settings, name)
        if not lowest <= value <= _LARGEST:
            bound = f"at most {_LARGEST}" if value > _LARGEST else f"at least {lowest}"
            raise ConfigError(f"--{name.replace('_', '-')} {value}: must be {bound}")

"""The simulated errors: every amount, with the reason for its default.

The defaults are those of a good network indoors (``PRESETS["network"]``): 1 to 2 % of depth, 0.5 to
1 degree of rotation over a segment. Amounts that grow along a segment are given for the paper's
segment of ``REFERENCE_LENGTH`` images. The next module to read is ``distortion``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Literal

from smust3r_colmap.errors import ConfigError

REFERENCE_LENGTH = 60
"""Images after which an error that grows has the size of its setting: the paper's segment length."""

Gauge = Literal["first-camera", "random"]
WarpGroup = Literal["affine3", "sl4"]


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """Amounts of every kind of error; zero of all of them is ``PRESETS["perfect"]``.

    Raises:
        ConfigError: an amount is negative, or a share is not within 0 to 1.
    """

    # ------------------------------------------------------------------ frame of a segment
    gauge: Gauge = "first-camera"
    """Origin of a segment: its first camera, as networks of the DUSt3R family have it, or any place."""
    scale_jitter: float = 0.05
    """Standard deviation of the logarithm of a segment's scale; metric networks are off by some percent."""
    warp: float = 0.0
    """Largest stretch of a segment by a transform wider than a similarity, as a share of lengths; 0 because
    MUSt3R's own pointmaps bend locally and are not warped as a whole."""
    warp_group: WarpGroup = "affine3"
    """Kind of the warp: affine3, or sl4 which also makes scale vary by ``warp`` over the radius of the scene."""

    # ----------------------------------------------------- bending, seen by the overlap
    drift_rotation_deg: float = 0.7
    """Angle (rms) by which the last camera of 60 is turned against the first, a random walk of the segment's own."""
    drift_translation: float = 0.01
    """The same for its position, as a share of the typical depth, besides what the turning does."""
    drift_scale: float = 0.01
    """The same for the logarithm of the scale of depths and steps."""

    # ------------------------------------------------- bending, not seen by the overlap
    chain_rotation_deg: float = 0.5
    """Angle per 60 images by which every segment bends in the same way: neighbours agree on it, so it adds up
    along the chain and only a loop shows it. Its axis is drawn once for the run."""
    chain_scale: float = 0.01
    """The same for the logarithm of the scale; its sign is drawn once for the run."""

    # ---------------------------------------------------------------------- depth, camera
    depth_distortion: float = 0.012
    """Relative depth error (rms over the pixels) that is smooth over the image, at the 60th image of a segment;
    half of its variance is there from the first image, the rest grows as a random walk."""
    focal_error: float = 0.01
    """Standard deviation of the logarithm of a segment's focal length. Depth is wrong by the same factor: sizes
    across the view are seen in the image, distances along it are inferred from the focal length."""
    depth_noise: float = 0.005
    """Relative depth error (standard deviation) of each pixel by itself; networks are smooth."""
    blob_share: float = 0.03
    """Pixels in patches (32 px wide at an image width of 512) that are 30 to 100 % too deep."""

    # ------------------------------------------------------------------------- confidence
    confidence_knows: float = 0.5
    """Share of the patches, and of the variance of the smooth error and the noise, that lowers the confidence."""
    confidence_noise: float = 0.2
    """Standard deviation of the logarithm of what the confidence has above 1, per pixel."""

    # ------------------------------------------------------------------------ descriptors
    descriptor_noise: float = 0.15
    """Length of the random vector added to a descriptor of unit length: cosines fall by 2 %."""
    false_loops: int = 0
    """Pairs of places that look alike although they share nothing (perceptual aliasing)."""
    false_loop_images: int = 7
    """Images of each of the two places, so as many alike pairs; more than the three that the paper asks for."""
    false_loop_gap: int = 100
    """Least distance of the two places in images; further than any window reaches."""

    # ---------------------------------------------------------------------------- failures
    failed_share: float = 0.0
    """Chance that nothing comes out of a segment; networks do not refuse."""
    dropped_share: float = 0.0
    """Chance that an image of a segment gets no pose; networks place every image."""

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, (int, float)) and not 0 <= value < float("inf"):
                raise ConfigError(f"simulation setting {one.name}: {value}, needed 0 or more")
        for name in ("blob_share", "confidence_knows", "failed_share", "dropped_share", "warp"):
            if getattr(self, name) > 1:
                raise ConfigError(f"simulation setting {name}: {getattr(self, name)}, needed a share from 0 to 1")
        if self.false_loop_images < 3:
            raise ConfigError(f"simulation setting false_loop_images: {self.false_loop_images}, needed 3 or more")


_PERFECT = SimulationSettings(
    scale_jitter=0.0,
    drift_rotation_deg=0.0,
    drift_translation=0.0,
    drift_scale=0.0,
    chain_rotation_deg=0.0,
    chain_scale=0.0,
    depth_distortion=0.0,
    focal_error=0.0,
    depth_noise=0.0,
    blob_share=0.0,
    confidence_noise=0.0,
    descriptor_noise=0.0,
)
_HARD = SimulationSettings(
    scale_jitter=0.15,
    drift_rotation_deg=2.0,
    drift_translation=0.03,
    drift_scale=0.03,
    chain_rotation_deg=1.5,
    chain_scale=0.03,
    depth_distortion=0.03,
    focal_error=0.03,
    depth_noise=0.015,
    blob_share=0.15,
    confidence_knows=0.25,
    descriptor_noise=0.3,
)
PRESETS: Mapping[str, SimulationSettings] = MappingProxyType(
    {"perfect": _PERFECT, "network": SimulationSettings(), "hard": _HARD}
)
"""``perfect``: the truth in the frame of each segment's first camera. ``network``: the defaults.
``hard``: about three times as wrong, as on scenes unlike those a network was trained on."""

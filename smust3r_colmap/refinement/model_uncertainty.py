"""How uncertain an adjusted model is: a standard deviation for every camera, and the links that hold it together.

The covariance of bundle adjustment, times the inflation by contradicting matches. The next module to read is
``mapper``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
import pycolmap

from smust3r_colmap.geometry.arrays import BoolArray, FloatArray, IntArray, Pair
from smust3r_colmap.refinement.bundle_adjustment import PRIOR_SIGMA_FRACTION
from smust3r_colmap.refinement.contradictions import contradiction_inflation
from smust3r_colmap.refinement.covariance import UNBOUNDED, pose_covariance
from smust3r_colmap.refinement.linearised_model import LinearisedModel
from smust3r_colmap.refinement.links import Link, links
from smust3r_colmap.refinement.misregistration import EpipolarSupport

MIN_IMAGES = 2
"""A single image has no other to be uncertain against."""
MAX_WEAK_LINKS = 3
"""Of the summary."""
MAX_DETERMINED = 0.5 * UNBOUNDED
"""Standard deviation of a centre in extents, or of a rotation in radians, that observations may leave; what is above is
not determined by them."""


@dataclass(frozen=True, kw_only=True)
class NamedLink:
    """A ``Link`` by names of images: what holds those up to ``before`` and those from ``after`` on together.

    Args:
        num_smaller: images of the smaller side. num_points: tracks across. num_scale_points: that carry the scale.
        scale_percent: standard deviation of the relative scale. rotation_deg: likewise.
        translation_percent: likewise, in percent of the extent.
        side_percent: of the smaller side's centres, root mean square, in percent of the extent.
    """

    before: str
    after: str
    num_smaller: int
    num_points: int
    num_scale_points: float
    scale_percent: float
    rotation_deg: float
    translation_percent: float
    side_percent: float


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelUncertainty:
    """Standard deviations of the N registered images of a model after the best alignment of all centres.

    Args:
        names: (N,) images in order.
        extent: of the path, in units of the model.
        noise_px: standard deviation of an observation.
        position_covariance: (N, 3, 3) in squared units of the model.
        rotation_sigma_deg: (N,) root of the summed variance about the three axes.
        inflation: (N,) by contradicting matches, contained in the others; infinite where most matches contradict.
        num_observations: (N,) that the covariance was made from.
        determined: (N,) whether observations bound the position and rotation of the image.
        links: what holds the two sides of every cut together, in order.
    """

    names: tuple[str, ...]
    extent: float
    noise_px: float
    position_covariance: FloatArray
    rotation_sigma_deg: FloatArray
    inflation: FloatArray
    num_observations: IntArray
    determined: BoolArray
    links: tuple[NamedLink, ...]

    def __post_init__(self) -> None:
        n = len(self.names)
        for one in fields(self):
            value = getattr(self, one.name)
            if isinstance(value, np.ndarray) and (len(value) != n or np.isnan(value).any()):
                raise ValueError(f"ModelUncertainty: {one.name} is {value.shape} for {n} images, or has NaN")

    @property
    def position_sigma(self) -> FloatArray:
        """(N,) root of the summed variance of the axes, in units of the model: what an error is compared with."""
        sigma: FloatArray = np.sqrt(np.trace(self.position_covariance, axis1=1, axis2=2))
        return sigma

    @property
    def predicted_error_percent(self) -> float:
        """Root mean square of the sigmas of the positions in percent of the extent; 0 without images."""
        if not len(self.names):
            return 0.0
        return float(100 * np.sqrt(np.mean(self.position_sigma**2)) / self.extent)


def measure_uncertainty(
    model: pycolmap.Reconstruction,
    supports: Collection[Mapping[Pair, EpipolarSupport]],
    *,
    calibrated: bool,
    initial_poses_count: bool = False,
) -> ModelUncertainty:
    """Measure an adjusted model.

    Args:
        model: image ids are index + 1.
        supports: how the verified matches of its image pairs fit it, by image index, of several kinds.
        calibrated: its intrinsics were fixed.
        initial_poses_count: its initial poses were not made from matches, so they are evidence of their own, with the
            standard deviation of the position priors.
    """
    linear = LinearisedModel.of(model)
    names = tuple(model.image(int(i)).name for i in linear.image_ids)
    inflation = contradiction_inflation(supports, [int(i) - 1 for i in linear.image_ids])
    counts = np.bincount(linear.image_of, minlength=len(linear))
    if len(linear) < MIN_IMAGES:
        return _without_shape(linear, names, inflation, counts)
    centre_sigma = PRIOR_SIGMA_FRACTION if initial_poses_count else UNBOUNDED
    covariance = pose_covariance(linear, calibrated=calibrated, centre_sigma=centre_sigma)
    factors = np.minimum(inflation, UNBOUNDED / np.maximum(covariance.position_sigma, 1e-300))
    factors = np.maximum(factors, 1)
    # Images that may be anywhere pull at the alignment, and with it at all others, by their share.
    pulled = np.mean(np.isinf(inflation)) * UNBOUNDED
    positions = covariance.blocks[:, :3, :3] * (factors**2)[:, None, None] + pulled**2 / 3 * np.eye(3)
    rotations = np.minimum(covariance.rotation_sigma_rad * factors, np.pi)
    bounded = (covariance.position_sigma < MAX_DETERMINED) & (covariance.rotation_sigma_rad < MAX_DETERMINED)
    # Centres that differ by less than their uncertainty make no path: the camera turned on the spot.
    bounded &= np.sqrt(linear.centres.var(axis=0).sum()) > np.median(covariance.position_sigma)
    return ModelUncertainty(
        names=names,
        extent=linear.extent,
        noise_px=linear.noise_px,
        position_covariance=_positive(positions) * linear.extent**2,
        rotation_sigma_deg=np.rad2deg(rotations),
        inflation=inflation,
        num_observations=counts,
        determined=bounded & (counts > 0),
        links=_named(links(linear), names),
    )


def adjusted_priors(model: pycolmap.Reconstruction, uncertainty: ModelUncertainty) -> list[pycolmap.PosePrior]:
    """The camera centres of the model with their covariance, as position priors for COLMAP."""
    covariance_of = dict(zip(uncertainty.names, uncertainty.position_covariance, strict=True))
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    return [
        pycolmap.PosePrior(
            pose_prior_id=image.image_id,
            corr_data_id=image.data_id,
            position=image.projection_center(),
            position_covariance=covariance_of[image.name],
            coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        )
        for image in images
    ]


def _without_shape(
    linear: LinearisedModel, names: tuple[str, ...], inflation: FloatArray, counts: IntArray
) -> ModelUncertainty:
    """Of a single image, or none: it fits any truth, so that nothing about it is determined."""
    n = len(linear)
    return ModelUncertainty(
        names=names,
        extent=linear.extent,
        noise_px=linear.noise_px,
        position_covariance=np.tile(np.eye(3) * (UNBOUNDED * linear.extent) ** 2 / 3, (n, 1, 1)),
        rotation_sigma_deg=np.full(n, 180.0),
        inflation=inflation,
        num_observations=counts,
        determined=np.zeros(n, dtype=bool),
        links=(),
    )


def _positive(matrices: FloatArray) -> FloatArray:
    """Symmetric, with no eigenvalue below a relative 1e-12: readers of a covariance invert it."""
    values, vectors = np.linalg.eigh((matrices + matrices.transpose(0, 2, 1)) / 2)
    floor = np.maximum(1e-12 * values[:, -1:], 1e-18)
    positive: FloatArray = (vectors * np.maximum(values, floor)[:, None, :]) @ vectors.transpose(0, 2, 1)
    return positive


def _named(found: Sequence[Link], names: Sequence[str]) -> tuple[NamedLink, ...]:
    return tuple(
        NamedLink(
            before=names[one.before],
            after=names[one.after],
            num_smaller=one.num_smaller,
            num_points=one.num_points,
            num_scale_points=one.num_scale_points,
            scale_percent=100 * one.scale_sigma,
            rotation_deg=float(np.rad2deg(one.rotation_sigma_rad)),
            translation_percent=100 * one.translation_sigma,
            side_percent=100 * one.side_sigma,
        )
        for one in found
    )


@dataclass(frozen=True, kw_only=True)
class UncertaintySummary:
    """The part of a ``ModelUncertainty`` that a summary has; lengths in percent of the extent of the path.

    Args:
        num_images: of the model.
        extent: in units of the model.
        noise_px: standard deviation of an observation.
        predicted_error_percent: root mean square of the positions' standard deviations.
        max_position_percent: the largest. least_certain: the image that has it.
        median_rotation_deg: of the rotations.
        undetermined: images whose pose no observations bound.
        contradicted: images that most of their matches contradict. contradicted_stretches: runs of them, in words.
        weak_links: the weakest first.
    """

    num_images: int
    extent: float
    noise_px: float
    predicted_error_percent: float
    max_position_percent: float
    least_certain: str
    median_rotation_deg: float
    undetermined: tuple[str, ...]
    contradicted: tuple[str, ...]
    contradicted_stretches: tuple[str, ...]
    weak_links: tuple[NamedLink, ...]


def summarise_uncertainty(found: ModelUncertainty) -> UncertaintySummary:
    """For the summary of the run."""
    worst = int(np.argmax(found.position_sigma))
    wrong = np.flatnonzero(np.isinf(found.inflation)).tolist()
    return UncertaintySummary(
        num_images=len(found.names),
        extent=found.extent,
        noise_px=found.noise_px,
        predicted_error_percent=found.predicted_error_percent,
        max_position_percent=float(100 * found.position_sigma[worst] / found.extent),
        least_certain=found.names[worst],
        median_rotation_deg=float(np.median(found.rotation_sigma_deg)),
        undetermined=tuple(name for name, bounded in zip(found.names, found.determined, strict=True) if not bounded),
        contradicted=tuple(found.names[row] for row in wrong),
        contradicted_stretches=_stretches(found.names, wrong),
        weak_links=tuple(sorted(found.links, key=lambda link: -link.side_percent)[:MAX_WEAK_LINKS]),
    )


def _stretches(names: Sequence[str], rows: Sequence[int]) -> tuple[str, ...]:
    """Runs of consecutive rows as ``first to last``, the longest first."""
    if not rows:
        return ()
    runs = np.split(np.asarray(rows), np.flatnonzero(np.diff(rows) > 1) + 1)
    runs.sort(key=len, reverse=True)
    return tuple(
        names[int(run[0])] if len(run) == 1 else f"{names[int(run[0])]} to {names[int(run[-1])]}" for run in runs
    )

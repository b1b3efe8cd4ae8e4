"""The covariance of an edge, comparable between all kinds of edges in one pose graph.

A solver that takes its rows as independent gives a covariance that is far too small: the residuals of
ten thousand pixels of thirty images are strongly correlated, because each submodel is distorted as a
whole. An edge of the graph is the relation of two *whole* submodels, not of the images they share.
The information of a solver is therefore scaled down to few observations per image, and a constant
covariance is added. The next module to read is ``pairwise``.

Measured on 25 pairs of submodels with true cameras, every submodel fitted to the truth by itself, which gives
the true relation of a pair. Median error at the middle of the overlap (as degrees, percent of scale,
percent of the depth), and its squared length in standard deviations over 7, which should be near 1:

    =============  ==================  =================  ===================  ===============
    set (pairs)    error, point edges  error, pose edges  rows as independent  as stated here
    =============  ==================  =================  ===================  ===============
    kitti_a (8)    0.05, 0.1, 0.8      0.02, 0.1, 0.8     300 to 4,500         0.3 and 0.4
    fox (8)        0.2, 0.6, 0.9       0.2, 0.7, 1.0      80 to 15,000         0.6 and 0.6
    castle_p30(3)  1.1, 0.9, 1.3       0.9, 0.8, 1.5      170 to 100,000       3.1 and 1.9
    kitchen (6)    1.9, 3.5, 3.4       1.7, 2.2, 3.4      16,000 to 33,000     6.6 and 10.7
    =============  ==================  =================  ===================  ===============

The two edges of one pair agree ten times better with each other than with the truth (median over the
sets 0.03 to 0.2 degrees, 0.01 to 0.7 %, 0.01 to 0.6 %), because they share the distortion of the submodels.
They are not independent: the pose graph (``stitching``) divides their information by their number.
"""

from __future__ import annotations

import numpy as np

from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.transform import Transform
from smust3r_colmap.products import Submodel, TransformEstimate

OBSERVATIONS_PER_IMAGE = 0.1
"""Independent observations per shared image, for 300 pixels as well as for one camera."""
SIGMA_FLOOR = 0.005
"""Smallest standard deviation in each direction of the tangent space at the middle of the overlap: radians,
log scale, shear, and fractions of the depth for a translation."""
SIGMA_UNMEASURED = 0.05
"""Standard deviation of a direction that the group of the estimate does not have (such as the shear
between two submodels of which a similarity is known): submodels of one backbone do not differ by more."""


def inflated_information(
    estimate: TransformEstimate,
    *,
    num_images: int,
    centre_source: FloatArray,
    depth_source: float,
    group: type[Transform] | None = None,
) -> FloatArray:
    """Information of an edge with inflated covariance.

    The solver's information is scaled to ``OBSERVATIONS_PER_IMAGE`` rows per shared image, and
    ``SIGMA_FLOOR`` is added to its covariance. Both happen in a frame with its origin in the middle of the
    overlap: there rotation, scale and shift are errors of different kinds, while at the origin of the
    submodel, which may be far, a rotation is mostly a shift. The adjoint carries the result back.

    Args:
        estimate: ``target_from_source``, with the information of the right perturbation that takes its
            ``num_points`` rows as independent; it may be singular.
        num_images: shared by the two submodels.
        centre_source: (3,) middle of the overlap in the source frame, such as ``overlap_centre``.
        depth_source: median depth of the scene there, in units of the source.
        group: of the pose graph, where the estimate's own is a smaller one; directions that the
            smaller one lacks get the standard deviation ``SIGMA_UNMEASURED``.

    Returns:
        (DOF, DOF) of ``group``, symmetric and positive semidefinite, of the right perturbation of
        ``group.from_matrix(estimate.b_from_a.matrix)``.

    Raises:
        ValueError: the depth or a number is not positive, the information has another shape than the
            group of its transform, or ``group`` is smaller than that.
    """
    own = type(estimate.b_from_a)
    wide = own if group is None else group
    if not (np.isfinite(depth_source) and depth_source > 0) or num_images < 1 or estimate.num_points < 1:
        raise ValueError(
            f"depth {depth_source}, {num_images} shared images, {estimate.num_points} rows: all must be positive"
        )
    if estimate.information.shape != (own.DOF, own.DOF) or wide.DOF < own.DOF:
        raise ValueError(
            f"information {estimate.information.shape} of a transform in {own.__name__} for {wide.__name__} "
            f"({wide.DOF} degrees of freedom)"
        )
    share = min(1.0, OBSERVATIONS_PER_IMAGE * num_images / estimate.num_points)
    errors = _floor_errors(own, centre_source, depth_source)
    whitened = np.eye(wide.DOF) * (SIGMA_FLOOR / SIGMA_UNMEASURED) ** 2
    whitened[: own.DOF, : own.DOF] = share * errors.T @ estimate.information @ errors
    # With the covariance of the floor as unit, information A joins it as (A^-1 + 1)^-1 = A (A + 1)^-1,
    # which needs no inverse of A.
    values, axes = np.linalg.eigh(whitened)
    values = np.maximum(values, 0.0)
    back = axes.T @ np.linalg.inv(_floor_errors(wide, centre_source, depth_source))
    information: FloatArray = (back.T * (values / (values + 1.0))) @ back
    return information


def overlap_centre(source: Submodel, shared: set[int], depth_source: float) -> FloatArray:
    """(3,) median point at the median depth before the cameras of the shared images.

    Args:
        source: the submodel; the point is in its frame.
        shared: indices into the collection.
        depth_source: median depth of its scene.

    Raises:
        ValueError: the submodel holds none of the images.
    """
    poses = source.seg_from_cam[[image in shared for image in source.images]]
    if not len(poses):
        raise ValueError(f"submodel {source.name} holds none of the {len(shared)} shared images")
    centre: FloatArray = np.median(poses[:, :, 3] + depth_source * poses[:, :, 2], axis=0)
    return centre


def _floor_errors(group: type[Transform], centre: FloatArray, depth: float) -> FloatArray:
    """(DOF, DOF) tangent vectors at the origin, as columns, of errors of size `SIGMA_FLOOR` about ``centre``.

    The groups are nested, and so are these columns: the first 6 move rigidly, the 7th scales, 5 shear,
    and 3 are projective.
    """
    place = np.eye(4)
    place[:3, 3] = centre
    errors: FloatArray = group.from_matrix(place).adjoint() @ group.vee(_generators(depth)[: group.DOF]).T
    return SIGMA_FLOOR * errors


def _generators(depth: float) -> FloatArray:
    """(15, 4, 4) of the algebra of SL(4) up to multiples of the identity, of size one at this depth."""
    found = np.zeros((15, 4, 4))
    for axis in range(3):
        second, third = (axis + 1) % 3, (axis + 2) % 3
        found[axis, axis, 3] = depth
        found[3 + axis, third, second], found[3 + axis, second, third] = 1.0, -1.0
        found[6, axis, axis] = 1.0
        found[7 + axis, third, second] = found[7 + axis, second, third] = 1.0
        found[12 + axis, 3, axis] = 1.0 / depth
    found[10, :3, :3] = np.diag([1.0, -1.0, 0.0])
    found[11, :3, :3] = np.diag([-1.0, -1.0, 2.0]) / np.sqrt(3)
    return found

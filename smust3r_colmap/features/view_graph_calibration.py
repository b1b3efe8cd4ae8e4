"""Focal lengths of unknown cameras from the fundamental matrices of many image pairs, by COLMAP.

Mapping begins with a guess of the focal length. Where the camera moves on an arc round what it looks at, a guess that
is too long by half can end in a wrong model with a small reprojection error. The pairs together know better, but not
always: of straight forward motion, or of cameras that all look at one point, every focal length explains the pairs, and
the noise decides. So a focal length counts if two halves of the pairs agree on it.

Sweeney et al., "Optimizing the viewing graph for structure-from-motion", ICCV 2015. The next module to read is
``rotation_consistency``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path

import numpy as np
import pycolmap

from smust3r_colmap.colmap.database import open_database, write_images
from smust3r_colmap.features.guided_verification import MIN_VERIFIED
from smust3r_colmap.geometry.arrays import Pair
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection

MAX_DIFFERENCE_RATIO = 0.05
"""Between the focal lengths of two halves. They differ by 0.1 to 4 % where both are within 5 % of the truth, and by
7 % or more where they are not: simulated arcs and straight lines, ``castle_p30``, ``courthouse_walk``,
``lund_street``."""
CALIBRATION_VERSION = 2
"""To be raised when the focal lengths found may change, so that finished folders look again."""
_CALIBRATED = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
UNCHANGED_RATIO = 1e-3
"""Within this of the guess, the pairs told nothing."""


@dataclass(frozen=True, kw_only=True)
class VerifiedPairs:
    """Verified pairs of a run's database, and the cameras of their images.

    Args:
        database: with keypoints and two-view geometries; image ids are index + 1.
        pairs: ascending; those with fewer matches than COLMAP's minimum do not count.
        cameras: start values by camera index.
        camera_of: camera index by image.
        seed: of the samplers.
    """

    database: Path
    pairs: tuple[Pair, ...]
    cameras: tuple[Intrinsics, ...]
    camera_of: Mapping[int, int]
    seed: int

    @classmethod
    def of(cls, database: Path, pairs: Iterable[Pair], collection: ImageCollection, *, seed: int) -> VerifiedPairs:
        """Pairs of a run's images, with the cameras of its collection."""
        camera_of = {k: image.camera for k, image in enumerate(collection.images)}
        return cls(
            database=database, pairs=tuple(sorted(pairs)), cameras=collection.cameras, camera_of=camera_of, seed=seed
        )


def cross_validated_cameras(verified: VerifiedPairs) -> tuple[Intrinsics, ...]:
    """The cameras with the focal lengths that both halves of the pairs find, by camera index; others as they are."""
    halves = [calibrated_cameras(replace(verified, pairs=verified.pairs[start::2])) for start in (0, 1)]
    cameras = []
    for guess, *found in zip(verified.cameras, *halves, strict=True):
        focal_px = [one.focal_px for one in found]
        told = min(abs(one / guess.focal_px - 1) for one in focal_px) > UNCHANGED_RATIO
        agree = told and max(focal_px) <= (1 + MAX_DIFFERENCE_RATIO) * min(focal_px)
        cameras.append(guess.zoomed(sqrt(focal_px[0] * focal_px[1]) / guess.focal_px) if agree else guess)
    return tuple(cameras)


def calibrated_cameras(verified: VerifiedPairs) -> tuple[Intrinsics, ...]:
    """The cameras with the focal lengths that the pairs determine, by camera index; others as they are.

    A focal length from EXIF or from the user stays. Runs in a child process: pycolmap ends its process on errors.
    """
    images = sorted({image for pair in verified.pairs for image in pair})
    with tempfile.TemporaryDirectory(prefix="smust3r-calibrate-") as scratch:
        path = Path(scratch) / "pairs.db"
        with (
            open_database(verified.database) as run,
            pycolmap.Database.open(path) as own,
            pycolmap.DatabaseTransaction(own),
        ):
            write_images(own, verified.cameras, [(image, verified.camera_of[image]) for image in images])
            for image in images:
                own.write_keypoints(image + 1, run.read_keypoints(image + 1))
            for first, second in verified.pairs:
                known = all(verified.cameras[verified.camera_of[k]].has_prior_focal for k in (first, second))
                geometry = run.read_two_view_geometry(first + 1, second + 1)
                if geometry.config == _CALIBRATED and geometry.F is None and not known:  # they were known at that time
                    geometry = _uncalibrated(run, first, second, verified.seed)
                # COLMAP stops without a fundamental matrix.
                if geometry.F is not None and len(geometry.inlier_matches) >= MIN_VERIFIED:
                    own.write_two_view_geometry(first + 1, second + 1, geometry)
        options = pycolmap.ViewGraphCalibrationOptions()
        options.reestimate_relative_pose = False
        options.random_seed = verified.seed
        pycolmap.calibrate_view_graph(path, options)
        with pycolmap.Database.open(path) as own:
            found = {camera.camera_id - 1: Intrinsics.from_colmap(camera) for camera in own.read_all_cameras()}
    return tuple(
        replace(found.get(k, camera), has_prior_focal=camera.has_prior_focal)
        for k, camera in enumerate(verified.cameras)
    )


def _uncalibrated(run: pycolmap.Database, first: int, second: int, seed: int) -> pycolmap.TwoViewGeometry:
    """The fundamental matrix of the matches of two images, and its inliers; without one, an empty geometry."""
    matches = np.asarray(run.read_matches(first + 1, second + 1), dtype=np.uint32).reshape(-1, 2)
    xy_a, xy_b = (
        np.asarray(run.read_keypoints(image + 1), dtype=np.float64)[matches[:, column], :2]
        for column, image in enumerate((first, second))
    )
    options = pycolmap.RANSACOptions(max_error=4.0, max_num_trials=1_000, random_seed=seed)
    found = pycolmap.estimate_fundamental_matrix(xy_a, xy_b, options) if len(matches) >= MIN_VERIFIED else None
    if found is None:
        return pycolmap.TwoViewGeometry()
    return pycolmap.TwoViewGeometry(
        config=int(pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED),
        F=found["F"],
        inlier_matches=matches[np.asarray(found["inlier_mask"], dtype=np.bool_)],
    )

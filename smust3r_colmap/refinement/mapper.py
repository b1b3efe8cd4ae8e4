"""The model on the bench: pycolmap's mapper, with a database of the matches that have consent.

Everything here runs in a child process, because pycolmap ends the process when one of its threads meets an
error. The next module to read is ``replacement``, which takes bent images off the bench and places them again.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pycolmap

from smust3r_colmap.colmap.database import write_colmap_database
from smust3r_colmap.colmap.reconstruction import cameras_of, poses_of
from smust3r_colmap.features.guided_verification import Consent, MatchedFeatures, View, ask_consent
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.refinement.bundle_adjustment import (
    MANY_OBSERVATIONS,
    MIN_ANGLE_DEG,
    Tolerance,
    triangulator_options,
)

LOOSE_PART = 0.012
"""Epipolar and reprojection tolerance of the first round, as a part of the longer image side: what stitching leaves."""
TIGHT_PART = 0.004
"""Of the second round, when the cameras have been adjusted once."""
MIN_SEEN_POINTS, MIN_AGREEING_PART = 12, 0.6
"""Points that place an image without a pose, and the part of its verified matches that must agree with the place."""


class Bench:
    """pycolmap's mapper on the matches that have consent; the objects that it needs live as long as it does.

    Args:
        collection: all images.
        cameras: the start values, by camera index.
        consent: keypoints and matches.
        cam_from_world: by image index, of a new model.
        scratch: an existing folder for a database in between.
        threads: of pycolmap.
        model: to go on with, instead of a new one.
    """

    def __init__(
        self,
        collection: ImageCollection,
        cameras: Sequence[Intrinsics],
        consent: Consent,
        cam_from_world: Mapping[int, FloatArray],
        *,
        scratch: Path,
        threads: int,
        model: pycolmap.Reconstruction | None = None,
    ) -> None:
        self.collection, self.consent, self.scratch, self.threads = collection, consent, scratch, threads
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            path = Path(folder) / "database.db"
            write_colmap_database(
                path,
                collection,
                cameras,
                keypoints=consent.correspondences.keypoints,
                matches=consent.correspondences.matches,
                j_from_i={},
                priors=(),
            )
            with pycolmap.Database.open(path) as database:
                self._cache = pycolmap.DatabaseCache.create(
                    database, pycolmap.DatabaseCacheOptions(min_num_matches=1, load_all_images=True)
                )
        if model is None:
            model = pycolmap.Reconstruction()
            model.load(self._cache)
            for index, pose in cam_from_world.items():
                model.frame(index + 1).rig_from_world = pycolmap.Rigid3d(pose)
                model.register_frame(index + 1)
        self.model = model
        self.mapper = pycolmap.IncrementalMapper(self._cache)
        self.mapper.begin_reconstruction(model)

    def with_matches(self, consent: Consent) -> Bench:
        """The same model with other matches; this bench is used up."""
        self.mapper.end_reconstruction(False)
        cameras = cameras_of(self.model, self.collection.cameras)
        return Bench(
            self.collection, cameras, consent, {}, scratch=self.scratch, threads=self.threads, model=self.model
        )

    def views(self, poses: Mapping[int, FloatArray] | None = None) -> dict[int, View]:
        """The model's cameras as consent asks for them; or as the given (3, 4) poses have them."""
        cameras = cameras_of(self.model, self.collection.cameras)
        return views_of(poses_of(self.model) if poses is None else poses, cameras, self.collection)

    def filter(self, pixels: float) -> None:
        """Leave out observations that are too far off and points that are seen under no angle."""
        self.mapper.observation_manager.filter_all_points3D(pixels, MIN_ANGLE_DEG)

    def complete(self, tolerance: Tolerance) -> None:
        """Longer tracks."""
        self.mapper.complete_and_merge_tracks(triangulator_options(tolerance))

    def register_missing(self, features: MatchedFeatures, tolerance: Tolerance) -> tuple[int, ...]:
        """Place images that have no pose by the points they see; returns their indices.

        Fewer points than COLMAP asks for are enough, because most of the image's matches must agree afterwards.
        """
        options = pycolmap.IncrementalMapperOptions()
        options.random_seed = 0
        options.num_threads = self.threads
        options.abs_pose_min_num_inliers = MIN_SEEN_POINTS
        options.abs_pose_refine_focal_length = options.abs_pose_refine_extra_params = False
        found: list[int] = []
        while True:
            candidates = self.mapper.find_next_images(options, False)
            new = [i for i in candidates if self._register(options, features, i)]
            for image_id in new:
                self.mapper.triangulate_image(triangulator_options(tolerance), image_id)
            found += new
            if not new:
                return tuple(sorted(i - 1 for i in found))

    def _register(self, options: pycolmap.IncrementalMapperOptions, features: MatchedFeatures, image_id: int) -> bool:
        if not self.mapper.register_next_image(options, image_id):
            return False
        if agrees(features, self.model, image_id, self.collection):
            return True
        self.mapper.observation_manager.deregister_frame(self.model.image(image_id).frame_id)
        return False

    def drop_needless_pairs(self) -> None:
        """Remove points that two images see only, where both have enough others.

        Two rays meet wherever the epipolar lines allow, so wrong matches of a repetitive facade look as good as right
        ones and hold an image where it does not belong.
        """
        model = self.model
        longer = dict.fromkeys(model.reg_image_ids(), 0)
        short = []
        for point_id, point in model.points3D.items():
            images = {element.image_id for element in point.track.elements}
            if len(images) > 2:
                for image_id in images:
                    longer[image_id] += 1
            else:
                short.append((point_id, images))
        for point_id, images in short:
            if len(images) < 2 or all(longer[i] >= MANY_OBSERVATIONS for i in images):
                self.mapper.observation_manager.delete_point3D(point_id)


def agrees(
    features: MatchedFeatures, model: pycolmap.Reconstruction, image_id: int, collection: ImageCollection
) -> bool:
    """Most verified matches of the image with others that have a pose lie on their epipolar lines."""
    poses = poses_of(model)
    around = {
        pair: rows for pair, rows in features.verified.items() if image_id - 1 in pair and all(i in poses for i in pair)
    }
    near = {i: poses[i] for pair in around for i in pair}
    views = views_of(near, cameras_of(model, collection.cameras), collection)
    consent = ask_consent(replace(features, raw=around, verified=around), views, tolerance=LOOSE_PART)
    return consent.correspondences.num_matches >= MIN_AGREEING_PART * max(sum(map(len, around.values())), 1)


def views_of(
    poses: Mapping[int, FloatArray], cameras: Sequence[Intrinsics], collection: ImageCollection
) -> dict[int, View]:
    """The cameras by image index, as consent asks for them.

    Args:
        poses: (3, 4) ``cam_from_world`` by image index.
        cameras: by camera index.
        collection: says which image has which camera.
    """
    return {i: View(cam_from_world=pose, intrinsics=cameras[collection.images[i].camera]) for i, pose in poses.items()}

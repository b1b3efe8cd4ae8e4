"""Predicted against true errors of the camera positions of finished runs, and the verdict.

    python scripts/judge_uncertainty.py OUT=../shared/data/castle_p30 OUT2=../shared/data/kitti_a
    python scripts/judge_uncertainty.py --spoil scale OUT=../shared/data/castle_p30

OUT is a finished run of ``reconstruct`` or ``refine``. The uncertainty is measured anew from its largest model and its
matches, so that nothing is reconstructed. A data set has ``poses.txt`` (truth), or ``reference_sparse/`` (a model of
COLMAP). A reference model has errors of its own; they are taken to be as large as predicted here, so that the
difference of the two has twice the variance.

``--spoil`` makes a wrong model of each run first: ``turn`` turns the middle third by 5 degrees about its first camera,
``scale`` scales it by 5 %, ``apart`` moves the second half by 5 % of the extent. Points go where most of the images do
that see them, and observations off by more than 4 pixels are discarded, as a mapper does.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from smust3r_colmap.colmap.reconstruction import poses_of
from smust3r_colmap.errors import InputError, SmustrError
from smust3r_colmap.evaluation.absolute_error import position_errors
from smust3r_colmap.evaluation.predicted_error import PredictedErrors
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.features.guided_verification import View, read_matched_features
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.refinement.acceptance import MAX_ERROR_PX
from smust3r_colmap.refinement.bundle_adjustment import MIN_ANGLE_DEG, extent_of
from smust3r_colmap.refinement.contradictions import point_support
from smust3r_colmap.refinement.model_uncertainty import ModelUncertainty, measure_uncertainty, summarise_uncertainty
from smust3r_colmap.refinement.reregistration import pair_support
from smust3r_colmap.report.verdict import FAILED_PERCENT, reasons_about

SPOILERS = ("turn", "scale", "apart")
SPOILT_DEG, SPOILT_FRACTION = 5.0, 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """One run.

    Args:
        name: of the data set. uncertainty: of its model.
        errors: (K,) true errors of the positions, of the images with a truth, in extents of the model's path.
        sigmas: (K,) predicted standard deviations of these, in the same unit.
    """

    name: str
    uncertainty: ModelUncertainty
    errors: FloatArray
    sigmas: FloatArray

    @property
    def figures(self) -> PredictedErrors:
        """How large they are, and how often the true ones are within multiples of the predicted."""
        return PredictedErrors.of(self.errors, self.sigmas)


def judge(run: Path, data: Path, *, spoil: str = "", calibrated: bool = False) -> Judged:
    """Measure the largest model of a run.

    Raises:
        InputError: there is no model, or no truth.
    """
    world_from_cam_true, is_reference = _truth(data)
    try:
        model = pycolmap.Reconstruction(run / "sparse/0")
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{run}: no model in sparse/0: {str(error).splitlines()[0]}") from error
    if spoil:
        spoil_model(model, spoil)
    uncertainty = measure(model, run / "work/features/database.db", calibrated=calibrated)
    estimated = {image.name: invert_rigid(image.cam_from_world().matrix()) for image in _registered(model)}
    fit = compare_trajectories(estimated, world_from_cam_true).reference_from_estimated
    names = [name for name in uncertainty.names if name in world_from_cam_true]
    moved = fit.move_cameras(np.stack([estimated[name] for name in names]))
    true = np.stack([world_from_cam_true[name] for name in names])
    extent = uncertainty.extent * float(fit.scale)
    sigma_of = dict(zip(uncertainty.names, uncertainty.position_sigma / uncertainty.extent, strict=True))
    own = np.sqrt(2) if is_reference else 1.0
    return Judged(
        name=data.name,
        uncertainty=uncertainty,
        errors=position_errors(moved, true) / extent,
        sigmas=own * np.array([sigma_of[name] for name in names]),
    )


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return [model.image(i) for i in sorted(model.reg_image_ids())]


def _truth(data: Path) -> tuple[dict[str, FloatArray], bool]:
    """``world_from_cam`` by name, and whether it is a reference model."""
    if (data / "poses.txt").is_file():
        return read_poses_txt(data / "poses.txt"), False
    return read_model_poses(data / "reference_sparse"), True


def measure(model: pycolmap.Reconstruction, database: Path, *, calibrated: bool) -> ModelUncertainty:
    """The uncertainty of a model with the matches of a run's feature database."""
    poses = poses_of(model)
    features = read_matched_features(database, poses)
    cameras = {i: Intrinsics.from_colmap(model.camera(model.image(i + 1).camera_id)) for i in poses}
    views = {i: View(cam_from_world=pose, intrinsics=cameras[i]) for i, pose in poses.items()}
    supports = (pair_support(features, views), point_support(model, features))
    return measure_uncertainty(model, supports, calibrated=calibrated)


def spoil_model(model: pycolmap.Reconstruction, how: str) -> None:
    """Make a model wrong, in place; see the module."""
    ids = sorted(model.reg_image_ids())
    centres = {i: np.asarray(model.image(i).projection_center()) for i in ids}
    n = len(ids)
    part = set(ids[n // 2 :] if how == "apart" else ids[n // 3 : 2 * n // 3])
    angle = np.deg2rad(SPOILT_DEG) if how == "turn" else 0.0
    scale = 1 + SPOILT_FRACTION if how == "scale" else 1.0
    shift = SPOILT_FRACTION * extent_of(np.stack(list(centres.values()))) if how == "apart" else 0.0
    rotation, fixed = Rotation.from_rotvec([0, angle, 0]).as_matrix(), centres[min(part)]
    moved = pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), fixed - scale * rotation @ fixed + [shift, 0, 0])
    for image_id in part:
        image = model.image(image_id)
        model.frame(image.frame_id).rig_from_world = moved.transform_camera_world(image.cam_from_world())
    for point in model.points3D.values():
        inside = [element.image_id in part for element in point.track.elements]
        if 2 * sum(inside) > len(inside):
            point.xyz = moved * point.xyz
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)


def verdict_of(uncertainty: ModelUncertainty) -> tuple[str, list[str]]:
    """What the uncertainty alone says of a model: level and reasons."""
    summary = summarise_uncertainty(uncertainty)
    reasons = [reason.text for reason in reasons_about("sparse/0", summary, 1.0)]
    failed = summary.predicted_error_percent >= FAILED_PERCENT
    return ("good" if not reasons else "failed" if failed else "weak"), reasons


def main(argv: Sequence[str] | None = None) -> int:
    """Print one line per run with its reasons, and the shares of all together."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", metavar="OUT=DATA", help="a finished run, and the folder with its truth")
    parser.add_argument("--spoil", choices=SPOILERS, default="", help="make each model wrong first")
    parser.add_argument("--calibrated", action="store_true", help="the intrinsics were given, not adjusted")
    arguments = parser.parse_args(argv)
    judged = []
    try:
        for pair in arguments.runs:
            run, _, data = pair.partition("=")
            if not data:
                raise InputError(f"{pair}: needed OUT=DATA")
            judged.append(judge(Path(run), Path(data), spoil=arguments.spoil, calibrated=arguments.calibrated))
            print(_line(judged[-1]), flush=True)
    except SmustrError as error:
        print(f"judge_uncertainty: {error}", file=sys.stderr)
        return 2
    together = PredictedErrors.of(
        *(np.concatenate([getattr(one, name) for one in judged]) for name in ("errors", "sigmas"))
    )
    print("all images together: within 1, 2, 3 sigma: " + ", ".join(f"{share:.0f} %" for share in together.within))
    return 0


def _line(one: Judged) -> str:
    level, reasons = verdict_of(one.uncertainty)
    true, predicted = 100 * one.figures.true_rmse, 100 * one.figures.predicted_rmse
    shares = ", ".join(f"{share:.0f} %" for share in one.figures.within)
    head = f"{one.name}: true {true:.3f} %, predicted {predicted:.3f} % of the extent; within 1, 2, 3 sigma: {shares}"
    return "\n".join([f"{head}; {level}", *(f"    {reason}" for reason in reasons)])


if __name__ == "__main__":
    sys.exit(main())

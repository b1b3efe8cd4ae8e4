"""``smust3r-colmap refine``: the flags for refining a model that another program made.

``refine_model`` does the work and is imported when the command runs, so that ``--help`` answers at once;
``cli`` prints the summary that comes back.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from smust3r_colmap.config import ClassicalConfig, ImportConfig, OutputConfig, RefinementConfig, RunConfig
from smust3r_colmap.errors import ConfigError
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.report.summary import RunSummary

MAX_POSE_TOLERANCE = 0.2
"""Beyond it hardly a match is refused, and the poses count for nothing."""


@dataclass(frozen=True, kw_only=True)
class Refine:
    """Give a COLMAP model that another program made real tracks, and adjust it to them (VGGT, MASt3R and the like).

    Poses must be as COLMAP has them, camera from world: camera centres in place of translations, or rotations
    the other way round, cannot be told from the numbers, and no track will agree with them. Start the same
    command again to go on after an interruption.
    """

    model: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL")]
    """Folder with cameras and images, .bin or .txt, or one with sparse/0 in it; points help, but may be missing."""
    images: Annotated[Path, tyro.conf.arg(metavar="IMAGES")]
    """Folder of the images at full size; files are found by name, base name or name without suffix."""
    output: Annotated[Path, tyro.conf.arg(metavar="OUT")] = Path("refined_out")
    """Folder of the result; made when missing."""
    share_cameras: bool = True
    """Make one camera of those that have one image each and nearly the same focal length."""
    camera_model: str = ""
    """COLMAP model of the cameras of the result; by default as they are, but SIMPLE_RADIAL for pinholes."""
    calibrated: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The cameras are known: leave their parameters as they are."""
    principal_point: bool = RefinementConfig.principal_point
    """Let the principal points move where two halves of the points agree on where they are."""
    pose_tolerance: float = 0.03
    """How far from its epipolar line a match may lie at first, as a part of the longer image side. Enough for cameras
    that are 3 degrees and 3 % of the extent off; smaller where the scene has places that look alike."""
    track_neighbours: int = RefinementConfig.track_neighbours
    """Images that each image is matched with, chosen by how much of the same surface they see."""
    complete: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Also try to place the images of IMAGES that the model lacks: by the points they share with it, then by COLMAP's
    incremental mapper."""
    masks: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of masks, IMAGE.png after the name of the image or STEM.png without its suffix, as large as the upright
    image. Where they are black there are no features, and trainers get them."""
    max_image_size: int = ClassicalConfig.max_image_size
    """Longer side at which SIFT runs."""
    max_features: int = ClassicalConfig.max_features
    """SIFT features per image; matching costs the square of it."""
    text: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write the COLMAP model as .txt beside the .bin files."""
    trainer: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write OUT/trainer, for splat and NeRF trainers."""
    workers: int = 0
    """Processes; 0 takes one per core that this process may use."""
    seed: int = 0
    """Of every random choice."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Throw away what an earlier run left in OUT."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print what the stages log, and the traceback of an unexpected error."""

    def __post_init__(self) -> None:
        if not 0 < self.pose_tolerance <= MAX_POSE_TOLERANCE:
            raise ConfigError(
                f"--pose-tolerance {self.pose_tolerance}: a part of the image side, above 0 up to {MAX_POSE_TOLERANCE}"
            )

    def run_config(self) -> RunConfig:
        """The settings of the run that the flags stand for; without depth maps there is no dense workspace."""
        return RunConfig(
            importing=ImportConfig(masks="" if self.masks is None else str(self.masks)),
            classical=ClassicalConfig(max_image_size=self.max_image_size, max_features=self.max_features),
            refinement=RefinementConfig(
                track_neighbours=self.track_neighbours, complete=self.complete, principal_point=self.principal_point
            ),
            output=OutputConfig(text=self.text, trainer=self.trainer, dense=False),
            workers=self.workers,
            seed=self.seed,
        )


def run_refine(command: Refine, reporter: Reporter) -> RunSummary:
    """Refine the model; errors leave as they are, see ``refine_model``."""
    from smust3r_colmap.importers.stage import CameraChoice  # noqa: PLC0415  (--help shall not pay for it)
    from smust3r_colmap.refine_model import refine_model  # noqa: PLC0415

    return refine_model(
        command.model,
        command.images,
        command.output,
        command.run_config(),
        pose_tolerance=command.pose_tolerance,
        cameras=CameraChoice(share=command.share_cameras, model=command.camera_model, calibrated=command.calibrated),
        overwrite=command.overwrite,
        reporter=reporter,
    )

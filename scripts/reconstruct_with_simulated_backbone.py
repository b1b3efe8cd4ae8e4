"""A whole run with a simulated backbone on an RGB-D data set: the error that the pipeline itself adds to good depth.

    python scripts/reconstruct_with_simulated_backbone.py ../shared/data/kitchen_rgbd OUT --workers 1
    python scripts/judge_depth_maps.py OUT ../shared/data/kitchen_rgbd

The simulated backbone (``synthetic.backbone``) takes the place of a network: cameras and depth of the data set, with
the simulated errors of a preset. All else is the usual run, refinement by SIFT and ``dense/`` included. Only
``trainer/``, which is not evaluated, is left out. The data set has ``images/``, ``depth/*.png`` (16 bits, millimetres),
``poses.txt`` and ``intrinsics.txt`` of a Kinect's depth sensor.

Photographs are those of the colour camera, an inch beside the sensor. What the sensor measured is therefore
drawn as that camera sees it, with the registration by which ``judge_depth_maps.py`` judges. A photograph without a
depth map borrows the readings of its neighbours.

The run reads a folder of images. A choice of them is linked into ``OUT_images`` beside ``OUT``, which is to stay as
long as formats shall be exported.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import numpy.typing as npt
from judge_depth_maps import NO_LIMIT_PX

from smust3r_colmap.backbones.base import BackboneContext, BackboneFactory
from smust3r_colmap.config import OutputConfig, RunConfig
from smust3r_colmap.errors import InputError, SmustrError
from smust3r_colmap.evaluation.depth_error import KINECT_COLOUR_FROM_SENSOR, depth_in_view
from smust3r_colmap.execution.progress import reporter_for
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.geometry.sim3 import invert_rigid
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.storage.run_directory import storage_errors
from smust3r_colmap.synthetic.backbone import SimulatedBackbone
from smust3r_colmap.synthetic.distortion import homogeneous
from smust3r_colmap.synthetic.settings import PRESETS
from smust3r_colmap.synthetic.truth import TrueScene

FloatMap = npt.NDArray[np.float32]
RgbImage = npt.NDArray[np.uint8]

SUBSET_FILE = "subset_every5.txt"
COLOUR_CAMERA = Intrinsics(model="SIMPLE_RADIAL", width=640, height=480, params=(534.0, 320.0, 240.0, -0.0175))
"""Of the photographs, for ``intrinsics.txt`` has the sensor's: one of the 200 that COLMAP's global mapper finds on
kitchen_rgbd, whose focal lengths have a median of 531.6 and a deviation of 3.5 px."""
MAP_SIZE_PX = (384, 288)
"""Width and height of the simulated maps: as large as those of the classical backbone, and three fifths of the
sensor's, so that the readings leave no holes in a surface."""


def main(words: Sequence[str] | None = None) -> int:
    """Reconstruct the data set named on the command line; exit codes as those of ``smust3r-colmap reconstruct``."""
    arguments = parse_arguments(words)
    config = RunConfig(
        backbone="simulated",
        backbone_options=f"preset={arguments.preset}",
        output=OutputConfig(trainer=False, dense=not arguments.no_dense),
        workers=arguments.workers or "auto",
    )
    try:
        images = chosen_images(arguments.data, arguments.images, arguments.output)
        summary = reconstruct(
            images,
            arguments.output,
            config,
            reporter=reporter_for(sys.stderr, quiet=False),
            factory=factory_of(arguments.data, arguments.preset),
        )
    except SmustrError as error:
        print(error, file=sys.stderr)
        return 2 if isinstance(error, InputError) else 1
    print(summary.render_text())
    return summary.exit_code


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="data set with images/, depth/, poses.txt and intrinsics.txt")
    parser.add_argument("output", type=Path, metavar="OUT", help="folder of the run; made when missing")
    parser.add_argument(
        "--images",
        type=Path,
        metavar="FILE",
        help=f"names of the images to take, one a line (DATA/{SUBSET_FILE}, or else all)",
    )
    parser.add_argument("--preset", choices=sorted(PRESETS), default="network", help="simulated errors (%(default)s)")
    parser.add_argument("--workers", type=int, help="processes; by default one per core")
    parser.add_argument("--no-dense", action="store_true", help="leave out the dense workspace")
    return parser.parse_args(words)


# ------------------------------------------------------------------------------- images
def chosen_images(data: Path, list_file: Path | None, output: Path) -> Path:
    """The folder to reconstruct: links to the images named in the list, or all images where there is none.

    Raises:
        InputError: the list cannot be read or names what is missing, or the folder for the links has other files.
        StorageError: the disk refused.
    """
    subset = list_file or data / SUBSET_FILE
    if list_file is None and not subset.exists():
        return data / "images"
    try:
        lines = subset.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"{subset}: needed a text file with names of images: {error}") from error
    names = [line.strip() for line in lines if line.strip()]
    links = output.resolve().with_name(f"{output.resolve().name}_images")
    with storage_errors(links):
        link_images(data / "images", names, links)
    return links


def link_images(images: Path, names: Sequence[str], links: Path) -> None:
    """Fill a folder with links to the named images, new or from an earlier start.

    Args:
        names: paths below ``images``, with forward slashes; subfolders are made.

    Raises:
        InputError: an image is missing or not below ``images``, or the folder has something else in it.
    """
    if outside := [name for name in names if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts]:
        raise InputError(f"{images}: {outside[0]} does not lie in it; names are paths below that folder")
    if missing := [name for name in names if not (images / name).is_file()]:
        raise InputError(f"{images}: {len(missing)} of {len(names)} images are missing, the first is {missing[0]}")
    links.mkdir(parents=True, exist_ok=True)
    there = {path.relative_to(links).as_posix(): path for path in links.rglob("*") if not is_plain_folder(path)}
    others = sorted(name for name, path in there.items() if name not in names or not path.is_symlink())
    if others:
        raise InputError(
            f"{links}: has {len(others)} files besides links to the {len(names)} images, such as {others[0]}; "
            "delete the folder or name another OUT"
        )
    for name in names:
        (links / name).parent.mkdir(parents=True, exist_ok=True)
        (links / name).unlink(missing_ok=True)  # it may lead to another data set
        (links / name).symlink_to((images / name).resolve())


def is_plain_folder(path: Path) -> bool:
    """A real folder, and no link to one."""
    return path.is_dir() and not path.is_symlink()


# ----------------------------------------------------------------------------- backbone
def factory_of(data: Path, preset: str) -> BackboneFactory:
    """Makes the simulated backbone of a data set for the images of the run."""

    def make_simulated(context: BackboneContext) -> SimulatedBackbone:
        truth = colour_scene(data, [image.name for image in context.collection.images])
        return SimulatedBackbone(truth, context.collection, PRESETS[preset], context.config.seed)

    return make_simulated


def colour_scene(data: Path, names: Sequence[str]) -> TrueScene:
    """The images with the cameras and the depth of the colour camera, in metres.

    Raises:
        InputError: a file of the data set is not as it should be, or its images are not as large as a Kinect's.
    """
    sensor = TrueScene.from_rgbd_folder(data, names, max_size=NO_LIMIT_PX)
    size, needed = ((one.width, one.height) for one in (sensor.intrinsics, COLOUR_CAMERA))
    if size != needed:
        raise InputError(
            f"{data / 'intrinsics.txt'}: images of {size[0]} x {size[1]} pixels, needed {needed[0]} x {needed[1]}: "
            "the colour camera of a Kinect is assumed"
        )
    return TrueScene(
        names=sensor.names,
        world_from_cam=sensor.world_from_cam @ homogeneous(invert_rigid(KINECT_COLOUR_FROM_SENSOR)),
        intrinsics=COLOUR_CAMERA.resized(*MAP_SIZE_PX),
        metric=sensor.metric,
        views=ColourViews(sensor),
    )


class ColourViews:
    """``Views`` of the colour camera: its photographs, and what the sensor beside it measured.

    Args:
        sensor: the photographs, with the cameras and the depth of the sensor.
    """

    def __init__(self, sensor: TrueScene) -> None:
        self._sensor = sensor
        self._camera = COLOUR_CAMERA.resized(*MAP_SIZE_PX)
        self._depths: dict[int, FloatMap] = {}

    def depth(self, k: int) -> FloatMap:
        """(H, W) z-depth of image k in metres, 0 where the sensor measured nothing."""
        if k not in self._depths:
            measured = self._sensor.depth(k)
            self._depths[k] = depth_in_view(measured, self._sensor.intrinsics, KINECT_COLOUR_FROM_SENSOR, self._camera)
        return self._depths[k]

    def rgb(self, k: int) -> RgbImage:
        """(H, W, 3) of image k."""
        return np.asarray(cv2.resize(self._sensor.rgb(k), MAP_SIZE_PX, interpolation=cv2.INTER_AREA), dtype=np.uint8)


if __name__ == "__main__":
    sys.exit(main())

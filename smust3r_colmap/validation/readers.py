"""The programs that read COLMAP models, as data: which rule makes each of them stop or do worse.

To add one, write a ``Reader`` into ``READERS``: ``refuses`` and ``warns`` map the name of a rule to what happens then.
"Refuses" is for a program that stops, or that goes on silently with wrong data; "warns" for one that works and gives
less. Rules that are wrong by themselves (``Severity.REFUSED`` and worse) need not be named: no program can use such a
model. A rule that affects no program has its own severity only. Every entry was seen in a run of the program or read
in its source, which ``evidence`` says. The next module to read is ``report``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from smust3r_colmap.errors import ConfigError
from smust3r_colmap.validation.checks_cameras import camera_model_rule
from smust3r_colmap.validation.description import CAMERA_MODELS


@dataclass(frozen=True, kw_only=True)
class Reader:
    """One program, or a family that shares its reader.

    Args:
        name: short, for tables and for ``--readers``.
        program: in full, with the version looked at.
        reads: which files.
        evidence: it was run on test models, or its source was read.
        refuses, warns: what happens, by name of the rule.
    """

    name: str
    program: str
    reads: str
    evidence: Literal["run", "source"]
    refuses: Mapping[str, str]
    warns: Mapping[str, str] = field(default_factory=dict)


def other_models(known: Iterable[str], what_happens: str) -> dict[str, str]:
    """Rules for every camera model that is not among the known ones."""
    return {camera_model_rule(model): what_happens for model in CAMERA_MODELS if model not in set(known)}


_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
_FIRST_ELEVEN = tuple(list(CAMERA_MODELS)[:11])
"""Numbers 0 to 10, which COLMAP had for many years."""

_COLMAP_CANNOT_LOAD = {
    "colmap-cannot-read": "stops while reading",
    "points-file-missing": "stops: wants a points3D file, empty if need be",
    "rigs-incomplete": "stops: wants rigs and frames, or neither",
    "frame-dangling": "stops while joining frames and images",
    "track-dangling": "stops at the first such element",
    "track-disagrees": "stops at the first such observation",
    "track-pseudo-zero": "stops: there is no such image or observation",
    "name-blank-in-text": "reads the name up to the first blank",
}

_NO_IMAGE = "stops at the first missing file"
_READS_AS_STORED = "reads the pixels as stored, so width and height are swapped"
_FLOAT32 = "computes with 32-bit numbers and rounds positions"
_NO_START = "stops: has no points to start from"

_NO_IMAGE_OF_TRANSFORMS = "stops at the first missing file of transforms.json"
_TRANSFORMS_UNUSABLE = {
    "transforms-unreadable": "stops when it is given transforms.json",
    "transforms-image-missing": _NO_IMAGE_OF_TRANSFORMS,
    "transforms-pose-not-rigid": "trains from transforms.json with a camera that is none",
}
"""Of nerfstudio's parser of transforms.json and of instant-ngp's loader, by their source."""

_GRAPHDECO = {
    **other_models(_PINHOLES, "stops: only undistorted (SIMPLE_)PINHOLE images are handled"),
    "text-simple-pinhole": "stops: its text reader takes PINHOLE only",
    "points-none": _NO_START,
    "points-file-missing": _NO_START,
    "ply-unreadable": "takes the PLY before points3D.bin, and then has no points",
    "ply-incomplete": "takes the PLY before points3D.bin, and then has no points",
    "image-file-missing": _NO_IMAGE,
    "image-exif-against-camera": _READS_AS_STORED,
    "name-blank-in-text": "reads the name up to the first blank",
}
_GRAPHDECO_WORSE = {
    "model-without-number": "looks in sparse/0 only",
    "principal-point-off-centre": "ignores cx and cy and takes the centre: blurred",
    "ply-stale": "trains from the PLY, not from points3D.bin",
    "coordinates-large": _FLOAT32,
    "outlier-cameras": "scales its steps by the extent of the cameras",
    "camera-kinds-mixed": "handles pinhole cameras only",
}

READERS: tuple[Reader, ...] = (
    Reader(
        name="COLMAP",
        program="COLMAP and pycolmap 4.2: reading, triangulation, adjustment, mapping, undistortion",
        reads=".bin or .txt",
        evidence="run",
        refuses={
            **_COLMAP_CANNOT_LOAD,
            "observation-dangling": "bundle adjustment stops with an IndexError",
            "track-single": 'bundle adjustment stops: "track.Length() > 1"',
            "image-size-resized": "undistortion and feature extraction refuse these images",
            "image-exif-against-camera": _READS_AS_STORED,
            "database-image-missing": "cannot continue from this model with this database",
            "database-image-id-differs": "cannot continue from this model with this database",
            "database-camera-id-differs": "cannot continue from this model with this database",
            "database-frame-id-differs": "triangulation stops with an IndexError",
            "database-keypoints-differ": "the mapper refuses a model with other observations",
            "dense-normals-missing": "fusion stops",
            "dense-map-size": "fusion stops",
            "dense-config-dangling": "fusion stops",
        },
        warns={
            "tracks-all-missing": "can show the model and not adjust it; hides points with fewer views than 3 at first",
            "name-blank": "cuts the names when it writes and reads text",
            "frame-pose-differs": "takes the pose of the frame",
            "mask-missing": "feature extraction skips images without a mask",
            "id-too-large": "databases cannot hold the id",
            "image-file-missing": "leaves these images out of a dense workspace",
        },
    ),
    Reader(
        name="3DGS",
        program="graphdeco gaussian-splatting of 2024 and later, and its forks",
        reads="sparse/0, .bin before .txt",
        evidence="run",
        refuses=_GRAPHDECO,
        warns=_GRAPHDECO_WORSE,
    ),
    Reader(
        name="3DGS-2023",
        program="forks of gaussian-splatting of 2023: 2dgs, mip-splatting, speedy-splat and others",
        reads="sparse/0, .bin before .txt",
        evidence="run",
        refuses={
            **_GRAPHDECO,
            "name-subfolder": "drops the folder from the name and finds no file",
            "name-two-dots": "cuts the name at its first dot",
            "name-stem-clash": "takes these images for one",
        },
        warns=_GRAPHDECO_WORSE,
    ),
    Reader(
        name="3DGS-depth",
        program="depth regularisation of gaussian-splatting, with its script make_depth_scale.py",
        reads="images.bin, depths/*.png, depth_params.json",
        evidence="run",
        refuses={
            "depth-params-unreadable": "stops",
            "depth-params-without-png": "stops",
            "depth-png-without-params": "stops",
            "tracks-all-missing": "every scale becomes 0",
            "point-id-huge": "makes an array as long as the largest point id",
            "name-stem-clash": "takes one depth map for two images",
        },
        warns={
            "depth-scale-ignored": "leaves these maps out",
            "image-unobserved": "their scales become 0",
            "image-weak": "fits their scales to a handful of points",
        },
    ),
    Reader(
        name="gsplat",
        program="gsplat examples, August 2026",
        reads="sparse/0 or sparse, through pycolmap",
        evidence="run",
        refuses={
            **_COLMAP_CANNOT_LOAD,
            **other_models(
                (*_PINHOLES, "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"),
                "has no such camera: stops, or takes it for the one before",
            ),
            "camera-kinds-mixed": "treats all cameras as the last one",
            "points-none": _NO_START,
            "observation-dangling": "stops with a KeyError",
            "image-unobserved": "stops with a KeyError when trained with depth loss",
            "image-file-missing": _NO_IMAGE,
            "image-exif-against-camera": _READS_AS_STORED,
            "downscaled-list-differs": "pairs images with the wrong files, without a word",
        },
        warns={
            "image-size-resized": "scales the intrinsics of all cameras by the ratio of the first image",
            "downscaled-size-differs": "scales the intrinsics of all cameras by the ratio of the first image",
            "model-not-largest": "takes model 0",
            "coordinates-large": _FLOAT32,
            "outlier-cameras": "normalises the scene by the distances of its cameras",
        },
    ),
    Reader(
        name="nerfstudio",
        program="nerfstudio, ColmapDataParser and colmap_to_json, July 2025; NerfstudioDataParser by its source",
        reads="colmap/sparse/0 (.txt before .bin for cameras and images, .bin before .txt for points), transforms.json",
        evidence="run",
        refuses={
            **other_models(
                (
                    *_PINHOLES,
                    "SIMPLE_RADIAL",
                    "RADIAL",
                    "OPENCV",
                    "OPENCV_FISHEYE",
                    "SIMPLE_RADIAL_FISHEYE",
                    "RADIAL_FISHEYE",
                ),
                "stops: not supported",
            ),
            "camera-kinds-mixed": "stops: all cameras must be of one kind",
            "points-file-missing": "stops with a ValueError",
            "image-file-missing": _NO_IMAGE,
            "image-exif-against-camera": _READS_AS_STORED,
            "mask-missing": "stops when masks are wanted: every image needs one",
            "name-blank-in-text": "reads the name up to the first blank",
            **_TRANSFORMS_UNUSABLE,
            "transforms-comments": "stops at the first comment when it is given transforms.json",
            "transforms-sharp-image-missing": _NO_IMAGE_OF_TRANSFORMS,
            "transforms-image-ending": _NO_IMAGE_OF_TRANSFORMS,
            "transforms-camera-model": "stops with a KeyError when it is given transforms.json",
            "transforms-intrinsics": "stops: wants focal lengths, principal point and size, for all or for every frame",
            "transforms-masks-incomplete": "stops: wants a mask for every frame of transforms.json or for none",
            "transforms-size-differs": "stops, or samples beside the image, when it is given transforms.json",
        },
        warns={
            "transforms-points-missing": "has no points to start splats from when it is given transforms.json",
            "transforms-cameras-differ": "trains other cameras from transforms.json than from the model",
            "camera-id-not-one": "writes intrinsics for every image, as if cameras were not shared",
            "outlier-cameras": "scales the scene by its farthest camera, so the rest becomes tiny",
            "downscaled-list-differs": "misses files of the smaller size",
            "image-size-resized": "takes the size from the model and not from the file",
            "model-not-largest": "takes model 0",
            "coordinates-large": _FLOAT32,
        },
    ),
    Reader(
        name="instant-ngp",
        program="colmap2nerf.py, February 2026; the program itself by its source",
        reads=".txt only (convert with pycolmap: write_text), or transforms.json",
        evidence="run",
        refuses={
            **other_models(
                (
                    *_PINHOLES,
                    "SIMPLE_RADIAL",
                    "RADIAL",
                    "OPENCV",
                    "OPENCV_FISHEYE",
                    "SIMPLE_RADIAL_FISHEYE",
                    "RADIAL_FISHEYE",
                ),
                "says that the camera is unknown and goes on without its parameters",
            ),
            "image-unobserved": "stops at the empty line with an IndexError",
            "name-blank": "makes _ of the blanks and finds no file",
            "image-file-missing": "stops: reads every image for its sharpness",
            **_TRANSFORMS_UNUSABLE,
        },
        warns={
            "coordinates-large": _FLOAT32,
            "transforms-sharp-image-missing": "leaves these frames of transforms.json out",
            "transforms-size-differs": "takes focal lengths and principal point in pixels of another size",
            "transforms-cameras-differ": "trains other cameras from transforms.json than from the model",
        },
    ),
    Reader(
        name="Brush",
        program="Brush, August 2026",
        reads=".bin or .txt of the model with most images",
        evidence="run",
        refuses={
            **other_models(_FIRST_ELEVEN, "stops: knows numbers 0 to 10"),
            "name-ending-clash": "takes the first file whose path ends like the name, which may be another",
            "name-case-clash": "does not tell upper from lower case",
            "points-file-missing": "wants all three files",
        },
        warns={
            camera_model_rule("FOV"): "treats it as a pinhole camera",
            "image-file-missing": "leaves these images out",
            "outlier-cameras": "training may explode",
            "name-stem-clash": "may take the mask of another image",
            "coordinates-large": _FLOAT32,
        },
    ),
    Reader(
        name="read_write_model",
        program="copies of COLMAP's read_write_model.py: hloc, MVSNets and many scripts",
        reads=".bin or .txt",
        evidence="run",
        refuses={
            **other_models(_FIRST_ELEVEN, "stops with a KeyError"),
            "name-blank-in-text": "reads the name up to the first blank",
            "points-file-missing": "stops: opens all three files",
        },
    ),
    Reader(
        name="kapture",
        program="kapture_import_colmap, January 2026",
        reads=".txt and the database",
        evidence="run",
        refuses={
            **other_models(_FIRST_ELEVEN, "does not know the camera"),
            "name-comma": "commas separate the columns of its files",
            "name-blank": "blanks end a name",
        },
    ),
    Reader(
        name="OpenSplat",
        program="OpenSplat, November 2025",
        reads=".bin only",
        evidence="source",
        refuses={
            "text-only": "stops: reads .bin only",
            **other_models((*_PINHOLES, "SIMPLE_RADIAL", "OPENCV"), "stops: unsupported camera model"),
            "points-file-missing": _NO_START,
            "points-none": _NO_START,
            "image-file-missing": _NO_IMAGE,
        },
        warns={"coordinates-large": _FLOAT32},
    ),
    Reader(
        name="LichtFeld",
        program="LichtFeld Studio, October 2025",
        reads=".bin or .txt",
        evidence="source",
        refuses={
            **other_models(
                tuple(model for model in _FIRST_ELEVEN if model not in ("FOV", "THIN_PRISM_FISHEYE")),
                "stops: unsupported camera model",
            ),
            "file-trailing-bytes": "stops: bytes are left over",
            "text-last-line-empty": "drops the last line and stops because lines are odd",
        },
        warns={"image-size-resized": "says so and goes on"},
    ),
    Reader(
        name="OpenMVS",
        program="OpenMVS InterfaceCOLMAP, 2024",
        reads="an undistorted workspace: sparse, images, stereo",
        evidence="source",
        refuses={
            **other_models(("PINHOLE",), "stops: PINHOLE only"),
            "track-dangling": "stops at points that name unknown images",
            "track-pseudo-zero": "stops at points that name unknown images",
            "image-file-missing": _NO_IMAGE,
        },
    ),
)


def find_readers(names: Iterable[str]) -> tuple[Reader, ...]:
    """The readers of these names, in the order of the table; all of them where no name is given.

    Raises:
        ConfigError: a name is not in the table.
    """
    wanted = {name.lower() for name in names}
    unknown = wanted - {reader.name.lower() for reader in READERS}
    if unknown:
        known = ", ".join(reader.name for reader in READERS)
        raise ConfigError(f"--readers {sorted(unknown)[0]}: no such reader; there are {known}")
    return tuple(reader for reader in READERS if not wanted or reader.name.lower() in wanted)

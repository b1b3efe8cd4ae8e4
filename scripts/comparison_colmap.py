"""One stage of COLMAP's on a folder of images; ``compare_with_colmap`` runs each in a process of its own.

    python scripts/comparison_colmap.py features|matching|incremental|global IMAGES WORK auto|single

It imports next to nothing, so that COLMAP is not charged for what only the comparison needs.
"""

from __future__ import annotations

import shutil
import sys
from itertools import combinations
from pathlib import Path

import pycolmap

SIFT_IMAGE_SIZE = 1024
SIFT_FEATURES = 6000
EXHAUSTIVE_UP_TO = 50
SEQUENTIAL_OVERLAP = 10
SPREAD_IMAGES = 80


def main() -> None:
    """Run the stage named on the command line."""
    stage, cameras = sys.argv[1], sys.argv[4]
    images, work = Path(sys.argv[2]), Path(sys.argv[3])
    if stage == "features":
        extract_features(images, work, cameras)
    else:
        {"matching": match_features, "incremental": map_incrementally, "global": map_globally}[stage](images, work)


def extract_features(images: Path, work: Path, cameras: str) -> None:
    """SIFT of all images; with ``auto`` cameras are shared where COLMAP thinks they are, with ``single`` by all."""
    options = pycolmap.FeatureExtractionOptions(max_image_size=SIFT_IMAGE_SIZE)
    options.sift.max_num_features = SIFT_FEATURES
    (work / "database.db").unlink(missing_ok=True)
    mode = {"auto": pycolmap.CameraMode.AUTO, "single": pycolmap.CameraMode.SINGLE}[cameras]
    pycolmap.extract_features(work / "database.db", images, camera_mode=mode, extraction_options=options)


def match_features(images: Path, work: Path) -> None:
    """All pairs of a small set; neighbours and spread images of a sequence."""
    names = sorted(path.relative_to(images).as_posix() for path in images.rglob("*") if path.is_file())
    if len(names) <= EXHAUSTIVE_UP_TO:
        pycolmap.match_exhaustive(work / "database.db")
        return
    neighbours = pycolmap.SequentialPairingOptions(overlap=SEQUENTIAL_OVERLAP, quadratic_overlap=True)
    pycolmap.match_sequential(work / "database.db", pairing_options=neighbours)
    spread = names[:: -(-len(names) // SPREAD_IMAGES)]
    pair_list = work / "pairs.txt"
    pair_list.write_text("".join(f"{a} {b}\n" for a, b in combinations(spread, 2)), encoding="utf-8")
    pairs = pycolmap.ImportedPairingOptions(match_list_path=pair_list)
    pycolmap.match_image_pairs(work / "database.db", pairing_options=pairs)


def map_incrementally(images: Path, work: Path) -> None:
    """COLMAP's incremental mapper with its defaults."""
    pycolmap.incremental_mapping(work / "database.db", images, emptied(work / "incremental"))


def map_globally(images: Path, work: Path) -> None:
    """COLMAP's global mapper (GLOMAP) with its defaults."""
    pycolmap.global_mapping(work / "database.db", images, emptied(work / "global"))


def emptied(folder: Path) -> Path:
    """The folder without what an interrupted run may have left in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


if __name__ == "__main__":
    main()

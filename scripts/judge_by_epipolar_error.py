"""Which of several models of the same images predicts better where unseen matches lie: a judge without a GPU.

    python scripts/judge_by_epipolar_error.py IMAGES incremental=colmap/incremental/0 ours=run/sparse/0

A splat shows errors of poses, focal length and distortion as blur, and they show as well in matches that
no model was made from: the two points of a true match lie on each other's epipolar lines. Corners of the
full-size images are matched afresh between images that overlap; those within a few pixels of a keypoint
that any of the models has put into a track are left out. The only filter is one loose fundamental matrix
per pair, fitted to the matches alone, so that no model chooses what it is judged by. Each model then
predicts epipolar lines with its own poses, intrinsics and distortion. Images that a model lacks, and
matches that it cannot undistort, are left out for all.

Figures are over all matches, of which no pair gives more than ``MATCHES_PER_PAIR``. The last column is
each model's median over that of the first, with the range in which nine of ten random choices of pairs
would have put it: a range around 1 is no difference. A model turned inside out along the line of sight
(the depth reversal of long focal lengths) is not told from a true one; the true cameras do that.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from smust3r_colmap.errors import InputError, SmustrError
from smust3r_colmap.geometry.arrays import FloatArray, IntArray
from smust3r_colmap.importers.image_folder import natural_key

Pair = tuple[str, str]
Models = Mapping[str, pycolmap.Reconstruction]

MIN_OVERLAP = 0.2  # points of an image that the other sees, too; with less, few matches of upright corners are true
NEIGHBOURS = 3  # in the order of names, where no model has tracks
NUM_CORNERS = 6000
CORNER_DISTANCE_PX = 5.0
CORNER_QUALITY = 0.003  # of the strongest; weaker ones are noise, or the blocks of a JPEG file
CORNER_SIZE_PX = 12.0  # of the described surroundings, in SIFT's measure: smaller ones mistake window for window
HELD_OUT_PX = 2.0  # SIFT finds the same spot again to a fraction of this
MAX_RATIO = 0.8
LOOSE_SHARE = 0.004  # of the longer side, 4 pixels of 1000: distortion must not make a true match look false
MIN_MATCHES = 60  # that one fundamental matrix explains; 30 have been the same dust on the lens
MATCHES_PER_PAIR = 300
RESAMPLES = 500


@dataclass(frozen=True, kw_only=True, eq=False)
class Corners:
    """Places of an image to be matched.

    Args:
        xy_img: (N, 2) pixels of the original image, the centre of the first at (0.5, 0.5).
        descriptors: (N, D) float32.
    """

    xy_img: FloatArray
    descriptors: npt.NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutMatches:
    """Matches of a pair of images that no model has used.

    Args:
        pair: the names of both.
        xy_a_img, xy_b_img: (M, 2) each, as in ``Corners``; equal rows are a match.
    """

    pair: Pair
    xy_a_img: FloatArray
    xy_b_img: FloatArray


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """How far held-out matches are from a model's epipolar lines, in pixels of the images.

    Args:
        model: its label.
        num_pairs, num_matches: that were measured, the same for all models.
        median_px, mean_px: of the symmetric epipolar distance.
        share_below_1px: of the matches.
        ratio: median over that of the first model.
        ratio_low, ratio_high: 5 and 95 % quantile of the ratio when pairs are drawn again.
    """

    model: str
    num_pairs: int
    num_matches: int
    median_px: float
    mean_px: float
    share_below_1px: float
    ratio: float
    ratio_low: float
    ratio_high: float


def main(words: Sequence[str] | None = None) -> int:
    """Judge the models named on the command line; the exit code is 2 when they cannot be."""
    arguments = parse_arguments(words)
    cv2.setRNGSeed(arguments.seed)
    rng = np.random.default_rng(arguments.seed)
    try:
        models = {label: read_model(folder) for label, folder in arguments.models.items()}
        matches = tuple(held_out_matches(arguments.images, models, num_pairs=arguments.pairs, rng=rng))
        judgements = judge(models, matches, rng=rng)
    except SmustrError as error:
        print(error, file=sys.stderr)
        return 2
    print(render_table(judgements))
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(one) for one in judgements], indent=1), encoding="utf-8")
    return 0


def parse_arguments(words: Sequence[str] | None) -> argparse.Namespace:
    """The command line; ``models`` is a dictionary from label to folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, help="folder of the images, as named in the models")
    parser.add_argument("models", nargs="+", metavar="LABEL=FOLDER", help="COLMAP models; ratios are to the first")
    parser.add_argument("--pairs", type=int, default=100, help="at most so many, drawn at random (%(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, too")
    arguments = parser.parse_args(words)
    labelled = [word.partition("=") for word in arguments.models]
    arguments.models = {label: Path(folder) for label, _, folder in labelled if folder}
    if len(arguments.models) != len(labelled):
        parser.error("models are given as LABEL=FOLDER, every label once")
    return arguments


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """A COLMAP model, binary or text.

    Raises:
        InputError: there is none in the folder.
    """
    try:
        return pycolmap.Reconstruction(folder)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(f"{folder}: not a COLMAP model: {str(error).splitlines()[0]}") from error


# ----------------------------------------------------------------------------- matches
def held_out_matches(
    images: Path, models: Models, *, num_pairs: int, rng: np.random.Generator
) -> Iterator[HeldOutMatches]:
    """Matches of random overlapping pairs; pairs that have hardly any are passed over.

    Raises:
        InputError: no two images stand in all models, or an image file is missing or has another size.
    """
    pairs = overlapping_pairs(models)
    if not pairs:
        counts = ", ".join(f"{label} has {model.num_reg_images()}" for label, model in models.items())
        raise InputError(f"no two neighbouring images have a pose in all models ({counts}); are the names the same?")
    chosen = sorted(rng.choice(len(pairs), size=min(num_pairs, len(pairs)), replace=False))
    corners: dict[str, Corners] = {}
    for pair in (pairs[k] for k in chosen):
        for name in pair:
            if name not in corners:
                corners[name] = without_tracked(find_corners(read_grey(images, name, models)), name, models)
        rows_a, rows_b = mutual_matches(corners[pair[0]], corners[pair[1]])
        xy_a, xy_b = corners[pair[0]].xy_img[rows_a], corners[pair[1]].xy_img[rows_b]
        camera = camera_of(next(iter(models.values())), pair[0])
        kept = np.flatnonzero(loosely_consistent(xy_a, xy_b, LOOSE_SHARE * max(camera.width, camera.height)))
        if len(kept) >= MIN_MATCHES:
            kept = rng.permutation(kept)[:MATCHES_PER_PAIR]
            yield HeldOutMatches(pair=pair, xy_a_img=xy_a[kept], xy_b_img=xy_b[kept])


def overlapping_pairs(models: Models) -> list[Pair]:
    """Pairs of images with poses in all models, each of which sees a fifth of the other's points in any of them.

    Where no model has a track, neighbours in the natural order of names.
    """
    names = sorted(
        set.intersection(*({image.name for image in registered(model)} for model in models.values())), key=natural_key
    )
    overlap = np.maximum.reduce([overlaps(model, names) for model in models.values()])
    if overlap.any():
        return [(names[i], names[j]) for i, j in zip(*np.nonzero(overlap >= MIN_OVERLAP), strict=True) if i < j]
    return [(names[i], names[j]) for i, j in combinations(range(len(names)), 2) if j - i <= NEIGHBOURS]


def overlaps(model: pycolmap.Reconstruction, names: Sequence[str]) -> FloatArray:
    """(N, N) shares of points that two of the named images have in common, of the one that sees more.

    0 on the diagonal, and for images without points.
    """
    place = {name: number for number, name in enumerate(names)}
    columns: list[int] = []
    points: list[int] = []
    for image in registered(model):
        if image.name in place:
            seen = {point.point3D_id for point in image.points2D if point.has_point3D()}
            points.extend(seen)
            columns.extend([place[image.name]] * len(seen))
    _, rows = np.unique(np.array(points, np.int64), return_inverse=True)
    seen_in = csr_array((np.ones(len(rows)), (rows, columns)), shape=(len(rows), len(names)))
    shared = (seen_in.T @ seen_in).toarray()
    counts = shared.diagonal().copy()
    np.fill_diagonal(shared, 0)
    overlap: FloatArray = shared / np.maximum(1, np.maximum.outer(counts, counts))
    return overlap


def registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Its images with a pose."""
    return [image for image in model.images.values() if image.has_pose]


def image_named(model: pycolmap.Reconstruction, name: str) -> pycolmap.Image:
    """An image that is known to be there."""
    image = model.find_image_with_name(name)
    if image is None:
        raise KeyError(name)
    return image


def camera_of(model: pycolmap.Reconstruction, name: str) -> pycolmap.Camera:
    """The camera of an image that is known to be there."""
    return model.cameras[image_named(model, name).camera_id]


def read_grey(images: Path, name: str, models: Models) -> npt.NDArray[np.uint8]:
    """(H, W) of an image file, as stored: COLMAP does not turn images by their EXIF tag.

    Raises:
        InputError: the file cannot be read, or is not of the size that a model's camera has.
    """
    grey = cv2.imread(str(images / name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if grey is None:
        raise InputError(f"{images / name}: cannot be read; is this the folder that the models were made of?")
    for label, model in models.items():
        camera = camera_of(model, name)
        if (camera.width, camera.height) != grey.shape[::-1]:
            raise InputError(
                f"{images / name}: {grey.shape[1]} x {grey.shape[0]} pixels, but {camera.width} x {camera.height} in "
                f"{label}; give the images that the models were made of"
            )
    return np.asarray(grey, np.uint8)


def find_corners(grey: npt.NDArray[np.uint8]) -> Corners:
    """Corners to a fraction of a pixel, described by upright SIFT of one size.

    Corners are not where SIFT's own blobs are, and are found at full size whatever size the models'
    features came from. Their size and direction are not estimated, so that images turned or scaled
    against each other are hardly matched; what is matched is more exact.

    Source: Shi and Tomasi 1994; Lowe 2004, section 6, for the descriptor; Arandjelovic and Zisserman 2012
    for its square root.
    """
    found = cv2.GFTTDetector.create(NUM_CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX).detect(grey, None)
    if not found:
        return Corners(xy_img=np.empty((0, 2)), descriptors=np.empty((0, 128), np.float32))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    exact = cv2.cornerSubPix(
        grey, np.array([keypoint.pt for keypoint in found], np.float32), (3, 3), (-1, -1), stop
    ).reshape(-1, 2)
    described, descriptors = cv2.SIFT.create().compute(grey, [cv2.KeyPoint(x, y, CORNER_SIZE_PX, 0) for x, y in exact])
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9), dtype=np.float32)
    # OpenCV counts from the centre of the first pixel, COLMAP from its corner.
    return Corners(xy_img=np.array([keypoint.pt for keypoint in described]).reshape(-1, 2) + 0.5, descriptors=roots)


def without_tracked(corners: Corners, name: str, models: Models) -> Corners:
    """Those that lie away from every keypoint of a track, in all models."""
    held_out = np.ones(len(corners.xy_img), bool)
    for model in models.values():
        tracked = [point.xy for point in image_named(model, name).points2D if point.has_point3D()]
        if tracked:
            distance_px, _ = cKDTree(np.array(tracked)).query(corners.xy_img)
            held_out &= distance_px > HELD_OUT_PX
    return Corners(xy_img=corners.xy_img[held_out], descriptors=corners.descriptors[held_out])


def mutual_matches(a: Corners, b: Corners) -> tuple[IntArray, IntArray]:
    """Rows of ``a`` and ``b`` that are each other's nearest, and clearly nearer than the second (Lowe 2004, 7.1)."""
    if min(len(a.xy_img), len(b.xy_img)) < 2:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    similarity = a.descriptors @ b.descriptors.T  # (A, B) cosines, as descriptors have length 1
    rows = np.arange(len(similarity))
    nearest = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[nearest] == rows
    first = similarity[rows, nearest]
    similarity[rows, nearest] = -1.0
    # The squared distance of unit vectors is 2 - 2 cos.
    clear = np.maximum(1 - first, 0) < MAX_RATIO**2 * (1 - similarity.max(axis=1))
    kept = np.flatnonzero(mutual & clear)
    return kept, nearest[kept]


def loosely_consistent(xy_a: FloatArray, xy_b: FloatArray, threshold_px: float) -> npt.NDArray[np.bool_]:
    """(M,) which matches one fundamental matrix explains, give or take ``threshold_px``."""
    if len(xy_a) < MIN_MATCHES:
        return np.zeros(len(xy_a), bool)
    _, inliers = cv2.findFundamentalMat(xy_a, xy_b, cv2.USAC_DEFAULT, threshold_px, 0.9999, 5000)
    return np.zeros(len(xy_a), bool) if inliers is None else np.asarray(inliers).ravel() > 0


# ---------------------------------------------------------------------------- judgement
def judge(models: Models, matches: Sequence[HeldOutMatches], *, rng: np.random.Generator) -> tuple[Judgement, ...]:
    """What every model makes of the same matches; the first is the one that ratios are to.

    Raises:
        InputError: there are no matches.
    """
    distances = [epipolar_distances_px(models, one) for one in matches]  # (models, M) each
    kept = [found[:, np.isfinite(found).all(axis=0)] for found in distances]
    kept = [found for found in kept if found.size]
    if not kept:
        raise InputError(f"no matches to judge by in {len(matches)} pairs; do the images overlap, are they sharp?")
    every = np.concatenate(kept, axis=1)
    medians = np.median(every, axis=1)
    ranges = np.quantile(resampled_ratios(kept, rng), (0.05, 0.95), axis=0)
    return tuple(
        Judgement(
            model=label,
            num_pairs=len(kept),
            num_matches=every.shape[1],
            median_px=float(medians[k]),
            mean_px=float(every[k].mean()),
            share_below_1px=float((every[k] < 1).mean()),
            ratio=float(medians[k] / medians[0]),
            ratio_low=float(ranges[0, k]),
            ratio_high=float(ranges[1, k]),
        )
        for k, label in enumerate(models)
    )


def resampled_ratios(distances: Sequence[FloatArray], rng: np.random.Generator) -> FloatArray:
    """(RESAMPLES, models) ratios of medians when as many pairs are drawn again with repeats (Efron 1979)."""
    ratios = []
    for _ in range(RESAMPLES):
        drawn = rng.integers(len(distances), size=len(distances))
        medians = np.median(np.concatenate([distances[k] for k in drawn], axis=1), axis=1)
        ratios.append(medians / medians[0])
    return np.array(ratios)


def epipolar_distances_px(models: Models, matches: HeldOutMatches) -> FloatArray:
    """(models, M) mean distance of both points from each other's epipolar line; NaN where a model has no line.

    Lines are straight only in an image without distortion; distances are taken there, and become pixels
    by the camera's mean focal length. Source: Hartley and Zisserman 2004, section 9.6 (essential matrix) and
    eq. 11.10, of whose two squared distances this is the mean of the roots.
    """
    return np.array([symmetric_distances_px(model, matches) for model in models.values()])


def symmetric_distances_px(model: pycolmap.Reconstruction, matches: HeldOutMatches) -> FloatArray:
    """(M,) distances in one model, see ``epipolar_distances_px``."""
    image_a, image_b = (image_named(model, name) for name in matches.pair)
    camera_a, camera_b = (camera_of(model, name) for name in matches.pair)
    b_from_a = (image_b.cam_from_world() * image_a.cam_from_world().inverse()).matrix()
    essential = np.cross(b_from_a[:, 3], b_from_a[:, :3], axisb=0, axisc=0)  # [t]x R
    rays_a, rays_b = on_plane(camera_a, matches.xy_a_img), on_plane(camera_b, matches.xy_b_img)
    lines_b, lines_a = rays_a @ essential.T, rays_b @ essential
    off = np.abs(np.sum(rays_b * lines_b, axis=1))  # |x_b^T E x_a|
    with np.errstate(divide="ignore", invalid="ignore"):
        in_a = camera_a.mean_focal_length() * off / np.linalg.norm(lines_a[:, :2], axis=1)
        in_b = camera_b.mean_focal_length() * off / np.linalg.norm(lines_b[:, :2], axis=1)
    distances: FloatArray = (in_a + in_b) / 2
    return distances


def on_plane(camera: pycolmap.Camera, xy_img: FloatArray) -> FloatArray:
    """(M, 3) undistorted points on the plane z = 1 of the camera; NaN where there is none."""
    xy_plane = np.asarray(camera.cam_from_img(xy_img), dtype=np.float64)
    return np.column_stack([xy_plane, np.ones(len(xy_img))])


def render_table(judgements: Sequence[Judgement]) -> str:
    """One line per model."""
    first = judgements[0]
    header = ["model", "median px", "mean px", "below 1 px", f"ratio to {first.model}"]
    lines = [
        [
            one.model,
            f"{one.median_px:.3f}",
            f"{one.mean_px:.3f}",
            f"{one.share_below_1px:.1%}",
            f"{one.ratio:.3f} ({one.ratio_low:.3f} to {one.ratio_high:.3f})",
        ]
        for one in judgements
    ]
    widths = [max(map(len, column)) for column in zip(header, *lines, strict=True)]
    rows = ["  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in (header, *lines)]
    return "\n".join([f"{first.num_matches} held-out matches of {first.num_pairs} pairs", *rows])


if __name__ == "__main__":
    sys.exit(main())

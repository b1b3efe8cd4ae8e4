"""Masks: no feature and no depth where they are black, trainers get them, and stages know their content."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from helpers.runs import quiet_run
from PIL import ExifTags, Image

from smust3r_colmap.backbones import masked_maps
from smust3r_colmap.backbones.masked_maps import MaskedMaps
from smust3r_colmap.cli.export import Export, run_export
from smust3r_colmap.colmap.database import create_database
from smust3r_colmap.config import (
    CameraConfig,
    ClassicalConfig,
    FeatureConfig,
    LoopConfig,
    OutputConfig,
    RefineConfig,
    RunConfig,
)
from smust3r_colmap.errors import ConfigError, ImageError, InputError, RunDirectoryError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.execution.task_pool import TaskPool
from smust3r_colmap.features import stage as run_features
from smust3r_colmap.features.sift import extract_features
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.geometry.camera import Intrinsics
from smust3r_colmap.importers.image_folder import import_image_folder
from smust3r_colmap.importers.masks import left_out_shares, load_mask, names_without_mask, with_alpha, with_masks
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import ImageCollection, ImageMask, SourceImage
from smust3r_colmap.refine_model import refine_model
from smust3r_colmap.storage.depth_maps import StoredDepthMaps
from smust3r_colmap.storage.run_directory import key_of
from smust3r_colmap.synthetic.room import DemoScene, demo_intrinsics

WIDTH, HEIGHT, NUM_IMAGES = 320, 240, 8
CAMERA = demo_intrinsics(WIDTH, HEIGHT)
STICKER = (slice(190, 240), slice(0, 320))
"""Rows and columns where every photograph shows the same: the bonnet of the car that carries the camera."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Photographs with a sticker, the masks that hide it, and where the camera really was."""

    images: Path
    masks: Path
    truth: dict[str, FloatArray]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    root = tmp_path_factory.mktemp("drive")
    scene = DemoScene()
    world_from_cam = scene.camera_path(32)[:NUM_IMAGES]
    sticker = np.random.default_rng(0).integers(0, 256, (HEIGHT // 6, WIDTH // 6, 3), np.uint8)
    sticker = np.asarray(cv2.resize(sticker, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)
    kept = np.full((HEIGHT, WIDTH), 255, np.uint8)
    kept[STICKER] = 0
    drive = Drive(
        images=root / "images",
        masks=root / "masks",
        truth={f"{k:03d}.png": pose for k, pose in enumerate(world_from_cam)},
    )
    for folder in (drive.images, drive.masks):
        folder.mkdir()
    for name, pose in drive.truth.items():
        rgb, _ = scene.render(pose, CAMERA)
        rgb[STICKER] = sticker[STICKER]
        Image.fromarray(rgb).save(drive.images / name)
        Image.fromarray(kept).save(drive.masks / f"{name}.png")
    return drive


def collection_of(drive: Drive, masks: Path | None = None) -> ImageCollection:
    collection = import_image_folder(drive.images, CameraConfig(camera_model="PINHOLE"))
    return collection if masks is None else with_masks(collection, masks)


def write_mask(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    path.parent.mkdir(exist_ok=True)
    Image.new("L", (width, height), 255).save(path)
    return path


# ------------------------------------------------------------------------------- finding
@pytest.mark.slow
def test_masks_are_found_by_the_whole_name_first_and_missing_ones_are_named(drive: Drive, tmp_path: Path) -> None:
    write_mask(tmp_path / "000.png.png")
    write_mask(tmp_path / "000.png")
    write_mask(tmp_path / "002.png")
    masked = collection_of(drive, tmp_path)
    paths = [image.mask and image.mask.path.name for image in masked.images]
    assert paths == ["000.png.png", None, "002.png", *[None] * (NUM_IMAGES - 3)]
    assert names_without_mask(masked.images) == ("001.png", *(f"{k:03d}.png" for k in range(3, NUM_IMAGES)))


def test_whatever_is_not_black_is_kept_at_any_depth(tmp_path: Path) -> None:
    """Labels of 16 bits are small numbers, which 8 bits would make black."""
    labels = np.array([[0, 1], [255, 65535]], np.uint16).repeat(40, axis=0).repeat(40, axis=1)
    image = SourceImage(name="a", path=tmp_path / "a", width=80, height=80, camera=0, digest="")
    for name, pixels in (("deep.png", labels), ("one_bit.png", labels > 0)):
        Image.fromarray(pixels).save(tmp_path / name)
        found = load_mask(tmp_path / name, image)
        assert np.array_equal(found, np.where(labels > 0, 255, 0))


KEPT = np.arange(80 * 60).reshape(60, 80) % 80 >= 20
"""The mask of an image of 80 x 60 px: the left quarter is left out."""


def palette(colour: tuple[int, int, int]) -> Image.Image:
    """Labels 0, black, and 1, of this colour."""
    labels = Image.fromarray(KEPT.astype(np.uint8)).convert("P")
    labels.putdata(KEPT.astype(np.uint8).ravel().tolist())
    labels.putpalette([0, 0, 0, *colour] + [0] * 762)
    return labels


def rgba(grey: object, alpha: object) -> Image.Image:
    layers = [np.broadcast_to(np.asarray(layer, np.uint8), KEPT.shape) for layer in (grey, grey, grey, alpha)]
    return Image.fromarray(np.dstack(layers))


@pytest.mark.parametrize(
    "mask",
    [
        Image.fromarray(KEPT.astype(np.uint8) * 255),
        Image.fromarray(KEPT.astype(np.uint8)),
        Image.fromarray(KEPT),
        Image.fromarray(np.dstack([KEPT * 0, KEPT * 0, KEPT * 1]).astype(np.uint8)),
        rgba(255, KEPT * 255),
        rgba(KEPT * 255, 255),
        rgba(KEPT * 255, KEPT * 255),
        Image.fromarray(np.dstack([KEPT * 0 + 255, KEPT * 255]).astype(np.uint8)),
        palette((128, 0, 0)),
        palette((0, 0, 3)),
    ],
    ids=["255", "one", "1-bit", "dark blue", "alpha only", "opaque", "both", "grey alpha", "palette", "dark palette"],
)
def test_masks_are_read_as_tools_write_them(mask: Image.Image, tmp_path: Path) -> None:
    mask.save(tmp_path / "m.png")
    image = SourceImage(name="a", path=tmp_path / "a", width=80, height=60, camera=0, digest="")
    assert np.array_equal(load_mask(tmp_path / "m.png", image) > 0, KEPT)


def test_alpha_is_the_mask_of_images_without_another(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for name in ("a.png", "b.png", "c.png"):
        rgba(90 + ord(name[0]), 255 if name == "c.png" else KEPT * 255).save(tmp_path / "photos" / name)
    write_mask(tmp_path / "masks" / "b.png", 80, 60)
    collection = import_image_folder(tmp_path / "photos", CameraConfig())
    masked = with_alpha(with_masks(collection, tmp_path / "masks"), {"a.png": 0.25, "b.png": 0.25, "c.png": 0.0})
    a, b, c = masked.images
    assert a.mask is not None and a.mask.of_alpha and a.mask.digest == a.digest
    assert np.array_equal(load_mask(a.mask.path, a) > 0, KEPT)
    assert b.mask is not None and not b.mask.of_alpha
    assert c.mask is None
    shares = left_out_shares(masked.images)
    assert list(shares) == ["a.png", "b.png"]
    assert shares["a.png"] == pytest.approx(0.25)


def test_masks_of_nothing_are_refused(drive: Drive, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--masks .*nothing: there is no such folder"):
        collection_of(drive, tmp_path / "nothing")
    write_mask(tmp_path / "other.png")
    with pytest.raises(InputError, match=r"none of the 8 images has a mask there; .* 000.png.png or 000.png"):
        collection_of(drive, tmp_path)


def test_a_mask_of_another_size_is_refused(drive: Drive, tmp_path: Path) -> None:
    write_mask(tmp_path / "003.png", HEIGHT, WIDTH)
    with pytest.raises(ImageError, match=r"003.png: the mask is 240x320 px and its image 320x240"):
        collection_of(drive, tmp_path)


@pytest.mark.parametrize("size", [0, 30, 200], ids=["empty", "header", "half"])
def test_a_broken_mask_is_refused_before_anything_is_done(drive: Drive, tmp_path: Path, size: int) -> None:
    path = write_mask(tmp_path / "003.png")
    path.write_bytes((drive.images / "003.png").read_bytes()[:size])
    with pytest.raises(ImageError, match=r"003.png: no image that can be read; masks are PNG"):
        collection_of(drive, tmp_path)


@pytest.mark.parametrize("orientation", [3, 6])
def test_what_exif_says_of_turning_a_mask_is_not_looked_at(drive: Drive, tmp_path: Path, orientation: int) -> None:
    """The same at the import and later: the upper half is black as it is stored, in a mask of the right size."""
    kept = np.full((HEIGHT, WIDTH), 255, np.uint8)
    kept[: HEIGHT // 2] = 0
    mask = Image.fromarray(kept)
    exif = mask.getexif()
    exif[ExifTags.Base.Orientation] = orientation
    mask.save(tmp_path / "000.png", exif=exif)
    image = collection_of(drive, tmp_path).images[0]
    assert image.mask is not None
    assert np.array_equal(load_mask(image.mask.path, image), kept)


def test_masks_may_be_as_large_as_photographs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow's limit for what comes from the open net is lower than that of photographs."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    size = (80, 60)
    write_mask(tmp_path / "a.png", *size)
    image = SourceImage(name="a.jpg", path=tmp_path / "a.jpg", width=80, height=60, camera=0, digest="photograph")
    camera = Intrinsics(model="PINHOLE", width=80, height=60, params=(70.0, 70.0, 40.0, 30.0))
    (masked,) = with_masks(ImageCollection(images=(image,), cameras=(camera,)), tmp_path).images
    assert masked.mask is not None


def test_a_photograph_is_no_mask(drive: Drive, tmp_path: Path) -> None:
    """By whatever way it came into the folder of masks, and also where an export is given that folder."""
    collection = collection_of(drive)
    (tmp_path / "000.png").write_bytes((drive.images / "000.png").read_bytes())
    for masks in (drive.images, tmp_path):
        with pytest.raises(ImageError, match=r"000.png: would be a mask and is the photograph 000.png, too; .* beside"):
            with_masks(collection, masks)
    (tmp_path / "link").symlink_to(drive.images)
    with pytest.raises(ImageError, match=r"000.png: would be a mask and is the photograph"):
        load_mask(tmp_path / "link" / "000.png", collection.images[0])


def test_a_run_with_masks_among_the_images_ends_before_it_begins(drive: Drive, tmp_path: Path) -> None:
    config = RunConfig(masks=drive.images)
    quiet, output = QuietReporter(sys.stderr), tmp_path / "out"
    with pytest.raises(ConfigError, match=r"--masks .*/images: lies inside the image folder"):
        reconstruct(drive.images, output, config, reporter=quiet)
    with pytest.raises(ConfigError, match=r"--masks .*/images: lies inside the image folder"):
        refine_model(tmp_path, drive.images, output, RefineConfig(masks=drive.images), reporter=quiet)
    assert not output.exists()


# ------------------------------------------------------------------------------ features
def keypoints_of(collection: ImageCollection, path: Path) -> list[FloatArray]:
    """(K, 2) of every image; at half the size, so that positions must be carried to the size of the mask."""
    create_database(path, collection)
    with TaskPool(workers=1) as pool, QuietReporter(sys.stderr).stage("features", total=len(collection)) as stage:
        extract_features(path, collection, max_image_size=WIDTH // 2, max_features=100, executor=pool, stage=stage)
    with pycolmap.Database.open(path) as database:
        keypoints = [np.asarray(database.read_keypoints(i + 1)) for i in range(len(collection))]
    return [each[:, :2].astype(np.float64) for each in keypoints]


def hidden(xy_img: FloatArray) -> npt.NDArray[np.bool_]:
    """Whether the pixel under each position shows the sticker."""
    row = np.floor(xy_img[:, 1])
    return np.asarray((row >= STICKER[0].start) & (row < STICKER[0].stop), np.bool_)


@pytest.mark.slow
def test_masked_pixels_have_no_features_and_the_others_keep_theirs(drive: Drive, tmp_path: Path) -> None:
    plain, masked = collection_of(drive), collection_of(drive, drive.masks)
    twice = replace(plain, images=(plain.images[0], replace(masked.images[0], name="again.png")))
    before, after = keypoints_of(twice, tmp_path / "database.db")
    assert hidden(before).sum() > 10
    assert len(after) > 25  # enough to need no second try with weaker features
    assert np.array_equal(after, before[~hidden(before)])


def test_the_key_of_the_features_knows_the_content_of_masks_and_stays_without(
    drive: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_features, "extract_features", lambda *_, **__: ())
    config = FeatureConfig(max_image_size=100, max_features=10)

    def key(collection: ImageCollection) -> str:
        first = replace(collection, images=collection.images[:1])
        return run_features.features_of_run(run, first, config).key

    write_mask(tmp_path / "masks/000.png")
    plain = collection_of(drive)
    as_ever = key_of("features", [(plain.images[0].digest, WIDTH, HEIGHT, 0)], plain.cameras, 100, 10, 0)
    with quiet_run(tmp_path / "run") as run:
        assert key(plain) == as_ever
        keys = {as_ever, key(collection_of(drive, drive.masks)), key(collection_of(drive, tmp_path / "masks"))}
    assert len(keys) == 3


# --------------------------------------------------------------------------------- depth
class _Ones:
    """Maps of one image, 4 x 6 pixels, with depth and confidence 5 everywhere."""

    def __len__(self) -> int:
        return 1

    def pointmap_seg(self, k: int) -> npt.NDArray[np.float32]:
        return np.full((4, 6, 3), 5, np.float32)

    def depth(self, k: int) -> npt.NDArray[np.float32]:
        return np.full((4, 6), 5, np.float32)

    def confidence(self, k: int) -> npt.NDArray[np.float32]:
        return np.full((4, 6), 5, np.float32)

    def rgb(self, k: int) -> npt.NDArray[np.uint8]:
        return np.full((4, 6, 3), 5, np.uint8)


def test_a_pixel_of_a_map_is_masked_as_its_centre_is(tmp_path: Path) -> None:
    """A map of 6 x 4 pixels of an image of 60 x 40: the centre of column 2 is pixel 25."""
    mask = np.full((40, 60), 255, np.uint8)
    mask[:, 25:] = 0
    mask[15, 5] = 0
    Image.fromarray(mask).save(tmp_path / "m.png")
    image = SourceImage(
        name="a",
        path=tmp_path,
        width=60,
        height=40,
        camera=0,
        digest="",
        mask=ImageMask(path=tmp_path / "m.png", digest=""),
    )
    maps = MaskedMaps(maps=_Ones(), images=(image,))
    kept = np.zeros((4, 6), np.bool_)
    kept[:, :2] = True
    kept[1, 0] = False
    assert np.array_equal(maps.depth(0), np.where(kept, 5, 0))
    assert np.array_equal(maps.confidence(0), np.where(kept, 5, 1))
    assert np.array_equal(np.isnan(maps.pointmap_seg(0)).all(axis=2), ~kept)
    assert (maps.rgb(0) == 5).all()
    whole = MaskedMaps(maps=_Ones(), images=(replace(image, mask=None),))
    assert (whole.depth(0) == 5).all()
    assert {one.dtype.name for one in (maps.depth(0), maps.confidence(0), maps.pointmap_seg(0))} == {"float32"}


def test_a_mask_is_decoded_once_for_each_content_and_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    decoded: list[Path] = []

    def counted(path: Path, image: SourceImage) -> npt.NDArray[np.uint8]:
        decoded.append(path)
        return load_mask(path, image)

    monkeypatch.setattr(masked_maps, "load_mask", counted)
    path = write_mask(tmp_path / "m.png", 60, 40)
    image = SourceImage(
        name="a", path=tmp_path, width=60, height=40, camera=0, digest="", mask=ImageMask(path=path, digest="white")
    )
    maps = MaskedMaps(maps=_Ones(), images=(image,))
    for _ in range(3):
        assert (maps.depth(0) == 5).all() and (maps.confidence(0) == 5).all() and (maps.pointmap_seg(0) == 5).all()
    assert decoded == [path]
    Image.new("L", (60, 40), 0).save(path)
    blackened = replace(image, mask=ImageMask(path=path, digest="black"))
    assert not MaskedMaps(maps=_Ones(), images=(blackened,)).depth(0).any()
    assert decoded == [path, path]


# ----------------------------------------------------------------------------- whole runs
SETTINGS = RunConfig(
    features=FeatureConfig(max_features=800),
    classical=ClassicalConfig(dense_size=96, depth_planes=16),
    loop_closing=LoopConfig(loop_closure=False),
    output=OutputConfig(dense=False, report=False),
    workers=1,
)


@pytest.fixture(scope="module")
def masked_run(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The output folder of a run that has a mask for all images but the last, and its warnings."""
    output = tmp_path_factory.mktemp("masked") / "out"
    masks = output.parent / "masks"
    masks.mkdir()
    for path in sorted(drive.masks.iterdir())[:-1]:
        (masks / path.name).write_bytes(path.read_bytes())
    warnings = io.StringIO()
    config = replace(SETTINGS, masks=masks)
    reconstruct(drive.images, output, config, reporter=QuietReporter(warnings))
    return output, warnings.getvalue()


@pytest.mark.slow
def test_a_masked_run_finds_the_cameras_and_names_images_without_a_mask(
    drive: Drive, masked_run: tuple[Path, str]
) -> None:
    output, warnings = masked_run
    found = compare_trajectories(read_model_poses(output / "sparse/0"), drive.truth)
    assert found.num_compared == NUM_IMAGES
    assert 0 < found.position_rmse < 0.01
    assert "1 of 8 images have no mask and are used as a whole, such as 007.png" in warnings
    assert 'masks = "' in (output / "config.toml").read_text()


@pytest.mark.slow
def test_a_masked_run_has_neither_features_nor_depth_there(masked_run: tuple[Path, str]) -> None:
    output, _ = masked_run
    model = pycolmap.Reconstruction(output / "sparse/0")
    maps = StoredDepthMaps(output / "work/stitched")
    for image in model.images.values():
        xy_img = np.array([point.xy for point in image.points2D])
        depth = maps.depth(image.name)
        is_hidden = hidden(
            np.stack([np.zeros(len(depth)), (np.arange(len(depth)) + 0.5) * HEIGHT / len(depth)], axis=1)
        )
        if image.name != f"{NUM_IMAGES - 1:03d}.png":
            assert not hidden(xy_img).any()
            assert not depth[is_hidden].any()
        assert (depth[~is_hidden] > 0).mean() > 0.5


@pytest.mark.slow
def test_the_trainer_gets_the_masks_of_the_run_and_so_does_a_later_export(
    masked_run: tuple[Path, str], tmp_path: Path
) -> None:
    output, _ = masked_run
    run_export(Export(run=output, format=("trainer",), output=tmp_path, quiet=True))
    for trainer in (output / "trainer", tmp_path / "trainer"):
        frames = json.loads((trainer / "transforms.json").read_text())["frames"]
        assert len(frames) == NUM_IMAGES
        shares = {}
        for frame in frames:
            mask = np.asarray(Image.open(trainer / frame["mask_path"]))
            shares[Path(frame["file_path"]).stem] = float((mask == 0).mean())
        assert shares.pop("007") == 0
        assert all(0.18 < share < 0.24 for share in shares.values())


def trainer_of(run: Path, output: Path, *, masks: Path | None = None) -> None:
    run_export(Export(run=run, format=("trainer",), output=output, masks=masks, quiet=True))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("002.png.png", lambda path: path.unlink(), r"masks: the mask of 002.png is gone since the run; .* --masks"),
        ("002.png.png", write_mask, r"002.png.png: the mask of 002.png has changed since the run; .* --masks"),
        ("007.png", write_mask, r"007.png: the mask of 007.png is new since the run; .* --masks"),
    ],
    ids=["gone", "changed", "new"],
)
def test_masks_that_are_not_those_of_the_run_are_refused_unless_they_are_named(
    masked_run: tuple[Path, str], tmp_path: Path, name: str, change: Callable[[Path], object], message: str
) -> None:
    output, _ = masked_run
    masks = output.parent / "masks"
    before = {path.name: path.read_bytes() for path in masks.iterdir()}
    try:
        change(masks / name)
        with pytest.raises(ImageError, match=message):
            trainer_of(output, tmp_path)
        assert not any(tmp_path.iterdir())
        trainer_of(output, tmp_path, masks=masks)
        assert (tmp_path / "trainer" / "masks").is_dir()
    finally:
        (masks / name).unlink(missing_ok=True)
        if name in before:
            (masks / name).write_bytes(before[name])


@pytest.mark.slow
def test_a_folder_of_masks_that_is_gone_is_named_with_the_way_out(masked_run: tuple[Path, str], tmp_path: Path) -> None:
    output, _ = masked_run
    masks = output.parent / "masks"
    masks.rename(output.parent / "moved")
    try:
        with pytest.raises(InputError, match=r"masks: the masks of the run are not there any more; .* --masks"):
            trainer_of(output, tmp_path)
    finally:
        (output.parent / "moved").rename(masks)


@pytest.mark.slow
def test_a_finished_run_that_does_not_know_its_masks_is_damaged(masked_run: tuple[Path, str], tmp_path: Path) -> None:
    output, _ = masked_run
    finished = output / "work" / "finished.json"
    before = finished.read_text()
    finished.write_text(json.dumps({**json.loads(before), "masks": "masks"}))
    try:
        with pytest.raises(RunDirectoryError, match=r"finished\.json: is damaged .* start the same"):
            trainer_of(output, tmp_path)
    finally:
        finished.write_text(before)

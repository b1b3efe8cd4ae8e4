"""The stand-in for COLMAP's binary: what it takes from a database, and the sequence of calls of COLMAP's benchmark."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import colmap_stand_in as shim
import numpy as np
import pycolmap
import pytest
from PIL import Image

from smust3r_colmap.colmap.database import create_database
from smust3r_colmap.config import CameraConfig
from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.image_folder import collection_from_scan, scan_image_folder
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.products import ImageCollection

SIZE = (160, 120)
PINHOLE = pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[50.0, 51.0, 81.0, 62.0])


def plain_camera(*, with_prior: bool = False) -> pycolmap.Camera:
    """As COLMAP makes it of the size, or of a focal length in EXIF."""
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 77.0, *SIZE)
    camera.has_prior_focal_length = with_prior
    return camera


def known_camera(model: pycolmap.Camera = PINHOLE) -> pycolmap.Camera:
    camera = pycolmap.Camera(model.todict())
    camera.has_prior_focal_length = True
    return camera


def write_database(path: Path, names: list[str], cameras: list[pycolmap.Camera]) -> dict[str, int]:
    """Images in another order than that of their names, each with as many keypoints as its place in the order."""
    ids = {}
    with pycolmap.Database.open(path) as database:
        camera_ids = [database.write_camera(camera) for camera in cameras]
        for k, name in enumerate(reversed(names)):
            image = pycolmap.Image(name=name, camera_id=camera_ids[k % len(cameras)])
            ids[name] = database.write_image(image)
        for k, name in enumerate(names):
            points = np.full((k + 3, 4), 10.0 * k, np.float32)
            descriptors = np.full((k + 3, 128), k, np.uint8)
            database.write_keypoints(ids[name], points)
            database.write_descriptors(
                ids[name], pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors)
            )
    return ids


def write_pair(path: Path, one: int, other: int, rows: list[list[int]], *, verified: bool) -> None:
    """Matches of images by their ids, with a two-view geometry or without."""
    matches = np.array(rows, np.uint32)
    with pycolmap.Database.open(path) as database:
        database.write_matches(one, other, matches)
        if verified:
            config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
            database.write_two_view_geometry(
                one, other, pycolmap.TwoViewGeometry(config=config, inlier_matches=matches[:1])
            )


@pytest.fixture
def images(tmp_path: Path) -> ImageCollection:
    folder = tmp_path / "images"
    folder.mkdir()
    for k, name in enumerate(("a.png", "b.png", "c.png", "d.png")):
        Image.new("RGB", SIZE, (90, 90, k)).save(folder / name)
    return collection_from_scan(scan_image_folder(folder), CameraConfig())


# ------------------------------------------------------------------------------ database
def test_features_and_verified_matches_are_copied_by_name(images: ImageCollection, tmp_path: Path) -> None:
    """d is not in COLMAP's database; of a and c there are matches that were not verified."""
    source, target = tmp_path / "database.db", tmp_path / "ours.db"
    ids = write_database(source, ["a.png", "b.png", "c.png"], [plain_camera()])
    assert ids["a.png"] > ids["b.png"]  # so that the columns of the matches change sides
    write_pair(source, ids["a.png"], ids["b.png"], [[0, 3], [1, 2]], verified=True)
    write_pair(source, ids["a.png"], ids["c.png"], [[0, 0]], verified=False)
    create_database(target, images)
    shim.copy_features_and_matches(source, target, images)
    with pycolmap.Database.open(target) as ours:
        assert [len(ours.read_keypoints(number)) for number in (1, 2, 3, 4)] == [3, 4, 5, 0]
        assert (np.asarray(ours.read_keypoints(3)) == 20).all()
        assert (np.asarray(ours.read_descriptors(2).data) == 1).all()
        assert ours.read_matches(1, 2).tolist() == [[0, 3], [1, 2]]
        assert ours.read_two_view_geometry(1, 2).inlier_matches.tolist() == [[0, 3]]
        for a, b in combinations((1, 2, 3, 4), 2):
            assert ours.exists_matches(a, b), "the run would match the pair itself"
            if (a, b) != (1, 2):
                assert len(ours.read_matches(a, b)) == 0


def test_images_that_are_turned_by_a_tag_are_refused(images: ImageCollection, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.new("RGB", SIZE).save(tmp_path / "images/b.png", exif=exif)
    write_database(tmp_path / "database.db", ["a.png", "b.png"], [plain_camera()])
    create_database(tmp_path / "ours.db", images)
    with pytest.raises(InputError, match=r"b.png: its EXIF orientation is 3"):
        shim.copy_features_and_matches(tmp_path / "database.db", tmp_path / "ours.db", images)


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        ([plain_camera()], CameraConfig(camera_mode="single")),
        ([plain_camera()] * 2, CameraConfig()),
        ([plain_camera()] * 4, CameraConfig(camera_mode="per-image")),
        ([plain_camera(with_prior=True)], CameraConfig(camera_mode="single")),
        (
            [known_camera()] * 4,
            CameraConfig(camera_mode="single", camera_model="PINHOLE", camera_params="50.0,51.0,81.0,62.0"),
        ),
    ],
)
def test_cameras_follow_the_database(tmp_path: Path, cameras: list[pycolmap.Camera], expected: CameraConfig) -> None:
    write_database(tmp_path / "database.db", ["a", "b", "c", "d"], cameras)
    assert shim.cameras_of(tmp_path / "database.db") == expected


def test_several_calibrations_are_refused(tmp_path: Path) -> None:
    other = pycolmap.Camera(model="PINHOLE", width=160, height=120, params=[60.0, 61.0, 81.0, 62.0])
    write_database(tmp_path / "two.db", ["a", "b"], [known_camera(), known_camera(other)])
    with pytest.raises(InputError, match="2 calibrations of 2 of 2 cameras are known"):
        shim.cameras_of(tmp_path / "two.db")
    write_database(tmp_path / "some.db", ["a", "b"], [known_camera(), plain_camera()])
    with pytest.raises(InputError, match="1 calibrations of 1 of 2 cameras are known"):
        shim.cameras_of(tmp_path / "some.db")


# -------------------------------------------------------------------------- command line
def test_what_the_binary_would_need_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["automatic_reconstructor", "--image_path", str(tmp_path), "--workspace_path", str(tmp_path)]
    only_sparse = ["--extraction", "0", "--matching", "0"]
    assert shim.main([*words, *only_sparse]) == 1
    assert "database.db: there is no such database" in capsys.readouterr().err
    assert shim.main([*words, "--dense", "1"]) == 1
    assert "give --dense 0" in capsys.readouterr().err
    for flags in (["--vocab_tree_path", "x"], ["--feature", "aliked"], ["--quality", "best"]):
        with pytest.raises(SystemExit) as left:
            shim.main([*words, *flags])
        assert left.value.code == 2


@pytest.mark.parametrize(("kind", "left_matches"), [("matches", 0), ("two_view_geometries", 1)])
def test_the_database_is_cleaned(tmp_path: Path, kind: str, left_matches: int) -> None:
    path = tmp_path / "database.db"
    ids = write_database(path, ["a", "b"], [plain_camera()])
    write_pair(path, ids["a"], ids["b"], [[0, 0]], verified=True)
    assert shim.main(["database_cleaner", "--database_path", str(path), "--type", kind]) == 0
    with pycolmap.Database.open(path) as database:
        assert (database.num_matched_image_pairs(), database.num_verified_image_pairs()) == (left_matches, 0)


def test_a_model_is_aligned_to_the_reference(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reference = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_rigs=2, num_frames_per_rig=5))
    moved = pycolmap.Reconstruction(reference)
    moved.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.array([1.0, 2, 3])))
    for name, model in (("reference", reference), ("moved", moved), ("aligned", None)):
        (tmp_path / name).mkdir()
        if model is not None:
            model.write(tmp_path / name)
    words = ["--input_path", str(tmp_path / "moved"), "--ref_model_path", str(tmp_path / "reference")]
    words += ["--output_path", str(tmp_path / "aligned"), "--alignment_max_error"]
    assert shim.main(["model_aligner", *words, "0.01"]) == 0
    aligned, true = (read_model_poses(tmp_path / name) for name in ("aligned", "reference"))
    for name, pose in true.items():
        np.testing.assert_allclose(aligned[name], pose, atol=1e-6)
    empty = pycolmap.Reconstruction()
    empty.write(tmp_path / "moved")
    assert shim.main(["model_aligner", *words, "0.01"]) == 1
    assert "cannot be aligned" in capsys.readouterr().err


# ------------------------------------------------------------------------- the benchmark
@pytest.mark.slow
@pytest.mark.data
def test_the_calls_of_colmaps_benchmark_give_models_of_its_matches(
    data_dir: Callable[[str], Path], tmp_path: Path
) -> None:
    """Three calls; true cameras are written between the first two, and pairs removed between the last two."""
    data, images, workspace = data_dir("fountain_p11"), tmp_path / "images", tmp_path / "workspace"
    for folder in (images, workspace):
        folder.mkdir()
    for path in sorted((data / "images").iterdir()):
        with Image.open(path) as opened:
            opened.resize((opened.width // 2, opened.height // 2)).save(images / path.name, quality=95)
    call = [sys.executable, str(Path(shim.__file__)), "automatic_reconstructor"]
    call += ["--image_path", str(images), "--workspace_path", str(workspace), "--use_gpu", "0", "--gpu_index", "-1"]
    call += ["--num_threads", "1", "--random_seed", "0", "--feature", "sift", "--mapper", "incremental"]
    call += ["--quality", "low", "--data_type", "individual"]

    def stage(extraction: int, matching: int, sparse: int) -> None:
        flags = {"extraction": extraction, "matching": matching, "sparse": sparse, "dense": 0}
        words = [word for name, value in flags.items() for word in (f"--{name}", str(value))]
        subprocess.run([*call, *words], check=True, cwd=workspace, capture_output=True)

    stage(1, 0, 0)
    width, height, *focal = map(float, (data / "intrinsics.txt").read_text().splitlines()[-1].split())
    half = pycolmap.Camera(
        model="PINHOLE", width=int(width) // 2, height=int(height) // 2, params=[value / 2 for value in focal]
    )
    with pycolmap.Database.open(workspace / "database.db") as database:
        for image in database.read_all_images():
            camera = known_camera(half)
            camera.camera_id = image.camera_id
            database.update_camera(camera)
    stage(0, 1, 0)
    with pycolmap.Database.open(workspace / "database.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        assert database.exists_two_view_geometry(ids["0000.jpg"], ids["0004.jpg"])
        database.delete_two_view_geometry(ids["0000.jpg"], ids["0004.jpg"])
        neighbours = database.read_matches(ids["0000.jpg"], ids["0001.jpg"])
    stage(0, 0, 1)

    with pycolmap.Database.open(workspace / "smust3r/work/features/database.db") as database:
        assert len(database.read_matches(1, 5)) == 0
        assert database.read_matches(1, 2).tolist() == neighbours.tolist()
    (model,) = (workspace / "sparse").iterdir()
    reconstruction = pycolmap.Reconstruction(model)
    assert reconstruction.num_reg_images() == 11
    ((camera,),) = [list(reconstruction.cameras.values())]
    assert camera.params == pytest.approx(half.params)

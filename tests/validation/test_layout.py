"""Where the parts of a scene are found."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.validation.layout import UnreadableModelError, find_layout


@pytest.mark.parametrize("place", [".", "sparse", "sparse/0"])
def test_a_scene_is_found_from_every_folder_on_the_way(scene: Path, place: str) -> None:
    layout = find_layout(scene / place, images=None, database=None)

    assert layout.model.resolve() == (scene / "sparse" / "0").resolve()
    assert layout.images is not None
    assert layout.images.resolve() == (scene / "images").resolve()
    assert layout.database is not None
    assert list(layout.numbered) == ["0"]


def test_scenes_inside_a_scene_are_named(scene: Path, tmp_path: Path) -> None:
    for name in ("sparse/0", "trainer/sparse/0", "dense/sparse"):
        shutil.copytree(scene / "sparse" / "0", tmp_path / name)
    layout = find_layout(tmp_path, images=None, database=None)

    assert layout.model == tmp_path / "sparse" / "0"
    assert [path.name for path in layout.inner_scenes] == ["trainer", "dense"]


def test_a_folder_without_a_model_says_where_it_looked(tmp_path: Path) -> None:
    with pytest.raises(UnreadableModelError, match=r"no COLMAP model here.*sparse/0, sparse"):
        find_layout(tmp_path, images=None, database=None)


def test_half_a_model_says_what_is_missing(tmp_path: Path) -> None:
    (tmp_path / "points3D.bin").write_bytes(bytes(8))
    with pytest.raises(UnreadableModelError, match=r"has points3D.bin, but a model needs cameras.bin and images.bin"):
        find_layout(tmp_path, images=None, database=None)


def test_paths_that_were_given_must_exist(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find_layout(tmp_path / "nothing", images=None, database=None)
    with pytest.raises(InputError, match=r"--images .*: no such folder"):
        find_layout(scene, images=tmp_path / "nothing", database=None)
    with pytest.raises(InputError, match=r"--database .*: no such file"):
        find_layout(scene, images=None, database=tmp_path / "nothing.db")


def test_a_file_in_the_place_of_a_folder_is_called_a_file(scene: Path) -> None:
    cameras = scene / "sparse" / "0" / "cameras.bin"
    with pytest.raises(InputError, match=r"cameras.bin: is a file; give the folder of the model"):
        find_layout(cameras, images=None, database=None)
    with pytest.raises(InputError, match=r"--images .*cameras.bin: is a file; give the folder that holds the images"):
        find_layout(scene, images=cameras, database=None)

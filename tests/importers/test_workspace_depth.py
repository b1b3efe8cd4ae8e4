from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.sensor_depth import VIEW, write_run
from PIL import Image

from smust3r_colmap.errors import ImageError, InputError
from smust3r_colmap.importers.workspace_depth import DenseWorkspace, read_depth_image


def test_a_workspace_has_cameras_and_depth_by_name(tmp_path: Path) -> None:
    workspace = DenseWorkspace.open(write_run(tmp_path, {"a.jpg": 1.0}, holes=3) / "dense")
    assert workspace.names == ("a.jpg", "b.jpg", "c.jpg", "d.jpg")
    assert workspace.camera("b.jpg").params == pytest.approx(VIEW.params)
    depth = workspace.depth("a.jpg")
    assert depth is not None
    assert depth.shape == (90, 120)
    assert (depth[:3] == 0).all()
    assert (depth[3:] > 0).any()
    assert workspace.depth("b.jpg") is None


def test_a_folder_without_a_workspace_is_refused_with_the_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"no dense workspace; .* export {tmp_path} --format dense"):
        DenseWorkspace.open(tmp_path / "dense")


def test_depth_images_are_in_units_and_have_no_reading_where_the_sensor_has_none(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 1500], [65535, 5000]], np.uint16)).save(tmp_path / "depth.png")
    assert read_depth_image(tmp_path / "depth.png", 1000).tolist() == [[0, 1.5], [0, 5]]


def test_images_that_hold_no_depth_are_refused(tmp_path: Path) -> None:
    Image.new("RGB", (4, 3)).save(tmp_path / "colour.png")
    with pytest.raises(ImageError, match=r"colour.png: uint8 of shape \(3, 4, 3\); needed one channel of 16 bits"):
        read_depth_image(tmp_path / "colour.png", 1000)
    with pytest.raises(ImageError, match=r"absent.png: cannot be read"):
        read_depth_image(tmp_path / "absent.png", 1000)

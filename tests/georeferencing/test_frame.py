"""The local frame: exact both ways, true lengths, and a linear form that says how far it holds."""

from __future__ import annotations

import numpy as np
import pytest

from smust3r_colmap.georeferencing.crs import parse_crs
from smust3r_colmap.georeferencing.frame import LocalFrame

pyproj = pytest.importorskip("pyproj")

UTM32 = parse_crs("EPSG:25832", "here")
PLACE = np.array([600000.0, 5300000.0, 500.0])
FRAME = LocalFrame(crs=UTM32, offset_m=(600000.0, 5300000.0, 500.0))


def test_round_trip_is_exact_to_micrometres() -> None:
    rng = np.random.default_rng(1)
    xyz = PLACE + rng.uniform(-2000, 2000, (50, 3)) * [1, 1, 0.1]
    np.testing.assert_allclose(FRAME.crs_from_local(FRAME.local_from_crs(xyz)), xyz, atol=1e-6)


def test_lengths_in_the_frame_are_those_on_the_ellipsoid_and_not_those_of_the_grid() -> None:
    xyz = np.array([[600000.0, 5300000.0, 0.0], [601000.0, 5300000.0, 0.0]])
    frame = LocalFrame(crs=UTM32, offset_m=(600000.0, 5300000.0, 0.0))
    a, b = frame.local_from_crs(xyz)
    lon_a, lat_a = pyproj.Transformer.from_crs(25832, 4258, always_xy=True).transform(*xyz[0, :2])
    lon_b, lat_b = pyproj.Transformer.from_crs(25832, 4258, always_xy=True).transform(*xyz[1, :2])
    _, _, geodesic = pyproj.Geod(ellps="GRS80").inv(lon_a, lat_a, lon_b, lat_b)
    assert np.linalg.norm(b - a) == pytest.approx(geodesic, abs=1e-4)
    assert abs(np.linalg.norm(b - a) - 1000) == pytest.approx(0.277, abs=0.01)  # 0.9996, and 100 km off the meridian


def test_the_earth_bends_away() -> None:
    """By the square of the distance over twice the radius."""
    far = FRAME.local_from_crs(PLACE[None] + [[0, 1000, 0]])[0]
    assert far[2] == pytest.approx(-(1000**2) / (2 * 6.38e6), rel=0.01)


def test_north_of_the_frame_is_not_that_of_the_grid() -> None:
    east, north, _ = FRAME.local_from_crs(PLACE[None] + [[0, 1000, 0]])[0]
    convergence = pyproj.Proj(25832).get_factors(10.3, 47.85).meridian_convergence
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(convergence, abs=0.05)


def test_the_linear_form_is_exact_near_the_origin() -> None:
    local = np.array([[100.0, -50.0, 20.0], [1000.0, 0.0, 0.0]])
    matrix = FRAME.linear_crs_from_local()
    linear = local @ matrix[:3, :3].T + matrix[:3, 3] + PLACE
    errors = np.linalg.norm(linear - FRAME.crs_from_local(local), axis=1)
    assert errors[0] < 0.002
    assert errors[1] == pytest.approx(0.078, abs=0.01)  # the bend of the earth at a kilometre


def test_offsets_are_whole_hundreds_about_the_middle() -> None:
    xyz = np.array([[600123.0, 5300049.0, np.nan], [600151.0, 5300051.0, 561.0], [600149.0, 5300070.0, np.nan]])
    assert LocalFrame.about(xyz, UTM32).offset_m == (600100, 5300100, 600)
    assert LocalFrame.about(xyz * [1, 1, np.nan], UTM32).offset_m == (600100, 5300100, 0)


def test_missing_heights_stay_missing() -> None:
    local = FRAME.local_from_crs(PLACE[None] * [1, 1, np.nan])
    assert np.isnan(local[0, 2])
    np.testing.assert_allclose(local[0, :2], 0, atol=1e-6)


def test_coordinates_of_a_site_are_cartesian() -> None:
    site = LocalFrame(crs=None, offset_m=(100.0, 200.0, 0.0))
    np.testing.assert_array_equal(site.local_from_crs(np.array([[101.0, 202.0, 3.0]])), [[1, 2, 3]])
    np.testing.assert_array_equal(site.crs_from_local(np.array([[1.0, 2.0, 3.0]])), [[101, 202, 3]])
    np.testing.assert_allclose(site.linear_crs_from_local(), np.eye(4), atol=1e-12)

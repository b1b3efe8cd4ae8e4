"""CRS: what texts mean, what is refused, and what PROJ would do in silence."""

from __future__ import annotations

import builtins
import warnings
from typing import Any

import numpy as np
import pytest

from smust3r_colmap.errors import InputError, MissingDependencyError
from smust3r_colmap.georeferencing.crs import (
    Crs,
    add_grids,
    egm96,
    is_in_area,
    parse_crs,
    transform,
    utm_zone,
    why_outside,
)

pyproj = pytest.importorskip("pyproj")

MUNICH = np.array([[11.575, 48.1375, 560.0]])


def crs(text: str) -> Crs:
    return parse_crs(text, "here")


def krueger_utm32(lon_deg: float, lat_deg: float) -> tuple[float, float]:
    """Transverse Mercator on GRS 80 by Krueger's series to the third order (Karney 2011, eqs. 7 to 12, 35)."""
    f = 1 / 298.257222101
    n = f / (2 - f)
    lat, lon = np.radians(lat_deg), np.radians(lon_deg - 9)
    e = np.sqrt(f * (2 - f))
    t = np.sinh(np.arctanh(np.sin(lat)) - e * np.arctanh(e * np.sin(lat)))
    xi, eta = np.arctan2(t, np.cos(lon)), np.arcsinh(np.sin(lon) / np.hypot(t, np.cos(lon)))
    alphas = (
        n / 2 - 2 * n**2 / 3 + 5 * n**3 / 16,
        13 * n**2 / 48 - 3 * n**3 / 5,
        61 * n**3 / 240,
    )
    x = eta + sum(a * np.cos(2 * k * xi) * np.sinh(2 * k * eta) for k, a in enumerate(alphas, start=1))
    y = xi + sum(a * np.sin(2 * k * xi) * np.cosh(2 * k * eta) for k, a in enumerate(alphas, start=1))
    radius = 6378137 / (1 + n) * (1 + n**2 / 4 + n**4 / 64)
    return float(500000 + 0.9996 * radius * x), float(0.9996 * radius * y)


def test_projection_by_another_formula() -> None:
    moved = transform(MUNICH, crs("EPSG:4258"), crs("EPSG:25832"))[0]
    assert moved[:2] == pytest.approx(krueger_utm32(11.575, 48.1375), abs=1e-4)
    assert moved[2] == 560


@pytest.mark.parametrize(
    ("text", "name", "vertical"),
    [
        ("EPSG:25832", "EPSG:25832", "unknown"),
        ("EPSG:25832+7837", "EPSG:25832", "DHHN2016 height"),
        ("WGS84 UTM 16N", "EPSG:32616", "unknown"),
        ("wgs84 utm 9S", "EPSG:32709", "unknown"),
        ("+proj=utm +zone=11 +ellps=WGS84 +datum=WGS84 +units=m +no_defs", "EPSG:32611", "unknown"),
        ("EPSG:4326", "EPSG:4326", "unknown"),
    ],
)
def test_accepted_texts(text: str, name: str, vertical: str) -> None:
    assert (crs(text).name, crs(text).vertical_name) == (name, vertical)


def test_three_axes_are_ellipsoidal_heights() -> None:
    assert crs("EPSG:4979").ellipsoidal
    assert crs("EPSG:4979").vertical_name.startswith("height above the ellipsoid")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:99999", "gcp_list.txt:1: 'EPSG:99999' does not exist; write EPSG:25832"),
        ("PUWG1992", "gcp_list.txt:1: 'PUWG1992' is no CRS that is known; write EPSG:25832"),
        ("WGS84 UTM 30U", "gcp_list.txt:1: 'WGS84 UTM 30U' is no CRS that is known"),
        ("WGS84 UTM 61N", "'WGS84 UTM 61N' is no CRS"),
        ("EPSG:4978", "neither a projection nor in degrees"),
    ],
)
def test_other_texts_are_refused_with_the_accepted_forms(text: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        parse_crs(text, "gcp_list.txt:1")
    assert message in str(error.value)


def test_feet_are_refused_because_proj_leaves_heights_alone() -> None:
    """PROJ converts x and y of EPSG:2249 and hands z on as it is, which tilts models."""
    _, _, z = pyproj.Transformer.from_crs("EPSG:2249", "EPSG:26986", always_xy=True).transform(775000, 2956000, 100.0)
    assert z == 100.0
    with pytest.raises(InputError, match="'EPSG:2249' is in US survey foot, and it is not clear whether the heights"):
        crs("EPSG:2249")
    with pytest.raises(InputError, match="is in US survey foot"):
        crs("EPSG:25832+6360")  # heights alone in feet


@pytest.mark.slow
def test_heights_above_a_geoid_need_its_grid() -> None:
    """Without ``allow_ballpark=False`` the ellipsoidal height comes back unchanged, with no more than a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        silent = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:9518", always_xy=True).transform(11.575, 48.1375, 560.0)
    assert silent[2] == 560.0
    with pytest.raises(InputError, match=r"there is no exact way from EPSG:4326 .* the grid is missing.*--proj-data"):
        transform(MUNICH, crs("EPSG:4979"), crs("EPSG:25832+5773"))
    ellipsoid = Crs(horizontal=crs("EPSG:25832").horizontal, ellipsoidal=True, origin="here")
    above_sea = Crs(horizontal=crs("EPSG:4326").horizontal, vertical=egm96(), origin="EXIF")
    with pytest.raises(InputError, match="EGM96 height"):
        transform(MUNICH, above_sea, ellipsoid)


def test_heights_of_unknown_datum_stay_as_they_are() -> None:
    assert transform(MUNICH, crs("EPSG:4326"), crs("EPSG:25832+7837"))[0, 2] == 560.0
    assert transform(MUNICH, crs("EPSG:4979"), crs("EPSG:25832"))[0, 2] == 560.0


def test_points_without_height_keep_their_place() -> None:
    ellipsoidal = Crs(horizontal=crs("EPSG:25832").horizontal, ellipsoidal=True, origin="here")
    both = np.vstack([MUNICH, MUNICH * [1, 1, np.nan]])
    moved = transform(both, crs("EPSG:4979"), ellipsoidal)
    assert moved[0, 2] == pytest.approx(560, abs=1e-6)
    assert np.isnan(moved[1, 2])
    np.testing.assert_allclose(moved[0, :2], moved[1, :2], atol=1e-6)


@pytest.mark.parametrize("code", [25832, 2180, 31467, 32632, 3857])
def test_round_trips_are_exact(code: int) -> None:
    """Also where the CRS has north before east (2180, 31467)."""
    place = np.array([[{2180: 19.0, 31467: 9.5}.get(code, 11.575), 50.0, 100.0]])
    there = transform(place, crs("EPSG:4326"), crs(f"EPSG:{code}"))
    assert is_in_area(there, crs(f"EPSG:{code}"))[0]
    back = transform(there, crs(f"EPSG:{code}"), crs("EPSG:4326"))
    np.testing.assert_allclose(back, place, atol=1e-8)  # a millimetre


def test_east_comes_first_whatever_the_axis_order() -> None:
    x, y, _ = transform(np.array([[19.0, 52.0, 0.0]]), crs("EPSG:4326"), crs("EPSG:2180"))[0]
    assert (x, y) == pytest.approx((500000, 459668), abs=500)  # the central meridian is 500 000 east


@pytest.mark.parametrize(
    ("x", "y", "text", "hint"),
    [
        (5300000, 600000, "EPSG:25832", "x and y are swapped: east comes first"),
        (9.5, 48.0, "EPSG:25832", "these are degrees, and the CRS is a projection"),
        (600000, 9_900_000, "EPSG:25832", "lies outside of EPSG:25832 (ETRS89 / UTM zone 32N), from here"),
        (600000, 5300000, "EPSG:4326", "these are metres, and the CRS is in degrees"),
        (11.0, 95.0, "EPSG:4326", "x and y are swapped"),
    ],
)
def test_points_outside_of_the_area_say_why(x: float, y: float, text: str, hint: str) -> None:
    assert not is_in_area(np.array([[x, y]]), crs(text))[0]
    assert hint in why_outside(x, y, crs(text))


@pytest.mark.parametrize(
    ("lon", "lat", "code"), [(11.5, 48, 32632), (-98, 30, 32614), (140.9, -38, 32754), (180, 10, 32660)]
)
def test_zone_of_a_place(lon: float, lat: float, code: int) -> None:
    assert utm_zone(lon, lat).name == f"EPSG:{code}"


def test_a_missing_package_is_named_with_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without_pyproj(name: str, *rest: Any, **named: Any) -> Any:
        if name.startswith("pyproj"):
            raise ImportError(name)
        return real(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without_pyproj)
    with pytest.raises(MissingDependencyError, match=r"pip install 'smust3r-colmap\[geo\]'"):
        crs("EPSG:25832")


def test_a_folder_of_grids_must_exist(tmp_path: Any) -> None:
    with pytest.raises(InputError, match="there is no such folder"):
        add_grids(tmp_path / "none")

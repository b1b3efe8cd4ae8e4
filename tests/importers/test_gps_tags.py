"""GPS in the tags of images: EXIF with its references, XMP in both forms, and what is broken."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from smust3r_colmap.errors import ImageError
from smust3r_colmap.importers.gps_tags import read_gps_tags, read_image_positions, up_in_camera

G = ExifTags.GPS
MUNICH: Mapping[int, object] = {
    G.GPSLatitudeRef: "N",
    G.GPSLatitude: (48.0, 8.0, 15.0),
    G.GPSLongitudeRef: "E",
    G.GPSLongitude: (11.0, 34.0, 30.0),
    G.GPSAltitudeRef: b"\x00",
    G.GPSAltitude: 519.5,
}
LATITUDE, LONGITUDE = 48 + 8 / 60 + 15 / 3600, 11 + 34 / 60 + 30 / 3600


def jpeg(gps: Mapping[int, object] | None, *, xmp: str = "", orientation: int = 1) -> bytes:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if gps is not None:
        exif[ExifTags.IFD.GPSInfo] = dict(gps)
    file = io.BytesIO()
    Image.new("RGB", (40, 32)).save(file, "JPEG", exif=exif, xmp=xmp.encode())
    return file.getvalue()


def attributes(**values: str) -> str:
    """As cameras of DJI write them."""
    inside = " ".join(f'drone-dji:{name}="{value}"' for name, value in values.items())
    return f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF><rdf:Description {inside}/></rdf:RDF></x:xmpmeta>'


def elements(**values: str) -> str:
    """As exiftool writes them again."""
    inside = "".join(f"<drone-dji:{name}>{value}</drone-dji:{name}>\n" for name, value in values.items())
    return f"<x:xmpmeta><rdf:RDF><rdf:Description rdf:about=''>{inside}</rdf:Description></rdf:RDF></x:xmpmeta>"


def test_position_of_exif() -> None:
    tags = read_gps_tags(jpeg(MUNICH))
    assert tags is not None
    assert (tags.lat_deg, tags.lon_deg, tags.height_m) == pytest.approx((LATITUDE, LONGITUDE, 519.5), abs=1e-9)
    assert (tags.sigma_h_m, tags.sigma_v_m, tags.up_cam, tags.assumed_sign) == (None, None, None, False)


def test_an_image_without_gps_has_no_position() -> None:
    assert read_gps_tags(jpeg(None)) is None


@pytest.mark.parametrize(
    ("changed", "sign_lat", "sign_lon"),
    [({}, 1, 1), ({G.GPSLatitudeRef: "S"}, -1, 1), ({G.GPSLongitudeRef: "W"}, 1, -1), ({G.GPSLatitudeRef: "s"}, -1, 1)],
)
def test_references_are_signs(changed: Mapping[int, object], sign_lat: int, sign_lon: int) -> None:
    tags = read_gps_tags(jpeg({**MUNICH, **changed}))
    assert tags is not None
    assert (tags.lat_deg, tags.lon_deg) == pytest.approx((sign_lat * LATITUDE, sign_lon * LONGITUDE))


@pytest.mark.parametrize(
    ("reference", "height"), [(b"\x00", 12.5), (b"\x01", -12.5), (b"\x02", 12.5), (b"\x03", -12.5)]
)
def test_heights_below_the_reference_are_negative(reference: bytes, height: float) -> None:
    tags = read_gps_tags(jpeg({**MUNICH, G.GPSAltitude: 12.5, G.GPSAltitudeRef: reference}))
    assert tags is not None
    assert tags.height_m == height


def test_accuracy_of_exif() -> None:
    stated = read_gps_tags(jpeg({**MUNICH, G.GPSHPositioningError: 5.0, G.GPSDOP: 2.0}))
    diluted = read_gps_tags(jpeg({**MUNICH, G.GPSDOP: 2.0}))
    assert stated is not None
    assert diluted is not None
    assert (stated.sigma_h_m, diluted.sigma_h_m) == (5.0, 6.0)


@pytest.mark.parametrize("form", [attributes, elements])
def test_xmp_overrides_exif_in_both_forms(form: Callable[..., str]) -> None:
    written = form(
        GpsLatitude="-48.1375001",
        GpsLongitude="+11.5750002",
        AbsoluteAltitude="+560.25",
        RelativeAltitude="+40.50",
        RtkFlag="50",
        RtkStdLon="0.012",
        RtkStdLat="0.015",
        RtkStdHgt="0.031",
        GimbalPitchDegree="-90.00",
        GimbalRollDegree="+0.00",
    )
    tags = read_gps_tags(jpeg(MUNICH, xmp=written))
    assert tags is not None
    assert (tags.lat_deg, tags.lon_deg) == (-48.1375001, 11.5750002)
    assert (tags.height_m, tags.relative_height_m) == (560.25, 40.5)
    assert (tags.sigma_h_m, tags.sigma_v_m) == (0.015, 0.031)
    assert tags.up_cam == pytest.approx((0, 0, -1), abs=1e-12)


def test_the_misspelt_longitude_is_read() -> None:
    tags = read_gps_tags(jpeg(None, xmp=attributes(GpsLatitude="48.5", GpsLongtitude="11.5")))
    assert tags is not None
    assert (tags.lat_deg, tags.lon_deg) == (48.5, 11.5)


def test_rtk_without_a_solution_states_no_accuracy() -> None:
    written = attributes(RtkFlag="0", RtkStdLon="0.012", RtkStdLat="0.015", RtkStdHgt="0.031")
    tags = read_gps_tags(jpeg({**MUNICH, G.GPSHPositioningError: 5.0}, xmp=written))
    assert tags is not None
    assert (tags.sigma_h_m, tags.sigma_v_m) == (5.0, None)


def test_accuracy_and_angles_in_the_camera_namespace() -> None:
    written = '<rdf:Description Camera:GPSXYAccuracy="3/2" Camera:GPSZAccuracy="4" Camera:Pitch="0" Camera:Roll="0"/>'
    tags = read_gps_tags(jpeg(MUNICH, xmp=written))
    assert tags is not None
    assert (tags.sigma_h_m, tags.sigma_v_m) == (1.5, 4.0)
    assert tags.up_cam == pytest.approx((0, 0, -1), abs=1e-12)  # this namespace counts pitch from looking down


def test_up_in_the_camera() -> None:
    assert up_in_camera(0, 0) == pytest.approx((0, -1, 0))  # y is down
    assert up_in_camera(0, 90) == pytest.approx((-1, 0, 0), abs=1e-12)  # turned clockwise, its right side is down
    assert np.linalg.norm(up_in_camera(-37, 12)) == pytest.approx(1)


def test_the_orientation_tag_is_no_direction_of_gravity() -> None:
    """pycolmap makes one of it: (0, 1, 0) for every upright file, which is wrong by 90 degrees for nadir images."""
    tags = read_gps_tags(jpeg(MUNICH, orientation=1))
    assert tags is not None
    assert tags.up_cam is None


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({G.GPSLatitude: (0.0, 0.0, 0.0), G.GPSLongitude: (0.0, 0.0, 0.0)}, "latitude 0 and longitude 0: the receiver"),
        ({G.GPSLatitude: (91.0, 0.0, 0.0)}, "latitude 91, longitude 11.575 is no position"),
        ({G.GPSLatitude: (IFDRational(1, 0), 0.0, 0.0)}, "the GPS tags cannot be read"),
    ],
)
def test_positions_that_are_none_are_refused(changed: Mapping[int, object], reason: str) -> None:
    with pytest.raises(ImageError, match=reason):
        read_gps_tags(jpeg({**MUNICH, **changed}))


def write(folder: Path, **images: bytes) -> list[str]:
    for name, data in images.items():
        (folder / f"{name}.jpg").write_bytes(data)
    return [f"{name}.jpg" for name in images]


def test_one_broken_image_does_not_stop_the_others(tmp_path: Path) -> None:
    null = {**MUNICH, G.GPSLatitude: (0.0, 0.0, 0.0), G.GPSLongitude: (0.0, 0.0, 0.0)}
    names = write(tmp_path, a=jpeg(MUNICH), b=b"no image", c=jpeg(null), d=jpeg(None), e=jpeg(MUNICH))
    found = read_image_positions(tmp_path, [*names, "gone.jpg"])
    assert [one.image for one in found.positions] == ["a.jpg", "e.jpg"]
    assert (found.positions[0].x, found.positions[0].y) == pytest.approx((LONGITUDE, LATITUDE))
    assert [fault.split(":")[0] for fault in found.faults] == ["b.jpg", "c.jpg", "gone.jpg"]


def without_references(gps: Mapping[int, object]) -> dict[int, object]:
    return {key: value for key, value in gps.items() if key not in (G.GPSLatitudeRef, G.GPSLongitudeRef)}


def test_a_missing_hemisphere_is_that_of_the_others(tmp_path: Path) -> None:
    west = {**MUNICH, G.GPSLongitudeRef: "W"}
    names = write(tmp_path, a=jpeg(west), b=jpeg(without_references(west)))
    found = read_image_positions(tmp_path, names)
    assert [one.x for one in found.positions] == pytest.approx([-LONGITUDE, -LONGITUDE])
    assert found.faults == ("b.jpg: EXIF does not name the hemisphere; north and west is taken, as the other images",)


def test_a_missing_hemisphere_of_all_is_assumed_and_said(tmp_path: Path) -> None:
    found = read_image_positions(tmp_path, write(tmp_path, a=jpeg(without_references(MUNICH))))
    assert found.positions[0].x == pytest.approx(LONGITUDE)
    assert found.faults == ("a.jpg: EXIF does not name the hemisphere; north and east is taken, by assumption",)


def test_a_height_of_zero_is_judged_by_the_others(tmp_path: Path) -> None:
    zero = jpeg({**MUNICH, G.GPSAltitude: 0.0})
    names = write(tmp_path, a=jpeg(MUNICH), b=zero, c=jpeg(MUNICH))
    found = read_image_positions(tmp_path, names)
    assert [one.z for one in found.positions] == [519.5, None, 519.5]
    assert found.faults == ("b.jpg: a height of 0 among others is taken as missing",)
    sea = read_image_positions(tmp_path, ["b.jpg"])
    assert ([one.z for one in sea.positions], sea.faults) == ([0.0], ())


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "count", "first"),
    [
        ("caliterra_drone", 75, (-98.0899917, 30.1712233, 317.3, None)),
        ("lund_street", 29, (13.1953889, 55.6981667, 37.0, 30.0)),
        ("oppaiyama_gcp", 68, (140.9360056, 38.2422528, 15.206, 5.0)),
    ],
)
def test_positions_of_real_images(
    data_dir: Callable[[str], Path], name: str, count: int, first: tuple[float, float, float, float | None]
) -> None:
    folder = data_dir(name) / "images"
    found = read_image_positions(folder, sorted(path.name for path in folder.iterdir()))
    assert (len(found.positions), found.faults) == (count, ())
    one = found.positions[0]
    assert (one.x, one.y, one.z) == pytest.approx(first[:3], abs=1e-3)
    assert one.sigma_h_m == first[3]

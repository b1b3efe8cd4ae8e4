"""geo.txt and gcp_list.txt to the letter, tables, and records that cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.survey import SurveyPoint, role_of_label, with_every_kth_as_check
from smust3r_colmap.importers.survey_files import read_points_files, read_positions_file


def write(folder: Path, name: str, text: str | bytes) -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


GEO = """EPSG:25832
# image x y z yaw pitch roll horizontal vertical
a.jpg 600000.5 5300001.25
b.jpg\t600010\t5300002\t560.5
c.jpg 600020 5300003 561 12 0 0
d.jpg 600030 5300004 562 12 5 0 0.02 0.03 more words
"""


def test_geo_txt_of_opendronemap(tmp_path: Path) -> None:
    found = read_positions_file(write(tmp_path, "geo.txt", GEO))
    a, b, c, d = found.positions
    assert (found.crs, found.crs_origin, found.faults) == ("EPSG:25832", "geo.txt:1", ())
    assert (a.image, a.x, a.y, a.z, a.origin) == ("a.jpg", 600000.5, 5300001.25, None, "geo.txt:3")
    assert (b.z, b.up_cam) == (560.5, None)
    assert (c.z, c.sigma_h_m, c.up_cam) == (561, None, None)  # angles may be yaw, pitch, roll or omega, phi, kappa
    assert (d.sigma_h_m, d.sigma_v_m) == (0.02, 0.03)


@pytest.mark.parametrize("change", [lambda text: b"\xef\xbb\xbf" + text, lambda text: text.replace(b"\n", b"\r\n")])
def test_a_bom_and_other_line_ends_change_nothing(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    plain = read_positions_file(write(tmp_path, "geo.txt", GEO))
    assert read_positions_file(write(tmp_path, "geo.txt", change(GEO.encode()))) == plain


def test_bad_records_are_named_and_left_out(tmp_path: Path) -> None:
    text = (
        "WGS84 UTM 32N\na.jpg 600000 5300000 nan\nb.jpg 1,5 2\nc.jpg 600000\nd.jpg,600000,5300000,5\n"
        "e.jpg inf 5300000\na.jpg 600001 5300000 500\nf.jpg 600000 5300000\n"
    )
    found = read_positions_file(write(tmp_path, "geo.txt", text))
    assert [(one.image, one.x, one.z) for one in found.positions] == [("a.jpg", 600001, 500), ("f.jpg", 600000, None)]
    assert found.faults == (
        "geo.txt:2: the height is nan; taken as without height",
        "geo.txt:3: left out: x '1,5' is no number; write a decimal point",
        "geo.txt:4: left out: 2 of at least 3 words of `image x y [z] [yaw pitch roll] [sigma_h sigma_v]`",
        "geo.txt:5: left out: 1 of at least 3 words of `image x y [z] [yaw pitch roll] [sigma_h sigma_v]`; it has "
        "commas: separate by blanks or tabs, or name the file .csv",
        "geo.txt:6: left out: x is inf",
        "geo.txt:7: a second position for a.jpg, after geo.txt:2; the last is taken",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "geo.txt: is empty; its first line names the CRS"),
        ("a.jpg 600000 5300000 500\n", "geo.txt:1: is a record, but the first line names the CRS"),
        (
            "EPSG:25832\na.jpg x 5300000\n",
            "holds no usable position of an image; the first message: geo.txt:2: left out",
        ),
        (b"EPSG:25832\n\xff\xfe", "is no UTF-8 text"),
    ],
)
def test_files_with_nothing_to_use_are_refused(tmp_path: Path, text: str | bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_positions_file(write(tmp_path, "geo.txt", text))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.txt: cannot be read: No such file"):
        read_positions_file(tmp_path / "none.txt")


@pytest.mark.parametrize(
    ("head", "crs"),
    [("EPSG:25832\nimage,easting,northing,alt,sigma_h\n", "EPSG:25832"), ("filename;lon;lat;z;acc_h\n", "EPSG:4326")],
)
def test_tables_of_positions(tmp_path: Path, head: str, crs: str) -> None:
    row = "b 1.jpg,9.5,48.25,500,0.5\n".replace(",", ";" if ";" in head else ",")
    found = read_positions_file(write(tmp_path, "fixes.csv", head + row))
    (one,) = found.positions
    assert found.crs == crs
    assert (one.image, one.x, one.y, one.z, one.sigma_h_m) == ("b 1.jpg", 9.5, 48.25, 500, 0.5)


def test_a_table_without_crs_or_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"t\.csv:1: the CRS is missing; write it in a line of its own"):
        read_positions_file(write(tmp_path, "t.csv", "image,x,y\na,1,2\n"))
    with pytest.raises(InputError, match=r"t\.csv:2: has no column 'y'; the columns are image, x"):
        read_positions_file(write(tmp_path, "t.csv", "EPSG:25832\nimage,x\na,1\n"))


GCP = """+proj=utm +zone=11 +datum=WGS84
235269.88\t3811198.11\t0.0\t1081\t686\tIMG_1.jpg\tgcp02
235269.88 3811198.11 0.0 176.335 307.090 IMG_2.jpg gcp02 extra
235262.54 3811203.5 5 1040.003 299.325 IMG_1.jpg CHK-1
235200 3811200 NaN 1 2 IMG_1.jpg
"""


def test_gcp_list_of_opendronemap(tmp_path: Path) -> None:
    found = read_points_files([write(tmp_path, "gcp_list.txt", GCP)])
    first, second, third = found.points
    assert found.crs == "+proj=utm +zone=11 +datum=WGS84"
    assert (first.label, first.x, first.y, first.z, first.role) == ("gcp02", 235269.88, 3811198.11, 0.0, "control")
    assert [(tag.image, tag.origin) for tag in first.tags] == [
        ("IMG_1.jpg", "gcp_list.txt:2"),
        ("IMG_2.jpg", "gcp_list.txt:3"),
    ]
    # whole numbers are centres of pixels there, and the first pixel has its centre at 0.5 here
    assert (first.tags[0].x_px, first.tags[0].y_px) == (1081.5, 686.5)
    assert (second.label, second.role) == ("CHK-1", "check")
    assert (third.label, third.z) == ("point 3", None)
    assert found.faults == ("gcp_list.txt:5: the height is NaN; taken as without height",)


def test_a_label_at_two_places_is_two_points_and_a_second_tag_is_left_out(tmp_path: Path) -> None:
    text = "EPSG:25832\n1 2 3 10 10 a.jpg p\n1 2 3 11 10 a.jpg p\n1 2 4 10 10 b.jpg p\n"
    found = read_points_files([write(tmp_path, "gcp_list.txt", text)])
    assert [(one.label, one.z, len(one.tags)) for one in found.points] == [("p", 3, 1), ("p (gcp_list.txt:4)", 4, 1)]
    assert found.faults == (
        "gcp_list.txt:3: left out: p has a tag in a.jpg already, by gcp_list.txt:2",
        "gcp_list.txt:4: p has other coordinates than in gcp_list.txt:2; named 'p (gcp_list.txt:4)'",
    )


def test_tables_of_points_and_tags(tmp_path: Path) -> None:
    points = write(
        tmp_path,
        "points.csv",
        "EPSG:25832\nlabel,x,y,z,sigma_h,sigma_v,role\np1,1,2,3,0.01,0.02,\np2,4,5,,,,horizontal\n"
        "p3,7,8,9,,,Check\np4,1,1,1,,,corner\n",
    )
    tags = write(
        tmp_path, "tags.csv", "label,image,px,py\np1,a.jpg,10,20\np3,a.jpg,30,40\nzz,a.jpg,1,1\np1,b.jpg,x,1\n"
    )
    found = read_points_files([points, tags])
    p1, p2, p3 = found.points
    assert (p1.sigma_h_m, p1.sigma_v_m, p1.role, p1.tags[0].x_px) == (0.01, 0.02, "control", 10.5)
    assert (p2.z, p2.role, p3.role) == (None, "horizontal", "check")
    assert found.faults == (
        "points.csv:6: left out: role 'corner' is none of control, check, tie, horizontal, vertical",
        "tags.csv:5: left out: px 'x' is no number",
        "tags.csv:4: left out: there is no point zz",
    )


def test_lists_in_different_crs_are_refused(tmp_path: Path) -> None:
    a = write(tmp_path, "a.txt", "EPSG:25832\n1 2 3 10 10 a.jpg p\n")
    b = write(tmp_path, "b.txt", "EPSG:25833\n1 2 3 10 10 a.jpg q\n")
    with pytest.raises(InputError, match=r"b\.txt:1: the CRS 'EPSG:25833' is another one than 'EPSG:25832'"):
        read_points_files([a, b])


@pytest.mark.parametrize(
    ("label", "role"), [("CHK1", "check"), ("chk_2", "check"), ("Check 7", "check"), ("gcp", "control")]
)
def test_check_points_are_known_by_their_names(label: str, role: str) -> None:
    assert role_of_label(label) == role


def test_every_kth_control_point_becomes_a_check_point() -> None:
    points = [SurveyPoint(label=name, x=0, y=0, z=0, role=role_of_label(name), origin="") for name in "abcde"]
    points.insert(1, SurveyPoint(label="chk", x=0, y=0, z=0, role="check", origin=""))
    changed = with_every_kth_as_check(points, 2)
    assert [one.label for one in changed if one.role == "check"] == ["chk", "b", "d"]
    with pytest.raises(InputError, match="--check-every 1: needs 2 or more"):
        with_every_kth_as_check(points, 1)


@pytest.mark.data
def test_real_lists(data_dir: Callable[[str], Path]) -> None:
    copr = read_points_files([data_dir("copr_gcp") / "gcp_list.txt"])
    assert {one.label: len(one.tags) for one in copr.points} == {
        **{f"gcp{k:02}": 3 for k in range(2, 10)},
        **{"gcp00": 1, "gcp01": 2},
    }
    assert {one.z for one in copr.points} == {0.0}
    oppaiyama = read_points_files([data_dir("oppaiyama_gcp") / "gcp_list.txt"])
    assert [(one.label, len(one.tags)) for one in oppaiyama.points] == [
        ("point 1", 32),
        ("point 2", 42),
        ("point 3", 45),
        ("point 4", 30),
    ]

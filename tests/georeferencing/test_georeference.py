"""The whole of it on a simulated survey with exact truth, and every record that does not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.surveys import PIXEL_M, Survey, make_survey, with_moved

from smust3r_colmap.errors import DegenerateAlignmentError, InputError
from smust3r_colmap.geometry.arrays import FloatArray
from smust3r_colmap.georeferencing.georeference import Georeference, georeference
from smust3r_colmap.georeferencing.survey_in_crs import Altitude
from smust3r_colmap.importers.survey import ImagePosition, ImagePositions, Role, SurveyPoints

pytest.importorskip("pyproj")

SURVEY = make_survey(np.random.default_rng(0))
EIGHT_AND_TWELVE: tuple[Role, ...] = ("check", "control", "check", "check", "control") * 4


def find(
    survey: Survey,
    positions: ImagePositions | None,
    points: SurveyPoints | None,
    *,
    crs: str = "auto",
    altitude: Altitude = "auto",
    height_offset_m: float = 0.0,
) -> Georeference:
    return georeference(
        survey.model(),
        positions,
        points,
        crs=crs,
        altitude=altitude,
        height_offset_m=height_offset_m,
        rng=np.random.default_rng(0),
    )


def camera_errors(survey: Survey, found: Georeference) -> FloatArray:
    truth = survey.frame.crs_from_local(survey.centres_local)
    errors: FloatArray = found.to_crs(survey.model().centres_model) - truth
    return errors


# ------------------------------------------------------------------------------- accuracy
@pytest.mark.slow
def test_eight_control_points_place_twelve_check_points_within_a_pixel() -> None:
    """Horizontal within half a pixel on the ground, heights within one, over four surveys."""
    squares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        survey = make_survey(rng)
        found = find(survey, None, survey.points(rng, 20, roles=EIGHT_AND_TWELVE))
        accuracy = found.accuracies()
        assert (accuracy["control"].count, accuracy["check"].count) == (8, 12)
        assert found.basis == "control points"
        squares.append((accuracy["check"].horizontal ** 2, accuracy["check"].rmse[2] ** 2))
    horizontal, vertical = np.sqrt(np.mean(squares, axis=0)) / PIXEL_M
    assert 0.1 < horizontal < 0.5
    assert 0.2 < vertical < 1.0


@pytest.mark.slow
def test_rtk_alone_places_check_points_within_a_pixel() -> None:
    squares = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        survey = make_survey(rng)
        positions = survey.positions(rng, sigma_h=0.02, sigma_v=0.03)
        found = find(survey, positions, survey.points(rng, 12, roles=["check"] * 12))
        assert (found.basis, found.up) == ("positions of images", None)
        check = found.accuracies()["check"]
        squares.append((check.horizontal**2, check.rmse[2] ** 2))
    horizontal, vertical = np.sqrt(np.mean(squares, axis=0)) / PIXEL_M
    assert horizontal < 1.0
    assert vertical < 2.0


def test_exact_control_gives_coordinates_to_a_millimetre() -> None:
    """Through projection, curvature and offset, and back."""
    rng = np.random.default_rng(1)
    found = find(SURVEY, None, SURVEY.points(rng, 8, tag_px=0.0))
    assert np.abs(camera_errors(SURVEY, found)).max() < 1e-3
    assert (found.faults, found.warnings) == ((), ())
    assert found.pixel_size_m == pytest.approx(PIXEL_M, rel=1e-3)
    assert found.frame.crs is not None
    assert (found.frame.crs.name, found.frame.crs.vertical_name) == ("EPSG:25832", "unknown")


def test_the_result_is_in_the_crs_that_is_asked_for() -> None:
    from pyproj import Transformer  # noqa: PLC0415

    rng = np.random.default_rng(2)
    found = find(SURVEY, None, SURVEY.points(rng, 8, tag_px=0.0), crs="EPSG:3035")
    truth = SURVEY.frame.crs_from_local(SURVEY.centres_local)
    x, y = Transformer.from_crs(25832, 3035, always_xy=True).transform(truth[:, 0], truth[:, 1])
    np.testing.assert_allclose(
        found.to_crs(SURVEY.model().centres_model), np.column_stack([x, y, truth[:, 2]]), atol=2e-3
    )


def test_three_control_points_are_checked_by_nothing() -> None:
    found = find(SURVEY, None, SURVEY.points(np.random.default_rng(21), 3, tag_px=0.0))
    assert np.abs(camera_errors(SURVEY, found)).max() < 1e-3
    assert found.warnings == ("nothing checks the 3 control points: no other point is left to compare",)


@pytest.mark.slow
def test_points_that_are_off_by_many_pixels_are_doubted() -> None:
    rng = np.random.default_rng(22)
    found = find(SURVEY, None, SURVEY.points(rng, 9, sigma_m=0.8))
    off = found.accuracies()["control_leave_one_out"].horizontal
    assert off > 0.5
    assert found.pixel_size_m is not None
    assert found.warnings[-1] == (
        f"control points, each left out of the fit, are {off:.3g} m, {off / found.pixel_size_m:.0f} pixels on the "
        "ground off: the points are not exact, or the model is bent"
    )
    with_check = find(SURVEY, None, SURVEY.points(rng, 9, sigma_m=0.8, roles=["check"] * 3))
    assert with_check.warnings[-1].startswith("check points are ")


@pytest.mark.slow
def test_check_points_change_nothing() -> None:
    rng = np.random.default_rng(3)
    points = SURVEY.points(rng, 12, sigma_m=0.02, roles=EIGHT_AND_TWELVE)
    control = replace(points, points=tuple(one for one in points.points if one.role == "control"))
    wild = replace(
        points, points=tuple(replace(one, z=(one.z or 0) + 9) if one.role == "check" else one for one in points.points)
    )
    matrices = [find(SURVEY, None, one).crs_from_model for one in (points, control)]
    offsets = [find(SURVEY, None, one).frame.offset_m for one in (points, control)]
    assert offsets[0] == offsets[1]
    np.testing.assert_allclose(matrices[0], matrices[1], atol=1e-9)
    check = find(SURVEY, None, wild).accuracies()["check"]
    assert check.mean[2] == pytest.approx(9, abs=0.1)


# -------------------------------------------------------------------- GPS and control points
@pytest.mark.slow
def test_control_points_win_over_gps_and_the_shift_of_gps_is_seen() -> None:
    rng = np.random.default_rng(4)
    positions = SURVEY.positions(rng, sigma_h=2, sigma_v=4, shift=(1, -2, 20))
    points = SURVEY.points(rng, 6)
    both, alone = find(SURVEY, positions, points), find(SURVEY, None, points)
    assert both.basis == "control points"
    np.testing.assert_allclose(
        both.to_crs(SURVEY.model().centres_model), alone.to_crs(SURVEY.model().centres_model), atol=1e-6
    )
    assert both.accuracies()["gps"].mean == pytest.approx((1, -2, 20), abs=2.5)


@pytest.mark.slow
def test_two_control_points_take_turn_and_scale_from_gps_and_its_shift_is_found() -> None:
    rng = np.random.default_rng(5)
    positions = SURVEY.positions(rng, sigma_h=0.05, sigma_v=0.08, shift=(3, -2, 48))
    found = find(SURVEY, positions, SURVEY.points(rng, 2))
    assert found.basis == "control points and positions of images"
    assert found.gps_offset_m == pytest.approx([3, -2, 48], abs=0.2)
    assert np.abs(camera_errors(SURVEY, found)).max() < 0.3
    assert any("alone, 3 would be needed" in text for text in found.warnings)


def test_two_control_points_alone_are_levelled_by_the_ground() -> None:
    found = find(SURVEY, None, SURVEY.points(np.random.default_rng(6), 2, tag_px=0.1))
    assert found.basis == "control points"
    assert found.up is not None
    turn = found.local_from_model.rotation @ SURVEY.local_from_model.rotation.T
    assert np.degrees(np.arccos(turn[2, 2])) < 4
    assert float(found.local_from_model.scale) == pytest.approx(7.3, rel=0.01)
    assert any(text.startswith("which way is up was taken from the plane of the ground") for text in found.warnings)


def test_too_little_is_refused_with_both_reasons() -> None:
    rng = np.random.default_rng(6)
    with pytest.raises(
        DegenerateAlignmentError, match=r"1 of 1 control points .* alone, 3 would be needed; and by the"
    ):
        find(SURVEY, None, SURVEY.points(rng, 1))


@pytest.mark.slow
def test_wrong_positions_are_named_and_left_out() -> None:
    rng = np.random.default_rng(7)
    positions = with_moved(
        SURVEY.positions(rng, sigma_h=2, sigma_v=4), {3: (200, 0), 11: (0, -200), 20: (150, 150), 31: (-200, 20)}
    )
    found = find(SURVEY, positions, None)
    left_out = [one.image for one in found.fixes if one.left_out]
    assert left_out == [SURVEY.names[k] for k in (3, 11, 20, 31)]
    assert sum("the position is" in text and "m off" in text for text in found.warnings) == 4
    assert found.accuracies()["gps"].count == 32


# ------------------------------------------------------------------------- records that do not fit
def test_a_wrong_tag_on_the_pixel_of_another_point_is_named() -> None:
    rng = np.random.default_rng(8)
    points = SURVEY.points(rng, 8)
    a, b = (
        points.points[0],
        next(
            one for one in points.points[1:] if {t.image for t in one.tags} & {t.image for t in points.points[0].tags}
        ),
    )
    shared = sorted({t.image for t in a.tags} & {t.image for t in b.tags})[0]
    pixel = next(t for t in b.tags if t.image == shared)
    tags = tuple(replace(t, x_px=pixel.x_px + 1, y_px=pixel.y_px) if t.image == shared else t for t in a.tags)
    found = find(SURVEY, None, replace(points, points=(replace(a, tags=tags), *points.points[1:])))
    (warning,) = [text for text in found.warnings if text.startswith(f"{a.label}, tag in {shared}")]
    assert f" px from where its {len(tags) - 1} other tags put it; it has the pixel of {b.label} in the same" in warning
    assert found.points[0].left_out is None
    assert np.abs(camera_errors(SURVEY, found)).max() < 0.2


def test_a_wrong_point_is_named() -> None:
    rng = np.random.default_rng(9)
    points = SURVEY.points(rng, 9, sigma_m=0.01)
    wrong = replace(points.points[5], x=points.points[5].x + 1.5)
    rows = (*points.points[:5], wrong, *points.points[6:])
    found = find(SURVEY, None, replace(points, points=rows))
    assert [one.point.label for one in found.points if one.left_out] == ["p5"]
    assert "p5 (gcp_list.txt:52): left out: 1.5" in found.warnings[0]


def test_tags_of_unknown_images_and_outside_are_named() -> None:
    rng = np.random.default_rng(10)
    points = SURVEY.points(rng, 8)
    first = points.points[0]
    odd = (replace(first.tags[0], image="gone.jpg"), replace(first.tags[1], x_px=1500.0), *first.tags[2:])
    found = find(SURVEY, None, replace(points, points=(replace(first, tags=odd), *points.points[1:])))
    assert f"{first.tags[0].origin}: left out: no image gone.jpg is in the model" in found.faults
    assert any("pixel (1500" in text and "which has 1024 x 768" in text for text in found.faults)


@pytest.mark.slow
def test_tags_of_resized_images_are_noticed() -> None:
    rng = np.random.default_rng(11)
    points = SURVEY.points(rng, 8)

    def scaled(factor: float) -> SurveyPoints:
        return replace(
            points,
            points=tuple(
                replace(one, tags=tuple(replace(t, x_px=factor * t.x_px, y_px=factor * t.y_px) for t in one.tags))
                for one in points.points
            ),
        )

    small = "may have been made in smaller copies of the images"
    positions = SURVEY.positions(rng, sigma_h=1, sigma_v=1)
    assert any(small in text for text in find(SURVEY, positions, scaled(0.5)).faults)
    assert any("made in images of another size" in text for text in find(SURVEY, positions, scaled(4.0)).faults)
    assert not any("size" in text for text in find(SURVEY, positions, points).faults)
    with pytest.raises(DegenerateAlignmentError, match=r"; besides: .* made in images of another size"):
        find(SURVEY, None, scaled(40.0))


def test_names_are_found_without_folders_and_in_any_case() -> None:
    rng = np.random.default_rng(12)
    points = SURVEY.points(rng, 6, tag_px=0.0)
    renamed = replace(
        points,
        points=tuple(
            replace(one, tags=tuple(replace(t, image=t.image.split("/")[1].lower()) for t in one.tags))
            for one in points.points
        ),
    )
    found = find(SURVEY, None, renamed)
    assert found.faults == ()
    assert np.abs(camera_errors(SURVEY, found)).max() < 1e-3


def test_a_point_with_one_tag_is_named() -> None:
    rng = np.random.default_rng(13)
    points = SURVEY.points(rng, 6)
    lonely = replace(points.points[2], tags=points.points[2].tags[:1])
    found = find(SURVEY, None, replace(points, points=(*points.points[:2], lonely, *points.points[3:])))
    assert found.points[2].left_out == f"one tag in the model ({lonely.tags[0].image}); two are needed"


def degrees(survey: Survey, rng: np.random.Generator) -> ImagePositions:
    """GPS as EXIF has it."""
    from pyproj import Transformer  # noqa: PLC0415

    rows = survey.positions(rng, sigma_h=0.5, sigma_v=0.5).positions
    lon, lat = Transformer.from_crs(25832, 4326, always_xy=True).transform([p.x for p in rows], [p.y for p in rows])
    found = [replace(p, x=float(x), y=float(y), origin=p.image) for p, x, y in zip(rows, lon, lat, strict=True)]
    return ImagePositions(crs="EPSG:4326", crs_origin="EXIF", positions=tuple(found))


def test_positions_in_degrees_get_their_zone_and_swapped_ones_are_named() -> None:
    positions = degrees(SURVEY, np.random.default_rng(14))
    rows = list(positions.positions)
    rows[4] = replace(rows[4], x=rows[4].y, y=rows[4].x)
    rows[9] = replace(rows[9], x=0.0, y=0.0)
    found = find(SURVEY, replace(positions, positions=tuple(rows)), None)
    assert found.frame.crs is not None
    assert found.frame.crs.name == "EPSG:32632"
    assert (
        f"{SURVEY.names[4]}: left out: the position is more than 50 km from the others; x and y, or latitude and "
        in (text[: len(text) - len("longitude, are swapped")] for text in found.faults)
    )
    assert f"{SURVEY.names[9]}: left out: the position is more than 50 km from the others" in found.faults
    assert np.abs(camera_errors(SURVEY, found)).max() < 2


def test_points_in_another_part_of_the_world_than_the_images_are_refused() -> None:
    rng = np.random.default_rng(15)
    points = replace(SURVEY.points(rng, 6), crs="EPSG:25833")
    with pytest.raises(
        InputError, match=r"gcp_list.txt:1: in EPSG:25833, the points lie \d+ km from the positions of "
    ):
        find(SURVEY, degrees(SURVEY, rng), points)


def test_a_crs_that_is_not_made_for_the_place_is_refused() -> None:
    rng = np.random.default_rng(16)
    points = SURVEY.points(rng, 6)
    with pytest.raises(InputError, match=r"--crs: EPSG:32611 .* is not made for the place, longitude 10\.33"):
        find(SURVEY, None, points, crs="EPSG:32611")
    with pytest.raises(InputError, match="--crs: EPSG:4326 is in degrees; name a projection in metres"):
        find(SURVEY, None, points, crs="EPSG:4326")
    swapped = replace(points, points=tuple(replace(one, x=one.y, y=one.x) for one in points.points))
    with pytest.raises(InputError, match=r"no point is left: .* x and y are swapped: east comes first"):
        find(SURVEY, None, swapped)


def test_one_swapped_point_is_named_and_the_others_are_used() -> None:
    rng = np.random.default_rng(17)
    points = SURVEY.points(rng, 7, tag_px=0.0)
    odd = replace(points.points[3], x=points.points[3].y, y=points.points[3].x)
    found = find(SURVEY, None, replace(points, points=(*points.points[:3], odd, *points.points[4:])))
    assert len(found.faults) == 1
    assert found.faults[0].endswith("x and y are swapped: east comes first")
    assert np.abs(camera_errors(SURVEY, found)).max() < 1e-3


@pytest.mark.slow
def test_vertical_datums_are_named_and_never_invented() -> None:
    rng = np.random.default_rng(18)
    points = SURVEY.points(rng, 6, tag_px=0.0)
    named = find(SURVEY, None, replace(points, crs="EPSG:25832+7837"))
    assert named.frame.crs is not None
    assert named.frame.crs.vertical_name == "DHHN2016 height"
    assert named.faults == ()
    assumed = find(SURVEY, None, points, crs="EPSG:25832+7837")
    assert assumed.faults == (
        "gcp_list.txt:1: it is not said what the heights refer to; they are taken as DHHN2016 height, of --crs",
    )
    positions = degrees(SURVEY, rng)
    gps = find(SURVEY, positions, None, altitude="ellipsoid")
    assert gps.frame.crs is not None
    assert gps.frame.crs.vertical_name.startswith("height above the ellipsoid")
    with pytest.raises(InputError, match="the grid is missing"):
        find(SURVEY, positions, replace(points, crs="EPSG:25832+7837"), altitude="ellipsoid")


@pytest.mark.slow
def test_heights_of_images_by_choice() -> None:
    rng = np.random.default_rng(19)
    rows = [
        replace(one, relative_z_m=(one.z or 0) - 480)
        for one in SURVEY.positions(rng, sigma_h=0.1, sigma_v=0.1).positions
    ]
    positions = ImagePositions(crs="EPSG:25832", crs_origin="geo.txt:1", positions=tuple(rows))
    heights = {
        choice: float(
            np.median(
                find(SURVEY, positions, None, altitude=choice, height_offset_m=5).to_crs(SURVEY.model().centres_model)[
                    :, 2
                ]
            )
        )
        for choice in ("auto", "relative")
    }
    assert heights["auto"] == pytest.approx(550, abs=1)
    assert heights["relative"] == pytest.approx(70, abs=1)
    none = find(SURVEY, positions, None, altitude="none")
    assert all(np.isnan(one.residual_m[2]) for one in none.fixes)
    assert np.abs(camera_errors(SURVEY, none)[:, :2]).max() < 1


def test_coordinates_of_a_site_need_no_crs() -> None:
    rng = np.random.default_rng(20)
    points = replace(SURVEY.points(rng, 6, tag_px=0.0), crs="LOCAL")
    found = find(SURVEY, None, points)
    assert found.frame.crs is None
    assert float(found.local_from_model.scale) == pytest.approx(7.3, rel=1e-3)
    with_gps = find(SURVEY, degrees(SURVEY, rng), points)
    assert with_gps.faults == ("the positions in EXIF are not used: the control points are in no CRS",)


def test_nothing_left_is_an_error() -> None:
    other = ImagePosition(image="other.jpg", x=600000.0, y=5300000.0, z=500.0, origin="geo.txt:2")
    positions = ImagePositions(crs="EPSG:25832", crs_origin="geo.txt:1", positions=(other,))
    with pytest.raises(
        InputError, match=r"no image of the model has a position: geo.txt:2: left out: no image other.jpg"
    ):
        find(SURVEY, positions, None)

"""Intrinsics as programs write them, of a lens of 460 px at 512 x 342 whose principal point is (253.7, 168.1)."""

from __future__ import annotations

import pytest

from smust3r_colmap.errors import InputError
from smust3r_colmap.importers.intrinsics_units import MendedIntrinsics, in_pixels

WIDTH, HEIGHT = 512, 342
FOCAL, CX, CY = 460.0, 253.7, 168.1


def mended(*params: float, num_focal: int = 2) -> MendedIntrinsics:
    return in_pixels(params, WIDTH, HEIGHT, num_focal=num_focal, place="cameras.txt: line 2", camera="camera 1")


@pytest.mark.parametrize(
    ("by", "what"),
    [
        (1 / 2, "multiplied by 2"),
        (2, "multiplied by 0.5"),
        (1 / WIDTH, "multiplied by 512"),
        (36 / WIDTH, "multiplied by 14.22"),
    ],
)
def test_another_resolution_or_unit_is_mended_to_the_truth(by: float, what: str) -> None:
    """Shrunk by two, twice as large, in parts of the width, in millimetres of 35 mm film."""
    found = mended(FOCAL * by, FOCAL * by, CX * by, CY * by, 0.01)
    assert found.params == pytest.approx((FOCAL, FOCAL, CX, CY, 0.01))
    assert what in found.what


def test_a_factor_that_no_program_takes_is_that_of_the_principal_point() -> None:
    found = mended(FOCAL * 0.7, CX * 0.7, CY * 0.7, num_focal=1)
    assert found.params == pytest.approx((FOCAL, CX, CY), rel=0.02)


def test_parts_of_each_side_are_mended() -> None:
    found = mended(FOCAL / WIDTH, FOCAL / HEIGHT, 0.4955, 0.4915)
    assert found.params == pytest.approx((FOCAL, FOCAL, 0.4955 * WIDTH, 0.4915 * HEIGHT))


def test_a_principal_point_at_zero_becomes_the_middle() -> None:
    found = mended(FOCAL, FOCAL, 0, 0)
    assert found.params == (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    assert "middle" in found.what


@pytest.mark.parametrize(
    ("cx", "cy"),
    [(CX, CY), (CX - 172, CY), (CX + 80, CY - 50), (CX * 1.1, CY * 1.1)],
    ids=["good", "left half", "crop", "a little off"],
)
def test_what_may_be_meant_is_left_alone(cx: float, cy: float) -> None:
    assert mended(FOCAL, FOCAL, cx, cy) == MendedIntrinsics(params=(FOCAL, FOCAL, cx, cy), what="")


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ((32.3, 32.3, CX, CY), r"line 2: camera 1 has focal length 32.3 px, for 512x342 px; .* millimetres \(459.4 px"),
        ((0.9, 0.9, CX, CY), r"parts of the width \(460.8 px\)"),
        ((1.8, 1.8, 0, 0), r"focal length 1.8 px after principal points at \(0, 0\) were put into the middle"),
        ((1e308, FOCAL, CX, CY), r"1e\+308 px.*never estimated"),
        ((0.0, FOCAL, CX, CY), r"focal length 0; it must be positive"),
        ((FOCAL, -500.0, CX, CY), r"focal length -500; it must be positive"),
        ((float("nan"), FOCAL, CX, CY), r"focal length nan; it must be positive"),
    ],
)
def test_what_has_several_meanings_is_refused_with_the_question(params: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        mended(*params)

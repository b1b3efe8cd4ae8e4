"""Imports between rooms go one way, and inside a stage's room only ``stage.py`` knows settings and clock."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from show_structure import PACKAGE, Arrows, arrows, circles, imports_of, modules, room_of

ORDER = (
    # foundations: they know no stage
    PACKAGE,
    "errors",
    "config",
    "geometry",
    "products",
    "estimators",
    "colmap",
    "storage",
    "execution",
    # stages, in the order of the method
    "importers",
    "evaluation",
    "features",
    "segmentation",
    "backbones",
    "alignment",
    "stitching",
    "refinement",
    "dense",
    "georeferencing",
    "exporters",
    # what looks at results
    "report",
    "validation",
    "synthetic",
    # tables of contents, and the command line
    "pipeline",
    "refine_model",
    "cli",
    "__main__",
)
"""A room imports from rooms before it only."""

STAGES = ("segmentation", "backbones", "alignment", "stitching", "refinement", "dense", "georeferencing", "features")


def test_every_room_has_its_place_in_the_order() -> None:
    rooms = {room_of(module) for module in modules()}
    assert rooms == set(ORDER)


@pytest.fixture(scope="module")
def structure() -> Arrows:
    return arrows()


def test_imports_go_one_way(structure: Arrows) -> None:
    place = {room: k for k, room in enumerate(ORDER)}
    upward = [one for (a, b), imports in structure.items() if place[a] < place[b] for one in imports]
    assert not upward, upward


def test_there_is_no_circle(structure: Arrows) -> None:
    assert circles(structure) == []


@pytest.mark.parametrize("room", STAGES)
def test_only_the_stage_of_a_room_knows_the_clock(room: str) -> None:
    known = modules()
    knowing = [
        module
        for module, path in known.items()
        if room_of(module) == room
        and any(one.endswith((".run_context", ".stage_clock")) for one in imports_of(path, known))
    ]
    allowed = {f"{PACKAGE}.{room}.stage"}
    if room == "backbones":  # a backbone is a stage of its own
        allowed |= {f"{PACKAGE}.backbones.{name}" for name in ("base", "feed_forward", "classical.backbone")}
    if room == "dense":  # a second entry, for models of other programs
        allowed.add(f"{PACKAGE}.dense.external_points")
    assert set(knowing) <= allowed


def test_circles_and_upward_imports_are_seen(tmp_path: Path) -> None:
    for name, text in {
        "a/one.py": "from smust3r_colmap.b import two\n",
        "b/two.py": "def f():\n    import smust3r_colmap.c.three\n",
        "c/three.py": "from smust3r_colmap.a.one import x\n",
        "d/four.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from smust3r_colmap.a.one import x\n",
    }.items():
        path = tmp_path / PACKAGE / name
        path.parent.mkdir(parents=True)
        path.write_text(text)
    for linked in ("exporters", "importers"):
        (tmp_path / linked).mkdir()
    found = arrows(tmp_path)
    assert set(found) == {("a", "b"), ("b", "c"), ("c", "a")}
    assert circles(found) == [("a", "b", "c")]


INDEX_NAMES = {"a", "b", "i", "j", "first", "second", "image", "image_id", "other"}
"""Names of image indices; two of them are neighbours if the view graph says so, not if they differ by one."""


def index_differences(tree: ast.AST) -> list[int]:
    """Lines with ``abs(i - j)`` of two image indices."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) in ("abs", "np.abs")
        and isinstance(node.args[0], ast.BinOp)
        and isinstance(node.args[0].op, ast.Sub)
        and all(
            isinstance(side, ast.Name) and side.id in INDEX_NAMES for side in (node.args[0].left, node.args[0].right)
        )
    ]


def test_neighbours_are_asked_of_the_view_graph() -> None:
    found = {
        module: lines
        for module, path in modules().items()
        if room_of(module) in (*STAGES, "exporters", "report")
        and (lines := index_differences(ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert not found
    assert index_differences(ast.parse("near = min(anchors, key=lambda i: abs(i - image_id))")) == [1]

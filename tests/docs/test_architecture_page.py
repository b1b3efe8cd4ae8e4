"""docs/architecture.md and docs/decisions: every path and module that they name exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
ARCHITECTURE = REPOSITORY / "docs/architecture.md"
DECISIONS = sorted((REPOSITORY / "docs/decisions").glob("[0-9]*.md"))
PAGES = [ARCHITECTURE, REPOSITORY / "docs/decisions/README.md", *DECISIONS]

PATH = re.compile(r"`((?:smust3r_colmap|exporters|importers|scripts|tests)/[^`\s]*)`")
LINK = re.compile(r"\]\(([^)#:]+)\)")
ROOM = re.compile(r"^\| `([^`]+/)` \| [^|]+ \| (.+) \|$", re.MULTILINE)
DIAGRAM = re.compile(r"\(`([^`]+/)`\)[^\n]*(?:\n[^\n`]+)?\n\n```\n(.*?)```", re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_path_on_the_page_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    missing = [path for path in PATH.findall(text) if not (REPOSITORY / path).exists()]
    assert not missing


def test_every_room_has_the_entry_that_the_table_names() -> None:
    rooms = ROOM.findall(ARCHITECTURE.read_text(encoding="utf-8"))
    entries = [folder + name for folder, names in rooms for name in re.findall(r"`([^`]+)`", names)]
    assert len(entries) >= len(rooms) > 15
    assert not [entry for entry in entries if not (REPOSITORY / entry).is_file()]


def test_the_table_has_every_room() -> None:
    rooms = {folder for folder, _ in ROOM.findall(ARCHITECTURE.read_text(encoding="utf-8"))}
    package = REPOSITORY / "smust3r_colmap"
    # Links to the top level, which the table has under their own names.
    there = {path for path in package.iterdir() if (path / "__init__.py").is_file() and not path.is_symlink()}
    assert rooms == {f"smust3r_colmap/{path.name}/" for path in there} | {"exporters/", "importers/"}


def test_every_module_in_a_diagram_of_a_room_exists() -> None:
    diagrams = DIAGRAM.findall(ARCHITECTURE.read_text(encoding="utf-8"))
    assert len(diagrams) >= 5
    for folder, diagram in diagrams:
        names = [name for line in diagram.splitlines() for name in _modules(line)]
        assert len(names) > 4, folder
        assert not [name for name in names if not (REPOSITORY / folder / f"{name}.py").is_file()], folder


def _modules(line: str) -> list[str]:
    """The names before the first wide gap of a line."""
    return re.split(r" {2,}", line.strip())[0].split(", ")


def test_the_index_lists_every_decision_once() -> None:
    index = (REPOSITORY / "docs/decisions/README.md").read_text(encoding="utf-8")
    assert LINK.findall(index)[1:] == [page.name for page in DECISIONS]
    assert [page.name[:3] for page in DECISIONS] == [f"{number:03}" for number in range(1, len(DECISIONS) + 1)]

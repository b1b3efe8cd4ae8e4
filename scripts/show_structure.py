"""The structure of the package: its rooms, the imports between them, circles, and lines.

A room is a folder of ``smust3r_colmap`` or one of its loose modules. Imports inside functions count, those for type
checkers only do not.

    python scripts/show_structure.py            # rooms with their lines, and who imports whom
    python scripts/show_structure.py --arrows   # every import between rooms
"""

from __future__ import annotations

import argparse
import ast
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "smust3r_colmap"
LINKED = ("exporters", "importers")

Arrows = Mapping[tuple[str, str], tuple[str, ...]]
"""From a room to a room: the imports, as ``module -> module``."""


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Every module of the product by its dotted name; the linked folders belong to the package."""
    found = {}
    for top in (PACKAGE, *LINKED):
        for path in sorted((root / top).rglob("*.py")):
            relative = path.relative_to(root)
            if any((root / Path(*relative.parts[:k])).is_symlink() for k in range(1, len(relative.parts))):
                continue
            parts = [*relative.parts[:-1], relative.stem]
            if top in LINKED:
                parts = [PACKAGE, *parts]
            found[".".join(part for part in parts if part != "__init__")] = path
    return found


def room_of(module: str) -> str:
    """The folder of a module, or the module itself where it lies loose."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else PACKAGE


def imports_of(path: Path, known: Mapping[str, Path]) -> Iterator[str]:
    """Modules of the package that a file imports when it runs."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for_checkers = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if node in for_checkers:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.module.startswith(PACKAGE):
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                yield submodule if submodule in known else node.module


def arrows(root: Path = ROOT) -> Arrows:
    """All imports from one room into another."""
    known = modules(root)
    found: dict[tuple[str, str], set[str]] = defaultdict(set)
    for module, path in known.items():
        for imported in imports_of(path, known):
            if room_of(module) != room_of(imported):
                found[room_of(module), room_of(imported)].add(f"{module} -> {imported}")
    return {pair: tuple(sorted(imports)) for pair, imports in sorted(found.items())}


def circles(pairs: Arrows) -> list[tuple[str, ...]]:
    """Rooms that import each other over any number of rooms, as sorted groups."""
    reached = {room: {room} for pair in pairs for room in pair}
    changed = True
    while changed:
        changed = False
        for a, b in pairs:
            if not reached[b] <= reached[a]:
                reached[a] |= reached[b]
                changed = True
    groups = {tuple(sorted(other for other in reached[room] if room in reached[other])) for room in reached}
    return sorted(group for group in groups if len(group) > 1)


def main() -> None:
    """Print the structure."""
    parser = argparse.ArgumentParser(description="Rooms of the package, imports between them, circles, lines.")
    parser.add_argument("--arrows", action="store_true", help="print every import between rooms")
    arguments = parser.parse_args()
    known = modules()
    lines: Counter[str] = Counter()
    for module, path in known.items():
        lines[room_of(module)] += len(path.read_text(encoding="utf-8").splitlines())
    pairs = arrows()
    for room, count in sorted(lines.items()):
        into = sorted(b for a, b in pairs if a == room)
        print(f"{room:16} {count:6} lines  -> {', '.join(into) or 'nothing'}")
    if arguments.arrows:
        for imports in pairs.values():
            print("\n".join(f"  {one}" for one in imports))
    found = circles(pairs)
    print(f"{len(lines)} rooms, {len(pairs)} arrows between rooms, {len(found)} circles, {sum(lines.values())} lines")
    for group in found:
        print(f"  circle: {', '.join(group)}")


if __name__ == "__main__":
    main()

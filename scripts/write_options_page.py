"""Writes docs/options.md: every option of every command, from the dataclasses that the command line is made of.

    python scripts/write_options_page.py [--check]

``--check`` writes nothing; the exit code is 1 if the page is not what it would write.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import tyro

from smust3r_colmap.cli.demo import Demo
from smust3r_colmap.cli.doctor import Doctor
from smust3r_colmap.cli.evaluate import Evaluate
from smust3r_colmap.cli.export import Export
from smust3r_colmap.cli.frames import Frames
from smust3r_colmap.cli.georeference import Georeference
from smust3r_colmap.cli.presets import PRESETS
from smust3r_colmap.cli.reconstruct import Reconstruct
from smust3r_colmap.cli.refine import Refine
from smust3r_colmap.cli.report import Report
from smust3r_colmap.cli.validate import Validate
from smust3r_colmap.cli.weights import ConvertWeights, FetchWeights, ListWeights, PathOfWeights, VerifyWeights
from smust3r_colmap.storage.config_file import flags_from_settings

PAGE = Path(__file__).resolve().parents[1] / "docs/options.md"

COMMANDS: Mapping[str, type] = {
    "reconstruct": Reconstruct,
    "refine": Refine,
    "frames": Frames,
    "export": Export,
    "georeference": Georeference,
    "report": Report,
    "validate": Validate,
    "evaluate": Evaluate,
    "demo": Demo,
    "doctor": Doctor,
    "weights list": ListWeights,
    "weights fetch": FetchWeights,
    "weights verify": VerifyWeights,
    "weights convert": ConvertWeights,
    "weights path": PathOfWeights,
}

INTRODUCTION = """# Options

This page is generated from the code by `scripts/write_options_page.py`. `smust3r-colmap COMMAND --help` prints
the same.

## Settings file

`reconstruct` and `refine` read settings from a file with `--config FILE.toml`. The keys are the options with
underscores, at the top level, without tables; `--no-loop-closure` is `loop_closure = false`. The file overrides the
defaults and the preset, and options on the command line override the file. An unknown key is an error. Every run writes
its settings to `config.toml` in the output folder.

```toml
segment_length = 40
overlap = 20
camera_mode = "single"
```

## Presets

`reconstruct --preset NAME` sets options that go together:

| preset | the same as |
|---|---|
"""


def main(words: Sequence[str] | None = None) -> int:
    """Write the page, or compare it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if the page is out of date")
    page = render_page()
    if parser.parse_args(words).check:
        return int(PAGE.read_text(encoding="utf-8") != page)
    PAGE.write_text(page, encoding="utf-8")
    return 0


def render_page() -> str:
    """The whole page."""
    commands = (line for name, command in COMMANDS.items() for line in _command(name, command))
    return "\n".join([INTRODUCTION + "\n".join(map(_preset, PRESETS)), "", *commands])


def _preset(name: str) -> str:
    flags = " ".join(flags_from_settings(PRESETS[name])).replace("=", " ")
    return _row((f"`{name}`", f"`{flags}`" if flags else "no options"))


def _command(name: str, command: type) -> Iterator[str]:
    yield from (f"## {name}", "", "\n\n".join(_paragraphs(command)), "")
    yield from _table(command)
    for settings in filter(None, map(_nested, dataclasses.fields(command))):
        for section in filter(None, map(_nested, dataclasses.fields(settings))):
            title, *rest = _paragraphs(section)
            yield from (f"### {title.rstrip('.')}", "")
            yield from ("\n\n".join(rest), "") if rest else ()
            yield from _table(section)
        yield from ("### Other settings", "")
        yield from _table(settings)


def _nested(field: dataclasses.Field[Any]) -> type | None:
    """The dataclass of a field that holds one."""
    factory: Any = field.default_factory
    return factory if isinstance(factory, type) and dataclasses.is_dataclass(factory) else None


def _paragraphs(command: type) -> list[str]:
    """Of the docstring, one line each."""
    return [" ".join(part.split()) for part in (inspect.getdoc(command) or "").split("\n\n")]


def _table(settings: type) -> Iterator[str]:
    hints = get_type_hints(settings, include_extras=True)
    meanings = _meanings(settings)
    rows = [
        (_spelling(field, hints[field.name]), _default(field), _meaning(field, hints, meanings))
        for field in dataclasses.fields(settings)
        if _nested(field) is None
    ]
    yield from ("| option | default | meaning |", "|---|---|---|", *map(_row, rows), "")


def _row(cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", "\\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"


def _spelling(field: dataclasses.Field[Any], hint: Any) -> str:
    """As it is typed: the name of a positional argument, or the flag, of a switch with its opposite."""
    metadata = getattr(hint, "__metadata__", ())
    metavar = next((one.metavar for one in metadata if getattr(one, "metavar", None)), None)
    if tyro.conf.Positional in metadata:
        return f"`{metavar}`"
    flag = field.name.replace("_", "-")
    if not isinstance(field.default, bool):
        return f"`--{flag} {metavar}`" if metavar else f"`--{flag}`"
    if tyro.conf.FlagCreatePairsOff in metadata:
        return f"`--{flag}`"
    return f"`--{flag}`, `--no-{flag}`"


def _default(field: dataclasses.Field[Any]) -> str:
    match field.default:
        case dataclasses.MISSING:
            return "required"
        case bool():
            return "on" if field.default else "off"
        case None | "" | ():
            return ""
        case _:
            return f"`{field.default}`"


def _meaning(field: dataclasses.Field[Any], hints: Mapping[str, Any], meanings: Mapping[str, str]) -> str:
    choices = _choices(hints[field.name])
    return meanings[field.name] + (f" One of {', '.join(f'`{one}`' for one in choices)}." if choices else "")


def _choices(hint: Any) -> tuple[str, ...]:
    """Of a Literal, wherever it stands in the annotation."""
    if get_origin(hint) is Literal:
        return get_args(hint)
    return next((found for found in map(_choices, get_args(hint)) if found), ())


def _meanings(settings: type) -> dict[str, str]:
    """The docstring below each field, of the class and of those that it inherits from."""
    found: dict[str, str] = {}
    for one in reversed(settings.__mro__[:-1]):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in zip(definition.body, definition.body[1:], strict=False):
            match field, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(meaning))):
                    found[name] = " ".join(meaning.split())
    return found


if __name__ == "__main__":
    sys.exit(main())

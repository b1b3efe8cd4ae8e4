"""``smust3r-colmap weights``: list, fetch, verify, convert and find the weights of the network.

A part of the command line, so it prints: results to standard output, questions and messages to
standard error. The work is done in the package ``weights``; what a command needs is imported when
it runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import tyro

from smust3r_colmap.backbones.weights.cache import (
    CONVERTED_SUFFIX,
    WEIGHTS_VARIABLE,
    converted_place,
    fetch_advice,
    find_cached,
    find_weights,
    part_of,
    published_place,
    weights_folder,
)
from smust3r_colmap.backbones.weights.catalogue import (
    BASE_ADDRESS,
    CATALOGUE,
    LICENCE_SUMMARY,
    NETWORK_TENSOR_BYTES,
    RECOMMENDED,
    OfficialFile,
    find_official,
    official,
)
from smust3r_colmap.backbones.weights.checksum import verify
from smust3r_colmap.cli.console import EXIT_FAILED, fail, reporting
from smust3r_colmap.config import Must3rConfig
from smust3r_colmap.errors import CheckpointError, ConfigError
from smust3r_colmap.execution.progress import Reporter
from smust3r_colmap.report.summary import EXIT_GOOD


@dataclass(frozen=True, kw_only=True)
class WeightsAction:
    """What all commands about weights take."""

    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the result, warnings and errors only."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the traceback of an unexpected error."""


@dataclass(frozen=True, kw_only=True)
class ListWeights(WeightsAction):
    """List the official files, their sums, and which of them are in the cache."""


@dataclass(frozen=True, kw_only=True)
class FetchWeights(WeightsAction):
    """Fetch an official file into the cache after consent to its licence; goes on after an interruption."""

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="[NAME]")] = RECOMMENDED
    """Official name, as `weights list` prints it."""
    accept_licence: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """You have read the licence and accept it; for scripts, which cannot be asked."""
    base_url: Annotated[str, tyro.conf.arg(metavar="URL")] = BASE_ADDRESS
    """Folder on a web server that has the file, say a mirror on your network; the sum must be right all the same."""


@dataclass(frozen=True, kw_only=True)
class VerifyWeights(WeightsAction):
    """Compare files with the published sums; exit code 1 if one is not as published."""

    file: Annotated[
        tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[FILE|NAME]", help_behavior_hint="(optional)")
    ] = None
    """A file, or an official name in the cache; without it, all official files in the cache."""


@dataclass(frozen=True, kw_only=True)
class ConvertWeights(WeightsAction):
    """Convert a published checkpoint to safetensors, which opens in less than a second."""

    source: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="SOURCE")]
    """A checkpoint (.pth), or an official name in the cache."""
    target: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="[TARGET.safetensors]", help_behavior_hint="(optional)"),
    ] = None
    """By default beside the source, under its name; in the cache it is then taken by itself."""


@dataclass(frozen=True, kw_only=True)
class PathOfWeights(WeightsAction):
    """Print the file that `reconstruct --backbone must3r` would take; exit code 1 if there is none."""

    name: Annotated[
        tyro.conf.Positional[str | None], tyro.conf.arg(metavar="[NAME]", help_behavior_hint="(optional)")
    ] = None
    """An official name: where that file lies in the cache."""
    network_size: int = Must3rConfig.network_size
    """Of the run; up to 224 it takes another network."""


WeightsCommand = Annotated[
    Annotated[ListWeights, tyro.conf.subcommand("list")]
    | Annotated[FetchWeights, tyro.conf.subcommand("fetch")]
    | Annotated[VerifyWeights, tyro.conf.subcommand("verify")]
    | Annotated[ConvertWeights, tyro.conf.subcommand("convert")]
    | Annotated[PathOfWeights, tyro.conf.subcommand("path")],
    tyro.conf.subcommand("weights", description="List, fetch, verify, convert and find the weights of the network."),
]


def run_weights(action: WeightsAction) -> int:
    """Run one of the commands and return its exit code; errors leave as they are."""
    with reporting(quiet=action.quiet, verbose=action.verbose) as reporter:
        return _run(action, reporter)


def _run(action: WeightsAction, reporter: Reporter) -> int:
    match action:
        case FetchWeights():
            return _fetch(action, reporter)
        case VerifyWeights():
            return _verify(action)
        case ConvertWeights():
            return _convert(action, reporter)
        case PathOfWeights():
            return _path(action)
        case _:
            return _list()


def _list() -> int:
    print(f"{'official file':37}  {'what it is':14}  {'trained at':10}  {'MD5':32}  in the cache")
    for file in CATALOGUE:
        print(f"{file.name:37}  {file.kind:14}  {file.image_size:7} px  {file.md5}  {_state(file)}")
    print(f"\nThe cache is {weights_folder()}.")
    print(f"{WEIGHTS_VARIABLE} is {os.environ.get(WEIGHTS_VARIABLE) or 'not set'}.")
    print("The files have a licence of their own, non-commercial; `weights fetch` shows what it says.")
    return EXIT_GOOD


def _state(file: OfficialFile) -> str:
    """Which forms of the file are in the cache, with their sizes."""
    published = published_place(file)
    forms = (("", published), ("converted ", converted_place(file)), ("broken off at ", part_of(published)))
    found = [f"{form}{_mib(path.stat().st_size)}" for form, path in forms if path.is_file()]
    if found:
        return ", ".join(found)
    return f"no, about {_mib(NETWORK_TENSOR_BYTES)}" if file.kind == "network" else "no"


def _mib(num_bytes: int) -> str:
    return f"{num_bytes / 2**20:.1f} MiB"


def _fetch(action: FetchWeights, reporter: Reporter) -> int:
    from smust3r_colmap.backbones.weights.download import download  # noqa: PLC0415  (needed by this command only)

    file = official(action.name)
    if urlsplit(action.base_url).scheme not in ("http", "https") or not action.base_url.isascii():
        raise ConfigError(f"--base-url {action.base_url}: must begin with http:// or https:// and be plain ASCII")
    target = published_place(file)
    if target.is_file():
        decision = verify(target)
        if decision.sound:
            reporter.note(decision.text)
            print(target)
            return EXIT_GOOD
        reporter.warn(decision.text)
    print(f"{LICENCE_SUMMARY}\n", file=sys.stderr)
    if not action.accept_licence and not _consents(file):
        return fail("the licence was not accepted; nothing was fetched", EXIT_FAILED)
    download(f"{action.base_url.rstrip('/')}/{file.name}", target, md5=file.md5, reporter=reporter)
    if file.kind == "network":
        reporter.note(f"`smust3r-colmap weights convert {file.name}` makes of it a file that opens at once")
    print(target)
    return EXIT_GOOD


def _consents(file: OfficialFile) -> bool:
    """Ask the person at the terminal; anything but a whole yes is a no.

    Raises:
        ConfigError: nobody can be asked.
    """
    if not sys.stdin.isatty():
        raise ConfigError(
            f"{file.name}: no terminal to ask for consent; read the licence and give --accept-licence if you accept it"
        )
    print(f"Do you accept it and want to fetch {file.name}? Type yes or no: ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() == "yes"


def _verify(action: VerifyWeights) -> int:
    if action.file is None:
        paths = [path for path in map(published_place, CATALOGUE) if path.is_file()]
        if not paths:
            return fail(f"{weights_folder()}: has no official file; {fetch_advice(official(RECOMMENDED))}", EXIT_FAILED)
    elif Path(action.file).is_file():
        paths = [Path(action.file)]
    else:
        paths = [published_place(official(action.file))]
        if not paths[0].is_file():
            return fail(f"{paths[0]}: is not there; {fetch_advice(official(action.file))}", EXIT_FAILED)
    decisions = [verify(path) for path in paths]
    for decision in decisions:
        print(decision.text)
    return EXIT_GOOD if all(decision.sound for decision in decisions) else EXIT_FAILED


def _convert(action: ConvertWeights, reporter: Reporter) -> int:
    source, file = Path(action.source), find_official(action.source)
    if not source.is_file() and file is not None:
        source = published_place(file)
    if not source.is_file():
        raise CheckpointError(f"{source}: no such file; name a checkpoint or an official file in the cache")
    target = source.with_suffix(CONVERTED_SUFFIX) if action.target is None else action.target
    if target.suffix != CONVERTED_SUFFIX:
        raise ConfigError(f"{target}: the name of the target must end with {CONVERTED_SUFFIX}")
    if target.exists():
        raise ConfigError(f"{target}: is there already; delete it or name another target")
    from smust3r_colmap.backbones.must3r.checkpoint import convert_checkpoint  # noqa: PLC0415  (loads torch)

    reporter.note(f"converting {source}")
    convert_checkpoint(source, target)
    print(target)
    return EXIT_GOOD


def _path(action: PathOfWeights) -> int:
    if action.name is None:
        try:
            print(find_weights(None, action.network_size))
        except CheckpointError as error:  # a question that was answered, not wrong use
            return fail(str(error), EXIT_FAILED)
        return EXIT_GOOD
    file = official(action.name)
    found = find_cached(file)
    if found is None:
        return fail(f"{file.name}: is not in the cache {weights_folder()}; {fetch_advice(file)}", EXIT_FAILED)
    print(found)
    return EXIT_GOOD

"""Where fetched weights lie, and which file a reconstruction takes.

The folder is ``weights`` in what the environment variable SMUST3R_CACHE names, else in ``smust3r-colmap`` of the
user's cache as ``platformdirs`` finds it. A network may lie there as published (``NAME.pth``), as converted
(``NAME.safetensors``), or both.
"""

from __future__ import annotations

import os
from pathlib import Path

from platformdirs import user_cache_path

from smust3r_colmap.backbones.weights.catalogue import CATALOGUE, Kind, OfficialFile, find_official
from smust3r_colmap.errors import CheckpointError

CACHE_VARIABLE = "SMUST3R_CACHE"
WEIGHTS_VARIABLE = "SMUST3R_WEIGHTS"

CONVERTED_SUFFIX = ".safetensors"


def weights_folder() -> Path:
    """The folder of fetched weights; it need not exist."""
    named = os.environ.get(CACHE_VARIABLE)
    cache = Path(named).expanduser() if named else user_cache_path("smust3r-colmap", appauthor=False)
    return cache / "weights"


def published_place(file: OfficialFile) -> Path:
    """Where ``fetch`` puts the file."""
    return weights_folder() / file.name


def converted_place(file: OfficialFile) -> Path:
    """Where ``convert`` puts its form of the file."""
    return published_place(file).with_suffix(CONVERTED_SUFFIX)


def part_of(target: Path) -> Path:
    """Where an incomplete file lies."""
    return target.with_name(f"{target.name}.part")


def find_cached(file: OfficialFile) -> Path | None:
    """The file in the cache: as converted, because that opens faster, else as published."""
    places = (converted_place(file), published_place(file))
    return next((place for place in places if place.is_file()), None)


def find_weights(given: str | None, network_size: int) -> Path:
    """The network that a reconstruction takes: as given, else by SMUST3R_WEIGHTS, else from the cache.

    Args:
        given: a path, or an official name that is in the cache; None when nothing was given.
        network_size: longer side of the images in the network, in pixels; the cache gives the network
            trained at 224 for sizes up to that, and one trained at 512 for larger ones.

    Raises:
        CheckpointError: what was given is not there, or nothing was given and the cache has none; the
            message has the ways to get one.
    """
    if given is not None:
        return named_file(given, said_by="--weights", kind="network")
    from_environment = os.environ.get(WEIGHTS_VARIABLE)
    if from_environment:
        return named_file(from_environment, said_by=WEIGHTS_VARIABLE, kind="network")
    wanted = _networks_for(network_size)
    found = next((path for path in map(find_cached, wanted) if path is not None), None)
    if found is None:
        raise CheckpointError(_ways_to_weights(wanted[0], network_size))
    return found


def named_file(named: str, *, said_by: str, kind: Kind) -> Path:
    """The file at a path, or the file of an official name in the cache.

    Args:
        named: path or official name; a file of that path comes first.
        said_by: the flag or variable it came from, for messages.
        kind: what the file has to be, as far as its name tells.

    Raises:
        CheckpointError: there is no such file, or it is of another kind.
    """
    path = Path(named).expanduser()
    file = find_official(path.name)
    if file is not None and file.kind != kind:
        names = ", ".join(other.name for other in CATALOGUE if other.kind == kind)
        raise CheckpointError(f"{said_by} {named}: is a {file.kind}, needed is a {kind} such as {names}")
    if path.is_file():
        return path
    if file is None or named != file.name:
        what = "is a folder" if path.is_dir() else "no such file"
        raise CheckpointError(f"{said_by} {named}: {what}; name a checkpoint file or an official file in the cache")
    cached = find_cached(file)
    if cached is None:
        raise CheckpointError(f"{said_by} {named}: is not in the cache {weights_folder()}; {fetch_advice(file)}")
    return cached


def fetch_advice(file: OfficialFile) -> str:
    """The command that fetches the file."""
    return f"fetch it with `smust3r-colmap weights fetch {file.name}`"


def _networks_for(network_size: int) -> list[OfficialFile]:
    trained_size = 224 if network_size <= 224 else 512
    return [file for file in CATALOGUE if file.kind == "network" and file.image_size == trained_size]


def _ways_to_weights(wanted: OfficialFile, network_size: int) -> str:
    others = [file for file in CATALOGUE if file.kind == "network" and find_cached(file) is not None]
    usable = f" (`--weights {others[0].name}`, which is there, works at other sizes less well)" if others else ""
    return (
        f"no weights for --network-size {network_size} in {weights_folder()}: {fetch_advice(wanted)} "
        f"(non-commercial licence), name a checkpoint with --weights FILE{usable}, or in the environment variable "
        f"{WEIGHTS_VARIABLE}; --backbone classical needs none"
    )

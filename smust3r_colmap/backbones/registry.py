"""Backbones by name: ours, and those that other packages register as entry points.

A package adds one with an entry point in the group ``smust3r_colmap.backbones`` that names a
``BackboneFactory``; docs/backbones.md shows how. Nothing is imported before it is asked for.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, cast

from smust3r_colmap.errors import ConfigError, MissingDependencyError

if TYPE_CHECKING:  # so that the names can be listed where numpy or pycolmap are broken
    from smust3r_colmap.backbones.base import Backbone, BackboneContext, BackboneFactory

ENTRY_POINT_GROUP = "smust3r_colmap.backbones"
OUR_PACKAGE = "smust3r-colmap"

BUILT_IN: Mapping[str, str] = {
    "classical": "smust3r_colmap.backbones.classical.backbone:make_classical",
    "must3r": "smust3r_colmap.backbones.must3r.backbone:make_must3r",
    "vggt": "smust3r_colmap.backbones.vggt:make_vggt",
}
"""Module and function of each factory of this package."""

_BROKEN_MODULE = (OSError, SyntaxError, NameError, AttributeError, TypeError, ValueError, RuntimeError)
"""What somebody else's module has been seen to raise while it is imported, besides ImportError."""


@dataclass(frozen=True, kw_only=True)
class KnownBackbone:
    """A backbone that can be asked for, which does not mean that it works.

    Args:
        name: after ``--backbone``.
        package: that brings it.
        target: ``module:attribute`` of its factory.
    """

    name: str
    package: str
    target: str


def list_backbones() -> tuple[KnownBackbone, ...]:
    """Ours, then those of other packages by name; a name that is claimed twice stands there twice."""
    ours = [KnownBackbone(name=name, package=OUR_PACKAGE, target=target) for name, target in BUILT_IN.items()]
    theirs = [
        KnownBackbone(name=entry.name, package=entry.dist.name if entry.dist else "unknown", target=entry.value)
        for entry in entry_points(group=ENTRY_POINT_GROUP)
    ]
    return (*ours, *sorted(theirs, key=lambda one: (one.name, one.package, one.target)))


def make_backbone(context: BackboneContext) -> Backbone:
    """The backbone that the configuration names.

    Args:
        context: of the run.

    Raises:
        ConfigError: the name is not known or claimed twice, its package is broken, or an option is not known.
        MissingDependencyError: a package that it needs is not installed.
        CheckpointError: its weights cannot be used.
    """
    known = find_backbone(context.config.backbone)
    factory = _imported(known)
    options = _WatchedOptions(context.options)
    made = factory(replace(context, options=options))
    _refuse_unread(options, known)
    _refuse_incomplete(made, known)
    return made


def find_backbone(name: str) -> KnownBackbone:
    """Who brings the backbone of this name.

    Raises:
        ConfigError: nobody does, or more than one package.
    """
    known = list_backbones()
    claims = [one for one in known if one.name == name]
    if not claims:
        names = sorted({one.name for one in known})
        near = difflib.get_close_matches(name, names)
        meant = f" (did you mean {' or '.join(near)}?)" if near else ""
        raise ConfigError(f"--backbone {name}: there is none of this name{meant}; known are {', '.join(names)}")
    if len(claims) > 1:
        claimants = " and ".join(f"{one.package} ({one.target})" for one in claims)
        raise ConfigError(f"--backbone {name}: is claimed by {claimants}; uninstall one of the packages")
    return claims[0]


def load_factory(name: str) -> BackboneFactory:
    """Import the factory of a backbone, and nothing more.

    Raises:
        ConfigError: as ``find_backbone``, or what was registered is no factory.
        MissingDependencyError: its module, or one that it imports, is not installed.
    """
    return _imported(find_backbone(name))


def read_options(text: str) -> dict[str, str]:
    """``"a=b,c=d"`` as ``{"a": "b", "c": "d"}``; a value may hold ``=``, but no comma.

    Raises:
        ConfigError: a part has no name or no ``=``, or a name comes twice.
    """
    options: dict[str, str] = {}
    for part in (part.strip() for part in text.split(",") if part.strip()):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or not name:
            raise ConfigError(f"--backbone-options: {part!r} is not name=value (a value cannot hold a comma)")
        if name in options:
            raise ConfigError(f"--backbone-options: {name} is given twice, as {options[name]!r} and {value!r}")
        options[name] = value
    return options


def _imported(known: KnownBackbone) -> BackboneFactory:
    module, _, attribute = known.target.partition(":")
    where = f"backbone {known.name} of the package {known.package} ({known.target})"
    try:
        found: object = import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    except ImportError as error:
        raise MissingDependencyError(f"{where} cannot be imported: {error}; install what is missing") from error
    except _BROKEN_MODULE as error:
        raise ConfigError(f"{where} is broken: {type(error).__name__}: {error}; tell its authors") from error
    if not callable(found):
        raise ConfigError(f"{where}: is a {type(found).__name__}, needed a function or class that takes the context")
    return cast("BackboneFactory", found)


# ------------------------------------------------------------------------------ what a factory did
class _WatchedOptions(Mapping[str, str]):
    """Options that remember which names were asked for, so that a misspelt one does not pass in silence."""

    def __init__(self, options: Mapping[str, str]) -> None:
        self._options = options
        self.asked: set[str] = set()

    def __getitem__(self, name: str) -> str:
        self.asked.add(name)
        return self._options[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._options)

    def __len__(self) -> int:
        return len(self._options)


def _refuse_unread(options: _WatchedOptions, known: KnownBackbone) -> None:
    unread = sorted(set(options) - options.asked)
    if unread:
        takes = f"knows {', '.join(sorted(options.asked))}" if options.asked else "takes no options"
        raise ConfigError(f"--backbone-options {', '.join(unread)}: the backbone {known.name} {takes}")


def _refuse_incomplete(made: object, known: KnownBackbone) -> None:
    wanted: Mapping[str, Callable[[object], bool]] = {
        "name": lambda value: isinstance(value, str),
        "metric": lambda value: isinstance(value, bool),
        "has_tracks": lambda value: isinstance(value, bool),
        "describe": callable,
        "reconstruct": callable,
    }
    lacking = [name for name, is_right in wanted.items() if not is_right(getattr(made, name, None))]
    if lacking:
        raise ConfigError(
            f"backbone {known.name} of the package {known.package}: its factory gave a {type(made).__name__} "
            f"without {', '.join(lacking)}; see docs/backbones.md"
        )

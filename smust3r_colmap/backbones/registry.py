"""Backbones by name: ours, and those that other packages register as entry points.

A package adds one with an entry point in the group ``smust3r_colmap.backbones`` that names a ``BackbonePlugin``;
docs/backbones.md shows how. Nothing is imported before it is asked for. The next module to read is ``feed_forward``.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any

from smust3r_colmap.backbones.options import parse_options
from smust3r_colmap.errors import ConfigError, MissingDependencyError

if TYPE_CHECKING:  # so that the names can be listed where numpy or pycolmap are broken
    from smust3r_colmap.backbones.base import Backbone, BackboneContext, BackbonePlugin

ENTRY_POINT_GROUP = "smust3r_colmap.backbones"
OUR_PACKAGE = "smust3r-colmap"

BUILT_IN: Mapping[str, str] = {
    "classical": "smust3r_colmap.backbones.classical.backbone:CLASSICAL",
    "must3r": "smust3r_colmap.backbones.must3r.backbone:MUST3R",
    "vggt": "smust3r_colmap.backbones.vggt:VGGT",
}
"""Module and plug-in of each backbone of this package."""

_BROKEN_MODULE = (OSError, SyntaxError, NameError, AttributeError, TypeError, ValueError, RuntimeError)
"""What a foreign module may raise on import besides ImportError."""


@dataclass(frozen=True, kw_only=True)
class KnownBackbone:
    """A registered backbone; it may not work.

    Args:
        name: after ``--backbone``.
        package: that registers it.
        target: ``module:attribute`` of its ``BackbonePlugin``.
    """

    name: str
    package: str
    target: str


def list_backbones() -> tuple[KnownBackbone, ...]:
    """Ours, then those of other packages by name; a name that two packages register is listed twice."""
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
        ConfigError: the name is unknown or registered twice, its package is broken, or an option makes no sense.
        MissingDependencyError: a package that it needs is not installed.
        CheckpointError: its weights cannot be used.
    """
    known = find_backbone(context.config.backbone)
    plugin = load_plugin(known)
    made = plugin.make(context, parse_options(context.config.backbone_options or "", plugin.options, known.name))
    _refuse_incomplete(made, known)
    return made


def find_backbone(name: str) -> KnownBackbone:
    """The backbone of this name.

    Raises:
        ConfigError: no package registers it, or more than one.
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


def load_plugin(known: KnownBackbone) -> BackbonePlugin[Any]:
    """Import a backbone, and nothing more.

    Raises:
        ConfigError: its module is broken, or what was registered is no ``BackbonePlugin``.
        MissingDependencyError: its module, or one that it imports, is not installed.
    """
    from smust3r_colmap.backbones.base import BackbonePlugin  # noqa: PLC0415  (needs numpy)

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
    if not isinstance(found, BackbonePlugin):
        raise ConfigError(f"{where}: is a {type(found).__name__}, needed a BackbonePlugin; see docs/backbones.md")
    return found


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
            f"backbone {known.name} of the package {known.package}: made a {type(made).__name__} "
            f"without {', '.join(lacking)}; see docs/backbones.md"
        )

"""What this machine has and what of the program works on it, for ``smust3r-colmap doctor``.

Every package is imported in a child process of its own with a time limit, because a broken native
library may abort the process that loads it and some packages are heavy. Nothing is installed,
changed or fetched.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Annotated, Any

import tyro

from smust3r_colmap import __version__
from smust3r_colmap.backbones.registry import OUR_PACKAGE, KnownBackbone, list_backbones
from smust3r_colmap.cli.console import EXIT_FAILED
from smust3r_colmap.errors import advice_for
from smust3r_colmap.execution.task_pool import usable_cores
from smust3r_colmap.report.summary import EXIT_GOOD

_IMPORT_TIMEOUT_S = 120.0

# Name of the distribution, and what a child process runs: it imports the package and prints one
# line for each accelerator that the package can use.
_PACKAGES = (
    ("numpy", "import numpy"),
    ("scipy", "import scipy"),
    ("pycolmap", "import pycolmap\nif pycolmap.has_cuda: print('CUDA')"),
    ("torch", "import torch\nfor k in range(torch.cuda.device_count()): print(torch.cuda.get_device_name(k))"),
    ("opencv-python-headless", "import cv2"),
    ("pillow", "import PIL"),
    ("trimesh", "import trimesh"),
    ("av", "import av"),
    ("pyproj", "import pyproj"),
    ("open3d", "import open3d\nif open3d.core.cuda.is_available(): print('CUDA')"),
)

# They may be broken and a reconstruction still works: av is for video only, open3d for meshes, torch for networks,
# pyproj to georeference.
_NOT_NEEDED = frozenset({"av", "open3d", "pyproj", "torch"})

_PARTS = (
    ("importer", "image folder", "smust3r_colmap.importers.image_folder"),
    ("importer", "video", "smust3r_colmap.importers.video_frames"),
    ("importer", "COLMAP model", "smust3r_colmap.importers.colmap_model"),
    ("exporter", "COLMAP model", "smust3r_colmap.exporters.colmap_sparse"),
    ("exporter", "COLMAP database", "smust3r_colmap.colmap.database"),
    ("exporter", "dense workspace", "smust3r_colmap.exporters.dense_workspace"),
    ("exporter", "training dataset", "smust3r_colmap.exporters.training_dataset"),
    ("exporter", "PLY cloud", "smust3r_colmap.exporters.ply"),
    ("exporter", "GLB scene", "smust3r_colmap.exporters.glb"),
    ("exporter", "TUM trajectory", "smust3r_colmap.exporters.tum_trajectory"),
    ("exporter", "georeference", "smust3r_colmap.exporters.geo_files"),
)

# What a child process runs to import a backbone, and what it runs besides where more is worth knowing.
_IMPORT_BACKBONE = """
from smust3r_colmap.backbones.registry import find_backbone, load_plugin
load_plugin(find_backbone({name!r}))
"""
_MORE_OF_BACKBONE = {
    "must3r": """
from smust3r_colmap.backbones.must3r.precision import describe_precision
from smust3r_colmap.config import Must3rConfig
from smust3r_colmap.errors import CheckpointError
from smust3r_colmap.backbones.weights.cache import find_weights
for line in describe_precision():
    print(line)
try:
    print(f"weights: {find_weights(None, Must3rConfig().network_size)}")
except CheckpointError as error:
    print(error)
""",
    "vggt": "from smust3r_colmap.backbones.vggt import import_vggt\nimport_vggt()\n",
}

# The backbone that works without anything else; the others may be broken.
_NEEDED_BACKBONE = "classical"


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Say what this machine has, what works on it and what is missing."""

    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print JSON."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print the traceback of an unexpected error."""


def run_doctor(command: Doctor) -> int:
    """Examine the machine, print what was found; the exit code."""
    diagnosis = examine()
    print(json.dumps(diagnosis.to_json_dict(), indent=1) if command.json else diagnosis.render_text())
    return EXIT_GOOD if diagnosis.healthy else EXIT_FAILED


@dataclass(frozen=True, kw_only=True)
class Check:
    """Whether one thing works here.

    Args:
        kind: ``"package"``, ``"backbone"``, ``"importer"`` or ``"exporter"``.
        name: for people.
        version: of a package; empty for a part of this program, or when it is not installed.
        works: it can be imported.
        needed: the program cannot do its work without it.
        devices: accelerators that it can use.
        notes: what else is worth knowing, such as whether a network has its weights.
        advice: why it does not work and what to do; empty when it works.
    """

    kind: str
    name: str
    version: str
    works: bool
    needed: bool
    devices: tuple[str, ...]
    notes: tuple[str, ...]
    advice: str


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """Everything that ``doctor`` says.

    Args:
        program, python, system: versions.
        cores: processor cores that this process may use.
        memory_bytes: of the machine; 0 where the system does not say.
        checks: packages first, then the parts of the program.
    """

    program: str
    python: str
    system: str
    cores: int
    memory_bytes: int
    checks: tuple[Check, ...]

    @property
    def healthy(self) -> bool:
        """Everything that is needed works."""
        return all(check.works for check in self.checks if check.needed)

    def to_json_dict(self) -> dict[str, Any]:
        """All facts, for ``--json``."""
        return {**asdict(self), "healthy": self.healthy}

    def render_text(self) -> str:
        """Several lines for people, ending without a line break."""
        memory = f"{self.memory_bytes / 2**30:.1f} GiB of memory" if self.memory_bytes else "memory unknown"
        lines = [
            f"smust3r-colmap {self.program}, Python {self.python}, {self.system}",
            f"{self.cores} processor cores usable, {memory}",
            f"accelerators: {self._accelerators()}",
            *(_check_line(check) for check in self.checks),
            "Everything needed works." if self.healthy else "Something needed does not work, see above.",
        ]
        return "\n".join(lines)

    def _accelerators(self) -> str:
        found = [f"{device} ({check.name})" for check in self.checks for device in check.devices]
        return ", ".join(found) if found else "none; the processor does all the work"


def examine() -> Diagnosis:
    """Import everything once, each in a child process, and say what works."""
    # Two at a time: the children mostly wait for the disk, and heavy packages take much memory.
    with ThreadPoolExecutor(max_workers=2) as pool:
        checks = [
            *pool.map(_check_package, *zip(*_PACKAGES, strict=True)),
            *pool.map(_check_backbone, list_backbones()),
            *pool.map(_check_part, *zip(*_PARTS, strict=True)),
        ]
    return Diagnosis(
        program=__version__,
        python=platform.python_version(),
        system=platform.platform(terse=True),
        cores=usable_cores(),
        memory_bytes=_memory_bytes(),
        checks=tuple(checks),
    )


def _check_package(distribution: str, program: str) -> Check:
    devices, advice = _run_child(program)
    return Check(
        kind="package",
        name=distribution,
        version=_version(distribution),
        works=not advice,
        needed=distribution not in _NOT_NEEDED,
        devices=devices,
        notes=(),
        advice=advice,
    )


def _check_backbone(known: KnownBackbone) -> Check:
    is_ours = known.package == OUR_PACKAGE
    program = _IMPORT_BACKBONE.format(name=known.name) + (_MORE_OF_BACKBONE.get(known.name, "") if is_ours else "")
    notes, advice = _run_child(program)
    return Check(
        kind="backbone",
        name=known.name if is_ours else f"{known.name} (of {known.package})",
        version="" if is_ours else _version(known.package),
        works=not advice,
        needed=is_ours and known.name == _NEEDED_BACKBONE,
        devices=(),
        notes=notes,
        advice=advice,
    )


def _check_part(kind: str, name: str, module: str) -> Check:
    _, advice = _run_child(f"import {module}")
    return Check(kind=kind, name=name, version="", works=not advice, needed=True, devices=(), notes=(), advice=advice)


def _run_child(program: str) -> tuple[tuple[str, ...], str]:
    """The lines that the program prints, and what is wrong with it (empty when it ends well)."""
    try:
        child = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=_IMPORT_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return (), f"importing it took longer than {_IMPORT_TIMEOUT_S:.0f} s"
    if child.returncode < 0:
        return (), f"importing it kills the process (signal {-child.returncode}); install it again"
    if child.returncode > 0:
        return (), advice_for(child.stderr)
    return tuple(child.stdout.splitlines()), ""


def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def _memory_bytes() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):  # Windows has no sysconf
        return 0


def _check_line(check: Check) -> str:
    state = "works" if check.works else ("BROKEN" if check.needed else "not usable, not needed")
    advice = f": {check.advice}" if check.advice else ""
    line = f"  {check.kind:8}  {f'{check.name} {check.version}'.strip():32}  {state}{advice}"
    return "\n".join([line, *(f"{'':12}{note}" for note in check.notes)])

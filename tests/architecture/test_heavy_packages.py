"""torch and open3d are loaded by what needs them only: they cost seconds, and system libraries of open3d may lack."""

from __future__ import annotations

import subprocess
import sys

import pytest
from show_structure import PACKAGE, modules

WITH_TORCH = tuple(f"{PACKAGE}.{name}" for name in ("backbones.must3r", "backbones.vggt", "synthetic.must3r_weights"))
"""Modules that may import torch."""

PROGRAM = """
import importlib, sys
for name in sys.argv[1:]:
    importlib.import_module(name)
print("LOADED", sorted({"torch", "open3d"} & set(sys.modules)))
"""


@pytest.mark.slow
def test_no_module_but_the_networks_imports_torch_or_open3d() -> None:
    names = [name for name in sorted(modules()) if not name.startswith(WITH_TORCH) and not name.endswith("__main__")]
    child = subprocess.run([sys.executable, "-c", PROGRAM, *names], capture_output=True, text=True, check=True)

    assert {f"{PACKAGE}.pipeline", f"{PACKAGE}.exporters.mesh", f"{PACKAGE}.backbones.classical.backbone"} <= set(names)
    assert child.stdout.splitlines()[-1] == "LOADED []"

"""What is installed is what lies in the tree."""

import configparser
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import smust3r_colmap

ROOT = Path(__file__).resolve().parents[2]
LINKED = ("exporters", "importers")


@pytest.fixture(scope="module")
def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if line.strip()]


def _folders_with_init(top: Path, name: str) -> set[str]:
    return {".".join((name, *path.parent.relative_to(top).parts)) for path in top.rglob("__init__.py")}


def test_packages_are_the_folders_with_an_init(setup_cfg: configparser.ConfigParser) -> None:
    packages = _lines(setup_cfg["options"]["packages"])
    in_tree = {
        name
        for name in _folders_with_init(ROOT / "smust3r_colmap", "smust3r_colmap")
        if name.split(".")[1:2] not in ([linked] for linked in LINKED)
    }
    for linked in LINKED:
        in_tree |= _folders_with_init(ROOT / linked, f"smust3r_colmap.{linked}")

    assert sorted(packages) == sorted(in_tree)


def test_every_python_file_lies_in_a_package() -> None:
    tops = [ROOT / "smust3r_colmap", *(ROOT / linked for linked in LINKED)]
    stray = [path for top in tops for path in top.rglob("*.py") if not (path.parent / "__init__.py").is_file()]

    assert stray == []


@pytest.mark.parametrize("name", LINKED)
def test_linked_folders_are_mapped_and_linked_relatively(setup_cfg: configparser.ConfigParser, name: str) -> None:
    assert os.readlink(ROOT / "smust3r_colmap" / name) == f"../{name}"
    assert f"smust3r_colmap.{name} = {name}" in _lines(setup_cfg["options"]["package_dir"])


def test_version_is_that_of_the_package(setup_cfg: configparser.ConfigParser) -> None:
    assert setup_cfg["metadata"]["version"] == "attr: smust3r_colmap.__version__"
    assert re.fullmatch(r"\d+\.\d+\.\d+", smust3r_colmap.__version__)
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## [{smust3r_colmap.__version__}]" in changes


def test_every_requirement_is_pinned(setup_cfg: configparser.ConfigParser) -> None:
    wanted = _lines(setup_cfg["options"]["install_requires"]) + _lines(setup_cfg["options.extras_require"]["dev"])
    names = {re.split(r"[<>=; ]", line)[0] for line in wanted}
    pins = {
        line.split("==")[0]
        for line in _lines((ROOT / "constraints.txt").read_text(encoding="utf-8"))
        if not line.startswith("#")
    }

    assert len(names) > 10
    assert names <= pins


def test_pins_are_exact_and_name_no_place() -> None:
    lines = _lines((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    pin = re.compile(r'[a-z0-9-]+==[0-9][0-9a-z.]*(; python_version (<|>=) "3\.11")?')

    assert [line for line in lines if not line.startswith("#") and not pin.fullmatch(line)] == []


@pytest.mark.slow
def test_help_loads_no_heavy_package() -> None:
    program = """
import contextlib, sys
from smust3r_colmap.cli.main import main
with contextlib.suppress(SystemExit):
    main(["reconstruct", "--help"])
heavy = {"torch", "open3d", "pycolmap", "cv2", "numpy", "scipy", "trimesh"}
print("LOADED", sorted(heavy & set(sys.modules)))
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert "--segment-length" in child.stdout
    assert child.stdout.splitlines()[-1] == "LOADED []"


@pytest.mark.slow
def test_a_reconstruction_loads_neither_torch_nor_open3d() -> None:
    program = """
import sys
import smust3r_colmap.cli.main, smust3r_colmap.pipeline
print(sorted({"torch", "open3d"} & set(sys.modules)))
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)

    assert child.stdout.strip() == "[]"


def test_open3d_is_imported_where_a_mesh_is_made_and_nowhere_else() -> None:
    importing = re.compile(r"^\s*(import|from) open3d\b|import_module\(\"open3d\"\)", re.MULTILINE)
    files = [path for top in ("smust3r_colmap", *LINKED) for path in (ROOT / top).rglob("*.py")]

    assert len(files) > 10
    assert [path.name for path in files if importing.search(path.read_text(encoding="utf-8"))] == ["mesh.py"]


@pytest.mark.parametrize("name", ["scripts/quickstart", "scripts/test", "scripts/colmap_shim", ".ci/run"])
def test_scripts_can_be_started_and_parse(name: str) -> None:
    assert os.access(ROOT / name, os.X_OK)
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)


def test_quickstart_refuses_a_python_that_cannot_work() -> None:
    environment = {**os.environ, "PYTHON": "false"}
    program = f'. "{ROOT}/scripts/bootstrap"; find_python'
    child = subprocess.run(["bash", "-c", program], env=environment, capture_output=True, text=True, check=False)

    assert child.returncode == 1
    assert "PYTHON=false is not a Python 3.10 to 3.14" in child.stderr

"""Backbones by name: what is refused and how, and the page that shows how to add one."""

from __future__ import annotations

import re
import subprocess
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import pytest
from helpers.room_network import RoomNetwork, context_of, install_package

from smust3r_colmap.backbones import registry
from smust3r_colmap.backbones.base import BackboneContext
from smust3r_colmap.backbones.classical.backbone import ClassicalBackbone
from smust3r_colmap.backbones.options import NoOptions, parse_options
from smust3r_colmap.backbones.registry import (
    BUILT_IN,
    find_backbone,
    list_backbones,
    load_plugin,
    make_backbone,
)
from smust3r_colmap.config import OutputConfig, RunConfig, SegmentationConfig
from smust3r_colmap.errors import CheckpointError, ConfigError, MissingDependencyError
from smust3r_colmap.evaluation.trajectory import compare_trajectories
from smust3r_colmap.execution.progress import QuietReporter
from smust3r_colmap.importers.model_poses import read_model_poses
from smust3r_colmap.importers.poses_txt import read_poses_txt
from smust3r_colmap.pipeline import reconstruct
from smust3r_colmap.products import ImageCollection
from smust3r_colmap.storage.run_directory import RunDirectory
from smust3r_colmap.synthetic.room import write_demo

PAGE = Path(__file__).resolve().parents[2] / "docs/backbones.md"
EMPTY = ImageCollection(images=(), cameras=())

Install = Callable[..., None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """``install("my-package", code, name="module:attribute")`` puts a package with entry points on the path."""

    def installed(package: str, code: str, **backbones: str) -> None:
        folder = tmp_path / "site" / package
        lines = [f"{name} = {target}" for name, target in backbones.items()]
        install_package(folder, package, "\n".join(["[smust3r_colmap.backbones]", *lines, ""]))
        module = package.replace("-", "_")
        (folder / f"{module}.py").write_text(code, encoding="utf-8")
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.delitem(sys.modules, module, raising=False)

    return installed


@pytest.fixture
def context(tmp_path: Path) -> BackboneContext:
    return context_of(EMPTY, RunDirectory(tmp_path / "run"))


def with_backbone(context: BackboneContext, name: str, options: str = "") -> BackboneContext:
    return replace(context, config=RunConfig(backbone=name, backbone_options=options))


# ---------------------------------------------------------------------------------- names
def test_ours_are_listed_first_and_classical_is_made(context: BackboneContext) -> None:
    assert [one.name for one in list_backbones()][: len(BUILT_IN)] == ["classical", "must3r", "vggt"]
    made = make_backbone(context)
    assert isinstance(made, ClassicalBackbone)
    assert (made.run, made.has_tracks) == (context.run, True)


def test_an_installed_backbone_is_found_by_its_name(install: Install, context: BackboneContext) -> None:
    install("other-net", WORKING, othernet="other_net:make")
    known = find_backbone("othernet")
    assert (known.package, known.target) == ("other-net", "other_net:make")
    assert known in list_backbones()
    made = make_backbone(with_backbone(context, "othernet", "size=7"))
    assert made.name == "othernet 7"


def test_a_name_of_nobody_is_refused_with_those_that_are_near(install: Install) -> None:
    with pytest.raises(ConfigError, match=r"must4r.*did you mean must3r\?\); known are classical, must3r, vggt"):
        find_backbone("must4r")
    install("other-net", WORKING, othernet="other_net:make")
    with pytest.raises(ConfigError, match=r"zzz: there is none of this name; known are classical, must3r, othernet"):
        find_backbone("zzz")


def test_a_name_of_ours_cannot_be_taken_over(install: Install, context: BackboneContext) -> None:
    install("other-net", WORKING, classical="other_net:make")
    with pytest.raises(ConfigError, match=r"classical: is claimed by smust3r-colmap \(.*\) and other-net \(other_net"):
        make_backbone(context)


def test_two_packages_cannot_share_a_name_and_others_still_work(install: Install, context: BackboneContext) -> None:
    install("one-net", WORKING, thenet="one_net:make", mine="one_net:make")
    install("two-net", WORKING, thenet="two_net:make")
    with pytest.raises(ConfigError, match=r"thenet: is claimed by one-net \(.*\) and two-net \(.*\); uninstall one"):
        find_backbone("thenet")
    assert make_backbone(with_backbone(context, "mine", "size=1")).name == "othernet 1"


def test_a_package_that_lies_twice_on_the_path_is_one(install: Install, tmp_path: Path) -> None:
    install("other-net", WORKING, othernet="other_net:make")
    install_package(tmp_path / "again", "other-net", "[smust3r_colmap.backbones]\nothernet = other_net:make\n")
    sys.path.insert(0, str(tmp_path / "again"))
    try:
        assert find_backbone("othernet").package == "other-net"
    finally:
        sys.path.remove(str(tmp_path / "again"))


# ---------------------------------------------------------------------------------- broken packages
WORKING = """
from dataclasses import dataclass
from smust3r_colmap.backbones.base import BackbonePlugin

@dataclass(frozen=True)
class Options:
    size: int = 3

class Made:
    metric = has_tracks = False
    def describe(self): ...
    def reconstruct(self, segments, view_graph, *, with_maps): ...

def make_other(context, options):
    made = Made()
    made.name = f"othernet {options.size}"
    return made

make = BackbonePlugin(make=make_other, options=Options)
"""


@pytest.mark.parametrize(
    ("code", "target", "error", "message"),
    [
        ("import no_such_module", "make", MissingDependencyError, "of the package other-net.*no_such_module'; install"),
        ("1 / 0 +", "make", ConfigError, "of the package other-net.*is broken: SyntaxError"),
        ("raise RuntimeError('no card')", "make", ConfigError, "other-net.*is broken: RuntimeError: no card"),
        (WORKING, "makes", ConfigError, "other-net.*is broken: AttributeError: .*makes"),
        ("make = 'text'", "make", ConfigError, "is a str, needed a BackbonePlugin; see docs/backbones.md"),
        (WORKING, "make_other", ConfigError, "is a function, needed a BackbonePlugin"),
        (
            WORKING.replace("return made", "return 3"),
            "make",
            ConfigError,
            "made a int without name, metric, has_tracks, describe",
        ),
        (WORKING.replace("has_tracks = ", ""), "make", ConfigError, "a Made without has_tracks; see docs/backbones.md"),
        (WORKING + "Made.reconstruct = 3", "make", ConfigError, "without reconstruct"),
    ],
)
def test_a_broken_package_is_named_with_the_cause(
    install: Install, context: BackboneContext, code: str, target: str, error: type[Exception], message: str
) -> None:
    install("other-net", code, othernet=f"other_net:{target}")
    with pytest.raises(error, match=message):
        make_backbone(with_backbone(context, "othernet"))


def test_nothing_of_an_installed_package_is_imported_before_it_is_asked_for(
    install: Install, context: BackboneContext
) -> None:
    install("other-net", "raise RuntimeError('imported')", othernet="other_net:make")
    assert make_backbone(context).name == "classical"
    assert "other_net" not in sys.modules


def test_the_list_needs_no_heavy_package() -> None:
    program = """
import sys
from smust3r_colmap.backbones.registry import list_backbones
list_backbones()
print(sorted({"torch", "pycolmap", "numpy"} & set(sys.modules)))
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "[]"


@pytest.mark.slow
def test_a_classical_backbone_needs_no_torch() -> None:
    program = """
import sys
from smust3r_colmap.backbones.registry import find_backbone, load_plugin
load_plugin(find_backbone("classical"))
print("torch" in sys.modules)
"""
    child = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert child.stdout.strip() == "False"


# ---------------------------------------------------------------------------------- options
@dataclass(frozen=True, kw_only=True)
class EveryKind:
    weights: Path
    a: str = ""
    size: int = 3
    threshold: float = 0.5
    fast: bool = False
    device: Literal["cpu", "cuda"] = "cpu"
    head: Path | None = None


def test_options_become_values_of_the_types_of_their_fields() -> None:
    assert parse_options("weights=w", EveryKind, "net") == EveryKind(weights=Path("w"))
    text = "weights=/x=y, a = b,size=7,threshold=1e-3,fast=true,device=cuda,head=h.pth"
    expected = EveryKind(
        weights=Path("/x=y"), a="b", size=7, threshold=1e-3, fast=True, device="cuda", head=Path("h.pth")
    )
    assert parse_options(text, EveryKind, "net") == expected
    assert parse_options("weights=w,a=", EveryKind, "net").a == ""
    assert parse_options("", NoOptions, "net") == parse_options(" , ", NoOptions, "net") == NoOptions()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("weights", "'weights' is not name=value"),
        ("a=1,=2", "'=2' is not name=value"),
        ("files=a.pth,b.pth", r"'b.pth' is not name=value \(a value cannot hold a comma\)"),
        ("a=1,b=2,a=3", "a is given twice, as '1' and '3'"),
        ("a=1", "--backbone net: needs --backbone-options weights=..."),
        ("weights=w,size=7.5", "size=7.5: needed a whole number"),
        ("weights=w,threshold=high", "threshold=high: needed a number"),
        ("weights=w,fast=yes", "fast=yes: needed true or false"),
        ("weights=w,device=tpu", "device=tpu: needed one of cpu, cuda"),
        ("weights=w,z=1,sise=2", "sise, z: the backbone net knows a, device, fast, head, size, threshold, weights"),
    ],
)
def test_options_that_make_no_sense_are_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_options(text, EveryKind, "net")


def test_options_that_a_backbone_does_not_have_are_refused(install: Install, context: BackboneContext) -> None:
    with pytest.raises(ConfigError, match="--backbone-options seed: the backbone classical takes no options"):
        make_backbone(with_backbone(context, "classical", "seed=1"))
    install("other-net", WORKING, othernet="other_net:make")
    with pytest.raises(ConfigError, match="--backbone-options sise, z: the backbone othernet knows size"):
        make_backbone(with_backbone(context, "othernet", "sise=1,size=1,z=2"))


# ---------------------------------------------------------------------------------- the page
def block_of_page(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found, f"docs/backbones.md has no block in {language}"
    return found[1]


@pytest.fixture
def mynet(install: Install, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The adapter of the page, installed as the page says, with a network that knows the room. Gives the weights."""
    entry = re.search(r'^(\w+) = "(.+)"$', block_of_page("toml"), re.MULTILINE)
    assert entry
    install("mynet-smust3r", block_of_page("python"), **{entry[1]: entry[2]})
    network: Any = types.ModuleType("mynet")
    network.load = lambda weights: RoomNetwork(NUM_IMAGES, unit_m=0.4)
    monkeypatch.setitem(sys.modules, "mynet", network)
    weights = tmp_path / "mynet.pth"
    weights.write_bytes(b"weights")
    return weights


NUM_IMAGES = 16


@pytest.mark.slow
def test_the_example_of_the_page_reconstructs_the_demo(mynet: Path, tmp_path: Path) -> None:
    write_demo(tmp_path / "room", num_images=NUM_IMAGES, width=160, height=120)
    config = RunConfig(
        backbone="mynet",
        backbone_options=f"weights={mynet}",
        segmentation=SegmentationConfig(segment_length=8, overlap=4),
        output=OutputConfig(trainer=False, dense=False, report=False),
    )
    summary = reconstruct(tmp_path / "room" / "images", tmp_path / "out", config, reporter=QuietReporter(sys.stderr))

    assert summary.exit_code == 0, summary.weak_reasons
    assert summary.num_registered == NUM_IMAGES
    assert not summary.metric
    found = compare_trajectories(
        read_model_poses(tmp_path / "out" / "sparse" / "0"), read_poses_txt(tmp_path / "room" / "poses.txt")
    )
    # The plug-in is exact; adjusting to features of images of 160 x 120 pixels costs it a little.
    assert found.position_rmse_percent < 0.15


def test_the_example_of_the_page_fits_a_screen_or_two() -> None:
    assert 50 <= len(block_of_page("python").splitlines()) <= 80


def test_the_example_of_the_page_refuses_well(
    mynet: Path, monkeypatch: pytest.MonkeyPatch, context: BackboneContext
) -> None:
    with pytest.raises(ConfigError, match="--backbone-options weigths: the backbone mynet knows weights"):
        make_backbone(with_backbone(context, "mynet", f"weigths=x,weights={mynet}"))
    with pytest.raises(CheckpointError, match=r"gone.pth: cannot be read: No such file"):
        make_backbone(with_backbone(context, "mynet", "weights=gone.pth"))
    monkeypatch.setitem(sys.modules, "mynet", None)
    made: Any = make_backbone(with_backbone(context, "mynet", f"weights={mynet}"))
    with pytest.raises(MissingDependencyError, match="pip install mynet"):
        _ = made.predictor.model


def test_every_backbone_of_the_page_exists() -> None:
    table = re.findall(r"^\| `(\w+)` ", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert table == list(BUILT_IN)
    assert registry.ENTRY_POINT_GROUP in block_of_page("toml")
    assert callable(load_plugin(find_backbone("vggt")).make)

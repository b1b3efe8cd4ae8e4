"""README.md and docs/: commands parse and the cheap ones run, flags and links exist, generated parts are up to date."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import write_options_page
from helpers.finished_runs import Example
from helpers.summaries import GOOD
from PIL import Image

from smust3r_colmap.cli.main import main, parse
from smust3r_colmap.config import RunConfig
from smust3r_colmap.storage.config_file import read_settings

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *(ROOT / "docs").glob("**/*.md")])
MAX_README_LINES = 150
MAX_PICTURE_BYTES = 200_000

FLAGS_OF_OTHERS = {
    "--data",  # ns-train
    "--data-dir",  # gsplat
    "--data-factor",
}
SHELL_WORDS = {"pip", "python", "colmap", "mkdir"}
"""Commands of other programs that pages show; those of COLMAP are run as Python beside them."""

RUN_HERE = ("export", "validate", "evaluate", "weights list")
"""How commands begin that take a second; `doctor` has tests of its own, the others take minutes, or weights."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def shell_lines(page: Path) -> Iterator[str]:
    """The commands in the shell blocks of a page, without comments; of sessions, the lines after a dollar."""
    for language, block in re.findall(r"^ *```(sh|console)\n(.*?)^ *```$", text_of(page), re.M | re.S):
        for line in block.replace("\\\n", " ").splitlines():
            command = line.strip()
            if language == "sh" or command.startswith("$ "):
                words = shlex.split(command.removeprefix("$ "), comments=True)
                if words:
                    yield shlex.join(words)


def our_commands(page: Path) -> Iterator[list[str]]:
    """The words after ``smust3r-colmap``, in blocks and within sentences and tables."""
    inline = [one for one in re.findall(r"`([^`\n]+)`", text_of(page)) if re.match(r"smust3r-colmap [a-z]+ \S", one)]
    for line in [*shell_lines(page), *inline]:
        program, *words = shlex.split(line)
        if program == "smust3r-colmap" and "COMMAND" not in words:
            yield words


# ------------------------------------------------------------------------------ commands
COMMANDS = sorted({(name_of(page), shlex.join(words)) for page in PAGES for words in our_commands(page)})


@pytest.mark.parametrize(("page", "command"), COMMANDS)
def test_every_command_parses(page: str, command: str) -> None:
    parse(shlex.split(command))


def test_the_main_commands_are_shown() -> None:
    shown = {command.split()[0] for _, command in COMMANDS}
    assert {"reconstruct", "refine", "export", "validate", "evaluate", "demo", "doctor", "weights"} <= shown


@pytest.fixture(scope="module")
def finished(finished_example: Example, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the paths of the pages: a finished run and its images, masks, and a model of another program."""
    folder = tmp_path_factory.mktemp("pages")
    shutil.copytree(finished_example.root, folder / "out")
    (folder / "demo_out").mkdir()
    shutil.copytree(finished_example.root, folder / "demo_out/result")
    shutil.copytree(finished_example.images, folder / "path/to/images")
    for name in ("model", "truth"):
        shutil.copytree(finished_example.root / "sparse/0", folder / "path/to" / name)
    for image in (folder / "path/to/images").rglob("*.png"):
        mask = folder / "path/to/masks" / image.relative_to(folder / "path/to/images")
        mask.parent.mkdir(parents=True, exist_ok=True)
        with Image.open(image) as opened:
            Image.new("L", opened.size, 255).save(mask)
    return folder


CHEAP = sorted({command for _, command in COMMANDS if command.startswith(RUN_HERE) and "mesh" not in command})


def shown_output(page: Path) -> dict[str, list[str]]:
    """The lines of a session that follow each command."""
    shown: dict[str, list[str]] = {}
    for block in re.findall(r"```console\n(.*?)```", text_of(page), re.S):
        command, *lines = block.splitlines()
        shown[command.removeprefix("$ smust3r-colmap ")] = lines
    return shown


def without_numbers(line: str) -> str:
    """Cut off where the page cuts it off."""
    return re.sub(r"[\d.,]+", "#", line.removesuffix("..."))


@pytest.mark.slow
def test_cheap_commands_give_what_the_page_says(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The training dataset first, for it is examined later. What is printed is that of the README but for numbers."""
    monkeypatch.chdir(finished)
    assert len(CHEAP) >= 8
    shown = shown_output(ROOT / "README.md")
    assert len(shown.keys() & set(CHEAP)) >= 2
    for command in sorted(CHEAP, key=lambda one: not one.startswith("export")):
        words = shlex.split(command)
        distorted = words[:2] in (["validate", "out"], ["validate", "path/to/model"]) and "--readers" not in words
        assert main(words) == (3 if distorted else 0), (command, capsys.readouterr())  # as docs/validate.md says
        printed = [without_numbers(line) for line in capsys.readouterr().out.splitlines()]
        for line in map(without_numbers, shown.get(command, ())):
            assert any(one.startswith(line) for one in printed), (command, line)
    assert (finished / "out/trainer/images_4").is_dir()


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_scripts_exist_with_the_flags_that_are_shown(page: Path) -> None:
    for line in shell_lines(page):
        words = shlex.split(line)
        scripts = [word for word in words if word.startswith("scripts/")]
        assert scripts or words[0] in SHELL_WORDS | {"smust3r-colmap", "source"}, line
        for script in scripts:
            source = text_of(ROOT / script)
            assert all(f'"{word}"' in source for word in words if word.startswith("--")), line


def test_every_flag_on_a_page_exists() -> None:
    flag = r"(?<![\w-])--[a-z][a-z0-9_-]*"
    known = {one.replace("_", "-") for one in re.findall(flag, write_options_page.render_page())} | FLAGS_OF_OTHERS
    known |= {
        one for script in (ROOT / "scripts").iterdir() if script.is_file() for one in re.findall(flag, text_of(script))
    }
    for page in PAGES:
        text = (
            re.sub(r"```sh\n(.*?)```", "", text_of(page), flags=re.S)
            if page.name == "continue_in_colmap.md"
            else text_of(page)
        )
        unknown = {one for one in re.findall(flag, text) if one.replace("_", "-") not in known}
        assert not unknown, (name_of(page), unknown)


# ----------------------------------------------------------------------------- generated
def test_the_options_page_is_up_to_date() -> None:
    assert write_options_page.main(["--check"]) == 0, "run python scripts/write_options_page.py"


def test_the_settings_file_of_the_options_page_is_read(tmp_path: Path) -> None:
    found = re.search(r"```toml\n(.*?)```", text_of(ROOT / "docs/options.md"), re.S)
    assert found
    (tmp_path / "config.toml").write_text(found[1])
    settings = read_settings(tmp_path / "config.toml", RunConfig)
    assert settings == {"segment_length": 40, "overlap": 20, "camera_mode": "single"}


def test_the_keys_of_the_summary_are_those_of_the_page() -> None:
    rows = re.findall(r"^\| (`.*?) \|", text_of(ROOT / "docs/outputs.md").partition("## The summary")[2], re.M)
    keys = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    assert keys == GOOD.to_json_dict().keys() | {"model_notes", "settings"}


# --------------------------------------------------------------------------------- pages
def anchors(page: Path) -> set[str]:
    """As GitHub makes them of headings."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_paths_of_the_repository_exist(page: Path) -> None:
    paths = re.findall(r"(?<![\w/.])(?:scripts|smust3r_colmap|exporters|importers|tests)/[\w/]+\.py\b", text_of(page))
    assert [path for path in paths if not (ROOT / path).is_file()] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"```.*?```", "", text_of(page), flags=re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_readme_is_short_and_links_every_page() -> None:
    readme = text_of(ROOT / "README.md")
    assert len(readme.splitlines()) <= MAX_README_LINES
    linked = set(re.findall(r"\]\((docs/\w+\.md)", readme))
    assert {name_of(page) for page in (ROOT / "docs").glob("*.md")} == linked


def test_pictures_are_small_and_used() -> None:
    pictures = sorted((ROOT / "docs/images").iterdir())
    assert pictures
    used = "".join(map(text_of, PAGES))
    assert [one.name for one in pictures if one.stat().st_size > MAX_PICTURE_BYTES or one.name not in used] == []

"""The script that takes a picture of a report."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import picture_of_report as script
import pytest
from PIL import Image

PAGE = """<style>body { margin: 0; background: #fff } @media (prefers-color-scheme: dark) { body { background: #000 } }
div { height: 100px; background: #c01020 }</style><div></div>"""


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, script.BROWSERS)), reason="no Chromium here; apt install chromium")
def test_the_picture_has_the_part_of_the_page_that_was_asked_for(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(PAGE)
    words = [str(tmp_path / "report.html"), str(tmp_path / "p.png"), "--width", "600", "--height", "200", "--top", "50"]
    for more, ground in (([], 255), (["--dark"], 0)):
        assert script.main([*words, *more]) == 0
        pixels = np.asarray(Image.open(tmp_path / "p.png").convert("RGB"))
        assert pixels.shape == (200, 600, 3)
        assert pixels[49, 300].tolist() == [0xC0, 0x10, 0x20]
        assert pixels[50, 300].tolist() == [ground] * 3


def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(tmp_path / "report.html"), str(tmp_path / "p.png")]
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert script.main(words) == 2
    assert "report.html: no such file" in capsys.readouterr().err
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert script.main(words) == 2
    assert "none of chromium" in capsys.readouterr().err

"""A picture of a report, taken by a Chromium without a window.

python scripts/picture_of_report.py OUT/report.html picture.png [--width 1000] [--top 0] [--height 1200] [--dark]
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-gpu")


def main(words: Sequence[str] | None = None) -> int:
    """Take the picture; the exit code is 2 when it cannot be taken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("report", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--width", type=int, default=1000, help="of the window; Chromium makes none below 500")
    parser.add_argument("--top", type=int, default=0, help="rows of the page that are left out above")
    parser.add_argument("--height", type=int, default=1200, help="of the picture")
    parser.add_argument("--dark", action="store_true", help="as on a system with dark windows")
    options = parser.parse_args(words)
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None or not options.report.is_file():
        reason = f"{options.report}: no such file" if browser else f"none of {', '.join(BROWSERS)} is installed"
        print(f"picture_of_report.py: {reason}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        command = [browser, "--headless", "--no-sandbox", "--hide-scrollbars", *QUIET, f"--user-data-dir={folder}"]
        command += ["--blink-settings=preferredColorScheme=0"] if options.dark else []
        command += [f"--window-size={options.width},{options.top + options.height}", f"--screenshot={shot}"]
        subprocess.run([*command, options.report.resolve().as_uri()], check=True, capture_output=True)
        with Image.open(shot) as opened:
            part = opened.convert("RGB").crop((0, options.top, options.width, options.top + options.height))
    part.save(options.picture, optimize=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

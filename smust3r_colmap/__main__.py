"""``python -m smust3r_colmap``, the same as the command ``smust3r-colmap``."""

import sys

from smust3r_colmap.cli import main

if __name__ == "__main__":
    sys.exit(main())

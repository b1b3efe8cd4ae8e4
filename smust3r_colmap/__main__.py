"""``python -m smust3r_colmap``, the same as the command ``smust3r-colmap``.

Every child process imports the module that the program began with, so this one imports nothing
but when it is told to run.
"""

import sys


def main() -> int:
    """Run the command line and return its exit code."""
    from smust3r_colmap.cli import main as run  # noqa: PLC0415  (see above)

    return run()


if __name__ == "__main__":
    sys.exit(main())

"""``python -m smust3r_colmap``, the same as the command ``smust3r-colmap``.

Every child process imports the module that the program began with, so this one imports nothing
but when it is told to run.
"""

import os
import sys


def main() -> int:
    """Run the command line and return its exit code."""
    # The work is spread over processes. OpenBLAS' threads, for matrices as small as ours, double the processor time
    # and save nothing (placing 237 images: 4.7 CPU s in 2.5 s with two threads, 2.1 in 2.1 s with one).
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from smust3r_colmap.cli.main import main as run  # noqa: PLC0415  (see above)

    return run()


if __name__ == "__main__":
    sys.exit(main())

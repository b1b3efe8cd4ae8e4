"""Everything this package raises on purpose.

    SmustrError
    +-- InputError                the caller gave something unusable
    |   +-- ConfigError           an option, or a combination of options
    |   +-- ImageError            one image file
    |   +-- VideoError            one video file
    |   +-- CollectionError       the set of images as a whole
    |   +-- CheckpointError       a file of network weights
    +-- ReconstructionError       the images are fine, the geometry did not come out
    |   +-- DegenerateAlignmentError   points that do not determine a transform
    +-- RunDirectoryError         the output folder
    |   +-- RunLockedError        another process is writing to it
    |   +-- StorageError          the disk refused (full, read-only, unreadable)
    +-- DownloadError             a file that could not be fetched
    +-- MissingDependencyError    an optional package, with what to install

A message names the file or segment at fault, the number found, the number needed and the way out.
The next module to read is ``products``.
"""

from __future__ import annotations

import re

# Where the name to import is not the name to install.
_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow"}
# Start of a shared library's name, and the Debian or Ubuntu package that has it.
_SYSTEM_PACKAGES = {
    "libusb-1.0": "libusb-1.0-0",
    "libGL": "libgl1",
    "libEGL": "libegl1",
    "libgomp": "libgomp1",
    "libX11": "libx11-6",
    "libglib": "libglib2.0-0",
}


class SmustrError(Exception):
    """Root of every error raised on purpose."""


class InputError(SmustrError):
    """The caller gave something unusable (exit code 2 on the command line)."""


class ConfigError(InputError):
    """An option, or a combination of options, makes no sense."""


class ImageError(InputError):
    """One image file cannot be used; the run goes on without it."""


class VideoError(InputError):
    """One video file cannot be used; a run goes on without it where there is something else."""


class CollectionError(InputError):
    """The set of images as a whole cannot be used."""


class CheckpointError(InputError):
    """A file of network weights is not what it should be."""


class ReconstructionError(SmustrError):
    """The images were read, but no geometry came out."""


class DegenerateAlignmentError(ReconstructionError):
    """The given points do not determine the transform asked for."""


class RunDirectoryError(SmustrError):
    """The output folder cannot be used as it is."""


class RunLockedError(RunDirectoryError):
    """Another living process is writing to the same output folder."""


class StorageError(RunDirectoryError):
    """The disk refused a read or a write."""


class DownloadError(SmustrError):
    """A file could not be fetched; what has come so far is kept."""


class MissingDependencyError(SmustrError):
    """An optional package is not installed; the message names what to install."""


def advice_for(stderr: str) -> str:
    """Why an import failed and what to install, from what the child process wrote; its last line is the exception."""
    ours = re.fullmatch(r"smust3r_colmap\.errors\.\w+: (.+)", (stderr.strip().splitlines() or [""])[-1])
    if ours:
        return ours[1]
    library = re.search(r"(lib[\w.+-]+?\.so[\w.]*): cannot open shared object file", stderr)
    if library:
        owner = next((owner for start, owner in _SYSTEM_PACKAGES.items() if library[1].startswith(start)), None)
        remedy = f"install the system package {owner} (Debian's name)" if owner else "install the package that has it"
        return f"the system library {library[1]} is missing; {remedy}"
    missing = re.search(r"No module named '([\w]+)", stderr)
    if missing:
        return f"{missing[1]} is not installed; pip install {_DISTRIBUTIONS.get(missing[1], missing[1])}"
    lines = stderr.strip().splitlines()
    return f"cannot be imported: {lines[-1] if lines else 'no message'}"

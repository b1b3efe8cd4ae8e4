"""Standard deviations of all camera poses of a run as a table, ``poses_uncertainty.csv``.

One line per image and model. Lengths are in units of the model, after the best similarity alignment of all camera
centres; an image of which observations do not bound the pose has ``determined`` 0.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from smust3r_colmap.refinement.model_uncertainty import ModelUncertainty
from smust3r_colmap.storage.atomic_write import write_atomically

COLUMNS = (
    "model",
    "image",
    "position_sigma",
    "rotation_sigma_deg",
    "cov_xx",
    "cov_xy",
    "cov_xz",
    "cov_yy",
    "cov_yz",
    "cov_zz",
    "num_observations",
    "contradicted",
    "determined",
)


def write_uncertainty(models: Mapping[str, ModelUncertainty], path: Path) -> None:
    """Write the table.

    Args:
        models: uncertainty by name of the model.
        path: of the file; replaced where it exists.

    Raises:
        StorageError: the disk refused.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    rows, columns = np.triu_indices(3)
    for model, found in models.items():
        upper = found.position_covariance[:, rows, columns]
        numbers = np.column_stack([found.position_sigma, found.rotation_sigma_deg, upper])
        for k, name in enumerate(found.names):
            is_contradicted = not np.isfinite(found.inflation[k])
            facts = (found.num_observations[k], int(is_contradicted), int(found.determined[k]))
            writer.writerow([model, name, *(f"{number:.9g}" for number in numbers[k]), *facts])
    write_atomically(path, text.getvalue().encode("utf-8", "surrogateescape"))

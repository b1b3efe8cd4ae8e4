"""One vector per image, for telling which images look alike (VLAD of SIFT).

Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010, with
the per-centre normalisation of Arandjelovic and Zisserman, "All about VLAD", CVPR 2013.
The vocabulary is trained on the run itself, so nothing has to be downloaded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

NUM_CENTRES = 64
_TRAINING_FEATURES = 50_000
FEATURES_PER_IMAGE = 1_000
"""Features of an image that count; 128 bytes each are held for all images at once."""


def vlad_descriptors(sift: Sequence[npt.NDArray[np.uint8]], *, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Descriptors (N, NUM_CENTRES * 128) float32 of unit length; zero rows for images without features.

    Args:
        sift: (K_i, 128) uint8 per image, already root-normalised by COLMAP; the first thousand are used.
        rng: chooses the training sample and the first centres.
    """
    from scipy.cluster.vq import kmeans2, vq  # noqa: PLC0415  (0.5 s that child processes need not pay)

    features = [one[:FEATURES_PER_IMAGE] for one in sift]
    stacked = np.concatenate([*features, np.zeros((0, 128), np.uint8)])
    out = np.zeros((len(features), NUM_CENTRES, 128), np.float32)
    if len(stacked) < NUM_CENTRES:
        return out.reshape(len(features), -1)
    sample = rng.choice(len(stacked), size=min(len(stacked), _TRAINING_FEATURES), replace=False)
    training = stacked[np.sort(sample)].astype(np.float32)
    vocabulary, _ = kmeans2(training, NUM_CENTRES, iter=10, minit="points", rng=rng)
    for image, few in enumerate(features):
        if len(few):
            own = few.astype(np.float32)
            word, _ = vq(own, vocabulary)
            np.add.at(out[image], word, own - vocabulary[word])
    out /= np.maximum(np.linalg.norm(out, axis=2, keepdims=True), 1e-9)
    flat = out.reshape(len(features), -1)
    unit: npt.NDArray[np.float32] = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
    return unit

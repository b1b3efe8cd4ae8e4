"""VLAD of SIFT features."""

from __future__ import annotations

import numpy as np

from smust3r_colmap.features.vlad import vlad_descriptors


def test_descriptors_of_alike_images_are_alike() -> None:
    rng = np.random.default_rng(0)
    places = [rng.integers(0, 120, size=(300, 128), dtype=np.uint8) for _ in range(4)]
    again = [
        np.clip(place.astype(int) + rng.integers(-6, 7, size=place.shape), 0, 255).astype(np.uint8) for place in places
    ]
    vlad = vlad_descriptors([*places, *again], rng=np.random.default_rng(1))
    similarity = vlad[:4] @ vlad[4:].T
    np.testing.assert_allclose(np.linalg.norm(vlad, axis=1), 1.0, atol=1e-5)
    assert (similarity.argmax(axis=1) == np.arange(4)).all()
    assert similarity.diagonal().min() > 0.5 > np.abs(similarity - np.diag(similarity.diagonal())).max()


def test_an_image_without_features_has_a_zero_descriptor() -> None:
    rng = np.random.default_rng(0)
    some = rng.integers(0, 120, size=(300, 128), dtype=np.uint8)
    vlad = vlad_descriptors([some, np.zeros((0, 128), np.uint8)], rng=rng)
    assert not vlad[1].any()
    assert vlad[0].any()

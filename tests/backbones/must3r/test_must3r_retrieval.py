"""Descriptors: against the reference vectors, and what a file must be."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch
from helpers.reference_vectors import needs_vectors, vectors
from torch import Tensor

from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.retrieval import RetrievalHead, mean_descriptor
from smust3r_colmap.errors import CheckpointError

WIDTH = 6
OPTIONS: Mapping[str, Any] = {
    "freeze_backbone": True,
    "prewhiten": "file",
    "hdims": "4_6",
    "residual": True,
    "postwhiten": "file",
    "featweights": "l2norm",
    "nfeat": 3,
    "imsize": 512,
    "nclusters": 8,
}


def state(seed: int = 0) -> dict[str, Tensor]:
    random = torch.Generator().manual_seed(seed)
    shapes = {
        "prewhiten.m": (1, WIDTH),
        "prewhiten.p": (WIDTH, WIDTH),
        "projector.0.weight": (4, WIDTH),
        "projector.0.bias": (4,),
        "projector.1.weight": (4,),
        "projector.1.bias": (4,),
        "projector.3.weight": (WIDTH, 4),
        "projector.3.bias": (WIDTH,),
        "postwhiten.m": (1, WIDTH),
        "postwhiten.p": (WIDTH, WIDTH),
    }
    return {
        key: torch.randn(shape, generator=random, dtype=torch.float64 if "whiten" in key else torch.float32)
        for key, shape in shapes.items()
    }


def write(path: Path, tensors: Mapping[str, object], **changed: object) -> Path:
    torch.save({"args": argparse.Namespace(**{**OPTIONS, **changed}), "model": dict(tensors)}, path)
    return path


def encoded(features: Tensor) -> EncodedImage:
    return EncodedImage(features=features, rows=1, columns=len(features))


def some_image(num_patches: int = 8, seed: int = 1) -> EncodedImage:
    return encoded(torch.randn(num_patches, WIDTH, generator=torch.Generator().manual_seed(seed)))


@needs_vectors
def test_head_reproduces_the_reference_vectors(tmp_path: Path) -> None:
    known = vectors("retrieval.npz")
    weights = {key.removeprefix("sd/"): torch.from_numpy(value) for key, value in known.items() if "/" in key}
    path = write(tmp_path / "head.pth", weights, hdims="32_64", nfeat=int(known["nfeat"]))
    head = RetrievalHead.load(path)
    image = encoded(torch.from_numpy(known["in_x"]))
    np.testing.assert_allclose(head.global_descriptor(image), known["global_feat"], rtol=0, atol=1e-5)


def test_mean_descriptor_is_the_mean_at_unit_length() -> None:
    descriptor = mean_descriptor(encoded(torch.tensor([[1.0, 0, 8], [5, 8, 0], [3, 4, 4], [3, 4, 4]])))
    assert descriptor.dtype == np.float32
    np.testing.assert_allclose(descriptor, np.array([3, 4, 4]) / 41**0.5, atol=1e-7)


@pytest.mark.parametrize("features", [[[1.0, 2], [-1, -2]], [[np.nan, 1], [1, 1]], [[np.inf, 1], [1, 1]]])
def test_descriptor_is_zero_where_there_is_none(features: list[list[float]]) -> None:
    np.testing.assert_array_equal(mean_descriptor(encoded(torch.tensor(features))), [0, 0])


def test_descriptors_do_not_depend_on_the_order_of_patches(tmp_path: Path) -> None:
    head = RetrievalHead.load(write(tmp_path / "head.pth", state()))
    image = some_image()
    shuffled = encoded(image.features[torch.randperm(8, generator=torch.Generator().manual_seed(3))])
    other = head.global_descriptor(some_image(seed=2))
    for describe in (mean_descriptor, head.global_descriptor):
        np.testing.assert_allclose(describe(shuffled), describe(image), atol=1e-6)
    assert 0.99999 < np.linalg.norm(other) < 1.00001
    assert 0 < other @ head.global_descriptor(image) < 0.95


def weighted_by_norm(features: Tensor) -> npt.NDArray[np.float32]:
    mean = features.norm(dim=1).double() @ features.double()
    return np.asarray(mean / mean.norm(), np.float32)


def test_head_without_any_part_weighs_the_features_by_their_norm(tmp_path: Path) -> None:
    path = write(tmp_path / "head.pth", {}, prewhiten=None, postwhiten=None, hdims="", residual=False)
    image = some_image()
    descriptor = RetrievalHead.load(path).global_descriptor(image)
    np.testing.assert_allclose(descriptor, weighted_by_norm(image.features), atol=1e-6)


def test_residual_adds_what_went_into_the_projector(tmp_path: Path) -> None:
    image = some_image()
    tensors = {key: value for key, value in state().items() if "postwhiten" not in key}
    for residual in (True, False):
        head = RetrievalHead.load(write(tmp_path / f"{residual}.pth", tensors, residual=residual, postwhiten=None))
        assert head.prewhiten is not None
        whitened = head.prewhiten(image.features)
        with torch.no_grad():
            projected = head.projector(whitened)
        expected = weighted_by_norm(projected + whitened if residual else projected)
        np.testing.assert_allclose(head.global_descriptor(image), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"featweights": "learned"}, "weighted by 'learned'"),
        ({"hdims": "4"}, "gives 4 numbers, to be added to its 6"),
        ({"hdims": "4_x"}, "hdims is '4_x'"),
        ({"hdims": None}, "hdims is None"),
        ({"hdims": "4", "residual": False}, "4 tensors have no place, such as projector.1.bias"),
        ({"hdims": "4_6_6"}, "projector.4.weight is missing"),
        ({"hdims": "4_5"}, r"projector.3.weight is \(6, 4\), needed \(5, 4\)"),
        ({"prewhiten": None}, "2 tensors have no place, such as prewhiten.m"),
    ],
)
def test_options_that_do_not_fit_are_refused(tmp_path: Path, changed: dict[str, object], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        RetrievalHead.load(write(tmp_path / "head.pth", state(), **changed))


def test_tensors_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    for key, weights, message in (
        ("prewhiten.p", torch.zeros(WIDTH), r"prewhiten takes \(1, 6\) by \(6,\)"),
        ("projector.1.weight", torch.zeros(5), r"projector.1.weight is \(5,\), needed \(4,\)"),
        ("projector.1.weight", "text", "more than tensors"),
    ):
        with pytest.raises(CheckpointError, match=message):
            RetrievalHead.load(write(tmp_path / "head.pth", {**state(), key: weights}))
    without = {key: value for key, value in state().items() if key != "postwhiten.m"}
    with pytest.raises(CheckpointError, match=r"postwhiten\.m is missing"):
        RetrievalHead.load(write(tmp_path / "head.pth", without))


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    torch.save({"encoder": {}, "decoder": {}}, tmp_path / "network.pth")
    with pytest.raises(CheckpointError, match=r"network\.pth is no retrieval head: it holds \['decoder', 'encoder'\]"):
        RetrievalHead.load(tmp_path / "network.pth")


def test_encoder_of_another_width_is_refused(tmp_path: Path) -> None:
    head = RetrievalHead.load(write(tmp_path / "head.pth", state()))
    with pytest.raises(ValueError, match="features of width 5, the head takes 6"):
        head.global_descriptor(encoded(torch.zeros(4, 5)))

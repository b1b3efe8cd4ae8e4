"""Running the network over the images of a segment (network specification, section 9).

First some images, the keyframes, are shown to it and remembered; then every image is predicted against
what it remembers. ``reconstruct_segment`` does both. ``remember`` is the first half, and with its
predictions kept, the drivers as published: they say of an image what was known when it came.

Predictions are handed on one by one, for those of 200 images take a gigabyte. An error in the middle,
such as memory that ran out, comes through as it was raised. Whoever wants to try again with fewer
keyframes does so after the ``except`` block: until then the error's traceback holds the tensors.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from smust3r_colmap.backbones.must3r.cameras import register_camera
from smust3r_colmap.backbones.must3r.encoder import EncodedImage
from smust3r_colmap.backbones.must3r.head import Pointmaps, activate
from smust3r_colmap.backbones.must3r.keyframes import (
    INITIAL_KEYFRAMES,
    Discovery,
    EvenlySpread,
    EveryKth,
    KeyframeChoice,
    UnlikeEachOther,
    View,
    WhereNew,
    place_to_give_up,
)
from smust3r_colmap.backbones.must3r.memory import Memory, RememberedImage
from smust3r_colmap.backbones.must3r.network import Network, render
from smust3r_colmap.errors import DegenerateAlignmentError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, eq=False)
class Prediction:
    """What the network says of one image.

    Args:
        index: of the image in its segment.
        raw: (H, W, 7) float32 output of the head, where the network runs; ``activate`` makes points of it.
        is_keyframe: the network remembered the image when it said so.
    """

    index: int
    raw: Tensor
    is_keyframe: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class Remembered:
    """What is left of the keyframes.

    Args:
        memory: their tokens.
        keyframes: their indices in the segment, in the order in which they were shown.
    """

    memory: Memory
    keyframes: tuple[int, ...]


# ---------------------------------------------------------------------------------- a whole segment
def reconstruct_segment(
    network: Network,
    images: Sequence[EncodedImage],
    choice: KeyframeChoice,
    *,
    refinements: int = 0,
    rerender: bool = True,
    batch_size: int = 1,
    order_by_shape: bool = False,
    reserve: int | None = None,
    on_memory: Callable[[Memory], None] | None = None,
) -> Iterator[Prediction]:
    """One prediction of every image, keyframes found and remembered on the way.

    Args:
        images: of the segment, one or more; each is taken by its index when it is needed and may be loaded then.
        choice: of the keyframes. The first one shown is the reference, whose camera frame is the world frame.
        refinements: times that the keyframes are shown again, against the memory of all of them.
        rerender: predict every image against the final memory, in order. False keeps what was said when
            an image was shown (last), and predicts against the final memory those that never were.
        batch_size: images predicted at once against the final memory.
        order_by_shape, reserve, on_memory: see ``remember``.

    Raises:
        ValueError: there is no image.
        MemoryError, RuntimeError, torch.OutOfMemoryError: as the allocators raise them.
    """
    if not len(images):
        raise ValueError("a segment without images")
    shown, keyframes, local_context = _programme(choice, len(images))
    remembered = yield from remember(
        network,
        images,
        shown,
        keyframes=keyframes,
        batches=batches_of(len(shown), initial=min(INITIAL_KEYFRAMES, choice.most)),
        refinements=refinements,
        local_context=local_context,
        keep_predictions=not rerender,
        order_by_shape=order_by_shape,
        reserve=reserve,
        on_memory=on_memory,
    )
    to_render = [index for index in range(len(images)) if rerender or index not in shown]
    yield from predict(network, images, remembered, to_render, batch_size=batch_size)


def _programme(choice: KeyframeChoice, num_images: int) -> tuple[Sequence[int], Collection[int] | WhereNew, int]:
    """Images in the order in which they are shown, which of them are kept, and the local context."""
    match choice:
        case EvenlySpread() | UnlikeEachOther():
            keyframes = choice.keyframes(num_images)
            return keyframes, keyframes, 0
        case EveryKth():
            return range(num_images), choice.keyframes(num_images), choice.local_context
        case WhereNew():
            return range(num_images), choice, choice.local_context


def batches_of(num_images: int, *, initial: int = INITIAL_KEYFRAMES) -> tuple[int, ...]:
    """Images shown at once: the initial ones together, the others one by one."""
    together = min(initial, num_images)
    return (together, *(1 for _ in range(num_images - together)))


def predict(
    network: Network, images: Sequence[EncodedImage], remembered: Remembered, indices: Sequence[int], *, batch_size: int
) -> Iterator[Prediction]:
    """Some images against the whole memory, which stays as it is (section 5.4)."""
    keyframes = set(remembered.keyframes)
    for start in range(0, len(indices), batch_size):
        batch = indices[start : start + batch_size]
        loaded = [_on_device(images[index], network) for index in batch]
        predictions = render(network, remembered.memory, loaded, batch_size=batch_size)
        for index, raw in zip(batch, predictions, strict=True):
            yield Prediction(index=index, raw=raw, is_keyframe=index in keyframes)


# ---------------------------------------------------------------------------------------- the first half
def remember(
    network: Network,
    images: Sequence[EncodedImage],
    shown: Sequence[int],
    *,
    keyframes: Collection[int] | WhereNew,
    batches: Sequence[int] | None = None,
    refinements: int = 0,
    local_context: int = 0,
    keep_predictions: bool = True,
    order_by_shape: bool = False,
    reserve: int | None = None,
    on_memory: Callable[[Memory], None] | None = None,
) -> Generator[Prediction, None, Remembered]:
    """Show images to the network and keep the tokens of some (sections 9.2 and 9.3).

    The first batch creates the memory and is kept whole. What is decided about an image stays so in the refinements,
    which put its fresh tokens in the place of the old ones; the reference keeps those it has.

    Args:
        images: of a segment, taken by their index when they are shown.
        shown: indices in the order in which the network is to see them; the first is the reference.
        keyframes: indices of those to keep, or the rule that decides when the network has seen them.
        batches: numbers of images shown at once, in sum those of ``shown``; by default two, then one by one.
        refinements: times that all are shown again.
        local_context: this many images last shown stay in the memory for a while, keyframes or not.
        keep_predictions: hand on what the network says in the last round. Images that nothing depends on
            are not shown at all where this is False.
        order_by_shape: put the images of a batch in ascending order of height and width, as upstream does. If
            the first two images have different shapes the reference is then the lower one, listed second or not.
        reserve: tokens to make room for beforehand, by default those of as many images as the memory can hold.
        on_memory: called whenever the memory has changed. Refinements change it in place.

    Returns:
        The memory and its keyframes; ``yield from`` hands it to a generator.

    Raises:
        ValueError: the batches are not those of the images shown.
    """
    batches = batches_of(len(shown)) if batches is None else batches
    if not batches or min(batches) < 1 or sum(batches) != len(shown):
        raise ValueError(f"batches {tuple(batches)} of {len(shown)} images")
    making = _MemoryInTheMaking(network, keyframes, num_shown=len(shown), local_context=local_context, reserve=reserve)
    for number in range(1 + refinements):
        handed_on = keep_predictions and number == refinements
        for first, indices in _split(shown, batches):
            if not (handed_on or making.depends_on(indices)):
                continue
            batch = [(index, _on_device(images[index], network)) for index in indices]
            if order_by_shape:
                batch.sort(key=lambda entry: entry[1].grid)
            raw_of = making.show(batch, first_label=first, with_outputs=handed_on)
            if on_memory is not None:
                on_memory(making.memory)
            if handed_on:
                for index in indices:
                    yield Prediction(index=index, raw=raw_of[index], is_keyframe=index in making.keyframes)
        making.end_round()
    memory = making.memory.counting(len(shown))
    logger.debug("%d of %d images remembered, %d tokens", len(making.keyframes), len(shown), len(memory))
    return Remembered(memory=memory, keyframes=making.keyframes)


def _split(shown: Sequence[int], batches: Sequence[int]) -> Iterator[tuple[int, Sequence[int]]]:
    """Every batch and the place of its first image."""
    first = 0
    for size in batches:
        yield first, shown[first : first + size]
        first += size


class _MemoryInTheMaking:
    """Decides about images as they are shown. An image's label is its place in the order of showing."""

    def __init__(
        self,
        network: Network,
        keyframes: Collection[int] | WhereNew,
        *,
        num_shown: int,
        local_context: int,
        reserve: int | None,
    ) -> None:
        self._network = network
        self._choice: Discovery | frozenset[int]
        if isinstance(keyframes, WhereNew):
            self._choice, self._most, expected = Discovery(keyframes.rule), keyframes.most, keyframes.most
        else:
            self._choice, self._most, expected = frozenset(keyframes), num_shown, len(keyframes)
        self._holds = min(num_shown, expected + local_context)
        self._reserve = reserve
        self._local_context = local_context
        self._memory: Memory | None = None
        self._labels: dict[int, int] = {}  # of every image shown, by its index
        self._kept: dict[int, int] = {}  # index of every keyframe, by its ascending label
        self._recent: deque[int] = deque()  # labels of the local context
        self._guests: set[int] = set()  # labels in the memory that are no keyframes

    @property
    def memory(self) -> Memory:
        """As it is now; there is one as soon as an image was shown."""
        assert self._memory is not None, "no image was shown"
        return self._memory

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Indices, in the order of showing."""
        return tuple(self._kept.values())

    def depends_on(self, indices: Collection[int]) -> bool:
        """Whether showing these images can make a difference to the memory."""
        return self._local_context > 0 or any(self._may_be_kept(index) for index in indices)

    def _may_be_kept(self, index: int) -> bool:
        if index in self._labels:
            return self._labels[index] in self._kept
        return isinstance(self._choice, Discovery) or index in self._choice

    # -------------------------------------------------------------------------------- showing
    def show(
        self, batch: Sequence[tuple[int, EncodedImage]], *, first_label: int, with_outputs: bool
    ) -> dict[int, Tensor]:
        """One update with some images and their indices; what the network says of each, if asked for."""
        undecided = isinstance(self._choice, Discovery) and any(index not in self._labels for index, _ in batch)
        with self._network.running():
            seen = self._network.decoder.see(
                [image for _, image in batch], self._memory, with_outputs=with_outputs or undecided
            )
        raw_of = {index: raw for (index, _), raw in zip(batch, seen.raw, strict=False)}
        if self._memory is None:
            self._create(batch, seen.remembered, raw_of)
        else:
            for place, ((index, _), tokens) in enumerate(zip(batch, seen.remembered, strict=True)):
                if index in self._labels:
                    self._meet_again(self._labels[index], tokens)
                else:
                    self._labels[index] = first_label + place
                    self._meet(index, tokens, raw_of.get(index))
        self._recent.extend(self._labels[index] for index, _ in batch)
        self._forget({self._recent.popleft() for _ in range(len(self._recent) - self._local_context)})
        return raw_of

    def _create(
        self, batch: Sequence[tuple[int, EncodedImage]], fresh: Sequence[RememberedImage], raw_of: dict[int, Tensor]
    ) -> None:
        reserve = self._holds * len(batch[0][1].features) if self._reserve is None else self._reserve
        self._memory = Memory.of(fresh, reserve=reserve)
        for label, (index, _) in enumerate(batch):
            self._labels[index], self._kept[label] = label, index
            if isinstance(self._choice, Discovery):
                self._choice.add(self._view(raw_of[index]))

    def _meet(self, index: int, tokens: RememberedImage, raw: Tensor | None) -> None:
        label = self._labels[index]
        if self._is_keyframe(index, raw) and self._find_place(label, tokens):
            self._kept[label] = index
        else:
            self._receive(label, tokens)

    def _meet_again(self, label: int, tokens: RememberedImage) -> None:
        if label not in self._kept:
            self._receive(label, tokens)
        elif label > 0:  # the reference stays as it is
            self.memory.overwrite_(label, tokens)

    def _is_keyframe(self, index: int, raw: Tensor | None) -> bool:
        if not isinstance(self._choice, Discovery):
            return index in self._choice
        assert raw is not None, "decided by what the network saw"
        view = self._view(raw)
        new = self._choice.is_new(view)
        if new:
            self._choice.add(view)
        return new

    def _view(self, raw: Tensor) -> View:
        return view_of(activate(raw, self._network.architecture.decoder.activation))

    # -------------------------------------------------------------------------------- the tokens
    def _find_place(self, label: int, tokens: RememberedImage) -> bool:
        """Put a keyframe into the memory; into the place of another where there are enough. False if none gives way."""
        if len(self._kept) < self._most:
            self._memory = self.memory.counting(label).extended([tokens])
            return True
        victim = place_to_give_up([*self._kept, label])
        if victim is None:
            return False
        del self._kept[victim]
        if int((self.memory.labels == victim).sum()) == len(tokens[0]):  # nothing has to move
            self.memory.overwrite_(victim, tokens)
            self._memory = self.memory.relabelled(victim, label)
        else:
            self._memory = self.memory.without([victim]).counting(label).extended([tokens])
        return True

    def _receive(self, label: int, tokens: RememberedImage) -> None:
        """For as long as the image is one of the last shown."""
        if self._local_context > 0:
            self._memory = self.memory.counting(label).extended([tokens])
            self._guests.add(label)

    def _forget(self, labels: set[int]) -> None:
        """Images that leave the local context, but for the keyframes among them."""
        leaving = labels & self._guests
        if leaving:
            self._memory = self.memory.without(leaving)
            self._guests -= leaving

    def end_round(self) -> None:
        """All images were shown; the next round starts without local context."""
        self._forget(set(self._recent))
        self._recent.clear()


# ------------------------------------------------------------------------------------------- helpers
def view_of(pointmaps: Pointmaps) -> View:
    """What ``Discovery`` looks at. The camera is that of the finite pixels; if they give none, it is at NaN."""
    points_world, points_cam, confidence = (
        values.cpu().numpy() for values in (pointmaps.points_world, pointmaps.points_cam, pointmaps.confidence)
    )
    finite = np.isfinite(points_world).all(axis=-1) & np.isfinite(points_cam).all(axis=-1) & np.isfinite(confidence)
    try:
        centre_world = register_camera(points_cam[finite], points_world[finite], confidence[finite])[:3, 3]
    except DegenerateAlignmentError:
        centre_world = np.full(3, np.nan)
    return View(points_world=points_world, depth=points_cam[..., 2], confidence=confidence, centre_world=centre_world)


def _on_device(image: EncodedImage, network: Network) -> EncodedImage:
    return replace(image, features=image.features.to(network.device))

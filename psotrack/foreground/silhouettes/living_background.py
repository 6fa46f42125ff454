"""A background that lives: MOG2 that goes on learning, but never learns an object.

`LivingBackground` sees one frame after the other, in one pass, from a file or from a live camera. Each frame goes
through:

0. a frame that does not show the scene is left out, never learned from, and counts as no frame; one that shows another
   scene, or the same in a light too different to be followed, begins a new background if that lasts;
1. the change of the light is removed (`lighting`);
2. MOG2 (Zivkovic, ICPR 2004) tells which pixels differ from all that they showed lately;
3. the blobs of these pixels that are objects become foreground (`object_blobs`); how much a blob must differ depends on
   the place: leaves, screens, waves and noise make a place restless;
4. MOG2 learns all pixels but those of objects, so that clouds, daylight and ghosts are absorbed in a second or two, and
   a drone that hovers for minutes is not.

`Living` is the background model of a file, in two passes: the first pass learns what most frames of the whole video
show, and the first two seconds are seen twice.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.foreground.silhouettes.foreground import OwnBackground, learned_mog2
from psotrack.foreground.silhouettes.lighting import (
    LEAST_DIFFERENCE,
    Comparison,
    Light,
    compare,
    light_of,
    remove_light,
)
from psotrack.foreground.silhouettes.object_blobs import (
    ObjectBlobs,
    find_objects,
    gradient,
    largest,
    possible_objects,
)
from psotrack.foreground.silhouettes.settings import ForegroundSettings

#: MOG2's label of foreground that is no shadow.
_FOREGROUND = 255
#: Squared Mahalanobis distance from the background beyond which a pixel may be foreground.
_VAR_THRESHOLD = 12.0
#: MOG2's variance of a new colour, and its least variance, squared grey levels: OpenCV's own.
_NEW_VARIANCE, _LEAST_VARIANCE = 15.0, 4.0
#: Learning rate per frame. MOG2 takes a new colour for background at a weight of 0.1, which is after 6 frames.
_LEARNING_RATE = 0.02
#: Number of first frames of a file that are seen twice, 2 s of most videos.
_FIRST_FRAMES = 50

#: A darker pixel of the same hue is a shadow if it keeps this share of the background's brightness, at least.
_SHADOW_BRIGHTNESS = 0.85
#: Shadows count as foreground up to this distance from foreground that is no shadow: pixels of a thin arm show the arm
#: and the background, and look like a shadow.
_TOUCHING = np.ones((5, 5), np.uint8)

#: A pixel is strong if it differs by this many times the place's usual deviation (root of the mean square).
_DEVIATIONS = 4.0
#: A strong pixel also differs by more than this many times the place's mean change within `_CHANGE_EVERY` frames.
_CHANGES, _CHANGE_EVERY = 3.7, 5
#: A single change counts at most as this many times the place's mean change, and as the least difference beside: the
#: changes of leaves and screens, which go on, soon count in full, and a place that a few drones cross stays calm.
_COUNTED_CHANGES = 4.0
#: A strong pixel also differs by more than a shift of the image by this many pixels would explain.
_SHIFT_PX = 1.0
#: Pixels that differ by less than this share of what makes a pixel strong are no part of a blob.
_EXTENT = 0.35
#: Learning rate per frame of each place's deviation and change, and the window over which they are averaged, pixels.
_USUAL_RATE, _USUAL_WINDOW = 0.005, (5, 5)
#: Number of calm frames assumed before the first frame, so that one drone that passes early makes no place restless.
_CALM_FRAMES = 10
#: Smaller differences are no change, grey levels: half of the noise of a good camera, by MOG2's least variance.
_LEAST_CHANGE = 4.0
#: Number of frames between two updates of the difference that a strong pixel needs, because it changes slowly.
_USUAL_EVERY = 8
#: One of three frames is learned, with the weight of three. Of a live camera, each of the first 25 frames is learned.
_LEARN_EVERY, _ALL_LEARNED = 3, 25
#: Pixels that show the known background are learned by MOG2 every second time only.
_ALL_EVERY = 2
#: Objects are protected from being learned with a margin, because their edges are blurred.
_MARGIN = np.ones((5, 5), np.uint8)
#: Beside an object, a difference of this many grey levels is noise.
_FAINT = 2
_AROUND = np.ones((3, 3), np.uint8)

_Image = UInt8[np.ndarray, "height width 3"]
_Mask = UInt8[np.ndarray, "height width"]


class Living(OwnBackground):
    """The background model "living" (see the module); shadows that touch other foreground count as foreground."""

    @property
    def key(self) -> Mapping[str, Any]:
        """See `BackgroundModel`."""
        used = ("working_reduction", "num_learning_frames", "min_blob_px", "soft_edges", "first_look")
        return {"living": 3, **{name: getattr(self.settings, name) for name in used}}

    def masks_as_they_come(self, frames: Iterable[_Image]) -> Iterator[_Mask | None]:
        """Yield the foreground of each frame, from what was seen before it, as of a live camera.

        Args:
            frames: all frames in their order, reduced.
        """
        background = None
        for frame in frames:
            background = LivingBackground(self.settings, frame) if background is None else background
            yield background.step(frame)

    def masks(
        self, learning: Iterable[tuple[float, _Image]], frames: Iterable[_Image]
    ) -> Iterator[_Mask | None]:
        """See `OwnBackground`."""
        most_frames = np.asarray(learned_mog2(learning, self.settings).getBackgroundImage())
        background = LivingBackground(self.settings, most_frames, self.settings.num_learning_frames)
        coming = iter(frames)
        first = list(itertools.islice(coming, _FIRST_FRAMES))
        # From the last to the first, so that the background of frame 0 is that of its time, and what is restless is
        # known.
        for frame in first[::-_LEARN_EVERY]:
            background.step(frame, num_frames=_LEARN_EVERY)
        for frame in itertools.chain(first, coming):
            yield background.step(frame)


class _Look(NamedTuple):
    """What was seen in a frame: the image without changes of light, and what differs from the background."""

    image: _Image
    difference: _Mask
    differs: _Mask
    labels: _Mask
    near: tuple[slice, slice]
    found: ObjectBlobs
    log_gain: float


class _Mog2:
    """OpenCV's MOG2, which is asked about, and learns, some pixels of an image.

    Args:
        image: (height, width, 3), the background.
        variance: variance of a new colour, squared grey levels.
    """

    def __init__(self, image: _Image, variance: float = _NEW_VARIANCE) -> None:
        self.variance = max(_LEAST_VARIANCE, variance)
        self._model = cv2.createBackgroundSubtractorMOG2(varThreshold=_VAR_THRESHOLD, detectShadows=True)
        self._model.setShadowThreshold(_SHADOW_BRIGHTNESS)
        self._model.setVarInit(self.variance)
        self._model.apply(image, learningRate=1)

    def labels(self, image: _Image, chosen: _Mask, learning_rate: float = 0.0) -> _Mask:
        """(height, width), MOG2's labels of the chosen pixels, which it also learns; 0 elsewhere."""
        if not cv2.hasNonZero(chosen):
            return np.zeros_like(chosen)
        labels = self._model.apply(image, cv2.bitwise_not(chosen), None, learning_rate)
        return np.asarray(cv2.bitwise_and(labels, chosen))


class LivingBackground:
    """The background of one camera, which changes with each frame; a second one waits for its scene to come back.

    Args:
        settings: settings of the foreground; `working_reduction`, `min_blob_px` and `soft_edges` are used.
        image: (height, width, 3), BGR, the background as far as it is known: the first frame of a live camera, or what
            most of a video's frames show. Of the frames' size.
        num_frames: number of frames that show this background: the more, the less a new frame changes the background.
    """

    def __init__(self, settings: ForegroundSettings, image: _Image, num_frames: int = 1) -> None:
        self._settings = settings
        self._scene = _Scene(settings, image, num_frames)
        self._other: _Scene | None = None
        self._num_changed, self._is_left_out = 0, False

    def step(self, image: _Image, known: _Mask | None = None, *, num_frames: int = 1) -> _Mask | None:
        """The foreground of the next frame; learns from the frame: `look`, then `learn`."""
        foreground = self.look(image, num_frames=num_frames)
        self.learn(known)
        return foreground

    def look(self, image: _Image, *, num_frames: int = 1) -> _Mask | None:
        """The foreground of the next frame; `learn` is to be called before the frame after it.

        Args:
            image: (height, width, 3), BGR frame.
            num_frames: number of frames for which this one stands, where frames were left out before it.

        Returns:
            (height, width): 0 for background, 255 for foreground; with soft edges, at and beside contours the share of
            the pixel that is foreground. None for a frame that does not show the scene.
        """
        log_gain, lasting_frames = self._compare(image)
        self._num_changed = self._num_changed + num_frames if log_gain else 0
        if self._num_changed > lasting_frames:
            is_other = math.isinf(log_gain)
            begun = _Scene(self._settings, image) if is_other else self._scene.in_light(math.exp(log_gain))
            # The background that is known for longer is kept.
            if self._other is None or self._other.num_known < self._scene.num_known:
                self._other = self._scene
            self._scene, self._num_changed, log_gain = begun, 0, 0.0
        self._is_left_out = math.isinf(log_gain)
        if self._is_left_out:
            return None
        return self._scene.look(image, log_gain, num_frames)

    def learn(self, known: _Mask | None = None) -> None:
        """Learn from the last frame.

        Args:
            known: (height, width), above 0 where a drone is known to be, for example by a tracker's prediction: these
                pixels are not learned. None: nothing is known.
        """
        if not self._is_left_out:
            self._scene.learn(known)

    def _compare(self, image: _Image) -> Comparison:
        """Compare a frame with the scene; where the light changed much, with the other one if that is nearer."""
        found = compare(image, self._scene.light)
        if found.log_gain and self._other is not None:
            before = compare(image, self._other.light)
            if abs(before.log_gain) < abs(found.log_gain):
                self._scene, self._other, found = self._other, self._scene, before
        return found


class _Scene:
    """What a camera shows in one light: see `LivingBackground`.

    Attributes:
        light: the light of the background.
        num_known: number of frames that have shown the background.
    """

    light: Light

    def __init__(self, settings: ForegroundSettings, image: _Image, num_frames: int = 1) -> None:
        self._soft_edges = settings.soft_edges
        self._least_px = math.ceil(settings.min_blob_px / settings.working_reduction**2)
        self._background: Float[np.ndarray, "height width 3"] = image.astype(np.float32)
        self._mog2 = _Mog2(image)
        shape = image.shape[:2]
        self._square = np.zeros(shape, np.float32)
        self._change = np.zeros(shape, np.float32)
        self._last = image
        self._num_frames = 0
        self._num_before = num_frames
        self._num_updates = 0
        self._num_learned, self._num_changed, self._expected_until = 0, 0, 0
        self._objects = np.zeros(shape, np.uint8)
        self._foreground: _Mask = np.zeros(shape, np.uint8)
        self._before: _Mask = np.full(shape, 255, np.uint8)
        self._expect()

    @property
    def num_known(self) -> int:
        return self._num_before + self._num_frames

    def in_light(self, gain: float) -> _Scene:
        """The same scene in a light that is `gain` times as bright."""
        scene = copy.copy(self)
        scene._background = np.minimum(gain * self._background, 255)
        scene._square, scene._change = gain**2 * self._square, gain * self._change
        scene._last = cv2.convertScaleAbs(self._last, alpha=gain)
        background = np.asarray(cv2.convertScaleAbs(scene._background))
        scene._mog2 = _Mog2(background, min(1.0, gain**2) * self._mog2.variance)
        scene._expected_until = 0
        scene._expect()
        return scene

    def look(self, image: _Image, log_gain: float, num_frames: int) -> _Mask:
        self._num_frames += num_frames
        num_new = self._num_frames - self._num_learned
        self._is_learned = self.num_known <= _ALL_LEARNED or num_new >= _LEARN_EVERY
        image = remove_light(image, self.light, self._foreground, log_gain)
        difference = largest(cv2.absdiff(image, self.light.background))
        usual, least = self._usual, self._least
        if log_gain:
            # In the frame's own light, in which its noise is that of any frame.
            difference = cv2.convertScaleAbs(difference, alpha=math.exp(log_gain))
            usual, least = self._limits(math.exp(log_gain))
        differs = cv2.compare(difference, least, cv2.CMP_GT)
        strong = cv2.compare(difference, usual, cv2.CMP_GT)
        # MOG2 takes long: it is asked only about pixels that may belong to an object, and those that these may touch;
        # in a frame that is learned, about all pixels that differ.
        possible, near = possible_objects(differs, strong)
        asked = differs if self._is_learned else cv2.bitwise_and(differs, cv2.dilate(possible, _TOUCHING))
        labels = self._mog2.labels(image, asked)
        touching = cv2.dilate(_white(labels[near] == _FOREGROUND), _TOUCHING)
        changed = cv2.bitwise_and(touching, _white(labels[near] > 0))
        strong = cv2.bitwise_and(changed, strong[near])
        before, is_restless = self._before[near], self._is_restless[near]
        found = find_objects(changed, strong, difference[near], before, is_restless, self._least_px)
        self._foreground = _placed(found.mask, near, differs.shape)
        self._before = difference
        self._last_look = _Look(image, difference, differs, labels, near, found, log_gain)
        soft = _with_soft_edges(found.mask, difference[near]) if self._soft_edges else found.mask
        return _placed(soft, near, differs.shape)

    def learn(self, known: _Mask | None) -> None:
        if self._is_learned:
            look, near = self._last_look, self._last_look.near
            own = look.found.with_own_edges(look.image[near], self.light.background[near])
            objects = _placed(own, near, look.differs.shape)
            self._learn(look, objects if known is None else objects | known)
            self._expect()

    def _learn(self, look: _Look, objects: _Mask) -> None:
        # A part of an object that one frame does not show is not learned at once.
        protected = cv2.dilate(cv2.bitwise_or(objects, self._objects), _MARGIN)
        self._objects = objects
        free = cv2.bitwise_not(protected)
        num_frames, self._num_learned = self._num_frames - self._num_learned, self._num_frames
        # At first each frame has the same weight.
        learning_rate = max(_LEARNING_RATE, 1 / (self.num_known))
        # MOG2 takes long, and most pixels show the background as it is known: they are learned less often.
        self._num_updates += 1
        learned = free if self._num_updates % _ALL_EVERY == 0 else cv2.bitwise_and(look.differs, free)
        self._mog2.labels(look.image, learned, _of_frames(learning_rate, num_frames))
        cv2.accumulateWeighted(look.image, self._background, _of_frames(learning_rate, num_frames), free)
        if look.log_gain:
            return  # what a large change of the light leaves is not usual
        rate = max(_USUAL_RATE, 1 / (self._num_frames + _CALM_FRAMES))
        unexplained = cv2.bitwise_and(look.difference, look.difference, mask=look.labels)
        square = cv2.multiply(unexplained, unexplained, dtype=cv2.CV_32F)
        cv2.accumulateWeighted(square, self._square, _of_frames(rate, num_frames), free)
        num_frames = self._num_frames - self._num_changed
        if num_frames >= _CHANGE_EVERY:
            # A hovering drone hardly changes, a screen does: so this is learned at objects too.
            change = largest(cv2.absdiff(look.image, self._last)).astype(np.float32)
            change = np.minimum(change, _COUNTED_CHANGES * self._change + LEAST_DIFFERENCE)
            cv2.accumulateWeighted(change, self._change, _of_frames(rate, num_frames))
            self._last, self._num_changed = look.image, self._num_frames

    def _expect(self) -> None:
        """What the next frames are compared with, and by how much they may differ, which changes slowly."""
        self.light = light_of(self._background)
        if self._num_frames < self._expected_until:
            return
        self._expected_until = self._num_frames + _USUAL_EVERY
        self._restless = self._restlessness()
        # A small shift of the image changes the pixels beside edges.
        shifted = _SHIFT_PX / 2 * cv2.dilate(gradient(self.light.background), np.ones((3, 3), np.uint8))
        self._explained = np.maximum(self._restless, shifted)
        self._usual, self._least = self._limits()
        self._is_restless = self._restless > 2 * LEAST_DIFFERENCE

    def _limits(self, gain: float = 1.0) -> tuple[_Mask, _Mask]:
        """Differences beyond which a pixel is strong, and differs at all, in a light that is `gain` times as bright."""
        usual = np.maximum(gain * self._explained, LEAST_DIFFERENCE)
        return _levels(usual), _levels(np.maximum(_EXTENT * gain * self._restless, _LEAST_CHANGE))

    def _restlessness(self) -> Float[np.ndarray, "height width"]:
        """(height, width), difference that leaves, screens, waves and noise make at a place, grey levels."""
        # OpenCV's running sums give numbers below 0 beside numbers that are many times larger.
        deviation = np.sqrt(np.maximum(cv2.blur(self._square, _USUAL_WINDOW), 0))
        change = cv2.blur(self._change, _USUAL_WINDOW)
        return np.maximum(_DEVIATIONS * deviation, _CHANGES * change)


def _with_soft_edges(mask: _Mask, difference: _Mask) -> _Mask:
    """The mask with the share of each pixel that an object covers, 0 to 255, at and beside the contours of objects.

    A pixel that an object half covers differs from the background by half as much as its neighbours within the object.
    """
    within = cv2.dilate(cv2.bitwise_and(difference, mask), _AROUND)
    share = cv2.divide(np.maximum(difference, _FAINT) - _FAINT, within, scale=255)
    return np.asarray(cv2.bitwise_and(cv2.max(share, cv2.erode(mask, _AROUND)), cv2.dilate(mask, _AROUND)))


def _of_frames(rate: float, num_frames: int) -> float:
    """The learning rate of several frames at once."""
    return 1 - (1 - rate) ** num_frames


def _levels(limit: Float[np.ndarray, "height width"]) -> _Mask:
    """Limits in whole grey levels: a whole number is above one of these where it is above the limit."""
    return np.minimum(limit, 255).astype(np.uint8)


def _placed(part: _Mask, near: tuple[slice, slice], shape: tuple[int, ...]) -> _Mask:
    """(height, width), a part of a mask at its place, and 0 elsewhere."""
    mask = np.zeros(shape, np.uint8)
    mask[near] = part
    return mask


def _white(chosen: np.ndarray) -> _Mask:
    return chosen.view(np.uint8) * np.uint8(255)

"""Frames that repeat the picture before: a stream that froze, a recorder without a new frame, a rate that was raised.

Where something moves, a repeated picture differs from the one before by what the codec makes of it, and all other
frames by the motion. In a frame in which what moves stands still for a moment, as many pixels change by noise as in the
frames beside it; in a repeated picture, fewer. Where nothing moves, a repeated picture says the same as a new one, and
need not be known.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import percentile_filter

#: Distance between the pixels that are compared, along each side of an image; a place has 2 x 2 of these pixels.
_SPARSE = 4
#: Frames, on each side, whose changes tell the usual change at a frame, and which of these changes, in percent: more
#: frames than this may be repeated without being usual.
_AROUND, _PERCENT = 90, 75
#: Largest change of a picture that MPEG-4 or H.264 encodes again, grey levels (measured, as a dark square that moves by
#: half a pixel: 7); and share of the usual change, which noise raises, below which a frame shows nothing new.
_ENCODED_AGAIN, _NOTHING_NEW = 6.0, 0.4
#: Number of pixels that change in a repeated frame, as a share of the number in its neighbours: measured up to 0.77, in
#: new frames from 0.86.
_LESS_NOISE = 0.8
#: Number of frames before and after in which motion that stops, or begins, does so gradually.
_GRADUAL = 6
#: Largest number of repeated frames that differ at all. Longer ones may show what has left the image and comes back.
_LONGEST = 30


class FrameChanges:
    """How much each frame differs from the frame before.

    Attributes:
        found: change of each frame at the place where it differs most, grey levels, and share of the pixels that
            differ; NaN for the first frame.
    """

    def __init__(self) -> None:
        self.found: list[tuple[float, float]] = []
        self._before: UInt8[np.ndarray, "rows columns"] | None = None

    def add(self, image: UInt8[np.ndarray, "height width *channels"]) -> None:
        """The next frame, BGR or grey; it is not kept."""
        sparse = image[::_SPARSE, ::_SPARSE]
        sparse = np.ascontiguousarray(sparse[..., 1] if sparse.ndim == 3 else sparse)
        found = np.nan, np.nan
        if self._before is not None:
            apart = cv2.absdiff(sparse, self._before)
            most = cv2.blur(apart.astype(np.float32), (2, 2)).max()
            found = float(most), cv2.countNonZero(apart) / apart.size
        self.found.append(found)
        self._before = sparse


def repeated_frames(changes: Sequence[tuple[float, float]]) -> Bool[np.ndarray, "frames"]:
    """Whether each frame repeats the picture before.

    Such frames lie between frames with the usual change, or last to the end: motion that stops by itself does so
    gradually.

    Args:
        changes: (frames,), as of `FrameChanges.found`.
    """
    change, differing = np.nan_to_num(np.array(changes, float)).reshape(-1, 2).T
    repeated = np.zeros(len(change), bool)
    if len(change) < 3:
        return repeated
    change[0] = change[1]
    usual = percentile_filter(change, _PERCENT, 2 * _AROUND + 1)
    nothing_new = change <= np.minimum(_ENCODED_AGAIN, _NOTHING_NEW * usual)
    nothing_new[0] = False
    edges = np.flatnonzero(np.diff(nothing_new.astype(np.int8), prepend=0, append=0))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        # Nearest first.
        sides = change[max(1, start - _GRADUAL) : start][::-1], change[stop : stop + _GRADUAL]
        least = max(_ENCODED_AGAIN / _NOTHING_NEW, usual[start] / 2)
        sudden = [side[0] >= max(least, side.max() / 2) for side in sides if len(side)]
        is_same = np.median(change[start:stop]) == 0
        between = len(sudden) == len(sides) and stop - start <= _LONGEST
        beside = [differing[place] for place in (start - 1, stop) if 0 < place < len(change)]
        less_noise = np.median(differing[start:stop]) <= _LESS_NOISE * min(beside, default=0)
        repeated[start:stop] = any(sudden) and all(sudden) and (is_same or between) and less_noise
    return repeated

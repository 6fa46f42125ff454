"""Frames whose foreground makes no sense: foreground everywhere in the image.

A camera that was pushed, a light that the background model does not follow, rain on the lens: most parts of the image
differ from the background, and no drone can be told from the rest. Such a frame is left out, as if the camera had no
frame at that time.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, UInt8

from psotrack.foreground.silhouettes.settings import MIN_COVERAGE

#: Parts along the longer side of the image.
_PARTS = 16
#: Share of the parts with foreground from which on foreground is everywhere. Ten drones of a part's size touch 40 of
#: 144 parts; a single drone that touches more than half of them is nearer than its distance can be told from its size.
_MOST_PARTS = 0.5
#: Shortest interval that is left out, frames. A single frame, such as the key frame of a codec with its speckle, does
#: the tracker less harm than a camera that is missing.
LEAST_FRAMES = 3

#: First frame and the frame after the last of one interval.
Interval = tuple[int, int]


def foreground_is_everywhere(
    silhouettes: UInt8[np.ndarray, "frames height width"],
) -> Bool[np.ndarray, "frames"]:
    """Whether most parts of each silhouette have foreground.

    Args:
        silhouettes: (frames, height, width), coverage, 0 to 255.
    """
    height, width = silhouettes.shape[1:]
    side = max(1, -(-max(height, width) // _PARTS))
    of_rows = np.maximum.reduceat(silhouettes, np.arange(0, height, side), axis=1)
    most = np.maximum.reduceat(of_rows, np.arange(0, width, side), axis=2)
    return np.asarray((most >= MIN_COVERAGE).mean(axis=(1, 2)) > _MOST_PARTS)


def intervals_of(chosen: Bool[np.ndarray, "frames"], least_frames: int = 1) -> list[Interval]:
    """The intervals of the chosen frames that have at least `least_frames` frames, in order."""
    changes = np.flatnonzero(np.diff(chosen.astype(np.int8), prepend=0, append=0))
    return [
        (int(start), int(stop))
        for start, stop in zip(changes[::2], changes[1::2], strict=True)
        if stop - start >= least_frames
    ]


def in_words(intervals: list[Interval], *, gap_frames: int) -> str:
    """Intervals as text: "120 to 180, 300"; those with shorter gaps between them than `gap_frames` as one interval."""
    joined: list[Interval] = []
    for start, stop in intervals:
        if joined and start - joined[-1][1] < gap_frames:
            start, _ = joined.pop()
        joined.append((start, stop))
    return ", ".join(f"{start} to {stop - 1}" if stop - start > 1 else f"{start}" for start, stop in joined)

"""The first look at a video: frames from which a background is learned, without decoding the video twice.

The first frames are decoded once and held, reduced. Frames from the rest of the video are reached by seeking, a few
frames each after a key frame, at most a small share of the video. A frame that is looked at stands for all frames that
are nearer to it than to another: its weight.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator

import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.silhouettes.foreground import learning_step, reduce_frame
from psotrack.foreground.silhouettes.settings import ForegroundSettings
from psotrack.recordings import VideoInfo, read_near

#: Memory for the frames that are held, bytes: 10 s of a video of 1920 x 1080 pixels, reduced by 4.
_HELD_BYTES = 96 * 2**20
#: Frames that are looked at in the rest of the video: one of 200, and at least 4, which is enough to tell what
#: stays at its place from what flies on.
_LATER_SHARE, _LEAST_LATER = 200, 4
#: Largest number of frames that are looked at: more do not tell better what most frames show.
_MOST_LOOKED_AT = 25

_Image = UInt8[np.ndarray, "height width 3"]


def look_first(
    video: VideoInfo, frames: Iterator[_Image], settings: ForegroundSettings
) -> tuple[list[tuple[float, _Image]], Iterator[_Image]]:
    """Weights and reduced frames from the whole video, and all frames in their order, reduced.

    Args:
        video: the video.
        frames: its frames; they are read once.
        settings: `working_reduction` and `num_learning_frames` are used.
    """
    reduced = (reduce_frame(frame, settings) for frame in frames)
    held: deque[_Image] = deque(itertools.islice(reduced, 1))
    if held:
        held.extend(itertools.islice(reduced, _HELD_BYTES // held[0].nbytes - 1))
    step = learning_step(video.num_frames, settings)
    step = max(step, -(-video.num_frames // _MOST_LOOKED_AT))
    chosen = {index: held[index] for index in range(0, len(held), step)}
    num_later = video.num_frames - len(held)
    if num_later > 0:
        count = min(-(-num_later // step), max(_LEAST_LATER, num_later // _LATER_SHARE))
        places = len(held) + (np.arange(count) + 0.5) * num_later / count
        later = read_near(video, places.astype(int).tolist())
        chosen |= {index: reduce_frame(frame, settings) for index, frame in later if index >= len(held)}
    weights = _weights(list(chosen), video.num_frames) if num_later > 0 else [1.0] * len(chosen)
    return list(zip(weights, chosen.values(), strict=True)), _all(held, reduced)


def _weights(chosen: list[int], num_frames: int) -> list[float]:
    """Number of frames that are nearest to each of the chosen ones, which are in their order."""
    middles = (np.array(chosen[:-1]) + chosen[1:]) / 2
    weights: list[float] = np.diff(middles, prepend=0.0, append=num_frames).tolist()
    return weights


def _all(held: deque[_Image], coming: Iterator[_Image]) -> Iterator[_Image]:
    while held:
        yield held.popleft()
    yield from coming

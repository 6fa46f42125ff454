"""When frames were filmed, from the times that their stream carries, on the clock of this computer."""

from __future__ import annotations

import numpy as np

#: Time over which the least delay of a stream is taken, seconds.
_BLOCK_S = 2.0
#: The least delays of two blocks that differ by more do not come from one clock, seconds: 0.5 % of `_BLOCK_S`, a frame
#: that the stream does not count, or a network that is held up for the whole block.
_AGREED_S = 0.01


class StreamClock:
    """Removes the jitter of arrival from the times of a stream's frames.

    A frame is filmed at its stream's time plus a delay that nobody knows, and arrives late by an amount that changes
    from frame to frame. The least delay of the last seconds is the one with no such lateness in it. It is found anew
    every two seconds, because two clocks drift apart. The times are used only where the last two least delays agree:
    a stream of JPEG images over HTTP, for instance, carries no times, and FFmpeg invents them at 25 per second.

    Attributes:
        is_used: whether the stream's times are used; None until the first two blocks are over.
    """

    def __init__(self) -> None:
        self.is_used: bool | None = None
        self._ends_s = self._last_s = -np.inf
        self._least_s = self._before_s = np.inf

    def time_s(self, stream_s: float, arrived_s: float) -> float:
        """When a frame would have arrived without jitter; its arrival where the stream's times cannot be used.

        Args:
            stream_s: the frame's time in the stream, seconds.
            arrived_s: when it arrived, seconds of `time.monotonic`.
        """
        if arrived_s >= self._ends_s:
            self._end_block(arrived_s)
        # A time that does not increase is none, and agrees with nothing.
        delay_s = arrived_s - stream_s if stream_s > self._last_s else -np.inf
        self._last_s = stream_s
        self._least_s = min(self._least_s, delay_s)
        least_s = min(self._least_s, self._before_s)
        return stream_s + least_s if self.is_used and np.isfinite(least_s) else arrived_s

    def _end_block(self, now_s: float) -> None:
        least_s = np.array([self._before_s, self._least_s])
        if not np.isposinf(least_s).any():  # else a block had no frame
            self.is_used = bool(np.isfinite(least_s).all() and np.ptp(least_s) <= _AGREED_S)
        self._before_s, self._least_s = self._least_s, np.inf
        self._ends_s = now_s + _BLOCK_S

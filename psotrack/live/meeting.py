"""Frames of several cameras meet at instants, by their times, while they come.

Instants follow one another by 1 / rate. At an instant each camera shows its nearest frame. An instant is complete when
no camera that films can still bring a nearer frame, or when it has waited long enough: a camera without a frame by then
is missing in the instant. A camera that has been silent for long is not waited for, until it films again.

No clock and no thread is used here: the caller says what time it is.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.recordings import REACH

#: A frame is the nearest one if the next frame, which comes this share of an interval later at least, is farther away.
_LEAST_INTERVAL = 0.8
#: A frame that comes sooner after the one before, in intervals, is the same frame again.
_DOUBLED = 0.3
#: A camera or a session whose delay is longer than this share of the longest wait is behind: it does less, before
#: anything is left out.
BEHIND = 0.5
#: A camera has stopped when no frame came for this time, seconds.
STOPPED_S = 1.0


@dataclass
class CameraCounts:
    """What happened to the frames of one camera.

    Attributes:
        frames: frames that came in time.
        missing: instants without a frame of the camera while it filmed.
        late: frames that came after their instant was over.
        doubled: frames that came twice.
        left_out: frames that were not processed, because the computer was too slow, or that did not show the scene.
        stops: how often the camera stopped.
    """

    frames: int = 0
    missing: int = 0
    late: int = 0
    doubled: int = 0
    left_out: int = 0
    stops: int = 0


@dataclass(frozen=True)
class Instant:
    """The frames of all cameras that meet at an instant.

    Attributes:
        number: number of the instant.
        time_s: its time, seconds.
        coverage: silhouette of each camera, by the camera's index; None where a camera has no frame.
        offset_s: (cameras,), time of each camera's frame minus the instant's, seconds; 0 where there is none.
        arrived_s: when the last of the frames came, on the caller's clock.
    """

    number: int
    time_s: float
    coverage: list[UInt8[np.ndarray, "height width"] | None]
    offset_s: Float[np.ndarray, "cameras"]
    arrived_s: float


class _Frame(NamedTuple):
    time_s: float
    coverage: UInt8[np.ndarray, "height width"]
    arrived_s: float


@dataclass
class MeetingCamera:
    """A camera's last frames, and its state.

    Attributes:
        interval_s: time from frame to frame, seconds.
        counts: what happened to its frames.
        films: whether it films, or is waited for because it may.
        has_filmed: whether it has filmed.
        has_ended: whether it will never film again.
        frames: frames that later instants may show.
        in_work_s: time of the frame that is in work; None for no frame.
        last_time_s: time of the last frame.
        last_came_s: when the last frame came, on the caller's clock.
    """

    interval_s: float
    counts: CameraCounts = field(default_factory=CameraCounts)
    films: bool = True
    has_filmed: bool = False
    has_ended: bool = False
    frames: deque[_Frame] = field(default_factory=deque)
    in_work_s: float | None = None
    last_time_s: float = -np.inf
    last_came_s: float = -np.inf

    def nearest(self, at_s: float) -> _Frame | None:
        """The frame that an instant shows; None where it has none so far."""
        near = [frame for frame in self.frames if self.reaches(frame.time_s, at_s)]
        return min(near, key=lambda frame: abs(frame.time_s - at_s), default=None)

    def reaches(self, time_s: float | None, at_s: float) -> bool:
        """Whether an instant may show a frame of a time."""
        return time_s is not None and abs(time_s - at_s) <= REACH * self.interval_s

    def is_decided(self, at_s: float) -> bool:
        """Whether no frame that is still to come can be nearer to an instant than those that came."""
        return not self.films or self.last_time_s >= at_s - _LEAST_INTERVAL / 2 * self.interval_s


class Meeting:
    """Brings frames together.

    Args:
        fps: frames per second of each camera.
        rate_hz: instants per second.
        wait_s: how long an instant waits for cameras, from its first frame on, seconds.
        first_s: time of the first instant, seconds.

    Attributes:
        cameras: state of each camera.
        wait_s: how long an instant waits.
        began_s: when the cameras began, on the caller's clock, infinite before: none has stopped then.
    """

    def __init__(self, fps: list[float], rate_hz: float, *, wait_s: float, first_s: float = 0.0) -> None:
        self.cameras = [MeetingCamera(1 / each) for each in fps]
        self.wait_s, self.began_s = wait_s, np.inf
        self._rate_hz, self._first_s = rate_hz, first_s
        self._next = 0

    def announce(self, index: int, time_s: float, now_s: float) -> bool:
        """A frame of a camera has come, and is in work: its instant waits for `put`.

        Returns:
            Whether the camera was not waited for until now.
        """
        camera = self.cameras[index]
        is_back = not camera.films
        camera.films, camera.has_filmed = True, True
        camera.last_came_s, camera.in_work_s = now_s, time_s
        return is_back

    def put(
        self, index: int, time_s: float, coverage: UInt8[np.ndarray, "height width"] | None, arrived_s: float
    ) -> None:
        """The silhouette of a frame.

        Args:
            index: the camera.
            time_s: when the frame was filmed, on the recording's clock.
            coverage: the silhouette; None for a frame that is left out.
            arrived_s: when the frame came, on the caller's clock.
        """
        camera = self.cameras[index]
        counts, camera.in_work_s = camera.counts, None
        if coverage is not None and time_s - camera.last_time_s < _DOUBLED * camera.interval_s:
            counts.doubled += 1
            return
        camera.last_time_s = max(camera.last_time_s, time_s)
        if coverage is None:
            counts.left_out += 1
        elif time_s + REACH * camera.interval_s < self._next_s:
            counts.late += 1
        else:
            counts.frames += 1
            camera.frames.append(_Frame(time_s, coverage, arrived_s))

    def end(self, index: int) -> None:
        """A camera has ended for good: it is not waited for."""
        camera = self.cameras[index]
        camera.films, camera.has_ended, camera.in_work_s = False, True, None

    def stopped(self, now_s: float) -> list[int]:
        """Cameras that have just stopped, or have not begun in time; they are not waited for until they film."""
        found = []
        for index, camera in enumerate(self.cameras):
            if camera.films and now_s - max(camera.last_came_s, self.began_s) > STOPPED_S:
                camera.films = False
                camera.counts.stops += camera.has_filmed
                found.append(index)
        return found

    @property
    def _next_s(self) -> float:
        """Time of the next instant."""
        return self._first_s + self._next / self._rate_hz

    @property
    def has_ended(self) -> bool:
        """Whether all cameras have ended, and no frame waits."""
        return all(camera.has_ended and not camera.frames for camera in self.cameras)

    def take(self, now_s: float) -> Instant | None:
        """The next instant, if it is complete or has waited long enough; instants that no camera films are passed."""
        while not any(shown := [camera.nearest(self._next_s) for camera in self.cameras]):
            if not self._is_over(self._next_s):
                return None
            self._next += 1
        at_s, period_s = self._next_s, 1 / self._rate_hz
        arrived_s = [frame.arrived_s for frame in shown if frame]
        is_decided = all(camera.is_decided(at_s) for camera in self.cameras)
        is_in_work = any(camera.reaches(camera.in_work_s, at_s) for camera in self.cameras)
        if is_in_work or not (is_decided or now_s - min(arrived_s) >= self.wait_s):
            return None
        for camera, frame in zip(self.cameras, shown, strict=True):
            camera.counts.missing += camera.films and not frame
            # The next instant needs no frame that is too far before it.
            while camera.frames and camera.frames[0].time_s + REACH * camera.interval_s < at_s + period_s:
                camera.frames.popleft()
        self._next += 1
        offset_s = np.array([frame.time_s - at_s if frame else 0.0 for frame in shown])
        offset_s[np.abs(offset_s) < 1e-6 * period_s] = 0.0
        coverage = [frame.coverage if frame else None for frame in shown]
        return Instant(self._next - 1, at_s, coverage, offset_s, max(arrived_s))

    def _is_over(self, at_s: float) -> bool:
        """Whether a later frame shows that an instant that no frame shows will stay without frames."""
        return any(camera.frames and camera.frames[0].time_s > at_s for camera in self.cameras) and all(
            not camera.films or camera.last_time_s > at_s + REACH * camera.interval_s
            for camera in self.cameras
        )

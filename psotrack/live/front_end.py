"""The front end of a session: a thread for each camera turns frames into silhouettes, which meet at instants.

OpenCV does not hold Python's lock while it works, so the threads use all processors. What they share is changed under
one lock.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from psotrack.live.addresses import ANSWER_S
from psotrack.live.cameras import LiveCamera
from psotrack.live.meeting import CameraCounts, Instant, Meeting
from psotrack.live.recorder import CLOSE_S, RecordedCounts
from psotrack.live.sources import SourceFrame
from psotrack.silhouettes import ForegroundSettings, LivingBackground, coverage, ignored_pixels, reduce_frame

logger = logging.getLogger(__name__)

#: Largest number of complete instants that wait for the tracker: more are left out, so that the delay does not grow.
_MOST_WAITING = 3
#: Longest time that a camera waits for the silhouettes of others before it learns, seconds.
_LONGEST_TURN_S = 0.02
#: Longest time for which the session waits for frames before it looks what is to be done without them, seconds.
_LOOK_S = 0.005
#: Time from the start of the sources to the recording's time 0, seconds.
_LEAD_S = 0.2
#: Longest time that the threads have to end, seconds: OpenCV waits 10 s for a device that does not answer.
_END_S = 10.0 + ANSWER_S + CLOSE_S


class FrontEnd:
    """Cameras that film, as a context manager: `begin` lets them, and `instants` are what they show.

    Args:
        cameras: the cameras.
        settings: settings of the silhouettes.
        rate_hz: instants per second.
        first_s: time of the first instant on the recording's clock, seconds.
        wait_s: how long an instant waits for cameras, seconds. A frame that has waited for longer is left out, so that
            the delay does not grow.

    Attributes:
        errors: errors that have ended cameras.
        recorded: what happened to the frames that are kept, by the camera's name; complete at the end.
    """

    def __init__(
        self,
        cameras: Sequence[LiveCamera],
        settings: ForegroundSettings,
        rate_hz: float,
        *,
        first_s: float,
        wait_s: float,
    ) -> None:
        self._cameras, self._settings, self._wait_s = cameras, settings, wait_s
        self._meeting = Meeting([each.fps for each in cameras], rate_hz, wait_s=wait_s, first_s=first_s)
        self._changed = threading.Condition()
        # No `threading.Event`: a signal handler that interrupts `set` and calls it again would wait for ever.
        self._is_stopped = False
        self._began_s: float | None = None
        self._ready: set[int] = set()
        #: Cameras that have never filmed, as they say, or will not film again.
        self._missing: set[int] = set()
        self._said = [""] * len(cameras)
        self.errors: list[Exception] = []
        self.recorded: dict[str, RecordedCounts] = {}

    def __enter__(self) -> FrontEnd:
        # As many threads as cameras: more for each of them would only wait.
        self._num_opencv_threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        self._threads = [
            threading.Thread(target=self._film, args=each, daemon=True) for each in enumerate(self._cameras)
        ]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        with self._changed:
            self._changed.notify_all()
        ends_s = time.monotonic() + _END_S
        for thread in self._threads:
            thread.join(max(0.0, ends_s - time.monotonic()))
        cv2.setNumThreads(self._num_opencv_threads)

    def stop(self) -> None:
        """Let the cameras end; from any thread or signal handler."""
        self._is_stopped = True

    def begin(self, longest_s: float) -> float:
        """Wait until all sources are ready, and let the cameras film.

        Args:
            longest_s: time after which there are no more instants, seconds.

        Returns:
            The time at which the recording's clock shows 0, `time.monotonic`.
        """
        with self._changed:
            self._changed.wait_for(lambda: len(self._ready) == len(self._cameras))
            self._began_s = self._meeting.began_s = time.monotonic() + _LEAD_S
            self._ends_s = self._began_s + longest_s
            self._changed.notify_all()
        return self._began_s

    @property
    def counts(self) -> dict[str, CameraCounts]:
        """Counts of each camera, by name."""
        return {
            camera.name: each.counts
            for camera, each in zip(self._cameras, self._meeting.cameras, strict=True)
        }

    @property
    def films(self) -> list[bool]:
        """Whether each camera films."""
        return [camera.films for camera in self._meeting.cameras]

    @property
    def num_able(self) -> int:
        """Number of cameras that film, or have filmed and may come back."""
        return len(self._cameras) - len(self._missing)

    def instants(self) -> Iterator[tuple[Instant, int]]:
        """Yield instants that are complete, and how many were left out before each."""
        while not self._is_stopped and self.num_able >= 2 and time.monotonic() < self._ends_s:
            with self._changed:
                now_s = time.monotonic()
                self._tell_stopped(now_s)
                ready = list(iter(partial(self._meeting.take, now_s), None))
                if not ready:
                    if self._meeting.has_ended:
                        return
                    self._changed.wait(_LOOK_S)
            num_left_out = max(0, len(ready) - _MOST_WAITING)
            for instant in ready[num_left_out:]:
                yield instant, num_left_out
                num_left_out = 0

    def _tell_stopped(self, now_s: float) -> None:
        for index in self._meeting.stopped(now_s):
            name = self._cameras[index].name
            if self._meeting.cameras[index].has_filmed:
                logger.warning("camera %s has stopped", name)
            elif not self._said[index]:  # else it is said already why
                logger.warning("camera %s: no frame came so far", name)

    # The thread of a camera

    def _film(self, index: int, camera: LiveCamera) -> None:
        """Frames to silhouettes."""
        try:
            CameraSilhouettes(self._settings, camera.name, None).warm_up()
            silhouettes = CameraSilhouettes(self._settings, camera.name, camera.ignore)
            begin, stopped = partial(self._wait_to_begin, index), lambda: self._is_stopped
            with contextlib.closing(camera.source.frames(begin, stopped)) as frames:
                for frame in itertools.takewhile(lambda _: not self._is_stopped, frames):
                    if isinstance(frame, str):
                        self._say(index, frame)
                    else:
                        self._take(index, frame, silhouettes)
        except Exception as error:
            logger.warning("camera %s: %s", camera.name, error)
            self.errors.append(error)
            self._missing.add(index)
        finally:
            with self._changed:
                self._ready.add(index)
                self._meeting.end(index)
                self._changed.notify_all()
            if camera.recorder is not None:
                self.recorded[camera.name] = camera.recorder.close()

    def _wait_to_begin(self, index: int) -> float:
        with self._changed:
            self._ready.add(index)
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._began_s is not None or self._is_stopped)
        return self._began_s or 0.0

    def _say(self, index: int, line: str) -> None:
        with self._changed:
            if line != self._said[index]:
                logger.warning("camera %s: %s", self._cameras[index].name, line)
            self._said[index] = line
            if not self._meeting.cameras[index].has_filmed:
                self._missing.add(index)

    def _take(self, index: int, frame: SourceFrame, silhouettes: CameraSilhouettes) -> None:
        """A frame: what the tracker waits for comes first."""
        camera, meeting = self._cameras[index], self._meeting
        with self._changed:
            self._said[index] = ""
            self._missing.discard(index)
            again = " again" if meeting.cameras[index].has_filmed else ""
            if meeting.announce(index, frame.time_s, time.monotonic()):
                logger.warning("camera %s films%s", camera.name, again)
        image = None
        if time.monotonic() - frame.arrived_s > self._wait_s:
            silhouettes.leave_out()
        else:
            image = silhouettes.look(frame.image)
        with self._changed:
            meeting.put(index, frame.time_s, image, frame.arrived_s)
            self._changed.notify_all()
            if image is not None:
                # Silhouettes of other cameras come first, which the tracker waits for.
                self._changed.wait_for(lambda: not meeting.has_work, _LONGEST_TURN_S)
        if image is not None:
            silhouettes.learn()
        if camera.recorder is not None:
            camera.recorder.write(frame.image, frame.time_s)


class CameraSilhouettes:
    """Silhouettes of one camera's frames, whose background is learned as they come.

    Args:
        settings: settings of the silhouettes.
        name: name of the camera, for messages.
        ignore: image that is white where nothing counts as foreground; None for no such image.
    """

    def __init__(self, settings: ForegroundSettings, name: str, ignore: Path | None) -> None:
        self._settings, self._name, self._ignore = settings, name, ignore
        self._ignored: Bool[np.ndarray, "rows columns"] | None = None
        self._background: LivingBackground | None = None
        self._num_frames = 1

    def leave_out(self) -> None:
        """The next frame is not seen."""
        self._num_frames += 1

    def look(self, frame: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """The silhouette of the next frame; `learn` is to be called before the frame after it."""
        image = reduce_frame(frame, self._settings)
        if self._background is None:
            self._background = LivingBackground(self._settings, image)
            if self._ignore is not None:
                size_wh = frame.shape[1], frame.shape[0]
                self._ignored = ignored_pixels(
                    self._ignore, self._name, size_wh, self._settings.working_reduction
                )
        mask = self._background.look(image, num_frames=self._num_frames)
        self._num_frames = 1
        if self._ignored is not None:
            mask = np.where(self._ignored, np.uint8(0), mask)
        return coverage(mask, self._settings.reduction // self._settings.working_reduction)

    def learn(self) -> None:
        """Learn from the last frame."""
        assert self._background is not None
        self._background.learn()

    def warm_up(self) -> None:
        """Do once what is slow the first time."""
        for level in (0, 9):
            self.look(np.full((270, 480, 3), level, np.uint8))
            self.learn()

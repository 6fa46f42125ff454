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
from collections.abc import Generator, Iterator, Sequence
from functools import partial

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    LivingBackground,
    coverage,
    ignored_pixels,
    reduce_frame,
)
from psotrack.live.meeting import STOPPED_S, Instant, Meeting
from psotrack.live.recorder import CLOSE_S, RecordedCounts
from psotrack.live.sources import ANSWER_S, LiveCamera, SourceFrame
from psotrack.support import processors

logger = logging.getLogger(__name__)

#: Largest number of complete instants that wait for the tracker: more are left out, so that the delay does not grow.
_MOST_WAITING = 3
#: Longest time that a camera waits for the silhouettes of others before it learns, seconds.
_LONGEST_TURN_S = 0.02
#: Longest time for which the session waits for frames before it looks what is to be done without them, seconds.
_LOOK_S = 0.005
#: What is said of a camera whose images have not shown its scene for as long as one that has stopped.
_UNSEEN = "its images do not show the scene: too dark, too bright, of one colour, or another picture"
#: Time from the start of the sources to the recording's time 0, seconds.
_LEAD_S = 0.2
#: Longest time that the threads have to end, seconds: OpenCV waits 10 s for a device that does not answer.
_END_S = 10.0 + ANSWER_S + CLOSE_S


class FrontEnd:
    """Cameras that film, and the instants that they show.

    Args:
        cameras: the cameras.
        settings: settings of the silhouettes.
        meeting: brings their frames together. A frame that has waited for longer than an instant does is left out, so
            that the delay does not grow.

    Attributes:
        num_left_out: number of complete instants that were left out, because the tracker was too slow.
        errors: errors that have ended cameras, by the camera's index.
        recorded: what happened to the frames that are kept, by the camera's name; complete at the end.
    """

    def __init__(self, cameras: Sequence[LiveCamera], settings: ForegroundSettings, meeting: Meeting) -> None:
        self._cameras, self._settings, self._meeting = cameras, settings, meeting
        self._changed = threading.Condition()
        self._ready = threading.Semaphore(0)
        # More threads than processors at once would only take Python's lock from each other.
        self._turns = threading.Semaphore(processors())
        # No `threading.Event`: a signal handler that interrupts `set` and calls it again would wait for ever.
        self._is_stopped = False
        self._said = [""] * len(cameras)
        self._shown_s = [np.inf] * len(cameras)
        self.num_left_out = 0
        self.errors: dict[int, Exception] = {}
        self.recorded: dict[str, RecordedCounts] = {}

    @property
    def num_able(self) -> int:
        """Number of cameras that film, or have filmed and may come back, or have said nothing so far."""
        states = zip(self._meeting.cameras, self._said, strict=True)
        is_able = [state.has_filmed or not said for state, said in states]
        return sum(able and index not in self.errors for index, able in enumerate(is_able))

    def stop(self) -> None:
        """Let the cameras end; from any thread or signal handler."""
        self._is_stopped = True

    def instants(self, longest_s: float) -> Generator[Instant]:
        """Let the cameras film, and yield the instants that are complete; to be closed, which ends the cameras.

        Args:
            longest_s: time after which there are no more instants, seconds.
        """
        num_opencv_threads = cv2.getNumThreads()
        # As many threads as cameras: more for each of them would only wait.
        cv2.setNumThreads(1)
        threads = [
            threading.Thread(target=self._film, args=each, daemon=True) for each in enumerate(self._cameras)
        ]
        for thread in threads:
            thread.start()
        try:
            for _ in threads:
                self._ready.acquire()
            with self._changed:
                self._meeting.began_s = time.monotonic() + _LEAD_S
                self._changed.notify_all()
            yield from self._complete(self._meeting.began_s + longest_s)
        finally:
            self.stop()
            with self._changed:
                self._changed.notify_all()
            ends_s = time.monotonic() + _END_S
            for thread in threads:
                thread.join(max(0.0, ends_s - time.monotonic()))
            cv2.setNumThreads(num_opencv_threads)

    def _complete(self, ends_s: float) -> Iterator[Instant]:
        while not self._is_stopped and self.num_able >= 2 and time.monotonic() < ends_s:
            with self._changed:
                now_s = time.monotonic()
                self._tell_stopped(now_s)
                ready = list(iter(partial(self._meeting.take, now_s), None))
                if not ready:
                    if self._meeting.has_ended:
                        return
                    self._changed.wait(_LOOK_S)
            self.num_left_out += max(0, len(ready) - _MOST_WAITING)
            yield from ready[-_MOST_WAITING:]

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
        silhouettes = CameraSilhouettes(self._settings, camera)
        try:
            with contextlib.closing(camera.source.frames(self._begin, lambda: self._is_stopped)) as frames:
                for frame in itertools.takewhile(lambda _: not self._is_stopped, frames):
                    if isinstance(frame, str):
                        self._say(index, frame)
                    else:
                        self._take(index, frame, silhouettes)
        except Exception as error:
            logger.warning("camera %s: %s", camera.name, error)
            self.errors[index] = error
        finally:
            self._ready.release()  # where it ended before it was ready
            with self._changed:
                self._meeting.end(index)
                self._changed.notify_all()
            if camera.recorder is not None:
                self.recorded[camera.name] = camera.recorder.close()

    def _begin(self) -> float:
        """Wait until all sources are ready."""
        self._ready.release()
        with self._changed:
            self._changed.wait_for(lambda: self._meeting.began_s < np.inf or self._is_stopped)
        return self._meeting.began_s

    def _say(self, index: int, line: str) -> None:
        with self._changed:
            if line and line != self._said[index]:
                logger.warning("camera %s: %s", self._cameras[index].name, line)
            self._said[index] = line

    def _take(self, index: int, frame: SourceFrame, silhouettes: CameraSilhouettes) -> None:
        """A frame: what the tracker waits for comes first."""
        camera, meeting = self._cameras[index], self._meeting
        # That of the middle row of a rolling shutter, as in a recording.
        time_s = frame.time_s + camera.line_time_s * frame.image.shape[0] / 2
        with self._changed:
            again = " again" if meeting.cameras[index].has_filmed else ""
            if meeting.announce(index, time_s, time.monotonic()):
                logger.warning("camera %s films%s", camera.name, again)
        with self._turns:
            is_late = time.monotonic() - frame.arrived_s > meeting.wait_s
            image = silhouettes.look(None if is_late else frame.image)
        if image is not None:
            self._shown_s[index] = time_s
        is_unseen = not is_late and time_s - self._shown_s[index] > STOPPED_S
        self._say(index, _UNSEEN if is_unseen else "")
        with self._changed:
            meeting.put(index, time_s, image, frame.arrived_s)
            self._changed.notify_all()
            if not is_late:
                # Silhouettes of other cameras come first, which the tracker waits for.
                self._changed.wait_for(lambda: not meeting.has_work, _LONGEST_TURN_S)
        if not is_late:
            with self._turns:
                silhouettes.learn()
        if camera.recorder is not None:
            camera.recorder.write(frame.image, frame.time_s)


class CameraSilhouettes:
    """Silhouettes of one camera's frames, whose background is learned as they come.

    Args:
        settings: settings of the silhouettes.
        camera: the camera.
    """

    def __init__(self, settings: ForegroundSettings, camera: LiveCamera) -> None:
        self._settings, self._camera = settings, camera
        self._background: LivingBackground | None = None
        self._num_frames = 0

    def look(
        self, frame: UInt8[np.ndarray, "height width 3"] | None
    ) -> UInt8[np.ndarray, "rows columns"] | None:
        """The silhouette of the next frame; None for a frame that is left out, or does not show the scene.

        `learn` comes before the frame after.
        """
        self._num_frames += 1
        if frame is None:
            return None
        settings, ignore = self._settings, self._camera.ignore
        image = reduce_frame(frame, settings)
        if self._background is None:
            self._background = LivingBackground(settings, image)
            self._ignored = None
            if ignore is not None:
                size_wh = frame.shape[1], frame.shape[0]
                self._ignored = ignored_pixels(ignore, self._camera.name, size_wh, settings.working_reduction)
        mask = self._background.look(image, num_frames=self._num_frames)
        self._num_frames = 0
        if mask is None:
            return None
        if self._ignored is not None:
            mask = np.where(self._ignored, np.uint8(0), mask)
        return coverage(mask, settings.reduction // settings.working_reduction)

    def learn(self) -> None:
        """Learn from the last frame."""
        assert self._background is not None
        self._background.learn()

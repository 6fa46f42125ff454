"""The front end of a session: a process for each camera turns frames into silhouettes, which meet at instants.

Threads would wait for Python's lock, which the tracker needs, too.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import logging.handlers
import math
import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator, MutableSequence, Sequence
from dataclasses import replace
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.sharedctypes import RawArray
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import PsotrackError
from psotrack.foreground.silhouettes import (
    ForegroundSettings,
    LivingBackground,
    coverage,
    ignored_pixels,
    reduce_frame,
)
from psotrack.live.meeting import BEHIND, STOPPED_S, Instant, Meeting
from psotrack.live.recorder import CLOSE_S, RecordedCounts
from psotrack.live.sources import ANSWER_S, LiveCamera, SourceFrame
from psotrack.support import with_traceback, workers

logger = logging.getLogger(__name__)

#: Largest number of complete instants that wait for the tracker: more are left out, so that the delay does not grow.
_MOST_WAITING = 3
#: Longest time that a camera waits for the silhouettes of others before it learns, and how often it looks, seconds.
_LONGEST_TURN_S, _TURN_S = 0.02, 0.001
#: Longest time for which the session waits for frames before it looks what is to be done without them, seconds.
_LOOK_S = 0.005
#: What is said of a camera whose images have not shown its scene for as long as one that has stopped.
_UNSEEN = "its images do not show the scene: too dark, too bright, of one colour, or another picture"
#: Time from the start of the sources to the recording's time 0, seconds.
_LEAD_S = 0.2
#: How often the thread that listens to the cameras looks whether the session is over, seconds.
_LISTEN_S = 0.1
#: Longest time that the cameras have to end, seconds: OpenCV waits 10 s for a device that does not answer.
_END_S = 10.0 + ANSWER_S + CLOSE_S
#: A camera that is behind learns every third frame only.
_LEARN_EVERY = 3
#: Lower priority of the processes of cameras, as `nice` counts it: an instant that is complete comes first.
_NICE = 5


class _Ready(NamedTuple):
    """A source is open."""


class _Came(NamedTuple):
    """A frame has come, and is in work."""

    time_s: float


class _Shown(NamedTuple):
    """What a frame showed: see `Meeting.put`."""

    time_s: float
    coverage: UInt8[np.ndarray, "height width"] | None
    arrived_s: float


class _Said(NamedTuple):
    """What is to be said of a camera, once; an empty line: nothing."""

    line: str


class _Ended(NamedTuple):
    """A camera has ended: its error, and what was recorded."""

    error: Exception | None
    recorded: RecordedCounts | None


class _Shared(NamedTuple):
    """Memory that all processes of a session share.

    Attributes:
        is_stopped: one number, not 0 after the session was stopped. No `threading.Event`: a signal handler that
            interrupts `set` and calls it again would wait for ever.
        in_work_s: (cameras,), time of the frame in each camera's hands; infinite for no frame.
    """

    is_stopped: MutableSequence[int]
    in_work_s: MutableSequence[float]


class FrontEnd:
    """Cameras that film, and the instants that they show.

    Args:
        cameras: the cameras; they are picklable, as processes of their own film.
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
        self._shared = _Shared(RawArray("b", 1), RawArray("d", [math.inf] * len(cameras)))
        self._said = [""] * len(cameras)
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
        self._shared.is_stopped[0] = 1

    def instants(self, longest_s: float) -> Generator[Instant]:
        """Let the cameras film, and yield the instants that are complete; to be closed, which ends the cameras.

        Args:
            longest_s: time after which there are no more instants, seconds.
        """
        wait_s = self._meeting.wait_s
        each = [
            (camera, index, self._settings, wait_s, self._shared)
            for index, camera in enumerate(self._cameras)
        ]
        with workers(_film, each) as connections:
            is_over = threading.Event()
            listener = threading.Thread(target=self._listen, args=(connections, is_over), daemon=True)
            listener.start()
            try:
                for _ in connections:
                    self._ready.acquire()
                with self._changed:
                    self._meeting.began_s = time.monotonic() + _LEAD_S
                for connection in connections:
                    with contextlib.suppress(OSError):  # of a camera that has ended
                        connection.send(self._meeting.began_s)
                yield from self._complete(self._meeting.began_s + longest_s)
            finally:
                self.stop()
                listener.join(_END_S)
                is_over.set()
                listener.join()

    def _complete(self, ends_s: float) -> Iterator[Instant]:
        while not self._shared.is_stopped[0] and self.num_able >= 2 and time.monotonic() < ends_s:
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

    # The thread that listens to the cameras

    def _listen(self, connections: list[Connection], is_over: threading.Event) -> None:
        """Take what the cameras send, until all have ended."""
        filming: dict[Connection, int] = {connection: index for index, connection in enumerate(connections)}
        while filming and not is_over.is_set():
            for ready in wait(list(filming), _LISTEN_S):
                assert isinstance(ready, Connection)
                try:
                    message = ready.recv()
                except (EOFError, OSError):
                    expected, found = "frames", "that the camera's process died"
                    remedy = (
                        "is memory short? is the call in a script outside of `if __name__ == '__main__':`?"
                    )
                    name = self._cameras[filming[ready]].name
                    message = _Ended(PsotrackError(name, expected=expected, found=found, remedy=remedy), None)
                with self._changed:
                    self._hear(filming[ready], message)
                    self._changed.notify_all()
                if isinstance(message, _Ended):
                    del filming[ready]

    def _hear(self, index: int, message: object) -> None:
        name, meeting = self._cameras[index].name, self._meeting
        match message:
            case _Came(time_s):
                again = " again" if meeting.cameras[index].has_filmed else ""
                if meeting.announce(index, time_s, time.monotonic()):
                    logger.warning("camera %s films%s", name, again)
            case _Shown(time_s, image, arrived_s):
                meeting.put(index, time_s, image, arrived_s)
            case _Said(line):
                if line and line != self._said[index]:
                    logger.warning("camera %s: %s", name, line)
                self._said[index] = line
            case logging.LogRecord():
                logging.getLogger(message.name).handle(message)
            case _Ready():
                self._ready.release()
            case _Ended(error, recorded):
                if error is not None:
                    logger.warning("camera %s: %s", name, error)
                    self.errors[index] = error
                if recorded is not None:
                    self.recorded[name] = recorded
                meeting.end(index)
                self._ready.release()  # where it ended before it was ready


def _film(
    camera: LiveCamera,
    index: int,
    settings: ForegroundSettings,
    wait_s: float,
    shared: _Shared,
    connection: Connection,
) -> None:
    """In the process of a camera: send what its frames show, until the session is stopped or the source ends."""
    if hasattr(os, "nice"):
        os.nice(_NICE)
    sending = threading.Lock()  # a recorder warns from a thread of its own

    def send(message: object) -> None:
        with sending:
            connection.send(message)

    def begin() -> float:
        send(_Ready())
        began_s: float = connection.recv()
        return began_s

    def is_stopped() -> bool:
        return bool(shared.is_stopped[0])

    package = logging.getLogger("psotrack")
    package.addHandler(_Sent(send))
    package.setLevel(logging.INFO)  # the parent process knows what is to be told
    _rehearse(settings, camera)
    filming, error, recorded = _Filming(camera, index, settings, wait_s, shared, send), None, None
    try:
        with contextlib.closing(camera.source.frames(begin, is_stopped)) as frames:
            for frame in itertools.takewhile(lambda _: not is_stopped(), frames):
                if isinstance(frame, str):
                    send(_Said(frame))
                else:
                    filming.take(frame)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise
    except Exception as found:
        error = with_traceback(found)
    finally:
        shared.in_work_s[index] = math.inf
        if camera.recorder is not None:
            recorded = camera.recorder.close()
    send(_Ended(error, recorded))


def _rehearse(settings: ForegroundSettings, camera: LiveCamera) -> None:
    """Make silhouettes of noise: the first ones take many times as long as others."""
    silhouettes = CameraSilhouettes(settings, replace(camera, ignore=None))
    for small in np.random.default_rng(0).integers(0, 256, (3, 27, 48, 3), np.uint8):
        silhouettes.look(cv2.resize(small, (1920, 1080)))
        silhouettes.learn()


class _Sent(logging.handlers.QueueHandler):
    """Sends what is logged to the parent process."""

    def __init__(self, send: Callable[[object], None]) -> None:
        super().__init__(queue.SimpleQueue())
        self._send = send

    def enqueue(self, record: logging.LogRecord) -> None:
        self._send(record)


class _Filming:
    """The frames of one camera, in its process."""

    def __init__(
        self,
        camera: LiveCamera,
        index: int,
        settings: ForegroundSettings,
        wait_s: float,
        shared: _Shared,
        send: Callable[[object], None],
    ) -> None:
        self._camera, self._index, self._wait_s, self._shared = camera, index, wait_s, shared
        self._send = send
        self._silhouettes = CameraSilhouettes(settings, camera)
        self._shown_s, self._num_unlearned = math.inf, 0

    def take(self, frame: SourceFrame) -> None:
        """A frame: what the tracker waits for comes first."""
        camera, in_work_s = self._camera, self._shared.in_work_s
        # That of the middle row of a rolling shutter, as in a recording.
        time_s = frame.time_s + camera.line_time_s * frame.image.shape[0] / 2
        in_work_s[self._index] = time_s
        self._send(_Came(time_s))
        is_late = time.monotonic() - frame.arrived_s > self._wait_s
        image = self._silhouettes.look(None if is_late else frame.image)
        if image is not None:
            self._shown_s = time_s
        self._send(_Shown(time_s, image, frame.arrived_s))
        in_work_s[self._index] = math.inf
        is_unseen = not is_late and time_s - self._shown_s > STOPPED_S
        self._send(_Said(_UNSEEN if is_unseen else ""))
        self._num_unlearned += 1
        is_behind = time.monotonic() - frame.arrived_s > BEHIND * self._wait_s
        if not is_late and (not is_behind or self._num_unlearned >= _LEARN_EVERY):
            self._wait_for_others(time_s)
            self._silhouettes.learn()
            self._num_unlearned = 0
        if camera.recorder is not None:
            camera.recorder.write(frame.image, frame.time_s)

    def _wait_for_others(self, time_s: float) -> None:
        """Let the others make the silhouettes of an instant, which the tracker waits for."""
        ends_s = time.monotonic() + _LONGEST_TURN_S
        while min(self._shared.in_work_s) <= time_s and time.monotonic() < ends_s:
            time.sleep(_TURN_S)


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

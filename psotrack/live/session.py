"""A session: silhouettes of live cameras go through the tracker, and its rows to the outputs."""

from __future__ import annotations

import contextlib
import gc
import logging
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from psotrack.errors import InputError, OutputError, PsotrackError
from psotrack.foreground.silhouettes import Exposures, usual_drone_px
from psotrack.live.front_end import FrontEnd
from psotrack.live.meeting import BEHIND, Instant, Meeting, MeetingCamera
from psotrack.live.recorder import RecordedCounts
from psotrack.live.sources import LiveCamera
from psotrack.pipeline import causal_settings, causal_tracker
from psotrack.recordings import Recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import Trajectories

logger = logging.getLogger(__name__)

#: How long an instant waits for cameras, and a frame for the processor, seconds.
WAIT_S = 0.1
#: A session that is behind searches for drones at every third instant only.
_SEARCHES_EVERY = 3
#: Time after which a thread hands on Python's lock, seconds.
_SWITCH_S = 0.0005


#: Takes the rows of each instant: writes them to a file or a stream, or sends them.
RowsOutput = Callable[[Trajectories], object]


@dataclass
class LiveResult:
    """What a session has done.

    Attributes:
        cameras: state of each camera, and what happened to its frames, by name.
        recorded: what happened to the frames that are kept, by the camera's name; complete at the end.
        instants: number of instants that were tracked.
        left_out: number of instants that were left out, because the computer was too slow.
        delay_s: delay of each instant, from the arrival of its last frame to its rows; of the last hour at most.
        failed_outputs: errors of outputs that were given up while others went on.
        drones: names of all drones.
        compile_s: wall time in which programs are compiled before the first frame, seconds.
        seconds: wall time from then on, seconds.
    """

    cameras: dict[str, MeetingCamera]
    recorded: dict[str, RecordedCounts]
    instants: int = 0
    left_out: int = 0
    delay_s: list[float] = field(default_factory=list)
    failed_outputs: list[OutputError] = field(default_factory=list)
    drones: set[str] = field(default_factory=set)
    compile_s: float = 0.0
    seconds: float = 0.0


class LiveSession:
    """Tracks drones while cameras film.

    Args:
        recording: the rig, and what is known of its cameras.
        cameras: cameras with their sources; other cameras of the rig are not used.
        settings: settings of the run.
        most_drones: largest number of drones at one time.
        first_s: time of the first instant on the recording's clock, seconds.
        wait_s: how long an instant waits for cameras, and a frame for the processor, seconds of the wall clock.

    Attributes:
        result: what the session has done so far.
        record: cameras, settings, versions and volume of the run, fit for JSON.
    """

    def __init__(
        self,
        recording: Recording,
        cameras: list[LiveCamera],
        settings: TrackSettings,
        *,
        most_drones: int = 16,
        first_s: float = 0.0,
        wait_s: float = WAIT_S,
    ) -> None:
        settings = causal_settings(settings)
        rig = recording.rig.select([camera.name for camera in cameras])
        sizes_wh = [(int(width), int(height)) for width, height in rig.cameras.image_size_wh]
        scaled = settings.silhouettes.scaled(sizes_wh, usual_drone_px(recording.rig))
        width, height = (-(-np.array(sizes_wh) // scaled.reduction)).max(axis=0).tolist()
        fps = [camera.fps for camera in cameras]
        self._rate_hz = settings.rate_hz or max(fps)
        self._meeting = Meeting(fps, self._rate_hz, wait_s=wait_s, first_s=first_s)
        self._front_end = FrontEnd(cameras, scaled, self._meeting)
        self._shape = len(cameras), height, width
        self._line_time_s = np.array([camera.line_time_s for camera in cameras], np.float32)
        self._tracker, self.record = causal_tracker(
            rig,
            settings,
            fps=self._rate_hz,
            bounds_m=recording.bounds_m,
            reduction=scaled.reduction,
            shape=(height, width),
            most_drones=most_drones,
        )
        states = dict(zip(rig.names, self._meeting.cameras, strict=True))
        self.result = LiveResult(states, self._front_end.recorded)

    def stop(self) -> None:
        """End the session after the present instant; from any thread or signal handler."""
        self._front_end.stop()

    def run(
        self,
        outputs: Sequence[RowsOutput],
        on_instant: Callable[[LiveResult], None] | None = None,
        *,
        longest_s: float = float("inf"),
    ) -> LiveResult:
        """Track until all sources have ended, `stop` is called, or the time is over.

        Args:
            outputs: what takes the rows. One that fails is given up with a warning, and the others go on.
            on_instant: is told of the result so far after each instant.
            longest_s: time after which the session ends, seconds.

        Raises:
            InputError: fewer than two cameras can film, or no frame came.
            OutputError: the last output has failed.
        """
        outputs, result, front_end = list(outputs), self.result, self._front_end
        compiling_s = time.monotonic()
        self._tracker.compile()
        result.compile_s = time.monotonic() - compiling_s
        # What was made so far is not searched for garbage again and again, which takes as long as a frame.
        gc.collect()
        gc.freeze()
        # A camera's thread, and this one, wait for Python's lock no longer than a small part of a frame.
        switch_s = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        try:
            with contextlib.closing(front_end.instants(longest_s)) as instants:
                for instant in instants:
                    self._track(instant, outputs)
                    result.left_out = front_end.num_left_out
                    result.seconds = time.monotonic() - self._meeting.began_s
                    if on_instant is not None:
                        on_instant(result)
                    # A search takes longer than a step: it must not be the reason why frames are left out.
                    is_behind = result.delay_s[-1] > BEHIND * self._meeting.wait_s
                    if not is_behind or result.instants % _SEARCHES_EVERY == 0:
                        self._tracker.look_ahead()
        finally:
            sys.setswitchinterval(switch_s)
            gc.unfreeze()
        self._check()
        return result

    def _check(self) -> None:
        """Raise the error of a session without a result."""
        for error in self._front_end.errors.values():
            if not isinstance(error, PsotrackError):
                raise error
        count, num_able = len(self.result.cameras), self._front_end.num_able
        if num_able < 2 or not self.result.instants:
            expected, found = "at least two cameras that film", f"{num_able} of {count}"
            if num_able >= 2:
                expected, found = "frames", "none until the session ended"
            remedy = "the lines above say why" if num_able < count else ""
            raise InputError("the cameras", expected=expected, found=found, remedy=remedy)

    def _track(self, instant: Instant, outputs: list[RowsOutput]) -> None:
        images = np.zeros(self._shape, np.uint8)
        for image, shown in zip(images, instant.coverage, strict=True):
            if shown is not None:
                image[: shown.shape[0], : shown.shape[1]] = shown
        is_there = np.array([shown is not None for shown in instant.coverage])
        offset_s, share = instant.offset_s.astype(np.float32), is_there.astype(np.float32)
        exposures = Exposures(offset_s, is_there, share, self._line_time_s)
        rows = self._tracker.step(instant.number, instant.time_s, images, exposures)
        result = self.result
        for output in list(outputs):
            try:
                output(rows)
            except OutputError as error:
                outputs.remove(output)
                if not outputs:
                    raise
                logger.warning("%s; tracking goes on with the other outputs", error)
                result.failed_outputs.append(error)
        result.instants += 1
        result.delay_s.append(time.monotonic() - instant.arrived_s)
        del result.delay_s[: -round(3600 * self._rate_hz)]
        result.drones.update(rows.drones)

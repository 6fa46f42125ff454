"""Tracking frame by frame, without the future: for live cameras, and for recordings as if they were live.

The frames are blocks of one. A track begins with the frame after the one in which its drone was found often enough, and
a drone that was lost for long is forgotten, so that neither memory nor time grows.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.foreground.silhouettes import Exposures, border_cells, foreground_is_everywhere
from psotrack.geometry import Rig
from psotrack.support import as_written
from psotrack.tracking.births import TrackCandidate, state_at
from psotrack.tracking.swarm.block import Block, Engine, Setting, make_block
from psotrack.tracking.swarm.parameters import TrackerSettings
from psotrack.tracking.swarm.run import RunInputs, Start, SwarmRun
from psotrack.tracking.swarm.tracker import Rows
from psotrack.trajectories import Trajectories

logger = logging.getLogger(__name__)

#: A drone that was not seen for longer is forgotten, seconds; and what is remembered of the drones' flights.
FORGOTTEN_S, REMEMBERED_S = 30.0, 60.0
#: What is told of a drone besides its position.
_SHOWN = ("velocity_m_s", "covariance_m2", "fitness", "num_cameras", "status")


class StepwiseTracker:
    """Tracks drones through the frames that `step` is given, one after the other.

    Args:
        rig: calibrated cameras.
        settings: settings of the run, with search and score; `drones.count` limits the number of drones at one time.
        fps: instants per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        reduction: image pixels per silhouette pixel, along each side.
        shape: height and width of the silhouettes.
        most_drones: largest number of drones at one time.
    """

    @as_written()
    def __init__(
        self,
        rig: Rig,
        settings: TrackerSettings,
        *,
        fps: float,
        bounds_m: Float[np.ndarray, "2 3"],
        reduction: int,
        shape: tuple[int, int],
        most_drones: int = 16,
    ) -> None:
        self._setting = Setting(rig, reduction, border_cells(rig.cameras.image_size_wh, reduction), fps)
        self._engine = Engine(self._setting)
        self._shape, self._drones = shape, settings.of_run.drones
        self._most = self._drones.count or most_drones
        self._new_run = partial(
            SwarmRun,
            self._setting,
            RunInputs(bounds_m, settings),
            on_cpu=not self._engine.side_by_side,
            most_drones=self._most,
            memory_frames=max(1, round(REMEMBERED_S * fps)),
        )
        self._begin()

    def _begin(self) -> None:
        self._run = self._new_run()
        self._starts: list[Start] = []
        self._was_full = False
        self._latest: tuple[Block, Rows] | None = None

    @as_written()
    def compile(self) -> None:
        """Compile the program for all numbers of drones that may come, so that no frame has to wait for it."""
        coverage = np.zeros((1, len(self._setting.rig), *self._shape), np.uint8)
        zero = np.zeros((1, len(self._setting.rig)), np.float32)
        exposures = Exposures(zero, zero > 0, zero + 1, zero)
        block = make_block(self._setting, np.zeros(1, int), coverage, exposures)
        drones = 0
        while drones < self._most:
            self._run.resize(drones + 1)
            drones = len(self._run.drone)
            self._engine.compile(self._run.job(block, []), block)
        # The first frame takes many times as long as others: it shall be none that is filmed.
        self._begin()
        self.step(0, 0.0, coverage[0], exposures[0])
        self.look_ahead()
        self._begin()

    @as_written()
    def step(
        self,
        instant: int,
        time_s: float,
        coverage: UInt8[np.ndarray, "cameras height width"],
        exposures: Exposures,
    ) -> Trajectories:
        """The drones at the next instant, those that are known so far, in the order of their births.

        Args:
            instant: number of the instant, which grows; by more than 1 where frames were left out.
            time_s: its time, seconds.
            coverage: (cameras, height, width), silhouettes of the frame, 0 to 255.
            exposures: when each camera's frame was exposed, and which cameras have one; NumPy arrays.

        Returns:
            Positions of the bodies' origins, named by the drones' numbers, from 0.
        """
        everywhere = foreground_is_everywhere(coverage)
        is_there = np.asarray(exposures.is_there) & ~everywhere
        coverage = np.where(is_there[:, None, None], coverage, np.uint8(0))
        exposed = replace(exposures, is_there=is_there)
        exposed = Exposures(*(np.asarray(value)[None] for value in vars(exposed).values()))
        elapsed = 1 if self._latest is None else instant - int(self._latest[0].instant[0])
        block = make_block(self._setting, np.array([instant]), coverage[None], exposed, elapsed=elapsed)
        # A track that was to begin in a frame that was left out begins now.
        late_s = [(instant - start.instant) / self._setting.fps for start in self._starts]
        starts = [
            replace(start, instant=instant, position_m=start.position_m + late * start.velocity_m_s)
            for start, late in zip(self._starts, late_s, strict=True)
        ]
        ((slots, rows),) = self._engine.track([self._run.job(block, starts)], block)
        self._starts = []
        self._run.finish(block, slots, rows)
        self._latest = block, rows
        return self._of_known(rows, instant, time_s)

    @as_written()
    def look_ahead(self) -> None:
        """What need not be done before the rows of a frame are passed on: births, and drones that are forgotten.

        Tracks that begin do so in the next frame.
        """
        assert self._latest is not None, "step comes first"
        block, rows = self._latest
        run, instant = self._run, int(block.instant[0])

        def begin(candidate: TrackCandidate) -> tuple[int, np.ndarray, np.ndarray]:
            last = max(candidate.path)
            position_m, velocity_m_s = state_at(candidate.path, last, run.limits)
            ago_s = (instant + 1 - last) / run.limits.fps
            return instant + 1, position_m + ago_s * velocity_m_s, velocity_m_s

        self._starts = run.plan(run.search(block, rows, run.slots), block, rows, begin)
        run.forget(instant - round(FORGOTTEN_S * run.limits.fps))
        if len(run.known) == self._most and not self._was_full and self._drones.count is None:
            logger.warning("%d drones are tracked; further drones are left out (--most-drones)", self._most)
            self._was_full = True

    def _of_known(self, rows: Rows, instant: int, time_s: float) -> Trajectories:
        number, body_offset_m = self._run.drone, np.array(self._drones.body_offset_m, np.float32)
        slots = sorted(self._run.known, key=lambda slot: int(number[slot]))
        known = {name: np.asarray(getattr(rows, name))[:, slots] for name in _SHOWN}
        known["covariance_m2"] = known["covariance_m2"] + (
            self._drones.origin_uncertainty_m or 0.0
        ) ** 2 * np.eye(3)
        found = Trajectories(
            frame=np.array([instant]),
            time_s=np.array([time_s]),
            drones=tuple(f"{number[slot]}" for slot in slots),
            position_m=np.asarray(rows.position_m)[:, slots] - body_offset_m,
            **known,
        )
        return found.without_lost()

"""Tracking frame by frame, without the future: for live cameras, and for recordings as if they were live.

The frames are blocks of one. A track begins with the frame after the one in which its drone was found often enough, and
a drone that was lost for long is forgotten, so that neither memory nor time grows.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import Rig
from psotrack.initiation import TrackCandidate, state_at
from psotrack.silhouettes import Exposures, border_cells, foreground_is_everywhere
from psotrack.tracking.block import Block, Engine, Setting, make_block
from psotrack.tracking.parameters import TrackerSettings
from psotrack.tracking.run import RunInputs, Start, SwarmRun
from psotrack.tracking.tracker import Rows
from psotrack.trajectories import Status

logger = logging.getLogger(__name__)

#: A drone that was not seen for longer is forgotten, seconds; and what is remembered of the drones' flights.
FORGOTTEN_S, REMEMBERED_S = 30.0, 60.0


@dataclass(frozen=True)
class DroneRow:
    """One drone in one frame.

    Attributes:
        drone: number of the drone, from 0 in the order of their births.
        position_m, velocity_m_s: (3,), metres and m/s.
        covariance_m2: (3, 3), covariance of the position.
        fitness: score in [0, 1].
        num_cameras: number of cameras that see the drone.
        status: tracked, coasting or lost.
    """

    drone: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    fitness: float
    num_cameras: int
    status: Status


class StepwiseTracker:
    """Tracks drones through the frames that `step` is given, one after the other.

    Args:
        rig: calibrated cameras.
        settings: the tracker's parts of the settings; `drones.count` limits the number of drones at one time.
        fps: instants per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        reduction: image pixels per silhouette pixel, along each side.
        shape: height and width of the silhouettes.
        most_drones: largest number of drones at one time.
    """

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
        self._shape, self._limited = shape, settings.drones.count is not None
        self._most = settings.drones.count or most_drones
        self._run = SwarmRun(
            self._setting,
            RunInputs(bounds_m, settings),
            on_cpu=not self._engine.side_by_side,
            most_drones=self._most,
            memory_frames=max(1, round(REMEMBERED_S * fps)),
        )
        self._starts: list[Start] = []
        self._instant = -1
        self._was_full = False
        self._latest: tuple[Block, Rows] | None = None

    def compile(self) -> None:
        """Compile the program for all numbers of drones that may come, so that no frame has to wait for it."""
        coverage = np.zeros((1, len(self._setting.rig), *self._shape), np.uint8)
        zero = np.zeros((1, len(self._setting.rig)), np.float32)
        block = make_block(
            self._setting, np.zeros(1, int), coverage, Exposures(zero, zero > 0, zero + 1, zero)
        )
        drones = 0
        while drones < self._most:
            self._run.resize(drones + 1)
            drones = len(self._run.drone)
            self._engine.track([self._run.job(block, [])], block)
        self._run.resize(0)

    def step(
        self,
        coverage: UInt8[np.ndarray, "cameras height width"],
        exposures: Exposures,
        *,
        num_frames: int = 1,
    ) -> list[DroneRow]:
        """The drones in the next frame: those that are known so far.

        Args:
            coverage: (cameras, height, width), silhouettes of the frame, 0 to 255.
            exposures: when each camera's frame was exposed, and which cameras have one; NumPy arrays.
            num_frames: instants since the last frame; above 1 where frames were left out.
        """
        everywhere = foreground_is_everywhere(coverage)
        is_there = np.asarray(exposures.is_there) & ~everywhere
        coverage = np.where(is_there[:, None, None], coverage, np.uint8(0))
        exposed = replace(exposures, is_there=is_there)
        exposed = Exposures(*(np.asarray(value)[None] for value in vars(exposed).values()))
        self._instant += num_frames
        instant = np.array([self._instant])
        block = make_block(self._setting, instant, coverage[None], exposed, elapsed=num_frames)
        # A track that was to begin in a frame that was left out begins now.
        late_s = [(self._instant - start.instant) / self._setting.fps for start in self._starts]
        starts = [
            replace(start, instant=self._instant, position_m=start.position_m + late * start.velocity_m_s)
            for start, late in zip(self._starts, late_s, strict=True)
        ]
        ((slots, rows),) = self._engine.track([self._run.job(block, starts)], block)
        self._starts = []
        self._run.finish(block, slots, rows)
        self._latest = block, rows
        return self._rows(rows)

    def look_ahead(self) -> None:
        """What need not be done before the rows of a frame are passed on: births, and drones that are forgotten.

        Tracks that begin do so in the next frame.
        """
        assert self._latest is not None, "step comes first"
        block, rows = self._latest
        run, following = self._run, self._instant + 1

        def begin(candidate: TrackCandidate) -> tuple[int, np.ndarray, np.ndarray]:
            last = max(candidate.path)
            position_m, velocity_m_s = state_at(candidate.path, last, run.fps, run.max_speed_m_s)
            ago_s = (following - last) / run.fps
            return following, position_m + ago_s * velocity_m_s, velocity_m_s

        self._starts = run.plan(run.search(block, rows, run.slots), block, rows, begin)
        run.forget(self._instant - round(FORGOTTEN_S * run.fps))
        if len(run.known) == self._most and not self._was_full and not self._limited:
            logger.warning("%d drones are tracked; further drones are left out (--most-drones)", self._most)
            self._was_full = True

    def _rows(self, rows: Rows) -> list[DroneRow]:
        number = self._run.drone
        return [
            DroneRow(
                int(number[slot]),
                np.asarray(rows.position_m)[0, slot],
                np.asarray(rows.velocity_m_s)[0, slot],
                np.asarray(rows.covariance_m2)[0, slot],
                float(rows.fitness[0, slot]),
                int(rows.num_cameras[0, slot]),
                Status(int(rows.status[0, slot])),
            )
            for slot in sorted(self._run.known, key=lambda slot: int(number[slot]))
        ]

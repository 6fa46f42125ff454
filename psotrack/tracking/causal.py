"""Tracking frame by frame, without the future: for live cameras, and for recordings as if they were live.

A drone's track begins when the search for new tracks has found the drone and has followed it for a while, from what
the frames so far show. The arrays have places for more drones than are known, so that a new drone does not change their
shapes: the program is compiled before the first frame, and again only when the places are used up. A drone that was
lost for long is forgotten, and its place is free for another drone, so that neither memory nor time grows.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack._typing import Array, Coverage
from psotrack.geometry import Camera, Rig
from psotrack.initiation import (
    NEW,
    CandidateSearch,
    DroneSearch,
    FoundCandidates,
    LostTracks,
    SeenFrame,
    find_false_tracks,
    find_lost_tracks,
    reidentify,
)
from psotrack.silhouettes import Exposures, foreground_is_everywhere, moved_by
from psotrack.support import stored_jit
from psotrack.tracking import sizes, tracker
from psotrack.tracking.batch import TrackedDrones
from psotrack.tracking.chunks import on_device
from psotrack.tracking.parameters import TrackerSettings, tracker_params, tracker_program
from psotrack.tracking.sizes import SizeMeasurements, SizeProgram
from psotrack.trajectories import Status

logger = logging.getLogger(__name__)

#: Number of frames between two updates of the drones' sizes.
SIZES_EVERY = 25
#: A result of the search for new drones that comes too late, and is older than this, is not used, seconds.
STALE_S = 0.4
#: Number of frames between two looks at whether a drone may begin, where all places are taken.
_FULL_EVERY = 5
#: A drone that was not seen for longer is forgotten, seconds; and what is remembered of the drones' flights.
FORGOTTEN_S, REMEMBERED_S = 30.0, 60.0
#: Numbers of drones for which the program is compiled.
CAPACITIES = (4, 8, 16, 32, 64)


@dataclass(frozen=True)
class CausalRow:
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


@dataclass(frozen=True)
class _Flights:
    """The drones in one frame or more, in NumPy; arrays with an axis of places, and one of frames before it."""

    position_m: Float[np.ndarray, "*frames places 3"]
    velocity_m_s: Float[np.ndarray, "*frames places 3"]
    status: Int[np.ndarray, "*frames places"]


class CausalTracker:
    """Tracks drones through the frames that `step` is given, one after the other.

    Args:
        rig: calibrated cameras.
        settings: the tracker's parts of the settings; `drones.count` limits the number of drones at one time.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        reduction: image pixels per silhouette pixel, along each side.
        shape: height and width of the silhouettes.
        most_drones: largest number of drones at one time.

    Attributes:
        search: searches for new drones; may be replaced before the first frame.
        num_late: number of searches whose result came too late for the frame in which the tracks were to begin.
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
        self._rig, self._settings, self._fps, self._bounds_m = rig, settings, fps, bounds_m
        self._cameras = on_device(rig.cameras)
        self._program = tracker_program(settings, reduction)
        self._reduction, self._shape = reduction, shape
        self._most = settings.drones.count or most_drones
        self._drones = self._no_drones(_capacity(1))
        self._number = np.full(len(self._drones), -1)
        self._num_born = 0
        self._starts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._memory: deque[_Flights] = deque(maxlen=max(1, round(REMEMBERED_S * fps)))
        self._measured: list[SizeMeasurements] = []
        self._num_frames = 0
        self._is_full, self._was_full = False, False
        self._found: dict[int, FoundCandidates] = {}
        self._num_begun, self._num_told = 0, 0
        self.num_late = 0
        self.search: DroneSearch = CandidateSearch(
            rig.cameras,
            reduction=reduction,
            fps=fps,
            bounds_m=bounds_m,
            max_speed_m_s=settings.motion.speed_limit_m_s,
            min_viewpoints=settings.status.min_cameras_to_begin,
            places=self.capacities,
        )

    @property
    def capacities(self) -> tuple[int, ...]:
        """Numbers of places for drones for which the program is compiled."""
        found = [_capacity(1)]
        while found[-1] < self._most:
            found.append(_capacity(found[-1] + 1))
        return tuple(found)

    def compile(self) -> None:
        """Compile the program for all numbers of drones that may come, so that no frame has to wait for it."""
        kept = self._drones, self._number
        coverage = np.zeros((len(self._rig), *self._shape), np.uint8)
        exposures = _all_missing(len(self._rig))
        for capacity in self.capacities:
            self._drones, self._number = self._no_drones(capacity), np.full(capacity, -1)
            _, measured = self._run(coverage, exposures, 1)
            self._learn_sizes([measured] * SIZES_EVERY)
        sizes.init(np.ones((1, 3), np.float32), np.full((1, 3), self._pinned), len(self._program.windows))
        self._drones, self._number = kept

    def step(
        self,
        coverage: UInt8[np.ndarray, "cameras height width"],
        exposures: Exposures,
        *,
        num_frames: int = 1,
    ) -> list[CausalRow]:
        """The drones in the next frame: those that are known so far.

        Args:
            coverage: (cameras, height, width), silhouettes of the frame, 0 to 255.
            exposures: when each camera's frame was exposed, and which cameras have one; NumPy arrays.
            num_frames: number of frames since the last one; above 1 where frames were left out.
        """
        everywhere = foreground_is_everywhere(coverage)
        is_there = np.asarray(exposures.is_there) & ~everywhere
        coverage = np.where(is_there[:, None, None], coverage, np.uint8(0))
        exposures = replace(exposures, is_there=is_there)
        info, measured = self._run(coverage, exposures, num_frames)
        self._measured.append(measured)
        self._memory.append(_Flights(*map(np.asarray, (info.position_m, info.velocity_m_s, info.status))))
        self._last = coverage, exposures
        self._num_frames += 1
        return self._rows(info)

    def look_ahead(self) -> None:
        """What need not be done before the rows of a frame are passed on: search for new drones, learn sizes.

        Tracks that begin do so in the next frame.
        """
        if len(self._measured) >= SIZES_EVERY:
            self._learn_sizes(self._measured)
            self._measured = []
            self._forget()
        for found in self.search.see(self._seen()):
            before = self._found.get(found.number)
            # An update comes at no fixed frame, and counts only where the result itself is late.
            if found.number > self._num_begun and (before is None or self._num_frames > before.begin_frame):
                self._found[found.number] = found
        for number, found in sorted(self._found.items()):
            is_late = self._num_frames > found.begin_frame
            if is_late and number > self._num_told:
                self._say_late()
                self._num_told = number
            # The candidates of a result that is too old are elsewhere by now; the search sends a newer one.
            is_old = is_late and self._num_frames - found.last_frame > STALE_S * self._fps
            if self._num_frames >= found.begin_frame and not is_old:
                self._begin(found)
                self._num_begun = number
                del self._found[number]

    def _run(
        self, coverage: UInt8[np.ndarray, "cameras height width"], exposures: Exposures, num_frames: int
    ) -> tuple[tracker.TrackerInfo, SizeMeasurements]:
        """Track one frame; the info and the measured sizes in NumPy."""
        self._drones, info, measured = _step(
            self._drones,
            self._track_starts(),
            np.float32(num_frames / self._fps),
            coverage,
            exposures,
            self._cameras,
            self._program,
        )
        self._starts = {}
        return jax.tree.map(np.asarray, (info, measured))

    def _rows(self, info: tracker.TrackerInfo) -> list[CausalRow]:
        return [
            CausalRow(
                int(self._number[place]),
                np.asarray(info.position_m[place]),
                np.asarray(info.velocity_m_s[place]),
                np.asarray(info.covariance_m2[place]),
                float(info.fitness[place]),
                int(info.num_cameras[place]),
                Status(int(info.status[place])),
            )
            for place in sorted(self._known, key=lambda place: int(self._number[place]))
        ]

    @property
    def _known(self) -> list[int]:
        """Places of drones that are known."""
        return np.flatnonzero(self._number >= 0).tolist()

    # New, lost and forgotten drones

    def _seen(self) -> SeenFrame:
        """The last frame, for the search for new drones."""
        (coverage, exposures), flights, state = self._last, self._memory[-1], self._drones.state
        is_known = self._number >= 0
        explains = np.asarray(state.present) & (np.asarray(state.missed) <= tracker.MAX_OCCLUDING_FRAMES)
        size_m = np.asarray(self._drones.params.size_m, np.float64)
        velocity_m_s = np.nan_to_num(np.asarray(flights.velocity_m_s, np.float64))
        return SeenFrame(
            self._num_frames - 1,
            coverage,
            np.asarray(exposures.is_there),
            np.asarray(flights.position_m, np.float64),
            explains & is_known,
            np.where(is_known[:, None], size_m, np.nan),
            moved_by(jax.tree.map(lambda leaf: leaf[None], exposures), velocity_m_s[None])[0],
            is_wanted=not self._nothing_may_begin(),
            begun=self._num_begun,
        )

    def _nothing_may_begin(self) -> bool:
        """Whether all places are taken, and no drone is lost that could come back."""
        if len(self._known) < self._most:
            self._is_full = False
        elif not self._is_full or self._num_frames % _FULL_EVERY == 0:
            self._is_full = not len(self._lost(self._known, 1).drone)
            if self._is_full:
                self._say_full()
        return self._is_full

    def _lost(self, known: list[int], chunk_frames: int) -> LostTracks:
        """The drones that were lost, at the beginning of the last `chunk_frames` frames."""
        flights = self._flights(known)
        return find_lost_tracks(
            flights.position_m,
            flights.velocity_m_s,
            flights.status == Status.TRACKED,
            np.asarray(self._drones.params.size_m, np.float64)[known],
            chunk_frames=chunk_frames,
            fps=self._fps,
        )

    def _begin(self, found: FoundCandidates) -> None:
        """Let the tracks of the candidates begin in the next frame, as new drones or as drones that were lost."""
        known = self._known
        # The candidates' frames are counted from the first frame of all.
        lost = self._lost(known, self._num_frames)
        assignment = reidentify(
            found.candidates,
            lost,
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=self._settings.motion.speed_limit_m_s,
            max_births=self._most - len(known),
        )
        for candidate, row in zip(found.candidates, assignment.tolist(), strict=True):
            if row >= 0:
                place = known[int(lost.drone[row])]
                logger.info("drone %d is back", self._number[place])
            elif row == NEW:
                place = self._new_place(candidate.size_m)
                logger.info("drone %d is new", self._number[place])
            else:
                continue
            last = candidate.last
            ago_s = (self._num_frames - last.frame) / self._fps
            self._starts[place] = (last.position_m + ago_s * last.velocity_m_s, last.velocity_m_s)

    def _new_place(self, size_m: Float[np.ndarray, "3"]) -> int:
        """A free place for a new drone, with the drone's number and size."""
        free = np.flatnonzero(self._number < 0)
        if not len(free):
            self._extend(_capacity(len(self._number) + 1))
            free = np.flatnonzero(self._number < 0)
        place = int(free[0])
        self._number[place], self._num_born = self._num_born, self._num_born + 1
        given = self._settings.drones.size_m
        of_drone = np.array(size_m if given is None else given, np.float32)
        params, state = self._drones.params, self._drones.state
        all_m = np.array(params.size_m)
        all_m[place] = of_drone
        added = sizes.init(of_drone[None], np.full((1, 3), self._pinned), len(self._program.windows))

        def at_place(array: Array, new: Array) -> Array:
            changed = np.array(array)
            changed[place] = np.asarray(new)[0]
            return jnp.asarray(changed)

        learned = jax.tree.map(at_place, self._drones.sizes, added)
        self._drones = TrackedDrones(state, replace(params, size_m=jnp.asarray(all_m)), learned)
        # What was remembered of this place is of another drone.
        for index, frame in enumerate(self._memory):
            status = np.array(frame.status)
            status[place : place + 1] = Status.LOST  # none in frames before the places were extended
            self._memory[index] = replace(frame, status=status)
        return place

    def _forget(self) -> None:
        """Free the places of drones that were not seen for long, and of tracks that follow no drone."""
        known = self._known
        if not known:
            return
        flights = self._flights(known)
        tracked = flights.status == Status.TRACKED
        size_m = np.asarray(self._drones.params.size_m, np.float64)[known]
        num_recent = round(FORGOTTEN_S * self._fps)
        gone = find_false_tracks(flights.position_m, tracked, size_m)
        if len(tracked) > num_recent:
            gone |= ~tracked[-num_recent:].any(axis=0)
        if not gone.any():
            return
        places = np.array(known)[gone]
        for place in places.tolist():
            logger.info("drone %d is forgotten", self._number[place])
        self._number[places] = -1
        present = np.array(self._drones.state.present)
        present[places] = False
        state = replace(self._drones.state, present=jnp.asarray(present))
        self._drones = replace(self._drones, state=state)

    def _flights(self, places: list[int]) -> _Flights:
        """The drones of some places in all frames that are remembered."""
        shape = (len(self._memory), len(self._number))
        position_m, velocity_m_s = np.full((2, *shape, 3), np.nan)
        status = np.full(shape, int(Status.LOST))
        for row, frame in enumerate(self._memory):
            count = len(frame.status)  # fewer before the places were extended
            position_m[row, :count], velocity_m_s[row, :count] = frame.position_m, frame.velocity_m_s
            status[row, :count] = frame.status
        return _Flights(position_m[:, places], velocity_m_s[:, places], status[:, places])

    def _say_late(self) -> None:
        if not self.num_late:
            logger.warning("new drones are found late: the computer is too slow")
        self.num_late += 1

    def _say_full(self) -> None:
        if not self._was_full and self._settings.drones.count is None:
            logger.warning("%d drones are tracked; further drones are left out (--most-drones)", self._most)
        self._was_full = True

    # The arrays

    @property
    def _pinned(self) -> bool:
        return not self._settings.drones.learn_sizes or self._settings.drones.size_m is not None

    def _no_drones(self, capacity: int) -> TrackedDrones:
        """Arrays with places for drones, none of which is known."""
        size_m = np.full((capacity, 3), 0.3)
        params = tracker_params(self._settings, size_m, fps=self._fps, bounds_m=self._bounds_m)
        middle = jnp.broadcast_to(params.bounds_m.mean(axis=0), (capacity, 3))
        state = tracker.init(jax.random.key(self._settings.seed), middle, jnp.zeros_like(middle), params)
        state = replace(state, present=jnp.zeros(capacity, bool))
        learned = sizes.init(params.size_m, np.full((capacity, 3), self._pinned), len(self._program.windows))
        return TrackedDrones(state, params, learned)

    def _extend(self, capacity: int) -> None:
        """More places; the drones keep theirs."""
        more, before = self._no_drones(capacity), len(self._number)
        size_m = jnp.concatenate([self._drones.params.size_m, more.params.size_m[before:]])
        params = replace(more.params, size_m=size_m)
        added = jax.tree.map(lambda leaf: leaf[before:], more.sizes)
        self._drones = TrackedDrones(
            tracker.with_added_tracks(self._drones.state, params),
            params,
            sizes.with_added_drones(self._drones.sizes, added),
        )
        self._number = np.concatenate([self._number, np.full(capacity - before, -1)])

    def _learn_sizes(self, measured: list[SizeMeasurements]) -> None:
        stacked = jax.tree.map(lambda *each: np.stack(each), *[self._at_capacity(one) for one in measured])
        self._drones = _with_learned_sizes(self._drones, stacked)

    def _at_capacity(self, measured: SizeMeasurements) -> SizeMeasurements:
        """Measurements of a frame with the present number of places."""
        missing = len(self._number) - len(measured.size_m)
        return jax.tree.map(
            lambda array: np.pad(array, ((0, missing), (0, 0)), constant_values=np.nan), measured
        )

    def _track_starts(self) -> tracker.TrackStarts:
        count = len(self._number)
        frame = np.full(count, -1, np.int32)
        position_m, velocity_m_s = np.zeros((2, count, 3), np.float32)
        for place, (position, velocity) in self._starts.items():
            frame[place], position_m[place], velocity_m_s[place] = 0, position, velocity
        return tracker.TrackStarts(frame, position_m, velocity_m_s)


def _capacity(num_drones: int) -> int:
    """The smallest number of places for which the program is compiled that holds some drones."""
    return next((capacity for capacity in CAPACITIES if capacity >= num_drones), num_drones)


def _all_missing(num_cameras: int) -> Exposures:
    zero = np.zeros(num_cameras, np.float32)
    return Exposures(zero, np.zeros(num_cameras, bool), zero + 1, zero)


@partial(stored_jit, static_argnames="program")
def _step(
    drones: TrackedDrones,
    starts: tracker.TrackStarts,
    dt_s: Float[Array, ""],
    coverage: Coverage,
    exposures: Exposures,
    cameras: Camera,
    program: tracker.Program,
) -> tuple[TrackedDrones, tracker.TrackerInfo, SizeMeasurements]:
    """One frame: tracks begin, the drones are found, their sizes are measured."""
    params = replace(drones.params, dt_s=dt_s)
    state = tracker.with_started_tracks(drones.state, starts, jnp.int32(0), params)
    state, info = tracker.step(state, coverage, cameras, params, program, exposures)
    well_seen = info.status == Status.TRACKED
    position_m = jnp.where(well_seen[:, None], info.position_m, jnp.nan)
    of_frame = jax.tree.map(lambda leaf: leaf[None], exposures)
    measured = sizes.measure_sizes(
        coverage[None],
        position_m[None],
        params.size_m,
        cameras,
        SizeProgram(program.windows, program.score.ring, program.reduction),
        params.bounds_m[0, 2],
        (jnp.nan_to_num(info.velocity_m_s)[None], of_frame),
    )
    return replace(drones, state=state), info, jax.tree.map(lambda leaf: leaf[0], measured)


@stored_jit
def _with_learned_sizes(drones: TrackedDrones, measured: SizeMeasurements) -> TrackedDrones:
    learned = sizes.learn_sizes(drones.sizes, measured)
    return replace(drones, params=replace(drones.params, size_m=learned.size_m), sizes=learned)

"""Tracking frame by frame, without the future: for live cameras, and for recordings as if they were live.

A drone's track begins in the frame after the search for new tracks has found it, from what the frames so far show. The
arrays have places for more drones than are known, so that a new drone does not change their shapes: the program is
compiled before the first frame, and again only when the places are used up. A drone that was lost for long is
forgotten, and its place is free for another drone, so that neither memory nor time grows.
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
    KnownDrones,
    LostTracks,
    TrackCandidate,
    compile_search,
    find_candidates,
    find_false_tracks,
    find_lost_tracks,
    reidentify,
)
from psotrack.silhouettes import Exposures, foreground_is_everywhere, moved_by
from psotrack.tracking import sizes, tracker
from psotrack.tracking.batch import TrackedDrones
from psotrack.tracking.chunks import on_device
from psotrack.tracking.parameters import TrackerSettings, tracker_params, tracker_program
from psotrack.tracking.sizes import SizeMeasurements, SizeProgram
from psotrack.trajectories import Status

logger = logging.getLogger(__name__)

#: Frames in which new drones are searched for, and number of frames between two searches.
SEARCHED_FRAMES, SEARCH_EVERY = 15, 5
#: Number of frames between two updates of the drones' sizes.
SIZES_EVERY = 25
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
class _Remembered:
    """What is remembered of a frame, in NumPy; arrays with an axis of places."""

    info: tracker.TrackerInfo
    coverage: UInt8[np.ndarray, "cameras height width"] | None
    exposures: Exposures


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
        self._memory: deque[_Remembered] = deque(maxlen=max(1, round(REMEMBERED_S * fps)))
        self._measured: list[SizeMeasurements] = []
        self._num_frames = 0
        self._was_full = False

    def compile(self) -> None:
        """Compile the program for all numbers of drones that may come, so that no frame has to wait for it."""
        kept = self._drones, self._number
        coverage = np.zeros((len(self._rig), *self._shape), np.uint8)
        exposures = _all_missing(len(self._rig))
        capacity = _capacity(1)
        while True:
            self._drones, self._number = self._no_drones(capacity), np.full(capacity, -1)
            _, measured = self._run(coverage, exposures, 1)
            self._learn_sizes([measured] * SIZES_EVERY)
            compile_search(self._rig.cameras, SEARCHED_FRAMES, capacity, self._reduction)
            if capacity >= self._most:
                break
            capacity = _capacity(capacity + 1)
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
        self._memory.append(_Remembered(info, coverage, exposures))
        if len(self._memory) > SEARCHED_FRAMES:
            old = self._memory[-1 - SEARCHED_FRAMES]
            self._memory[-1 - SEARCHED_FRAMES] = replace(old, coverage=None)
        self._num_frames += 1
        return self._rows(info)

    def look_ahead(self) -> None:
        """What need not be done before the rows of a frame are passed on: search for new drones, learn sizes."""
        if len(self._measured) >= SIZES_EVERY:
            self._learn_sizes(self._measured)
            self._measured = []
            self._forget()
        if self._num_frames % SEARCH_EVERY == 0 and len(self._memory) >= SEARCHED_FRAMES:
            self._search()

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

    def _search(self) -> None:
        """Search the last frames for new drones and for drones that were lost; their tracks begin in the next frame."""
        known, settings = self._known, self._settings
        recent = list(self._memory)[-SEARCHED_FRAMES:]
        position_m, velocity_m_s, tracked = self._flights(known)
        size_m = np.asarray(self._drones.params.size_m, np.float64)[known]
        lost = find_lost_tracks(
            position_m, velocity_m_s, tracked, size_m, chunk_frames=len(recent), fps=self._fps
        )
        max_births = self._most - len(known)
        if max_births <= 0 and not len(lost.drone):
            self._say_full()
            return
        coverage = np.stack([frame.coverage for frame in recent if frame.coverage is not None])
        candidates = find_candidates(
            self._rig.cameras,
            coverage,
            self._known_drones(recent),
            reduction=self._reduction,
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=settings.motion.speed_limit_m_s,
        )
        assignment = reidentify(
            candidates,
            lost,
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=settings.motion.speed_limit_m_s,
            max_births=max_births,
        )
        self._begin(candidates, assignment, lost, known)

    def _begin(
        self,
        candidates: tuple[TrackCandidate, ...],
        assignment: Int[np.ndarray, "candidates"],
        lost: LostTracks,
        known: list[int],
    ) -> None:
        for candidate, row in zip(candidates, assignment.tolist(), strict=True):
            last = candidate.last
            # A drone that was last found some frames ago was lost again.
            if last is None or last.frame < SEARCHED_FRAMES - 1 - tracker.MAX_OCCLUDING_FRAMES:
                continue
            if row >= 0:
                place = known[int(lost.drone[row])]
                logger.info("drone %d is back", self._number[place])
            elif row == NEW:
                place = self._new_place(candidate.size_m)
                logger.info("drone %d is new", self._number[place])
            else:
                continue
            ago_s = (SEARCHED_FRAMES - last.frame) / self._fps
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
            status = np.array(frame.info.status)
            status[place : place + 1] = Status.LOST  # none in frames before the places were extended
            self._memory[index] = replace(frame, info=replace(frame.info, status=status))
        return place

    def _forget(self) -> None:
        """Free the places of drones that were not seen for long, and of tracks that follow no drone."""
        known = self._known
        if not known:
            return
        position_m, _, tracked = self._flights(known)
        size_m = np.asarray(self._drones.params.size_m, np.float64)[known]
        num_recent = round(FORGOTTEN_S * self._fps)
        gone = find_false_tracks(position_m, tracked, size_m)
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

    def _flights(
        self, places: list[int]
    ) -> tuple[Float[np.ndarray, "frames drones 3"], Float[np.ndarray, "frames drones 3"], np.ndarray]:
        """Positions and velocities of drones in all frames that are remembered, and whether they were found."""
        frames = list(self._memory)
        shape = (len(frames), len(self._number))
        position_m, velocity_m_s = np.full((2, *shape, 3), np.nan)
        tracked = np.zeros(shape, bool)
        for row, frame in enumerate(frames):
            count = len(frame.info.status)  # fewer before the places were extended
            position_m[row, :count], velocity_m_s[row, :count] = (
                frame.info.position_m,
                frame.info.velocity_m_s,
            )
            tracked[row, :count] = frame.info.status == Status.TRACKED
        return position_m[:, places], velocity_m_s[:, places], tracked[:, places]

    def _known_drones(self, recent: list[_Remembered]) -> KnownDrones:
        """The drones of all places in the last frames; places without a drone explain no foreground."""
        position_m, velocity_m_s, tracked = self._flights(list(range(len(self._number))))
        is_known = self._number >= 0
        explains = np.array(tracked)
        for shift in range(1, tracker.MAX_OCCLUDING_FRAMES + 1):
            explains[shift:] |= tracked[: len(tracked) - shift]
        count = len(recent)
        exposures = jax.tree.map(lambda *each: np.stack(each), *[frame.exposures for frame in recent])
        size_m = np.asarray(self._drones.params.size_m, np.float64)
        return KnownDrones(
            position_m[-count:],
            explains[-count:] & is_known,
            np.where(is_known[:, None], size_m, np.nan),
            moved_m=moved_by(exposures, np.nan_to_num(velocity_m_s[-count:])),
            is_there=exposures.is_there,
            min_viewpoints=self._settings.status.min_cameras_to_begin,
        )

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


@partial(jax.jit, static_argnames="program")
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


@jax.jit
def _with_learned_sizes(drones: TrackedDrones, measured: SizeMeasurements) -> TrackedDrones:
    learned = sizes.learn_sizes(drones.sizes, measured)
    return replace(drones, params=replace(drones.params, size_m=learned.size_m), sizes=learned)

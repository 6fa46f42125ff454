"""One run: its drones in slots, the births of new ones, and the return of those that were lost."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.support.array_types import Key
from psotrack.tracking.births import (
    NEW,
    STAYED_SPANS,
    WINDOW_FRAMES,
    BirthRules,
    Births,
    FlightLimits,
    InitialState,
    KnownDrones,
    LostTracks,
    TrackCandidate,
    find_false_tracks,
    find_lost_tracks,
    reidentify,
    unexplained,
)
from psotrack.tracking.swarm.block import Block, Job, Setting, capacity, grown
from psotrack.tracking.swarm.parameters import TrackerSettings, tracker_params, tracker_program
from psotrack.tracking.swarm.tracker import Rows, Slots, TrackerParams, TrackStarts, empty_slots
from psotrack.trajectories import Status, padded

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunInputs:
    """Inputs of one run of the tracker.

    Attributes:
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        settings: settings of the run, with search and score.
        given: the drones at frame 0, where they are given instead of found.
    """

    bounds_m: Float[np.ndarray, "2 3"]
    settings: TrackerSettings
    given: InitialState | None = None


@dataclass(frozen=True)
class Start:
    """A track that starts, or starts again.

    Attributes:
        slot: the drone's slot.
        instant: the first instant.
        position_m, velocity_m_s: (3,), state at this instant.
        size_m: (3,), full lengths; NaN for a drone whose lengths are known.
        again: whether the drone was tracked before, and lost.
    """

    slot: int
    instant: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    again: bool


@dataclass(frozen=True)
class Flights:
    """The drones in some frames, in NumPy; arrays with axes of frames and slots."""

    instant: Int[np.ndarray, "frames"]
    position_m: Float[np.ndarray, "frames slots 3"]
    velocity_m_s: Float[np.ndarray, "frames slots 3"]
    tracked: Bool[np.ndarray, "frames slots"]

    @classmethod
    def of(cls, instant: Int[np.ndarray, "frames"], rows: Rows) -> Flights:
        """The flights of some rows."""
        tracked = np.asarray(rows.status) == Status.TRACKED
        return cls(
            instant,
            np.asarray(rows.position_m, np.float64),
            np.asarray(rows.velocity_m_s, np.float64),
            tracked,
        )


@dataclass
class _Past:
    """What is remembered of the drone in a slot.

    Attributes:
        low_m, high_m: (3,), corners of the box about all places where it was found, metres.
        last: last instant in which it was found.
        missed: whether it was missed since it was first found.
    """

    last: int = -1
    low_m: Float[np.ndarray, "3"] = field(default_factory=lambda: np.full(3, np.inf))
    high_m: Float[np.ndarray, "3"] = field(default_factory=lambda: np.full(3, -np.inf))
    missed: bool = False

    def add(self, flights: Flights, slot: int) -> None:
        """Take further frames."""
        tracked, position_m = flights.tracked[:, slot], flights.position_m[:, slot]
        found_m = position_m[tracked]
        self.low_m = np.minimum(self.low_m, found_m.min(axis=0, initial=np.inf))
        self.high_m = np.maximum(self.high_m, found_m.max(axis=0, initial=-np.inf))
        self.last = max(self.last, int(flights.instant[tracked].max(initial=-1)))
        self.missed |= bool((np.isfinite(position_m).all(axis=-1) & ~tracked).any())


class SwarmRun:
    """A run in progress.

    Args:
        setting: what all runs of the recording share.
        inputs: inputs of the run.
        on_cpu: whether a CPU computes the blocks.
        most_drones: largest number of drones at one time; None for any number.
        memory_frames: number of frames that are remembered; None for all.
        num_frames: number of frames of the recording; None for a recording without end, whose first frames have ghosts.

    Attributes:
        slots: the drones after the last block.
        drone: (slots,), number of the drone in each slot; -1 for an empty slot.
        limits: where and how fast drones may fly.
    """

    def __init__(
        self,
        setting: Setting,
        inputs: RunInputs,
        *,
        on_cpu: bool = True,
        most_drones: int | None = None,
        memory_frames: int | None = None,
        num_frames: int | None = None,
    ) -> None:
        settings = self._settings = inputs.settings.of_run
        self._setting, self._tracker_settings = setting, inputs.settings
        self.limits = FlightLimits(setting.fps, inputs.bounds_m, settings.motion.speed_limit_m_s)
        self.program = tracker_program(inputs.settings, setting.reduction, on_cpu=on_cpu)
        self._most = settings.drones.count or most_drones
        # What is followed now, and what was followed before the block that was searched last.
        self._births = self._births_before = Births(
            setting.rig.cameras,
            self.limits,
            BirthRules(
                settings.status.min_cameras_to_begin,
                # A recording's background is known from the start, that of a stream is learned from its first frames.
                ghosts_from=0 if num_frames is None else WINDOW_FRAMES,
                num_frames=num_frames,
                size_m=settings.drones.size_m,
            ),
        )
        self._key = jax.random.key(settings.seed)
        self._num_born = 0
        self._known_params: dict[int, TrackerParams] = {}
        self._memory: deque[Flights] = deque(maxlen=memory_frames)
        self.resize(0)

    # Slots

    def resize(self, num_drones: int) -> None:
        """Make slots for some drones, empty ones, and forget those that there were."""
        self.slots = self._empty(capacity(num_drones))
        self.drone = np.full(len(self.slots), -1)
        self._past = [_Past() for _ in self.drone]

    def _params(self, count: int) -> TrackerParams:
        """The tracker's parameters for a number of slots."""
        if count not in self._known_params:
            self._known_params[count] = tracker_params(self._tracker_settings, count, self.limits)
        return self._known_params[count]

    def _empty(self, count: int) -> Slots:
        return _empty_slots(self._key, count, self._params(count))

    def with_room(self, slots: Slots) -> Slots:
        """Some earlier slots, as many as there are now."""
        return slots if len(slots) == len(self.drone) else grown(slots, self._empty(len(self.drone)))

    def job(self, block: Block, starts: list[Start], before: Slots | None = None) -> Job:
        """This run in a block.

        Args:
            block: the block.
            starts: tracks that start; those at other instants than the block's are left out.
            before: the drones before the block; None: the present ones.
        """
        count = len(self.drone)
        frame = np.full(count, -1, np.int32)
        position_m, velocity_m_s = np.zeros((2, count, 3), np.float32)
        size_m = np.full((count, 3), np.nan, np.float32)
        for start in starts:
            if block.instant[0] <= start.instant <= block.instant[-1]:
                frame[start.slot] = int(np.searchsorted(block.instant, start.instant))
                position_m[start.slot], velocity_m_s[start.slot] = start.position_m, start.velocity_m_s
                size_m[start.slot] = start.size_m
        return Job(
            self.with_room(self.slots if before is None else before),
            TrackStarts(frame, position_m, velocity_m_s, size_m),
            self._params(count),
            self.program,
        )

    @property
    def known(self) -> list[int]:
        """Slots of drones that are known."""
        return np.flatnonzero(self.drone >= 0).tolist()

    def given_starts(self, given: InitialState, instant: int) -> list[Start]:
        """Starts of drones whose first positions are given."""
        found = zip(given.position_m, given.velocity_m_s, given.size_m, strict=True)
        return [self._born(instant, position, velocity, size) for position, velocity, size in found]

    def _born(
        self,
        instant: int,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        size_m: Float[np.ndarray, "3"],
    ) -> Start:
        """The start of a new drone, in the first empty slot."""
        free = np.flatnonzero(self.drone < 0)
        if not len(free):
            before = len(self.drone)
            more = capacity(before + 1) - before
            self.drone = np.append(self.drone, np.full(more, -1))
            self._past += [_Past() for _ in range(more)]
            free = np.array([before])
        slot = int(free[0])
        self.drone[slot], self._num_born = self._num_born, self._num_born + 1
        self._past[slot] = _Past(instant)
        self._clear_memory(slot)
        given = self._settings.drones.size_m
        return Start(
            slot, instant, position_m, velocity_m_s, size_m if given is None else np.array(given), False
        )

    # Births

    def search(
        self, block: Block, rows: Rows, slots: Slots, *, again: bool = False
    ) -> tuple[TrackCandidate, ...]:
        """Drones without a track in a block that was tracked.

        Args:
            block: the block.
            rows: its rows.
            slots: the drones after the block, among them those that began in it.
            again: whether the block was searched before, with fewer known drones: of drones whose blobs were one, the
                others are seen once some are known.
        """
        if self._nothing_may_begin(block, rows):
            return ()
        if not again:
            self._births_before = self._births
        is_first = not self._memory and not self._num_born
        rules = self._settings.status.min_cameras_to_begin, self._settings.drones.size_m
        key = self.limits.bounds_m.tobytes(), self.limits.max_speed_m_s, *rules
        if is_first and key in block.births:
            # Before the first drone, all runs that look for the same drones find the same.
            found, births = block.births[key]
            self._births = births.copy()
            return found
        births = self._births = self._births_before.copy()
        size_m = np.asarray(slots.size_m, np.float64)
        box_px = np.asarray(rows.box_px, np.float64)
        explains = np.asarray(np.isfinite(box_px).all(axis=-1).any(axis=-1))
        position_m = np.where(explains[..., None], np.asarray(rows.position_m, np.float64), np.nan)
        shown = unexplained(block.blobs, box_px)
        for frame, instant in enumerate(block.instant.tolist()):
            births.step(instant, shown[frame], KnownDrones(position_m[frame], size_m, box_px[frame]))
        found = births.candidates()
        if is_first:
            block.births[key] = found, births.copy()
        return found

    def plan(
        self,
        candidates: tuple[TrackCandidate, ...],
        block: Block,
        rows: Rows,
        begin: Callable[[TrackCandidate], tuple[int, np.ndarray, np.ndarray]],
    ) -> list[Start]:
        """The tracks of candidates that are lost drones, or new ones.

        Args:
            candidates: the candidates of a block.
            block: the block.
            rows: its rows.
            begin: instant at which a candidate's track begins, and its position and velocity then.
        """
        if not candidates:
            self._births.take(())
            return []
        lost, known = self._lost(block, rows), self.known
        most = None if self._most is None else max(self._most - len(known), 0)
        assignment = reidentify(candidates, lost, self.limits, max_births=most)
        # What is no drone yet, because it does not move for instance, is followed on.
        taken = [each for each, row in zip(candidates, assignment, strict=True) if row >= 0 or row == NEW]
        self._births.take(taken)
        self._births_before.take(taken)
        starts = []
        for candidate, row in zip(candidates, assignment.tolist(), strict=True):
            if row >= 0:
                slot = known[int(lost.drone[row])]
                starts.append(Start(slot, *begin(candidate), np.full(3, np.nan), True))
            elif row == NEW:
                starts.append(self._born(*begin(candidate), candidate.size_m))
            else:
                continue
            start = starts[-1]
            word = "is back" if start.again else "is new"
            logger.info("instant %d: drone %d %s", start.instant, self.drone[start.slot], word)
        return starts

    def finish(self, block: Block, slots: Slots, rows: Rows) -> None:
        """The block is tracked: go on from these slots, without tracks that turned out to follow no drone."""
        self.slots = slots
        flights = Flights.of(block.instant, rows)
        self._memory.append(flights)
        for slot in self.known:
            if slot < flights.tracked.shape[1]:
                self._past[slot].add(flights, slot)
        self._drop_false_tracks()

    def take_back(self) -> None:
        """Forget the last block, which is tracked again."""
        self._memory.pop()

    def forget(self, oldest: int) -> None:
        """Empty the slots of drones that were not seen since an instant, and of tracks that follow no drone."""
        present = np.asarray(self.slots.present)
        now = int(self._memory[-1].instant[-1]) if self._memory else -1
        for slot in self.known:
            # A track that is to begin is not there yet, and may stand in a slot that the next block will add.
            last = self._past[slot].last
            if slot < len(present) and last < now and (last < oldest or not present[slot]):
                logger.info("drone %d is forgotten", self.drone[slot])
                self.drone[slot] = -1
                self._leave(slot)

    def _leave(self, gone: int | Int[np.ndarray, "gone"]) -> None:
        """Track nothing in some slots any more."""
        present = np.array(self.slots.present)
        present[gone] = False
        self.slots = replace(self.slots, present=jax.device_put(present))

    def _nothing_may_begin(self, block: Block, rows: Rows) -> bool:
        """Whether all drones that may be are known, and none is lost that could come back."""
        known = self.known
        if self._most is None or len(known) < self._most:
            return False
        found = np.equal(np.asarray(rows.status)[:, known], Status.TRACKED)
        was_missed = any(self._past[slot].missed for slot in known) or not found.all()
        return not was_missed or not len(self._lost(block, rows).drone)

    def _lost(self, block: Block, rows: Rows) -> LostTracks:
        """The drones that were lost, by their place among the known ones."""
        flights, known = self._flights(Flights.of(block.instant, rows)), self.known
        return find_lost_tracks(
            flights.position_m[:, known],
            flights.velocity_m_s[:, known],
            flights.tracked[:, known],
            self._sizes_m()[known],
            instant=flights.instant,
            fps=self._setting.fps,
            counted=self._settings.drones.count is not None,
        )

    def _sizes_m(self) -> Float[np.ndarray, "slots 3"]:
        return np.asarray(self.with_room(self.slots).size_m, np.float64)

    def _drop_false_tracks(self) -> None:
        """Empty the slots of tracks that turned out to follow no drone; their rows stay."""
        known = np.array(self.known, int)
        pasts = [self._past[slot] for slot in known]
        way_m = np.array([np.linalg.norm(past.high_m - past.low_m) for past in pasts])
        # Mostly all drones have moved: the frames that are remembered are looked at only where one has not.
        if not (way_m < STAYED_SPANS * self._sizes_m()[known].max(axis=-1)).any():
            return
        flights = self._flights()
        is_false = find_false_tracks(
            flights.position_m[:, known], flights.tracked[:, known], self._sizes_m()[known]
        )
        if is_false.any():
            self._leave(known[is_false])

    # Memory

    def _flights(self, *latest: Flights) -> Flights:
        """The drones in all frames that are remembered, and in the latest, with as many slots as there are now."""
        remembered, count = [*self._memory, *latest], len(self.drone)

        def joined(name: str) -> np.ndarray:
            return np.concatenate([padded(name, getattr(each, name), count) for each in remembered])

        instant = np.concatenate([each.instant for each in remembered])
        return Flights(instant, joined("position_m"), joined("velocity_m_s"), joined("tracked"))

    def _clear_memory(self, slot: int) -> None:
        """What was remembered of a slot is of another drone."""
        for index, frames in enumerate(self._memory):
            tracked = frames.tracked.copy()
            tracked[:, slot : slot + 1] = False
            self._memory[index] = replace(frames, tracked=tracked)


@partial(jax.jit, static_argnames="count")
def _empty_slots(key: Key, count: int, params: TrackerParams) -> Slots:
    """One program, because each operation alone would be a program of its own."""
    return empty_slots(key, count, params)

"""The paper's other outside-in method: drones from the lines of sight of their detections, followed over time.

Frame after frame the motion model says where drones are expected; the sightings of all cameras are matched with them
and with each other, and triangulated (`crossings`); what comes of it corrects the motion model. What nobody expected
and is there in several frames is a drone, a new one or one that was lost.

Motion model, status and covariances are those of the swarm's tracker, and so are the results.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from psotrack import motion
from psotrack._typing import Array
from psotrack.cameras import Camera
from psotrack.crossings import View, crossings, in_view
from psotrack.fitness import ScoreSettings
from psotrack.initialisation import FLOOR_CLEARANCE_M, Start
from psotrack.lifecycle import NEW, SPEED_SHARE, Lost, recognised
from psotrack.motion import GATE_999, MotionParams, MotionState
from psotrack.newcomers import Newcomer
from psotrack.progress import Report, silent
from psotrack.settings import TrackSettings
from psotrack.sightings import Sightings
from psotrack.sizes import Looks
from psotrack.sizes import init as init_sizes
from psotrack.tracker import DISPERSION_FRAMES, TrackerInfo
from psotrack.tracker_inputs import motion_params
from psotrack.tracking import Arrival, Tracked
from psotrack.trajectories import Status
from psotrack.triangulation import viewpoints

#: What was found in so many of its first frames is a drone.
CONFIRMED_HITS, FIRST_FRAMES = 5, 8
#: And by so many of the cameras that have it in view, or lines of sight cross there by chance. Detectors miss, and
#: drones are hidden: half of the cameras would be too many to ask for.
MIN_SHARE = 0.4
#: What begins nearer to a track than this is taken for a part of it.
SEPARATION_M = 0.25
#: What agrees from so many viewpoints is there, wherever it was expected; two agree by chance.
TRUSTED_VIEWPOINTS = 3
#: Squared distance from where it was expected, normalised by covariance, from which on a drone is elsewhere if trusted
#: viewpoints say so. The filter makes outliers of what is beyond its gate, which is as well up to twice as far.
SURPRISING = 2 * GATE_999
#: The motion model's arrays have room for a multiple of so many tracks: each length is compiled.
ROOM = 16


@dataclass(frozen=True)
class _Found:
    """What a frame says of a track by itself."""

    position_m: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    disagreement: float
    num_cameras: int
    span_m: Float[np.ndarray, "2"]
    surprising: bool


@dataclass(frozen=True)
class _Row:
    """What is known of a track after a frame; found is None where the frame did not show it."""

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    covariance_m2: Float[np.ndarray, "3 3"]
    num_in_view: int
    found: _Found | None

    @property
    def share(self) -> float:
        """Of the cameras that have it in view, those that saw it."""
        num_cameras = 0 if self.found is None else self.found.num_cameras
        return num_cameras / max(num_cameras, self.num_in_view, 1)


@dataclass
class _Track:
    """A track on its way: the number of its drone, once it is one; how much the cameras disagree; all of its frames."""

    drone: int | None
    dispersion: float
    rows: list[_Row] = field(default_factory=list)
    hits: int = 0
    missed: int = 0

    @property
    def share(self) -> float:
        """Of the cameras that had it in view, those that saw it, in the frames in which it was found."""
        shares = [row.share for row in self.rows if row.found is not None]
        return float(np.mean(shares)) if shares else 0.0

    @property
    def last_found(self) -> _Row:
        """The last row in which it was found; the first one if it never was."""
        return next((row for row in reversed(self.rows) if row.found is not None), self.rows[0])

    @property
    def size_m(self) -> Float[np.ndarray, "3"]:
        """Full lengths along the world's axes, the median of all frames."""
        spans = [row.found.span_m for row in self.rows if row.found is not None]
        width, height = np.median(spans, axis=0) if spans else np.full(2, np.nan)
        return np.array([width, width, height])


def follow(
    cameras: Camera,
    sightings: Sightings,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    known: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None = None,
    report: Report = silent,
) -> Tracked:
    """Follow the drones through all frames.

    Fitness is the share of the cameras with the drone in view whose sightings agree on it. Sizes are those of the
    boxes, as wide along x as along y.

    Args:
        cameras: with one leading axis.
        sightings: of all cameras.
        settings: of the motion model, speeds, coasting, and how many drones there are.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room.
        known: position and velocity of drones at frame 0; None finds them.
        report: told of the frames.
    """
    # A scope, not a switch: nothing outside of it computes differently.
    with jax.enable_x64(True):
        follower = _Follower(cameras, settings, fps, bounds_m)
        if known is not None:
            follower.begin_known(*known)
        with report("track", sightings.num_frames) as advance:
            for frame in range(sightings.num_frames):
                values = (sightings.centre_px, sightings.size_px, sightings.noise_px)
                follower.step(frame, View(*(value[frame] for value in values)))
                advance(1)
    return _tracked(follower.drones(), sightings.num_frames, settings)


def start_of(tracked: Tracked) -> Start:
    """The drones that were there at frame 0, as a start of tracking."""
    there = np.flatnonzero(np.isfinite(tracked.info.position_m[0]).all(axis=-1))
    position_m, velocity_m_s = (
        np.asarray(value[0], np.float64)[there]
        for value in (tracked.info.position_m, tracked.info.velocity_m_s)
    )
    size_m = np.asarray(tracked.sizes.size_m, np.float64)[there]
    return Start(position_m, velocity_m_s, size_m, np.asarray(tracked.info.num_cameras[0], float)[there])


class _Follower:
    """The tracks on their way, in slots of the motion model's arrays."""

    def __init__(
        self, cameras: Camera, settings: TrackSettings, fps: float, bounds_m: Float[np.ndarray, "2 3"]
    ) -> None:
        self._cameras = cameras
        self._viewpoint = viewpoints(cameras)
        self._settings = settings
        self._fps = fps
        self._bounds_m = bounds_m
        self._max_coasting_frames = round(settings.max_coasting_s * fps)
        self._num_drones = 0
        self._slots: list[_Track | None] = []
        self._ended: list[_Track] = []
        self._params = _params(settings, 0)
        self._state = _nobody(0, self._params)

    def begin_known(
        self, position_m: Float[np.ndarray, "known 3"], velocity_m_s: Float[np.ndarray, "known 3"]
    ) -> None:
        """Drones that will be there in the next frame."""
        for position, velocity in zip(position_m, velocity_m_s, strict=True):
            before_m = position - velocity / self._fps
            self._begin(_Track(self._num_drones, 1.0), before_m, velocity, self._settings.velocity_std_m_s)
            self._num_drones += 1

    def step(self, frame: int, view: View) -> None:
        """One frame: predict, match, correct, and see who comes and goes."""
        self._state = _on_host(_predict(self._state, 1 / self._fps, self._params))
        found = self._found(view)
        self._correct(found)
        self._note(frame, found)
        self._bury()
        self._welcome()

    def drones(self) -> list[_Track]:
        """The tracks that are of drones; several may be of one."""
        tracks = [*self._ended, *(track for _, track in self._tracks())]
        return [track for track in tracks if track.drone is not None]

    def _tracks(self) -> list[tuple[int, _Track]]:
        return [(slot, track) for slot, track in enumerate(self._slots) if track is not None]

    def _begin(
        self,
        track: _Track,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        velocity_std_m_s: float,
    ) -> int:
        """Put a track into a slot, with room made for it."""
        if None not in self._slots:
            self._slots += [None] * ROOM
            self._params = _params(self._settings, len(self._slots))
            more = _nobody(ROOM, _params(self._settings, ROOM))
            self._state = _on_host(jax.tree.map(lambda *both: np.concatenate(both), self._state, more))
        slot = self._slots.index(None)
        self._slots[slot] = track
        covariance_m2 = np.square(self._settings.spread_m) * np.eye(3)
        self._place(slot, position_m, velocity_m_s, covariance_m2, velocity_std_m_s)
        return slot

    def _place(
        self,
        slot: int,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        covariance_m2: Float[np.ndarray, "3 3"],
        velocity_std_m_s: float,
    ) -> None:
        """Let the motion of a track begin here."""
        params = replace(_params(self._settings, 1), velocity_std_m_s=jnp.float64(velocity_std_m_s))
        begun = motion.init(position_m[None], velocity_m_s[None], covariance_m2[None], params)
        for each in fields(MotionState):
            getattr(self._state, each.name)[slot] = np.asarray(getattr(begun, each.name))[0]

    def _end(self, slot: int) -> None:
        track = self._slots[slot]
        assert track is not None
        self._ended.append(track)
        self._slots[slot] = None

    def _found(self, view: View) -> dict[int, _Found]:
        """What the frame shows of the tracks, by slot; where it shows what is none of them a track begins."""
        slots, tracks = [slot for slot, _ in self._tracks()], [track for _, track in self._tracks()]
        expected_m = np.asarray(self._state.apparent_m[slots])
        expected_m2 = np.asarray(self._state.covariance[slots, :3, :3])
        crossed = crossings(
            self._cameras,
            view,
            self._bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]]),
            expected_m,
            expected_m2,
            np.array([track.dispersion for track in tracks]),
        )
        usual = float(np.median([track.dispersion for track in tracks])) if tracks else 1.0
        found: dict[int, _Found] = {}
        # Those that were expected first: what is left may be a part of one of them.
        for row in np.argsort(crossed.expected < 0, kind="stable").tolist():
            who, seen, position_m = int(crossed.expected[row]), crossed.seen[row], crossed.position_m[row]
            num_viewpoints = len(set(self._viewpoint[seen].tolist()))
            if seen.sum() < max(self._settings.min_cameras, 2) or num_viewpoints < 2:
                continue
            if who >= 0:
                slot = slots[who]
            elif (distance_m := np.linalg.norm(expected_m - position_m, axis=-1)).min(
                initial=np.inf
            ) < SEPARATION_M:
                # Its track was surer than it should have been, as when a drone turns sharply.
                who = int(distance_m.argmin())
                slot = slots[who]
                if slot in found:
                    continue
            else:
                speed_m_s = SPEED_SHARE * self._settings.max_speed_m_s
                slot = self._begin(_Track(None, usual), position_m, np.zeros(3), speed_m_s)
            surprising = False
            if who >= 0:
                off_m, spread_m2 = position_m - expected_m[who], expected_m2[who] + crossed.covariance_m2[row]
                surprising = bool(off_m @ np.linalg.solve(spread_m2, off_m) >= SURPRISING)
            if not surprising or num_viewpoints >= TRUSTED_VIEWPOINTS:
                found[slot] = _Found(
                    position_m,
                    crossed.covariance_m2[row],
                    float(crossed.disagreement[row]),
                    int(seen.sum()),
                    crossed.span_m[row],
                    surprising,
                )
        return found

    def _correct(self, found: dict[int, _Found]) -> None:
        """Correct the motion model by what was found."""
        room = len(self._slots)
        measured_m, covariance_m2 = np.zeros((room, 3)), np.tile(np.eye(3), (room, 1, 1))
        was_measured, lost = np.zeros((2, room), bool)
        for slot, track in self._tracks():
            if slot in found:
                measured_m[slot], covariance_m2[slot] = found[slot].position_m, found[slot].covariance_m2
                was_measured[slot] = True
            track.missed = 0 if slot in found else track.missed + 1
            lost[slot] = track.missed > self._max_coasting_frames
        limits = (1 / self._fps, self._bounds_m, self._settings.max_speed_m_s)
        corrected = _correct(
            self._state, measured_m, covariance_m2, was_measured, lost, *limits, self._params
        )
        predicted_m_s = np.asarray(self._state.velocity_m_s)
        self._state = _on_host(corrected)
        for slot, one in found.items():
            if one.surprising:
                # The filter would take it for an outlier for a second; all of its views agree that it is none.
                speed_m_s = SPEED_SHARE * self._settings.max_speed_m_s
                self._place(slot, one.position_m, predicted_m_s[slot], one.covariance_m2, speed_m_s)

    def _note(self, frame: int, found: dict[int, _Found]) -> None:
        """Note what is known of each track after the frame."""
        position_m, velocity_m_s, covariance_m2 = (
            np.asarray(getattr(self._state, name))
            for name in ("position_m", "velocity_m_s", "position_covariance_m2")
        )
        num_in_view = in_view(self._cameras, position_m).sum(axis=-1)
        for slot, track in self._tracks():
            one = found.get(slot)
            state = (position_m[slot], velocity_m_s[slot], covariance_m2[slot])
            track.rows.append(_Row(frame, *state, int(num_in_view[slot]), one))
            if one is not None:
                track.hits += 1
                track.dispersion += (one.disagreement - track.dispersion) / DISPERSION_FRAMES

    def _bury(self) -> None:
        """End tracks that are lost, and those that were a crossing by chance."""
        for slot, track in self._tracks():
            too_few = len(track.rows) - track.hits > FIRST_FRAMES - CONFIRMED_HITS
            too_few |= track.hits >= CONFIRMED_HITS and track.share < MIN_SHARE
            chance = track.drone is None and too_few
            if chance or track.missed > self._max_coasting_frames:
                self._end(slot)

    def _welcome(self) -> None:
        """Tracks that were found often enough are drones: one that is missed, or a new one."""
        coming = [of for of in self._tracks() if of[1].drone is None and of[1].hits >= CONFIRMED_HITS]
        if not coming:
            return
        absent = self._absent()
        wanted = self._settings.drones
        chosen = recognised(
            tuple(_newcomer(track) for _, track in coming),
            _lost([track for _, track in absent], coming[0][1].rows[-1].frame, self._fps),
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=self._settings.max_speed_m_s,
            max_births=None if wanted is None else max(wanted - self._num_drones, 0),
        )
        for (slot, track), who in zip(coming, chosen.tolist(), strict=True):
            if who >= 0:
                former_slot, former = absent[who]
                track.drone = former.drone
                if former_slot is not None:
                    self._end(former_slot)
            elif who == NEW:
                track.drone = self._num_drones
                self._num_drones += 1
            else:
                self._end(slot)

    def _absent(self) -> list[tuple[int | None, _Track]]:
        """The last track of each drone that is not found now, with its slot if it is still expected somewhere."""
        ended: list[tuple[int | None, _Track]] = [(None, track) for track in self._ended]
        last = {track.drone: (slot, track) for slot, track in [*ended, *self._tracks()]}
        missed = {drone: of for drone, of in last.items() if of[0] is None or of[1].missed > 0}
        return [of for drone, of in missed.items() if drone is not None]


def _newcomer(track: _Track) -> Newcomer:
    """A track as a newcomer, at the frame in which it began; its velocity is known by now."""
    first, now = track.rows[0], track.rows[-1]
    return Newcomer(
        frame=first.frame - now.frame,
        position_m=first.position_m,
        velocity_m_s=now.velocity_m_s,
        size_m=track.size_m,
        num_cameras=first.num_in_view,
        moves=True,
    )


def _lost(tracks: list[_Track], frame: int, fps: float) -> Lost:
    """Drones that are missed, as they were when last found."""
    last = [track.last_found for track in tracks]
    return Lost(
        drone=np.array([track.drone for track in tracks], int),
        position_m=np.array([row.position_m for row in last]).reshape(-1, 3),
        velocity_m_s=np.array([row.velocity_m_s for row in last]).reshape(-1, 3),
        seconds=np.array([frame - row.frame for row in last], float) / fps,
        size_m=np.array([track.size_m for track in tracks]).reshape(-1, 3),
        doubtful=np.zeros(len(tracks), bool),
        left_m=np.empty((0, 3)),
    )


# --- the motion model, for as many tracks as there is room for, in float64


def _params(settings: TrackSettings, room: int) -> MotionParams:
    return jax.tree.map(lambda value: np.asarray(value, np.float64), motion_params(settings, room))


def _nobody(room: int, params: MotionParams) -> MotionState:
    none = np.zeros((room, 3))
    return _on_host(motion.init(none, none, np.tile(np.eye(3), (room, 1, 1)), params))


def _on_host(state: MotionState) -> MotionState:
    """The state in arrays of its own."""
    return jax.tree.map(np.array, state)


@jax.jit
def _predict(state: MotionState, dt_s: Float[Array, ""], params: MotionParams) -> MotionState:
    return motion.predict(state, dt_s, params)


@jax.jit
def _correct(
    state: MotionState,
    measured_m: Float[Array, "drones 3"],
    covariance_m2: Float[Array, "drones 3 3"],
    was_measured: Bool[Array, "drones"],
    lost: Bool[Array, "drones"],
    dt_s: Float[Array, ""],
    bounds_m: Float[Array, "2 3"],
    max_speed_m_s: Float[Array, ""],
    params: MotionParams,
) -> MotionState:
    state, _ = motion.update(state, measured_m, covariance_m2, was_measured, params)
    limits = {"dt_s": dt_s, "bounds_m": bounds_m, "max_speed_m_s": max_speed_m_s}
    return motion.tamed(state, ~was_measured, lost, **limits)


# --- from notes to arrays


def _tracked(tracks: list[_Track], num_frames: int, settings: TrackSettings) -> Tracked:
    """The notes on all drones in arrays."""
    num_drones = len({track.drone for track in tracks})
    shape = (num_frames, num_drones)
    info = TrackerInfo(
        position_m=np.full((*shape, 3), np.nan),
        velocity_m_s=np.full((*shape, 3), np.nan),
        covariance_m2=np.full((*shape, 3, 3), np.nan),
        measured_m=np.full((*shape, 3), np.nan),
        measured_covariance_m2=np.full((*shape, 3, 3), np.nan),
        fitness=np.zeros(shape),
        num_cameras=np.zeros(shape, int),
        status=np.full(shape, int(Status.LOST)),
    )
    arrivals: list[Arrival] = []
    size_m: dict[int, Float[np.ndarray, "3"]] = {}
    for track in sorted(tracks, key=lambda track: track.rows[0].frame):
        assert track.drone is not None
        if track.rows[0].frame > 0:
            arrivals.append(Arrival(track.rows[0].frame, track.drone, again=track.drone in size_m))
        size_m[track.drone] = track.size_m
        for row in track.rows:
            _write(info, row, (row.frame, track.drone))
    score = ScoreSettings(windows=settings.windows)
    sizes = np.array([size_m[drone] for drone in range(num_drones)], np.float32).reshape(-1, 3)
    return Tracked(
        info=info,
        sizes=jax.tree.map(np.asarray, init_sizes(sizes, np.zeros(sizes.shape, bool), score)),
        looks=Looks(np.full((*shape, 3), np.nan), np.full((*shape, len(score.windows)), np.nan)),
        arrivals=tuple(arrivals),
        compile_s=0.0,
    )


def _write(info: TrackerInfo, row: _Row, of: tuple[int, int]) -> None:
    """Write a row into the arrays."""
    info.position_m[of], info.velocity_m_s[of] = row.position_m, row.velocity_m_s
    info.covariance_m2[of] = row.covariance_m2
    info.status[of] = int(Status.COASTING)
    if row.found is not None:
        info.status[of] = int(Status.TRACKED)
        info.measured_m[of], info.measured_covariance_m2[of] = row.found.position_m, row.found.covariance_m2
        info.num_cameras[of] = row.found.num_cameras
        info.fitness[of] = row.share

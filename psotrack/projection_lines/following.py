"""The tracks of all drones, frame after frame."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float

from psotrack.correspondence import CameraSightings, Sightings
from psotrack.geometry import Camera, viewpoints
from psotrack.initiation import FLOOR_CLEARANCE_M, NEW, SPEED_SHARE, reidentify
from psotrack.motion import GATE_999
from psotrack.projection_lines.crossings import crossings, in_view
from psotrack.projection_lines.motions import Motions
from psotrack.projection_lines.parting import parted
from psotrack.projection_lines.results import tracked_of
from psotrack.projection_lines.tracks import Found, Track, TrackRow, lost_of, newcomer_of
from psotrack.settings import TrackSettings
from psotrack.support import Report, no_progress
from psotrack.tracking import DISPERSION_FRAMES, Tracked

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


def follow(
    cameras: Camera,
    sightings: Sightings,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    known: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None = None,
    report: Report = no_progress,
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
                follower.step(frame, sightings.at(frame))
                advance(1)
    return tracked_of(follower.drones(), sightings.num_frames, settings)


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
        self._motions = Motions(settings, fps, bounds_m)
        self._max_coasting_frames = round(settings.max_coasting_s * fps)
        self._num_drones = 0
        self._slots: list[Track | None] = []
        self._ended: list[Track] = []

    def begin_known(
        self, position_m: Float[np.ndarray, "known 3"], velocity_m_s: Float[np.ndarray, "known 3"]
    ) -> None:
        """Drones that will be there in the next frame."""
        for position, velocity in zip(position_m, velocity_m_s, strict=True):
            before_m = position - velocity / self._fps
            self._begin(Track(self._num_drones, 1.0), before_m, velocity, self._settings.velocity_std_m_s)
            self._num_drones += 1

    def step(self, frame: int, view: CameraSightings) -> None:
        """One frame: predict, match, correct, and see who comes and goes."""
        self._motions.predict()
        found = self._found(view)
        self._correct(found)
        self._note(frame, found)
        self._bury()
        self._welcome()

    def drones(self) -> list[Track]:
        """The tracks that are of drones; several may be of one."""
        tracks = [*self._ended, *(track for _, track in self._tracks())]
        return [track for track in tracks if track.drone is not None]

    def _tracks(self) -> list[tuple[int, Track]]:
        return [(slot, track) for slot, track in enumerate(self._slots) if track is not None]

    def _begin(
        self,
        track: Track,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        velocity_std_m_s: float,
    ) -> int:
        """Put a track into a slot, with room made for it."""
        if None not in self._slots:
            self._motions.grow()
            self._slots += [None] * (len(self._motions) - len(self._slots))
        slot = self._slots.index(None)
        self._slots[slot] = track
        covariance_m2 = np.square(self._settings.spread_m) * np.eye(3)
        self._motions.place(slot, position_m, velocity_m_s, covariance_m2, velocity_std_m_s)
        return slot

    def _end(self, slot: int) -> None:
        track = self._slots[slot]
        assert track is not None
        self._ended.append(track)
        self._slots[slot] = None

    def _found(self, view: CameraSightings) -> dict[int, Found]:
        """What the frame shows of the tracks, by slot; where it shows what is none of them a track begins."""
        slots, tracks = [slot for slot, _ in self._tracks()], [track for _, track in self._tracks()]
        expected_m = np.asarray(self._motions.state.apparent_m[slots])
        expected_m2 = np.asarray(self._motions.state.covariance[slots, :3, :3])
        span_m = np.array([track.span_m for track in tracks]).reshape(-1, 2)
        crossed = crossings(
            self._cameras,
            parted(self._cameras, view, expected_m, span_m),
            self._bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]]),
            expected_m,
            expected_m2,
            np.array([track.dispersion for track in tracks]),
        )
        usual = float(np.median([track.dispersion for track in tracks])) if tracks else 1.0
        found: dict[int, Found] = {}
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
                slot = self._begin(Track(None, usual), position_m, np.zeros(3), speed_m_s)
            surprising = False
            if who >= 0:
                off_m, spread_m2 = position_m - expected_m[who], expected_m2[who] + crossed.covariance_m2[row]
                surprising = bool(off_m @ np.linalg.solve(spread_m2, off_m) >= SURPRISING)
            if not surprising or num_viewpoints >= TRUSTED_VIEWPOINTS:
                found[slot] = Found(
                    position_m,
                    crossed.covariance_m2[row],
                    float(crossed.disagreement[row]),
                    int(seen.sum()),
                    crossed.span_m[row],
                    surprising,
                )
        return found

    def _correct(self, found: dict[int, Found]) -> None:
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
        predicted_m_s = np.asarray(self._motions.state.velocity_m_s)
        self._motions.correct(measured_m, covariance_m2, was_measured, lost)
        for slot, one in found.items():
            if one.surprising:
                # The filter would take it for an outlier for a second; all of its views agree that it is none.
                speed_m_s = SPEED_SHARE * self._settings.max_speed_m_s
                self._motions.place(slot, one.position_m, predicted_m_s[slot], one.covariance_m2, speed_m_s)

    def _note(self, frame: int, found: dict[int, Found]) -> None:
        """Note what is known of each track after the frame."""
        position_m, velocity_m_s, covariance_m2 = (
            np.asarray(getattr(self._motions.state, name))
            for name in ("position_m", "velocity_m_s", "position_covariance_m2")
        )
        num_in_view = in_view(self._cameras, position_m).sum(axis=-1)
        for slot, track in self._tracks():
            one = found.get(slot)
            state = (position_m[slot], velocity_m_s[slot], covariance_m2[slot])
            track.rows.append(TrackRow(frame, *state, int(num_in_view[slot]), one))
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
        chosen = reidentify(
            tuple(newcomer_of(track) for _, track in coming),
            lost_of([track for _, track in absent], coming[0][1].rows[-1].frame, self._fps),
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

    def _absent(self) -> list[tuple[int | None, Track]]:
        """The last track of each drone that is not found now, with its slot if it is still expected somewhere."""
        ended: list[tuple[int | None, Track]] = [(None, track) for track in self._ended]
        last = {track.drone: (slot, track) for slot, track in [*ended, *self._tracks()]}
        missed = {drone: of for drone, of in last.items() if of[0] is None or of[1].missed > 0}
        return [of for drone, of in missed.items() if drone is not None]

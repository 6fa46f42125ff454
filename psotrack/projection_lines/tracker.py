"""The tracks of all drones through all frames: predict, match, triangulate, correct."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float, Int

from psotrack.correspondence import (
    SEPARATION_M,
    CameraSightings,
    Crossings,
    Expected,
    Sightings,
    crossings,
    moved_to_instant,
)
from psotrack.geometry import Camera, in_images, project_visible, sizes_px, to_camera, viewpoints
from psotrack.initiation import (
    NEW,
    SPEED_SHARE,
    TRUSTED_VIEWPOINTS,
    BirthRules,
    Births,
    KnownDrones,
    Measurement,
    TrackCandidate,
    reidentify,
)
from psotrack.motion import GATE_999
from psotrack.projection_lines.merged_boxes import split_merged_boxes
from psotrack.projection_lines.results import as_tracks
from psotrack.projection_lines.single_views import SingleViews, find_single_views
from psotrack.projection_lines.track_motion import TrackMotion
from psotrack.projection_lines.tracks import Track, TrackRow, as_lost_tracks
from psotrack.settings import DroneSettings, MotionSettings, StatusSettings
from psotrack.support import Report, no_progress
from psotrack.trajectories import Tracks

#: Squared distance from the expected position, normalised by covariance, from which on a drone is elsewhere if trusted
#: viewpoints say so. The filter treats positions beyond its gate as outliers, which is right up to twice the gate.
SURPRISING = 2 * GATE_999


@dataclass(frozen=True)
class LineSettings:
    """The parts of the settings that the projection lines read (see `psotrack.settings`).

    Attributes:
        motion, drones, status: parts of `TrackSettings`.
        spread_m: standard deviation of a new track's position, metres.
    """

    motion: MotionSettings
    drones: DroneSettings
    status: StatusSettings
    spread_m: float


def track_detections(
    cameras: Camera,
    sightings: Sightings,
    settings: LineSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    known: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None = None,
    report: Report = no_progress,
) -> Tracks:
    """Track the drones through all frames by their detections.

    The fitness is the share of the cameras with the drone in view whose detections agree on the drone. Sizes are those
    of the boxes, as wide along x as along y.

    Args:
        cameras: cameras with one leading axis.
        sightings: detections of all cameras.
        settings: the parts of the settings that the projection lines read.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        known: positions and velocities of the drones at frame 0, (known, 3) each, metres and m/s; None finds the
            drones.
        report: reports progress, in frames.
    """
    # float64 is switched on in this block only.
    with jax.enable_x64(True):
        tracker = _Tracker(cameras, settings, fps, bounds_m, _density_px2(cameras, sightings))
        if known is not None:
            tracker.start_known(*known)
        with report("track", sightings.num_frames) as advance:
            for frame in range(sightings.num_frames):
                tracker.step(frame, sightings.at(frame))
                advance(1)
    return as_tracks(tracker.tracks_of_drones(), sightings.num_frames, settings.status.max_coasting_std_m)


def _density_px2(cameras: Camera, sightings: Sightings) -> Float[np.ndarray, "cameras"]:
    """(cameras,), mean number of sightings per frame and square pixel; of one sighting at least in the whole time."""
    total = np.maximum(np.isfinite(sightings.noise_px).sum(axis=(0, -1)), 1)
    return total / sightings.num_frames / np.asarray(cameras.image_size_wh, np.float64).prod(axis=-1)


class _Tracker:
    """Tracks in progress, in slots of the motion model's arrays."""

    def __init__(
        self,
        cameras: Camera,
        settings: LineSettings,
        fps: float,
        bounds_m: Float[np.ndarray, "2 3"],
        density_px2: Float[np.ndarray, "cameras"],
    ) -> None:
        self._cameras = cameras
        self._density_px2 = density_px2
        self._viewpoint = viewpoints(cameras)
        self._settings = settings
        self._fps = fps
        self._bounds_m = bounds_m
        self._max_speed_m_s = settings.motion.speed_limit_m_s
        self._motion = TrackMotion(settings.motion, fps, bounds_m)
        self._births = Births(
            cameras,
            BirthRules(settings.status.min_cameras_to_begin),
            fps=fps,
            bounds_m=bounds_m,
            max_speed_m_s=self._max_speed_m_s,
        )
        self._max_coasting_frames = round(settings.status.max_coasting_s * fps)
        self._num_drones = 0
        self._slots: list[Track | None] = []
        self._ended: list[Track] = []

    def start_known(
        self, position_m: Float[np.ndarray, "known 3"], velocity_m_s: Float[np.ndarray, "known 3"]
    ) -> None:
        """Start tracks of drones that will be at these positions in the next frame."""
        covariance_m2 = np.square(self._settings.spread_m) * np.eye(3)
        for position, velocity in zip(position_m, velocity_m_s, strict=True):
            slot = self._slot_of(Track(self._new_drone(), 1.0))
            std_m_s = self._settings.motion.velocity_std_m_s
            self._motion.place(slot, position - velocity / self._fps, velocity, covariance_m2, std_m_s)

    def step(self, frame: int, view: CameraSightings) -> None:
        """One frame: predict, match, correct, end tracks and begin new ones."""
        self._motion.predict()
        measured, seen_by_one = self._measure(frame, view)
        self._correct(measured, seen_by_one)
        for slot, track in self._active():
            track.append(self._row(frame, self._motion, slot, measured.get(slot)))
        for slot, track in self._active():
            if track.unseen > self._max_coasting_frames:
                self._end(slot)
        self._begin(frame)

    def tracks_of_drones(self) -> list[Track]:
        """All tracks; several may be of one drone."""
        return [*self._ended, *(track for _, track in self._active())]

    def _active(self) -> list[tuple[int, Track]]:
        """Slots and tracks that have not ended."""
        return [(slot, track) for slot, track in enumerate(self._slots) if track is not None]

    def _slot_of(self, track: Track) -> int:
        """Put a track into a free slot, and return the slot."""
        if None not in self._slots:
            self._motion.grow()
            self._slots += [None] * (len(self._motion) - len(self._slots))
        slot = self._slots.index(None)
        self._slots[slot] = track
        return slot

    def _end(self, slot: int) -> None:
        track = self._slots[slot]
        assert track is not None
        self._ended.append(track)
        self._slots[slot] = None

    def _new_drone(self) -> int:
        self._num_drones += 1
        return self._num_drones - 1

    def _measure(self, frame: int, view: CameraSightings) -> tuple[dict[int, Measurement], SingleViews]:
        """The frame's measurements by slot, and the views by slot of drones that have none."""
        active = self._active()
        slots, tracks = [slot for slot, _ in active], [track for _, track in active]
        shown, view = view, self._at_instant(view, slots)
        expected = Expected(
            np.asarray(self._motion.state.apparent_m[slots]),
            np.asarray(self._motion.state.covariance[slots, :3, :3]),
            np.array([track.dispersion for track in tracks]),
        )
        span_m = np.array([track.span_m for track in tracks]).reshape(-1, 2)
        view = split_merged_boxes(self._cameras, view, expected.position_m, span_m)
        required = self._settings.status.min_cameras_to_begin
        crossed = crossings(self._cameras, view, self._bounds_m, expected, required)
        measured: dict[int, Measurement] = {}
        taken: list[int] = []
        # Expected drones first: an unexpected position may be a part of an expected drone.
        for row in np.argsort(crossed.expected < 0, kind="stable").tolist():
            seen = crossed.seen[row]
            num_viewpoints = len(set(self._viewpoint[seen].tolist()))
            if seen.sum() < max(self._settings.status.min_cameras, 2) or num_viewpoints < 2:
                continue
            number = int(crossed.expected[row])
            if number < 0:
                number = self._nearly_expected(crossed, row, slots, expected, measured)
            if number < 0:
                continue
            taken.append(row)
            surprising = bool(_surprise(crossed, row, expected)[number] >= SURPRISING)
            if slots[number] in measured or (surprising and num_viewpoints < TRUSTED_VIEWPOINTS):
                continue
            measured[slots[number]] = Measurement(
                crossed.position_m[row],
                crossed.covariance_m2[row],
                float(crossed.disagreement[row]),
                int(seen.sum()),
                num_viewpoints,
                crossed.span_m[row],
                surprising,
            )
        rest = view.without(*_camera_and_box(crossed.box[taken]))
        there_m = np.where(np.isin(slots, [*measured])[:, None], expected.position_m, np.nan)
        known = KnownDrones(there_m, span_m[:, [0, 0, 1]], _boxes_px(self._cameras, there_m, span_m))
        usual = float(np.median(expected.dispersion)) if tracks else 1.0
        # As the cameras showed them: what is born has a motion of its own. Parts of split boxes are of known drones.
        num_boxes = shown.noise_px.shape[1]
        unexplained = shown.without(*np.nonzero(np.isnan(rest.noise_px[:, :num_boxes])))
        others = self._births.step(frame, unexplained, known, usual)
        return measured, self._seen_by_one(rest, others, slots, measured)

    def _nearly_expected(
        self,
        crossed: Crossings,
        row: int,
        slots: list[int],
        expected: Expected,
        measured: dict[int, Measurement],
    ) -> int:
        """Index of the expected drone that an unexpected crossing belongs to; -1 if there is none.

        A crossing beside a drone is a part of the drone. If the drone was found in the last frame and has no crossing
        now, a crossing of trusted viewpoints may be farther away: another drone hardly replaces this one in one frame.
        """
        distance_m = np.linalg.norm(expected.position_m - crossed.position_m[row], axis=-1)
        if distance_m.min(initial=np.inf) < SEPARATION_M:
            return int(distance_m.argmin())
        if len(set(self._viewpoint[crossed.seen[row]].tolist())) < TRUSTED_VIEWPOINTS:
            return -1
        is_open = np.array([slot not in measured and self._missed(slot) == 0 for slot in slots], bool)
        surprise = np.where(is_open, _surprise(crossed, row, expected), np.inf)
        return int(surprise.argmin()) if surprise.min(initial=np.inf) < SURPRISING else -1

    def _missed(self, slot: int) -> int:
        track = self._slots[slot]
        return 0 if track is None else track.missed

    def _seen_by_one(
        self,
        rest: CameraSightings,
        others: Int[np.ndarray, "crossings cameras"],
        slots: list[int],
        measured: dict[int, Measurement],
    ) -> SingleViews:
        """The views of drones that have no measurement, among the detections that are of no other drone; by slot."""
        missed = [slot for slot in slots if slot not in measured]
        state = self._motion.state
        views = find_single_views(
            self._cameras,
            rest,
            np.isfinite(rest.without(*_camera_and_box(others)).noise_px),
            self._density_px2,
            np.asarray(state.apparent_m[missed]),
            np.asarray(state.covariance[missed, :3, :3]),
            np.array([track.dispersion for slot, track in self._active() if slot in missed]),
        )
        return replace(views, drone=np.array(missed, int)[views.drone])

    def _at_instant(self, view: CameraSightings, slots: list[int]) -> CameraSightings:
        """The detections as they would be if all frames had been exposed at the instant."""
        if view.exposures is None:
            return view
        state = self._motion.state
        variance = np.asarray(state.covariance[slots, 3:6, 3:6]).trace(axis1=-2, axis2=-1) / 3
        return moved_to_instant(
            self._cameras,
            view,
            np.asarray(state.apparent_m[slots]),
            np.asarray(state.velocity_m_s[slots]),
            np.sqrt(np.maximum(variance, 0.0)),
            self._settings.motion.velocity_std_m_s,
        )

    def _correct(self, measured: dict[int, Measurement], seen_by_one: SingleViews) -> None:
        """Correct the motion model by the measurements, and by the views of drones that have none."""
        lost = np.zeros(len(self._slots), bool)
        for slot, track in self._active():
            track.missed = 0 if slot in measured else track.missed + 1
            track.unseen = 0 if slot in measured or slot in seen_by_one.drone else track.unseen + 1
            lost[slot] = track.unseen > self._max_coasting_frames
        predicted_m_s = np.asarray(self._motion.state.velocity_m_s)
        for number, slot in enumerate(seen_by_one.drone.tolist()):
            view = seen_by_one.jacobian[number], seen_by_one.off_px[number], seen_by_one.noise_px[number]
            self._motion.correct_in_image(slot, *view)
        self._motion.correct(measured, seen_by_one.drone, lost)
        for slot, one in measured.items():
            if one.surprising:
                # The filter would treat the position as an outlier for a second, but all viewpoints agree on it.
                speed_m_s = SPEED_SHARE * self._max_speed_m_s
                self._motion.place(slot, one.position_m, predicted_m_s[slot], one.covariance_m2, speed_m_s)

    def _row(self, frame: int, motion: TrackMotion, slot: int, measured: Measurement | None) -> TrackRow:
        """The row of a track after a frame."""
        position_m, velocity_m_s, covariance_m2 = (
            np.asarray(getattr(motion.state, name))[slot]
            for name in ("position_m", "velocity_m_s", "position_covariance_m2")
        )
        num_in_view = int(in_images(self._cameras, position_m).sum())
        return TrackRow(frame, position_m, velocity_m_s, covariance_m2, num_in_view, measured)

    def _begin(self, frame: int) -> None:
        """Begin the tracks of candidates: of drones that are missed, or of new drones."""
        missed = self._missed_drones()
        candidates = self._births.candidates(may_return=len(missed) > 0)
        if not candidates:
            self._births.take(())
            return
        count = self._settings.drones.count
        assignment = reidentify(
            candidates,
            as_lost_tracks([track for _, track in missed]),
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=self._max_speed_m_s,
            max_births=None if count is None else max(count - self._num_drones, 0),
        )
        self._births.take(
            each for each, row in zip(candidates, assignment, strict=True) if row >= 0 or row == NEW
        )
        for candidate, assigned in zip(candidates, assignment.tolist(), strict=True):
            if assigned >= 0:
                former_slot, former = missed[assigned]
                if former_slot is not None:
                    self._end(former_slot)
                self._start(candidate, former.drone, frame)
            elif assigned == NEW:
                self._start(candidate, self._new_drone(), frame)

    def _start(self, candidate: TrackCandidate, drone: int, frame: int) -> None:
        """Start a track at the frame in which the candidate was first seen, and follow it to the present frame."""
        first = candidate.path[candidate.instant]
        motion = TrackMotion(self._settings.motion, self._fps, self._bounds_m)
        motion.grow()
        std_m_s = self._settings.motion.velocity_std_m_s
        motion.place(0, first.position_m, candidate.velocity_m_s, first.covariance_m2, std_m_s)
        track = Track(drone, first.disagreement)
        track.append(self._row(candidate.instant, motion, 0, first))
        for instant in range(candidate.instant + 1, frame + 1):
            motion.predict()
            one = candidate.path.get(instant)
            motion.correct({} if one is None else {0: one}, np.empty(0, int), np.zeros(len(motion), bool))
            track.missed = track.unseen = 0 if one is not None else track.missed + 1
            track.append(self._row(instant, motion, 0, one))
        self._motion.take(self._slot_of(track), motion, 0)

    def _missed_drones(self) -> list[tuple[int | None, Track]]:
        """The last track of each drone that is not found now, with its slot if the track has not ended."""
        ended: list[tuple[int | None, Track]] = [(None, track) for track in self._ended]
        last = {track.drone: (slot, track) for slot, track in [*ended, *self._active()]}
        return [(slot, track) for slot, track in last.values() if slot is None or track.missed > 0]


def _camera_and_box(
    box: Int[np.ndarray, "crossings cameras"],
) -> tuple[Int[np.ndarray, "used"], Int[np.ndarray, "used"]]:
    """(used,), cameras and boxes of the detections in crossings."""
    row, camera = np.nonzero(box >= 0)
    return camera, box[row, camera]


def _boxes_px(
    cameras: Camera, position_m: Float[np.ndarray, "drones 3"], span_m: Float[np.ndarray, "drones 2"]
) -> Float[np.ndarray, "drones cameras 4"]:
    """Boxes of drones as in `KnownDrones`; NaN where a drone's place or width is not known, or has no image."""
    pixels, _ = project_visible(cameras, position_m[:, None])
    half_px = sizes_px(cameras, np.asarray(to_camera(cameras, position_m[:, None])), span_m[:, None]) / 2
    return np.concatenate([pixels + 0.5, np.broadcast_to(half_px, pixels.shape)], axis=-1)


def _surprise(crossed: Crossings, row: int, expected: Expected) -> Float[np.ndarray, "drones"]:
    """(drones,), squared distances of a crossing from expected positions, normalised by both covariances."""
    off_m = crossed.position_m[row] - expected.position_m
    spread_m2 = expected.covariance_m2 + crossed.covariance_m2[row]
    return (off_m * np.linalg.solve(spread_m2, off_m[..., None])[..., 0]).sum(axis=-1)

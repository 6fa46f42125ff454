"""The tracks of all drones through all frames: predict, match, triangulate, correct."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.correspondence import CameraSightings, Sightings
from psotrack.geometry import Camera, in_images, viewpoints
from psotrack.initiation import FLOOR_CLEARANCE_M, NEW, SPEED_SHARE, reidentify
from psotrack.motion import GATE_999
from psotrack.projection_lines.crossings import Crossings, crossings
from psotrack.projection_lines.exposures import moved_to_instant
from psotrack.projection_lines.merged_boxes import split_merged_boxes
from psotrack.projection_lines.results import as_tracks
from psotrack.projection_lines.single_views import SingleViews, find_single_views
from psotrack.projection_lines.track_motion import TrackMotion
from psotrack.projection_lines.tracks import Measurement, Track, TrackRow, as_candidate, as_lost_tracks
from psotrack.settings import DroneSettings, MotionSettings, StatusSettings
from psotrack.support import Report, no_progress
from psotrack.tracking import DISPERSION_FRAMES
from psotrack.trajectories import Tracks

#: A track that was found in this many of its first frames is of a drone, if enough cameras agreed in this many of them.
CONFIRMED_HITS, FIRST_FRAMES, AGREED_HITS = 5, 8, 3
#: The number where only two viewpoints agree: lines of sight of two cameras cross by chance for longer.
CONFIRMED_HITS_OF_TWO = 15
#: The number where more viewpoints than two have the place in view, but something hides the drone from them, such as a
#: post. Two things that pass each other's epipolar lines by a third of a pixel per frame cross for as long.
CONFIRMED_HITS_OF_TWO_ALONE = 30
#: Largest number, and if it is larger share, of frames in which a track may be missed that is not confirmed yet after
#: its first frames.
LATER_MISSED, MISSED_SHARE = 9, 0.4
#: Least share of the cameras with the drone in view that must see the drone; fewer lines of sight cross by chance.
#: Detectors miss drones and drones hide each other: half of the cameras would be too many.
MIN_SHARE = 0.4
#: A position nearer than this to a track is taken for a part of the track, metres.
SEPARATION_M = 0.25
#: A position that this many viewpoints agree on is accepted at any distance from the prediction; two viewpoints may
#: agree by chance.
TRUSTED_VIEWPOINTS = 3
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
        self._motion = TrackMotion(settings.motion, fps, bounds_m)
        self._max_coasting_frames = round(settings.status.max_coasting_s * fps)
        self._num_drones = 0
        self._slots: list[Track | None] = []
        self._ended: list[Track] = []

    def start_known(
        self, position_m: Float[np.ndarray, "known 3"], velocity_m_s: Float[np.ndarray, "known 3"]
    ) -> None:
        """Start tracks of drones that will be at these positions in the next frame."""
        for position, velocity in zip(position_m, velocity_m_s, strict=True):
            before_m = position - velocity / self._fps
            track = Track(self._num_drones, 1.0)
            self._start(track, before_m, velocity, self._settings.motion.velocity_std_m_s)
            self._num_drones += 1

    def step(self, frame: int, view: CameraSightings) -> None:
        """One frame: predict, match, correct, end and confirm tracks."""
        self._motion.predict()
        measured, seen_by_one = self._measure(view)
        self._correct(measured, seen_by_one)
        self._append_rows(frame, measured)
        self._end_lost_tracks()
        self._confirm_tracks()

    def tracks_of_drones(self) -> list[Track]:
        """The tracks that are of drones; several may be of one drone."""
        tracks = [*self._ended, *(track for _, track in self._active())]
        return [track for track in tracks if track.drone is not None]

    def _track(self, slot: int) -> Track:
        track = self._slots[slot]
        assert track is not None
        return track

    def _active(self) -> list[tuple[int, Track]]:
        """Slots and tracks that have not ended."""
        return [(slot, track) for slot, track in enumerate(self._slots) if track is not None]

    def _start(
        self,
        track: Track,
        position_m: Float[np.ndarray, "3"],
        velocity_m_s: Float[np.ndarray, "3"],
        velocity_std_m_s: float,
    ) -> int:
        """Put a track into a free slot, and return the slot."""
        if None not in self._slots:
            self._motion.grow()
            self._slots += [None] * (len(self._motion) - len(self._slots))
        slot = self._slots.index(None)
        self._slots[slot] = track
        covariance_m2 = np.square(self._settings.spread_m) * np.eye(3)
        self._motion.place(slot, position_m, velocity_m_s, covariance_m2, velocity_std_m_s)
        return slot

    def _end(self, slot: int) -> None:
        self._ended.append(self._track(slot))
        self._slots[slot] = None

    def _measure(self, view: CameraSightings) -> tuple[dict[int, Measurement], SingleViews]:
        """The frame's measurements by slot, and the views by slot of drones that have none.

        A position that is of no track starts one.
        """
        active = self._active()
        # Drones, and tracks that enough viewpoints have agreed on once, come first; see `_crossings`.
        sure = [(slot, track) for slot, track in active if track.drone is not None or track.agreed_hits]
        vague = [(slot, track) for slot, track in active if track.drone is None and not track.agreed_hits]
        slots, tracks = [slot for slot, _ in sure + vague], [track for _, track in sure + vague]
        view = self._at_instant(view, slots)
        expected_m = np.asarray(self._motion.state.apparent_m[slots])
        expected_m2 = np.asarray(self._motion.state.covariance[slots, :3, :3])
        span_m = np.array([track.span_m for track in tracks]).reshape(-1, 2)
        dispersion = np.array([track.dispersion for track in tracks])
        num_sure = len(sure)
        view = split_merged_boxes(self._cameras, view, expected_m[:num_sure], span_m[:num_sure])
        crossed = self._crossings(view, expected_m, expected_m2, dispersion, num_sure)
        usual = float(np.median([track.dispersion for track in tracks])) if tracks else 1.0
        measured: dict[int, Measurement] = {}
        # Detections in which lines of sight cross are of something that several cameras see.
        crossing: list[int] = []
        # Expected drones first: an unexpected position may be a part of an expected drone.
        for row in np.argsort(crossed.expected < 0, kind="stable").tolist():
            number, seen, position_m = int(crossed.expected[row]), crossed.seen[row], crossed.position_m[row]
            num_viewpoints = len(set(self._viewpoint[seen].tolist()))
            if seen.sum() < max(self._settings.status.min_cameras, 2) or num_viewpoints < 2:
                continue
            crossing.append(row)
            if number >= 0:
                slot = slots[number]
            elif (near := self._nearly_expected(crossed, row, slots, expected_m, expected_m2, measured)) >= 0:
                # The track's covariance was too small, as when a drone turns sharply.
                number, slot = near, slots[near]
                if slot in measured:
                    continue
            elif _beside_better(crossed, row):
                continue
            else:
                speed_m_s = SPEED_SHARE * self._settings.motion.speed_limit_m_s
                slot = self._start(Track(None, usual), position_m, np.zeros(3), speed_m_s)
            surprising = number >= 0 and bool(
                _surprise(crossed, row, expected_m[[number]], expected_m2[[number]])[0] >= SURPRISING
            )
            if not surprising or num_viewpoints >= TRUSTED_VIEWPOINTS:
                measured[slot] = Measurement(
                    position_m,
                    crossed.covariance_m2[row],
                    float(crossed.disagreement[row]),
                    int(seen.sum()),
                    num_viewpoints,
                    crossed.span_m[row],
                    surprising,
                )
        return measured, self._seen_by_one(view, crossed.box[crossing], slots, measured)

    def _crossings(
        self,
        view: CameraSightings,
        expected_m: Float[np.ndarray, "drones 3"],
        expected_m2: Float[np.ndarray, "drones 3 3"],
        dispersion: Float[np.ndarray, "drones"],
        num_sure: int,
    ) -> Crossings:
        """Crossings of the frame's lines of sight, with the first `num_sure` of the expected tracks, then the others.

        Lines of two viewpoints cross by chance, where more viewpoints have the place in view. Such crossings are looked
        for among the detections of nothing else, so that they take no detection from a drone.
        """
        required = self._settings.status.min_cameras_to_begin
        bounds_m = self._bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])

        def crossed_by(view: CameraSightings, part: slice, min_views: int | None) -> Crossings:
            expected = expected_m[part], expected_m2[part], dispersion[part]
            return crossings(self._cameras, view, bounds_m, *expected, min_views)

        first = crossed_by(view, slice(num_sure), required)
        if required is not None:
            return first
        rest = view.without(*_camera_and_box(first.box))
        return first.joined(crossed_by(rest, slice(num_sure, None), 2), num_sure)

    def _nearly_expected(
        self,
        crossed: Crossings,
        row: int,
        slots: list[int],
        expected_m: Float[np.ndarray, "drones 3"],
        expected_m2: Float[np.ndarray, "drones 3 3"],
        measured: dict[int, Measurement],
    ) -> int:
        """Index of the expected drone that an unexpected crossing belongs to; -1 if there is none.

        A crossing beside a drone is a part of the drone. If the drone was found in the last frame and has no crossing
        now, a crossing of trusted viewpoints may be farther away: another drone hardly replaces this one in one frame.
        """
        distance_m = np.linalg.norm(expected_m - crossed.position_m[row], axis=-1)
        if distance_m.min(initial=np.inf) < SEPARATION_M:
            return int(distance_m.argmin())
        if len(set(self._viewpoint[crossed.seen[row]].tolist())) < TRUSTED_VIEWPOINTS:
            return -1
        is_open = np.array([slot not in measured and self._track(slot).missed == 0 for slot in slots], bool)
        surprise = np.where(is_open, _surprise(crossed, row, expected_m, expected_m2), np.inf)
        return int(surprise.argmin()) if surprise.min(initial=np.inf) < SURPRISING else -1

    def _seen_by_one(
        self,
        view: CameraSightings,
        used: Int[np.ndarray, "crossings cameras"],
        slots: list[int],
        measured: dict[int, Measurement],
    ) -> SingleViews:
        """The views of drones that have no measurement, among the detections that are of no other drone; by slot."""
        missed = [slot for slot in slots if slot not in measured and self._track(slot).drone is not None]
        free = np.isfinite(view.without(*_camera_and_box(used)).noise_px)
        state = self._motion.state
        views = find_single_views(
            self._cameras,
            view,
            free,
            self._density_px2,
            np.asarray(state.apparent_m[missed]),
            np.asarray(state.covariance[missed, :3, :3]),
            np.array([self._track(slot).dispersion for slot in missed]),
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
        room = len(self._slots)
        measured_m, covariance_m2 = np.zeros((room, 3)), np.tile(np.eye(3), (room, 1, 1))
        was_measured, lost = np.zeros((2, room), bool)
        for slot, track in self._active():
            if slot in measured:
                measured_m[slot] = measured[slot].position_m
                covariance_m2[slot] = measured[slot].covariance_m2
                was_measured[slot] = True
            track.missed = 0 if slot in measured else track.missed + 1
            track.unseen = 0 if slot in measured or slot in seen_by_one.drone else track.unseen + 1
            lost[slot] = track.unseen > self._max_coasting_frames
        predicted_m_s = np.asarray(self._motion.state.velocity_m_s)
        for number, slot in enumerate(seen_by_one.drone.tolist()):
            view = seen_by_one.jacobian[number], seen_by_one.off_px[number], seen_by_one.noise_px[number]
            self._motion.correct_in_image(slot, *view)
        unseen = ~was_measured
        unseen[seen_by_one.drone] = False
        self._motion.correct(measured_m, covariance_m2, was_measured, unseen, lost)
        for slot, one in measured.items():
            if one.surprising:
                # The filter would treat the position as an outlier for a second, but all viewpoints agree on it.
                speed_m_s = SPEED_SHARE * self._settings.motion.speed_limit_m_s
                self._motion.place(slot, one.position_m, predicted_m_s[slot], one.covariance_m2, speed_m_s)

    def _append_rows(self, frame: int, measured: dict[int, Measurement]) -> None:
        """Append the frame's row to each track."""
        position_m, velocity_m_s, covariance_m2 = (
            np.asarray(getattr(self._motion.state, name))
            for name in ("position_m", "velocity_m_s", "position_covariance_m2")
        )
        in_view = in_images(self._cameras, position_m)
        num_in_view = in_view.sum(axis=-1)
        required = self._required_viewpoints(in_view)
        for slot, track in self._active():
            one = measured.get(slot)
            state = (position_m[slot], velocity_m_s[slot], covariance_m2[slot])
            track.rows.append(TrackRow(frame, *state, int(num_in_view[slot]), one))
            if one is not None:
                track.hits += 1
                track.agreed_hits += int(one.num_viewpoints >= required[slot])
                track.hits_of_three += one.num_viewpoints >= TRUSTED_VIEWPOINTS
                track.dispersion += (one.disagreement - track.dispersion) / DISPERSION_FRAMES

    def _required_viewpoints(self, in_view: Bool[np.ndarray, "slots cameras"]) -> Int[np.ndarray, "slots"]:
        """(slots,), number of viewpoints that must agree to begin a track at places with these cameras in view."""
        required = self._settings.status.min_cameras_to_begin
        if required is not None:
            return np.full(len(in_view), required)
        at = self._viewpoint[:, None] == np.unique(self._viewpoint)
        return np.clip((in_view @ at > 0).sum(axis=-1), 2, TRUSTED_VIEWPOINTS)

    def _end_lost_tracks(self) -> None:
        """End tracks of lost drones, and tracks that come from chance crossings of lines of sight."""
        for slot, track in self._active():
            if (track.drone is None and _by_chance(track)) or track.unseen > self._max_coasting_frames:
                self._end(slot)

    def _confirm_tracks(self) -> None:
        """Assign drones to tracks that were found often enough: a drone that is missed, or a new drone.

        A drone that is missed is found again by fewer frames of two views than a new one.
        """
        missed = self._missed_drones()
        unconfirmed = [
            (slot, track)
            for slot, track in self._active()
            if track.drone is None and (self._is_confirmed(track) or (missed and _may_be_known(track)))
        ]
        if not unconfirmed:
            return
        count = self._settings.drones.count
        assignment = reidentify(
            tuple(as_candidate(track) for _, track in unconfirmed),
            as_lost_tracks([track for _, track in missed], unconfirmed[0][1].rows[-1].frame, self._fps),
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=self._settings.motion.speed_limit_m_s,
            max_births=None if count is None else max(count - self._num_drones, 0),
        )
        for (slot, track), assigned in zip(unconfirmed, assignment.tolist(), strict=True):
            if assigned >= 0:
                former_slot, former = missed[assigned]
                track.drone = former.drone
                if former_slot is not None:
                    self._end(former_slot)
            elif not self._is_confirmed(track):
                continue
            elif assigned == NEW:
                track.drone = self._num_drones
                self._num_drones += 1
            else:
                self._end(slot)

    def _is_confirmed(self, track: Track) -> bool:
        """Whether a track was found often enough, and enough cameras agreed, to be of a drone."""
        if track.agreed_hits < AGREED_HITS:
            # A number of cameras that is asked for counts without exception.
            is_open = self._settings.status.min_cameras_to_begin is None
            return is_open and track.hits >= CONFIRMED_HITS_OF_TWO_ALONE
        of_two = track.hits_of_three < AGREED_HITS
        return track.hits >= (CONFIRMED_HITS_OF_TWO if of_two else CONFIRMED_HITS)

    def _missed_drones(self) -> list[tuple[int | None, Track]]:
        """The last track of each drone that is not found now, with its slot if the track has not ended."""
        ended: list[tuple[int | None, Track]] = [(None, track) for track in self._ended]
        last = {track.drone: (slot, track) for slot, track in [*ended, *self._active()]}
        return [
            (slot, track)
            for drone, (slot, track) in last.items()
            if drone is not None and (slot is None or track.missed > 0)
        ]


def _camera_and_box(
    box: Int[np.ndarray, "crossings cameras"],
) -> tuple[Int[np.ndarray, "used"], Int[np.ndarray, "used"]]:
    """(used,), cameras and boxes of the detections in crossings."""
    row, camera = np.nonzero(box >= 0)
    return camera, box[row, camera]


def _surprise(
    crossed: Crossings,
    row: int,
    expected_m: Float[np.ndarray, "drones 3"],
    expected_m2: Float[np.ndarray, "drones 3 3"],
) -> Float[np.ndarray, "drones"]:
    """(drones,), squared distances of a crossing from expected positions, normalised by both covariances."""
    off_m = crossed.position_m[row] - expected_m
    spread_m2 = expected_m2 + crossed.covariance_m2[row]
    return (off_m * np.linalg.solve(spread_m2, off_m[..., None])[..., 0]).sum(axis=-1)


def _beside_better(crossed: Crossings, row: int) -> bool:
    """Whether a crossing is beside one that more cameras see: a part of the same drone."""
    near = np.linalg.norm(crossed.position_m - crossed.position_m[row], axis=-1) < SEPARATION_M
    num_cameras = crossed.seen.sum(axis=-1)
    return bool((near & (num_cameras > num_cameras[row])).any())


def _may_be_known(track: Track) -> bool:
    """Whether a track was found often enough to be of a drone that is missed."""
    often = track.hits >= CONFIRMED_HITS and len(track.rows) <= FIRST_FRAMES
    return often and track.agreed_hits >= AGREED_HITS


def _by_chance(track: Track) -> bool:
    """Whether an unconfirmed track comes from chance crossings of lines of sight."""
    most_missed = FIRST_FRAMES - CONFIRMED_HITS
    if len(track.rows) > FIRST_FRAMES:
        most_missed = max(LATER_MISSED, int(MISSED_SHARE * len(track.rows)))
    too_few = len(track.rows) - track.hits > most_missed
    return too_few or (track.hits >= CONFIRMED_HITS and track.share < MIN_SHARE)

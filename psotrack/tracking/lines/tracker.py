"""The tracks of all drones through all frames: predict, match, triangulate, correct."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from psotrack.geometry import Camera, in_images, project_visible, sizes_px, to_camera
from psotrack.settings import BLOBS, TrackSettings
from psotrack.support import Report, as_written, no_progress
from psotrack.tracking.births import (
    NEW,
    NO_DRONE,
    SPEED_SHARE,
    TRUSTED_VIEWPOINTS,
    BirthRules,
    Births,
    FlightLimits,
    KnownDrones,
    TrackCandidate,
    reidentify,
)
from psotrack.tracking.lines.history import SPAN_FRAMES, History, TrackedDrone
from psotrack.tracking.lines.merged_boxes import split_merged_boxes
from psotrack.tracking.lines.single_views import SingleViews, find_single_views
from psotrack.tracking.lines.track_motion import TrackMotion
from psotrack.tracking.matching import (
    SEPARATION_M,
    Crossings,
    Expected,
    Measurement,
    Sightings,
    crossings,
    moved_to_instant,
)
from psotrack.tracking.motion import GATE_999
from psotrack.tracking.swarm import DISPERSION_FRAMES, Places
from psotrack.trajectories import Tracks

#: Squared distance from the expected position, normalised by covariance, from which on a drone is elsewhere if trusted
#: viewpoints say so. The filter treats positions beyond its gate as outliers, which is right up to twice the gate.
SURPRISING = 2 * GATE_999


def track_detections(
    cameras: Camera,
    sightings: Sightings,
    settings: TrackSettings,
    *,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    known: tuple[Float[np.ndarray, "known 3"], Float[np.ndarray, "known 3"]] | None = None,
    report: Report = no_progress,
) -> tuple[Tracks, Places]:
    """Track the drones through all frames by their detections; returns tracks, and the drones' places in the images.

    The fitness is the share of the cameras with the drone in view whose detections agree on the drone. Sizes are those
    of the boxes, as wide along x as along y. Places are those that the cameras would show at the instants.

    Args:
        cameras: cameras with one leading axis.
        sightings: detections of all cameras.
        settings: motion, number of drones, and status; `swarm.spread_m` is the standard deviation of known positions.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        known: positions and velocities of the drones at frame 0, (known, 3) each, metres and m/s; None finds the
            drones.
        report: reports progress, in frames.
    """
    with as_written(float64=True):
        tracker = _Tracker(cameras, sightings, settings, fps, bounds_m)
        if known is not None:
            tracker.start_known(*known)
        with report("track", sightings.num_frames) as advance:
            for frame in range(sightings.num_frames):
                tracker.step(frame)
                advance(1)
    return tracker.tracks()


def _density_px2(cameras: Camera, sightings: Sightings) -> Float[np.ndarray, "cameras"]:
    """(cameras,), mean number of sightings per frame and square pixel; of one sighting at least in the whole time."""
    total = np.maximum(np.isfinite(sightings.noise_px).sum(axis=(0, -1)), 1)
    return total / sightings.num_frames / np.asarray(cameras.image_size_wh, np.float64).prod(axis=-1)


class _Tracker:
    """The drones so far: what each frame showed of them, and the motion model's states; both by number of drone."""

    def __init__(
        self,
        cameras: Camera,
        sightings: Sightings,
        settings: TrackSettings,
        fps: float,
        bounds_m: Float[np.ndarray, "2 3"],
    ) -> None:
        self._cameras, self._sightings, self._settings = cameras, sightings, settings
        self._density_px2 = _density_px2(cameras, sightings)
        self._limits = FlightLimits(fps, bounds_m, settings.motion.speed_limit_m_s)
        self._motion = TrackMotion(settings.motion, self._limits)
        self._births = Births(
            cameras,
            self._limits,
            BirthRules(
                settings.status.min_cameras_to_begin,
                num_frames=sightings.num_frames,
                size_m=settings.drones.size_m,
                any_size=settings.detections != BLOBS,
            ),
        )
        self._max_coasting_frames = round(settings.status.max_coasting_s * fps)
        self._history = History(sightings.num_frames, len(cameras.K))
        self._drones: list[TrackedDrone] = []

    def start_known(
        self, position_m: Float[np.ndarray, "known 3"], velocity_m_s: Float[np.ndarray, "known 3"]
    ) -> None:
        """Start tracks of drones that will be at these positions in the next frame."""
        covariance_m2 = np.square(self._settings.swarm.spread_m) * np.eye(3)
        for position, velocity in zip(position_m, velocity_m_s, strict=True):
            std_m_s = self._settings.motion.velocity_std_m_s
            before_m, number = position - velocity / self._limits.fps, self._new_drone()
            self._motion.place(number, before_m, velocity, covariance_m2, std_m_s)
            self._history.note((0, number), position, velocity, covariance_m2, None, 0)

    def step(self, frame: int) -> None:
        """One frame: predict, match, correct, end tracks and begin new ones."""
        self._motion.predict()
        measured, seen_by_one = self._measure(frame, self._sightings[frame])
        self._correct(measured, seen_by_one)
        for number in self._followed():
            self._note(frame, number, self._motion, number, measured.get(number))
        self._begin(frame)

    def tracks(self) -> tuple[Tracks, Places]:
        """The tracks of all drones, and their places in the images."""
        return self._history.tracks(len(self._drones))

    def _followed(self) -> list[int]:
        """The drones whose tracks go on."""
        most = self._max_coasting_frames
        return [number for number, drone in enumerate(self._drones) if drone.unseen <= most]

    def _new_drone(self) -> int:
        self._drones.append(TrackedDrone())
        if len(self._drones) > len(self._motion):
            self._motion.grow()
            self._history.grow(len(self._motion))
        return len(self._drones) - 1

    def _measure(self, frame: int, view: Sightings) -> tuple[dict[int, Measurement], SingleViews]:
        """The frame's measurements by drone, and the views of drones that have none."""
        numbers = self._followed()
        expected = self._expected(numbers)
        lately = slice(max(frame - SPAN_FRAMES, 0), frame)
        span_m = np.array([self._history.span_m(number, lately) for number in numbers]).reshape(-1, 2)
        expected_px = _boxes_px(self._cameras, expected.position_m, span_m)
        shown, view = view, split_merged_boxes(self._at_instant(view, numbers), expected_px)
        required = self._settings.status.min_cameras_to_begin
        crossed = crossings(self._cameras, view, self._limits.bounds_m, expected, required)
        measured: dict[int, Measurement] = {}
        taken: list[int] = []
        # Expected drones first: an unexpected position may be a part of an expected drone.
        for row in np.argsort(crossed.expected < 0, kind="stable").tolist():
            one = crossed.measurement(row)
            if one.num_cameras < self._settings.status.min_cameras or one.num_viewpoints < 2:
                continue
            place = int(crossed.expected[row])
            if place < 0:
                is_open = [each not in measured and not self._drones[each].missed for each in numbers]
                place = self._nearly_expected(crossed, row, expected, np.array(is_open, bool))
            if place < 0:
                continue
            taken.append(row)
            surprising = bool(_surprise(crossed, row, expected)[place] >= SURPRISING)
            if numbers[place] in measured or (surprising and one.num_viewpoints < TRUSTED_VIEWPOINTS):
                continue
            measured[numbers[place]] = replace(one, surprising=surprising)
        rest = view.ungrouped(crossed.box[taken])
        found = np.isin(numbers, [*measured])[:, None]
        # The corner of the image is the origin of the boxes of known drones.
        known_px = np.where(found[..., None], expected_px + np.array([0.5, 0.5, 0.0, 0.0]), np.nan)
        seen = np.zeros((len(numbers), len(self._density_px2)), bool)
        for row, number in enumerate(numbers):
            seen[row] = number in measured and np.isfinite(measured[number].noise_px)
        known_m = np.where(found, expected.position_m, np.nan)
        known = KnownDrones(known_m, span_m[:, [0, 0, 1]], known_px, seen)
        # As the cameras showed them: what is born has a motion of its own. Parts of split boxes are of known drones.
        num_boxes = shown.noise_px.shape[1]
        unexplained = shown.where(np.isfinite(rest.noise_px[:, :num_boxes]))
        others = self._births.step(frame, unexplained, known, expected.usual)
        missed = [number for number in numbers if number not in measured]
        views = find_single_views(
            self._cameras, rest.ungrouped(others), self._density_px2, self._expected(missed)
        )
        return measured, replace(views, drone=np.array(missed, int)[views.drone])

    def _nearly_expected(
        self, crossed: Crossings, row: int, expected: Expected, is_open: Bool[np.ndarray, "drones"]
    ) -> int:
        """Index of the expected drone that an unexpected crossing belongs to; -1 if there is none.

        A crossing beside a drone is a part of the drone. If the drone is open, because it was found in the last frame
        and has no crossing now, a crossing of trusted viewpoints may be farther away: another drone hardly replaces
        this one in one frame.
        """
        distance_m = np.linalg.norm(expected.position_m - crossed.position_m[row], axis=-1)
        if distance_m.min(initial=np.inf) < SEPARATION_M:
            return int(distance_m.argmin())
        if crossed.num_viewpoints[row] < TRUSTED_VIEWPOINTS:
            return -1
        surprise = np.where(is_open, _surprise(crossed, row, expected), np.inf)
        return int(surprise.argmin()) if surprise.min(initial=np.inf) < SURPRISING else -1

    def _expected(self, numbers: list[int]) -> Expected:
        """Where drones are expected."""
        return Expected(
            np.asarray(self._motion.state.apparent_m[numbers]),
            np.asarray(self._motion.state.covariance[numbers, :3, :3]),
            np.array([self._drones[number].dispersion for number in numbers]),
        )

    def _at_instant(self, view: Sightings, numbers: list[int]) -> Sightings:
        """The detections as they would be if all frames had been exposed at the instant."""
        state = self._motion.state
        return moved_to_instant(
            self._cameras,
            view,
            np.asarray(state.apparent_m[numbers]),
            np.asarray(state.velocity_m_s[numbers]),
            np.asarray(state.covariance[numbers, 3:6, 3:6]),
            self._settings.motion.velocity_std_m_s,
        )

    def _correct(self, measured: dict[int, Measurement], seen_by_one: SingleViews) -> None:
        """Correct the motion model by the measurements, and by the views of drones that have none."""
        for number, drone in enumerate(self._drones):
            drone.missed = 0 if number in measured else drone.missed + 1
            drone.unseen = 0 if number in measured or number in seen_by_one.drone else drone.unseen + 1
        predicted_m_s = np.asarray(self._motion.state.velocity_m_s)
        for index, number in enumerate(seen_by_one.drone.tolist()):
            view = seen_by_one.jacobian[index], seen_by_one.off_px[index], seen_by_one.noise_px[index]
            self._motion.correct_in_image(number, *view)
        self._motion.correct(measured, seen_by_one.drone.tolist())
        for number, one in measured.items():
            if one.surprising:
                # The filter would treat the position as an outlier for a second, but all viewpoints agree on it.
                speed_m_s = SPEED_SHARE * self._limits.max_speed_m_s
                place = one.position_m, predicted_m_s[number], one.covariance_m2
                self._motion.place(number, *place, speed_m_s)

    def _note(
        self, frame: int, number: int, motion: TrackMotion, row: int, measured: Measurement | None
    ) -> None:
        """Note a drone after a frame, unless it was not found and its place is too vague."""
        drone, state = self._drones[number], jax.tree.map(lambda leaf: leaf[row : row + 1], motion.state)
        (position_m,), (velocity_m_s,) = np.asarray(state.position_m), np.asarray(state.velocity_m_s)
        (covariance_m2,) = np.asarray(state.position_covariance_m2)
        if measured is not None:
            drone.dispersion += (measured.disagreement - drone.dispersion) / DISPERSION_FRAMES
        elif np.linalg.eigvalsh(covariance_m2)[-1] > self._settings.status.max_coasting_std_m**2:
            return
        num_in_view = int(in_images(self._cameras, position_m).sum())
        self._history.note((frame, number), position_m, velocity_m_s, covariance_m2, measured, num_in_view)

    def _begin(self, frame: int) -> None:
        """Begin the tracks of candidates: of drones that are missed, or of new drones."""
        may_return = any(drone.missed for drone in self._drones)
        candidates = self._births.candidates(may_return=may_return)
        if not candidates:
            self._births.take(())
            return
        count, known = self._settings.drones.count, len(self._drones)
        lost = self._history.lost(known, frame, self._limits.fps, counted=count is not None)
        most = None if count is None else max(count - known, 0)
        assignment = reidentify(candidates, lost, self._limits, max_births=most)
        begun = [each for each in zip(candidates, assignment.tolist(), strict=True) if each[1] != NO_DRONE]
        self._births.take(candidate for candidate, _ in begun)
        for candidate, row in begun:
            number = self._new_drone() if row == NEW else int(lost.drone[row])
            self._history.begins(candidate.instant, number, again=row != NEW)
            self._start(candidate, number, frame)

    def _start(self, candidate: TrackCandidate, number: int, frame: int) -> None:
        """Start a track at the frame in which the candidate was first seen, and follow it to the present frame."""
        first = candidate.path[candidate.instant]
        motion = TrackMotion(self._settings.motion, self._limits)
        motion.grow()
        std_m_s = self._settings.motion.velocity_std_m_s
        motion.place(0, first.position_m, candidate.velocity_m_s, first.covariance_m2, std_m_s)
        self._drones[number] = drone = TrackedDrone(first.disagreement)
        self._note(candidate.instant, number, motion, 0, first)
        for instant in range(candidate.instant + 1, frame + 1):
            motion.predict()
            one = candidate.path.get(instant)
            motion.correct({} if one is None else {0: one})
            drone.missed = drone.unseen = 0 if one is not None else drone.missed + 1
            self._note(instant, number, motion, 0, one)
        self._motion.put(number, motion.state)


def _boxes_px(
    cameras: Camera, position_m: Float[np.ndarray, "drones 3"], span_m: Float[np.ndarray, "drones 2"]
) -> Float[np.ndarray, "drones cameras 4"]:
    """Middles and half lengths of drones' boxes; NaN where a drone's size is not known, or its place has no image."""
    pixels, _ = project_visible(cameras, position_m[:, None])
    half_px = sizes_px(cameras, np.asarray(to_camera(cameras, position_m[:, None])), span_m[:, None]) / 2
    return np.concatenate([pixels, half_px], axis=-1)


def _surprise(crossed: Crossings, row: int, expected: Expected) -> Float[np.ndarray, "drones"]:
    """(drones,), squared distances of a crossing from expected positions, normalised by both covariances."""
    off_m = crossed.position_m[row] - expected.position_m
    spread_m2 = expected.covariance_m2 + crossed.covariance_m2[row]
    return (off_m * np.linalg.solve(spread_m2, off_m[..., None])[..., 0]).sum(axis=-1)

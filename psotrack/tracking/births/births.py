"""Births: things that no track explains, followed from frame to frame until they are drones.

In: sightings of what known drones do not explain, as blobs of foreground or boxes of a detector, one frame after the
other. They are matched over the cameras (`correspondence`), and each place in which lines of sight cross is followed.
Out: candidates, which behave like drones: found in eight of about ten frames, seen from enough viewpoints, neither
faster nor larger than drones. A drone that is found late costs a short gap, and a recording is tracked again from where
the candidate was first found; but a false track may last to the end of the video. So each rule prefers to miss a drone.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.geometry import Camera, in_images, project, viewpoints
from psotrack.tracking.matching import (
    NOISE_PX,
    NOISE_SHARE,
    SEPARATION_M,
    Crossings,
    Expected,
    Measurement,
    Sightings,
    crossings,
    moved_to_instant,
)

#: A candidate was found in this many frames. Most drones are found in eight of ten; where a detector misses a drone
#: now and then, `MISSED_SHARE` is the limit.
MIN_FOUND = 8
#: Number of frames from which a state is taken, and after which too many missed frames are noticed.
WINDOW_FRAMES = 10
#: A drone that was lost is found again by fewer: `RETURNED_FOUND` of `RETURNED_FRAMES` first frames.
RETURNED_FRAMES, RETURNED_FOUND = 8, 5
#: Number of frames in which enough viewpoints must agree for this; fewer agree while other drones hide the drone.
AGREED_FOUND = 3
#: The number of frames where only two viewpoints have the place in view: lines of sight of two cameras cross by chance
#: for longer. And where more have it in view, but something hides the drone from them, such as a post: two things that
#: pass each other's epipolar lines by a third of a pixel per frame cross for as long.
FOUND_BY_TWO, FOUND_BY_TWO_ALONE = 15, 30
#: A place that was not found in more consecutive frames, or in a larger share of its frames, is given up.
MOST_MISSED, MISSED_SHARE = 9, 0.4
#: Number of measurements of a place that are remembered.
MOST_REMEMBERED = 100
#: A frame in which another assignment of the sightings is at least this likely, relative to the best one, does not say
#: that the drone is there: two drones in one plane with two cameras cross in four places.
AMBIGUOUS = 0.1
#: A position that this many viewpoints agree on is no chance crossing of lines of sight.
TRUSTED_VIEWPOINTS = 3
#: Least share of the cameras with a place in view, and not hidden by known drones, that see a drone there, in the mean
#: over its frames. Obstacles hide drones, silhouettes of small drones flicker, and detectors miss drones at times: a
#: missing sighting says much less than a sighting.
MIN_SEEING_SHARE = 0.4
#: Smallest height of a drone's middle above the floor, metres. What is lower is a shadow, because the middle of a drone
#: that stands on its legs is higher.
FLOOR_CLEARANCE_M = 0.08
#: Largest height of a drone that is low over the floor, as a share of its width: its blob holds its shadow.
MAX_HEIGHT_SHARE = 0.3
#: Smallest height of a drone, as a share of its width: flat drones seen from above determine it badly.
MIN_HEIGHT_SHARE = 0.1
#: Largest ratio between the spans of a candidate and of the known drones; limits of the span without known drones,
#: metres, which a given size extends.
SIZE_RATIO, SPANS_M = 2.0, (0.1, 1.5)
#: A candidate may be faster than the limit by this factor: a line then says that it flies at the limit.
FASTER = 1.5
#: Smallest distance of a candidate from a known drone, as a share of the sum of their half axes: nearer is its rim.
MIN_DISTANCE = 0.8
#: A place whose span grows by more than this ratio is given up: a drone that departs from its ghost, which are one blob
#: at first.
MAX_GROWTH = 1.5
#: A candidate that moves by less than this share of its span in `WINDOW_FRAMES`, or by less than this number of
#: standard deviations, in its first or last frames stands still.
MIN_TRAVEL, TRAVEL_SIGMAS = 0.04, 3.0
#: A candidate moves if its last place is farther from its first than this share of its span.
MIN_DISPLACEMENT = 0.5
#: Standard deviation of a followed place's acceleration, m/s².
ACCELERATION_STD_M_S2 = 5.0
#: Standard deviation of the velocity of a place that was found once, as a share of a drone's largest speed.
SPEED_SHARE = 1 / 3
#: Number of frames over which the disagreement of the cameras is averaged.
_DISPERSION_FRAMES = 25


@dataclass(frozen=True)
class KnownDrones:
    """Drones that are tracked in one frame.

    Attributes:
        position_m: (drones, 3), metres; NaN where a drone is not found.
        size_m: (drones, 3), full lengths along the world's axes, metres; NaN where they are not known yet.
        box_px: (drones, cameras, 4), middle and half lengths of their boxes; NaN where there is none; None where
            nothing is known of what they hide.
        seen: (drones, cameras), cameras whose sightings are the drones'; None where that is not known.
    """

    position_m: Float[np.ndarray, "drones 3"]
    size_m: Float[np.ndarray, "drones 3"]
    box_px: Float[np.ndarray, "drones cameras 4"] | None = None
    seen: Bool[np.ndarray, "drones cameras"] | None = None


#: No drone is known.
NO_DRONES = KnownDrones(np.empty((0, 3)), np.empty((0, 3)))


@dataclass(frozen=True)
class TrackCandidate:
    """A drone without a track.

    Attributes:
        instant: first instant in which the drone is found.
        position_m, velocity_m_s: (3,), position and velocity at this instant.
        size_m: (3,), full lengths along the world's axes.
        num_cameras: number of cameras that see the drone at this instant.
        moves: whether the drone moves. A candidate that does not move may be a ghost: foreground at a place where a
            drone stood while the background was learned.
        path: what was measured, by instant.
        is_sure: whether it was found often enough to be a drone that was never seen before.
        number: number of the followed place, which copies of its `Births` share.
    """

    instant: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    num_cameras: int
    moves: bool
    path: dict[int, Measurement] = field(default_factory=dict)
    is_sure: bool = True
    number: int = 0


@dataclass
class _Path:
    """A place that is followed.

    Attributes:
        number: its number, from 0 in the order of the places' beginnings.
        first: instant in which it was found first.
        found: what was measured, by instant.
        frames: numbers of the frames in which it was found, without those that were left out.
        agreed, trusted: number of frames in which as many viewpoints agreed as are needed to begin a track, and in
            which at least `TRUSTED_VIEWPOINTS` agreed.
        num_seeing, num_should_see: number of cameras that saw something there, and that should see a drone there,
            summed over the frames in which it was found.
        missed: frames since it was last found.
        dispersion: disagreement of the cameras, averaged over time.
    """

    number: int
    first: int
    dispersion: float
    found: dict[int, Measurement] = field(default_factory=dict)
    frames: list[int] = field(default_factory=list)
    agreed: int = 0
    trusted: int = 0
    num_seeing: int = 0
    num_should_see: int = 0
    missed: int = 0

    @property
    def places_m(self) -> Float[np.ndarray, "found 3"]:
        """(found, 3), the places."""
        return np.array([one.position_m for one in self.found.values()])

    @property
    def span_m(self) -> Float[np.ndarray, "2"]:
        """(2,), median width and height."""
        return np.median([one.span_m for one in self.found.values()], axis=0)

    def copy(self) -> _Path:
        """A copy that goes on by itself."""
        return replace(self, found=dict(self.found), frames=list(self.frames))


@dataclass(frozen=True)
class BirthRules:
    """What is asked of a drone before its track begins.

    Attributes:
        min_viewpoints: number of viewpoints that must agree; None: three where three have the place in view, else two.
        ghosts_from: instant from which a place that stands still may be a ghost: foreground where a drone stood while
            the background was learned; None for sightings that have no ghosts.
        num_frames: number of frames of the recording; None for a recording without end. In a recording of fewer than
            `WINDOW_FRAMES` frames, four fifths of them are enough.
        size_m: full lengths of the drones, metres; None where they are not given.
        any_size: whether a drone that is no known one may have any size on which the cameras agree. A detector's boxes
            are of what was asked for; blobs of foreground are of people and lights too.
    """

    min_viewpoints: int | None = None
    ghosts_from: int | None = None
    num_frames: int | None = None
    size_m: tuple[float, ...] | None = None
    any_size: bool = False

    @property
    def min_found(self) -> int:
        """Least number of frames in which a drone was found."""
        if self.num_frames is None:
            return MIN_FOUND
        return min(MIN_FOUND, math.ceil(MIN_FOUND / WINDOW_FRAMES * self.num_frames))

    @property
    def spans_m(self) -> tuple[float, float]:
        """Smallest and largest span of a drone where none is known, metres."""
        if self.size_m is None:
            return SPANS_M
        span_m = max(self.size_m)
        return min(SPANS_M[0], span_m / SIZE_RATIO), max(SPANS_M[1], span_m * SIZE_RATIO)


@dataclass(frozen=True)
class FlightLimits:
    """Where and how fast drones may fly, and how often they are seen.

    Attributes:
        fps: instants per second.
        bounds_m: (2, 3), corners of the room, metres; the lowest z is the floor, on which shadows lie.
        max_speed_m_s: largest speed of a drone, m/s.
    """

    fps: float
    bounds_m: Float[np.ndarray, "2 3"]
    max_speed_m_s: float


class Births:
    """Follows places until they are drones.

    Args:
        cameras: cameras with one leading axis, float64.
        limits: where and how fast drones may fly.
        rules: what is asked of a drone.
    """

    def __init__(self, cameras: Camera, limits: FlightLimits, rules: BirthRules = BirthRules()) -> None:
        self._cameras, self._limits, self._rules = cameras, limits, rules
        self._viewpoint = viewpoints(cameras)
        self._at = self._viewpoint[:, None] == np.unique(self._viewpoint)
        self._clear_m = limits.bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
        self._paths: list[_Path] = []
        self._mean, self._covariance = np.empty((0, 6)), np.empty((0, 6, 6))
        self._instant = self._frame = self._num_begun = 0
        self._is_whole = np.zeros((len(self._viewpoint), 0), bool)

    def __len__(self) -> int:
        return len(self._paths)

    def copy(self) -> Births:
        """The places as they are now, to follow them again through the next frames."""
        one = copy.copy(self)
        one._paths = [path.copy() for path in self._paths]
        one._mean, one._covariance = self._mean.copy(), self._covariance.copy()
        return one

    def step(
        self, instant: int, view: Sightings, known: KnownDrones, usual_dispersion: float = 1.0
    ) -> Int[np.ndarray, "crossings cameras"]:
        """Take the next frame.

        Args:
            instant: number of the frame's instant.
            view: sightings that no known drone explains.
            known: the drones that are tracked.
            usual_dispersion: ratio of the variance of sightings and `view.noise_px`², for places that are new.

        Returns:
            (crossings, cameras), which of the camera's boxes are of something that several cameras see; -1 for none.
        """
        self._frame += 1
        there = np.isfinite(view.noise_px).any(axis=-1)
        side_px = np.sqrt(view.size_px.prod(axis=-1))
        self._is_whole = view.noise_px <= 1.001 * (NOISE_PX + NOISE_SHARE * side_px)
        if not self._paths and len(set(self._viewpoint[there].tolist())) < 2:
            self._instant = instant
            return np.full((0, len(there)), -1)
        self._predict(instant)
        boxes = self._find(instant, view, known, usual_dispersion)
        # What was a drone for some frames is one until it is taken, though something hides it.
        self._keep([self._is_drone(path) or not self._is_chance(path) for path in self._paths])
        return boxes

    def candidates(self, *, may_return: bool = False) -> tuple[TrackCandidate, ...]:
        """What behaves like a drone by now.

        Args:
            may_return: whether drones are lost that may come back, which fewer frames show.
        """
        return tuple(
            self._candidate(path, is_sure)
            for path in self._paths
            if (is_sure := self._is_drone(path)) or (may_return and self._may_be_known(path))
        )

    def take(self, candidates: Iterable[TrackCandidate]) -> None:
        """Follow some candidates no longer, because they have tracks; and none that has not been found for long."""
        taken = {candidate.number for candidate in candidates}
        self._keep([path.missed <= MOST_MISSED and path.number not in taken for path in self._paths])

    def _predict(self, instant: int) -> None:
        """Go on to an instant, at constant velocity."""
        step_s = (instant - self._instant) / self._limits.fps
        self._instant = instant
        ahead = np.eye(6) + step_s * np.eye(6, k=3)
        pushed = np.vstack([step_s**2 / 2 * np.eye(3), step_s * np.eye(3)]) * ACCELERATION_STD_M_S2
        self._mean = self._mean @ ahead.T
        self._covariance = ahead @ self._covariance @ ahead.T + pushed @ pushed.T
        for path in self._paths:
            path.missed += 1

    def _find(
        self, instant: int, view: Sightings, known: KnownDrones, usual_dispersion: float
    ) -> Int[np.ndarray, "crossings cameras"]:
        speed_std_m_s, covariance = SPEED_SHARE * self._limits.max_speed_m_s, self._covariance[:, 3:, 3:]
        view = moved_to_instant(
            self._cameras, view, self._mean[:, :3], self._mean[:, 3:], covariance, speed_std_m_s
        )
        crossed = self._crossings(view, usual_dispersion)
        in_view = in_images(self._cameras, crossed.position_m)
        num_seeing, num_should_see = self._cameras_that_see(crossed, view, in_view, known)
        # A place that is followed may be hidden for some frames: see `_is_drone`.
        seen_enough = (crossed.expected >= 0) | (num_seeing >= MIN_SEEING_SHARE * num_should_see)
        counts = seen_enough & self._counts(crossed, known)
        required = self._required_viewpoints(in_view)
        begun: list[tuple[_Path, Measurement]] = []
        # Followed places first: a new position may be a part of one of them.
        for row in np.argsort(crossed.expected < 0, kind="stable").tolist():
            if not counts[row]:
                continue
            one = crossed.measurement(row)
            number = int(crossed.expected[row])
            if number < 0 and (distance_m := self._distances_m(one)).min(initial=np.inf) < SEPARATION_M:
                # The covariance was too small, as when a drone turns sharply.
                number = int(distance_m.argmin())
                if not self._paths[number].missed:
                    continue
            if number < 0:
                path = _Path(self._num_begun, instant, usual_dispersion)
                self._num_begun += 1
                begun.append((path, one))
            else:
                path = self._paths[number]
                self._correct(number, one)
            path.found[instant] = one
            path.frames.append(self._frame)
            if len(path.frames) > MOST_REMEMBERED:
                del path.found[min(path.found)], path.frames[0]
            path.missed = 0
            path.num_seeing += int(num_seeing[row])
            path.num_should_see += int(num_should_see[row])
            path.agreed += int(one.num_viewpoints >= required[row])
            path.trusted += int(one.num_viewpoints >= TRUSTED_VIEWPOINTS)
            path.dispersion += (one.disagreement - path.dispersion) / _DISPERSION_FRAMES
        for path, one in begun:
            self._paths.append(path)
            covariance = np.diag([0.0] * 3 + [speed_std_m_s**2] * 3)
            covariance[:3, :3] = one.covariance_m2
            self._mean = np.vstack([self._mean, np.append(one.position_m, np.zeros(3))])
            self._covariance = np.concatenate([self._covariance, covariance[None]])
        return crossed.box[counts]

    def _crossings(self, view: Sightings, usual_dispersion: float) -> Crossings:
        """Crossings of the lines of sight: of places on which enough viewpoints agreed once, then of the others.

        Lines of two viewpoints cross by chance, where more viewpoints have the place in view. Such crossings are looked
        for among the sightings of nothing else, so that they take no sighting from a drone.
        """
        sure = np.array(
            [path.agreed > 0 or self._rules.min_viewpoints is not None for path in self._paths], bool
        )
        dispersion = np.array([path.dispersion for path in self._paths])

        def crossed_by(view: Sightings, of: Int[np.ndarray, "some"], least: int | None) -> Crossings:
            expected = Expected(
                self._mean[of, :3], self._covariance[of, :3, :3], dispersion[of], usual_dispersion
            )
            found = crossings(self._cameras, view, self._clear_m, expected, least)
            return found.numbered(of)

        first = crossed_by(view, np.flatnonzero(sure), self._rules.min_viewpoints)
        if self._rules.min_viewpoints is not None:
            return first
        rest = view.ungrouped(first.box)
        if np.isfinite(rest.noise_px).any(axis=-1).sum() < 2:
            return first
        return first.joined(crossed_by(rest, np.flatnonzero(~sure), 2))

    def _cameras_that_see(
        self,
        crossed: Crossings,
        view: Sightings,
        in_view: Bool[np.ndarray, "crossings cameras"],
        known: KnownDrones,
    ) -> tuple[Int[np.ndarray, "crossings"], Int[np.ndarray, "crossings"]]:
        """Number of cameras that see something at each crossing, and of those that should see a drone there."""
        pixels = np.asarray(project(self._cameras, crossed.position_m[:, None])[0])
        should_see = in_view & ~_hidden(pixels, known)
        # A sighting that holds the place, of several drones for instance, shows that something is there.
        holds = (np.abs(pixels[:, :, None] - view.centre_px) < view.size_px / 2).all(axis=-1).any(axis=-1)
        sees = crossed.seen | (holds & should_see)
        return sees.sum(axis=-1), (should_see | crossed.seen).sum(axis=-1)

    def _counts(self, crossed: Crossings, known: KnownDrones) -> Bool[np.ndarray, "crossings"]:
        """Which crossings look like a drone that is none of the known ones."""
        points_m, seen = crossed.position_m, crossed.seen
        is_found = np.isfinite(known.position_m).all(axis=-1)
        spans_m = known.size_m[is_found & np.isfinite(known.size_m).all(axis=-1)].max(axis=-1)
        limits = self._rules.spans_m
        if len(spans_m):
            limits = spans_m.min() / SIZE_RATIO, spans_m.max() * SIZE_RATIO
        span_m = crossed.span_m.max(axis=-1)
        has_size = (span_m >= limits[0]) & (span_m <= limits[1])
        if self._rules.any_size and not len(spans_m):
            has_size |= crossed.span_ratio < SIZE_RATIO
        size_m = crossed.span_m[:, [0, 0, 1]]
        # A known drone of unknown size is taken to be as large as the candidate.
        known_size_m = np.where(np.isfinite(known.size_m), known.size_m, size_m[:, None])
        off = 2 * (points_m[:, None] - known.position_m) / (size_m[:, None] + known_size_m)
        apart = np.nan_to_num(np.linalg.norm(off, axis=-1), nan=np.inf).min(axis=1, initial=np.inf)
        # What is left of blobs that known drones hide in part may be their rims.
        whole = (crossed.box >= 0) & self._is_whole[np.arange(len(self._viewpoint)), crossed.box]
        better = np.linalg.norm(points_m[:, None] - points_m, axis=-1) < SEPARATION_M
        better &= seen.sum(axis=-1) > seen.sum(axis=-1)[:, None]
        return (
            has_size
            & (apart >= MIN_DISTANCE)
            & ((self._num_viewpoints(whole) >= 2) | (len(spans_m) == 0))
            & ((crossed.ambiguity < AMBIGUOUS) | (crossed.num_viewpoints >= TRUSTED_VIEWPOINTS))
            & ~((crossed.expected < 0) & better.any(axis=1))
            & ~self._seen_instead(crossed, known)
        )

    def _seen_instead(self, crossed: Crossings, known: KnownDrones) -> Bool[np.ndarray, "crossings"]:
        """Which crossings are of cameras that all should see some known drone, and of which none does.

        Where cameras disagree, some of them see a drone beside the place where the others see it: no second drone.
        """
        if known.seen is None or not len(known.seen):
            return np.zeros(len(crossed.seen), bool)
        should_see = in_images(self._cameras, known.position_m)
        all_should = (~crossed.seen[:, None] | should_see).all(axis=-1)
        return (all_should & ~(crossed.seen[:, None] & known.seen).any(axis=-1)).any(axis=-1)

    def _distances_m(self, one: Measurement) -> Float[np.ndarray, "paths"]:
        return np.linalg.norm(self._mean[: len(self._paths), :3] - one.position_m, axis=-1)

    def _required_viewpoints(self, in_view: Bool[np.ndarray, "points cameras"]) -> Int[np.ndarray, "points"]:
        """Number of viewpoints that must agree to begin a track at places with these cameras in view."""
        if self._rules.min_viewpoints is not None:
            return np.full(len(in_view), self._rules.min_viewpoints)
        return np.clip(self._num_viewpoints(in_view), 2, TRUSTED_VIEWPOINTS)

    def _num_viewpoints(self, seen: Bool[np.ndarray, "points cameras"]) -> Int[np.ndarray, "points"]:
        return (seen @ self._at).sum(axis=-1)

    def _correct(self, number: int, one: Measurement) -> None:
        """Correct a followed place by a measurement."""
        covariance = self._covariance[number]
        gain = np.linalg.solve(covariance[:3, :3] + one.covariance_m2, covariance[:3]).T
        self._mean[number] += gain @ (one.position_m - self._mean[number, :3])
        after = covariance - gain @ covariance[:3]
        self._covariance[number] = (after + after.T) / 2

    def _is_chance(self, path: _Path) -> bool:
        """Whether a place comes from chance crossings of lines, or from a drone that departs from its ghost."""
        age = self._frame - path.frames[0] + 1
        found = [*path.found.values()]
        is_grown = float(found[-1].span_m.max()) > MAX_GROWTH * float(found[0].span_m.max())
        too_few = age > WINDOW_FRAMES and len(found) < (1 - MISSED_SHARE) * age
        return path.missed > MOST_MISSED or too_few or is_grown

    def _is_drone(self, path: _Path) -> bool:
        """Whether a place was found often enough, by enough cameras, and is not much faster than a drone."""
        least = self._rules.min_found
        if path.agreed < AGREED_FOUND:
            # A number of viewpoints that is asked for counts without exception.
            least = FOUND_BY_TWO_ALONE if self._rules.min_viewpoints is None else MOST_REMEMBERED + 1
        elif path.trusted < AGREED_FOUND:
            least = FOUND_BY_TWO
        if len(path.found) < least or path.num_seeing < MIN_SEEING_SHARE * path.num_should_see:
            return False
        first, last = min(path.found), max(path.found)
        way_m = float(np.linalg.norm(path.found[last].position_m - path.found[first].position_m))
        return way_m * self._limits.fps <= FASTER * self._limits.max_speed_m_s * (last - first)

    def _may_be_known(self, path: _Path) -> bool:
        """Whether a place was found often enough to be of a drone that was lost."""
        is_young = path.frames[-1] - path.frames[0] < RETURNED_FRAMES
        return is_young and len(path.found) >= RETURNED_FOUND and path.agreed >= AGREED_FOUND

    def _candidate(self, path: _Path, is_sure: bool) -> TrackCandidate:
        first, ghosts_from = next(iter(path.found.values())), self._rules.ghosts_from
        position_m, velocity_m_s = state_at(path.found, path.first, self._limits)
        return TrackCandidate(
            path.first,
            position_m,
            velocity_m_s,
            self._size_m(path),
            first.num_cameras,
            ghosts_from is None or path.first < ghosts_from or _is_moving(path),
            path.found,
            is_sure,
            path.number,
        )

    def _size_m(self, path: _Path) -> Float[np.ndarray, "3"]:
        """Full lengths of an ellipsoid whose outlines are as wide and as high as the sightings: median of all frames.

        At elevation e, an ellipsoid with the semi-axes a (horizontal) and c (vertical) has an outline of half height
        sqrt(a² sin² e + c² cos² e).
        """
        width, height = path.span_m
        place_m = np.median(path.places_m, axis=0)
        ray_m = place_m - self._cameras.centre_world
        sin2 = float(np.median((ray_m[:, 2] / np.linalg.norm(ray_m, axis=-1)) ** 2))
        upright2 = (height**2 - width**2 * sin2) / max(1 - sin2, 0.1)
        highest = MAX_HEIGHT_SHARE if place_m[2] - self._limits.bounds_m[0, 2] < width else np.inf
        height = np.clip(np.sqrt(max(upright2, 0.0)), MIN_HEIGHT_SHARE * width, highest * width)
        return np.array([width, width, height])

    def _keep(self, kept: list[bool]) -> None:
        self._paths = [path for path, is_kept in zip(self._paths, kept, strict=True) if is_kept]
        mask = np.array(kept, bool)
        self._mean, self._covariance = self._mean[mask], self._covariance[mask]


def state_at(
    path: dict[int, Measurement], instant: int, limits: FlightLimits
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and velocity at an instant, from the ten measurements nearest to it.

    A drone turns within half a second, and the ends of a straight line would be wrong by centimetres.
    """
    instants = np.array([*path])
    near = np.sort(np.argsort(np.abs(instants - instant), kind="stable")[:WINDOW_FRAMES])
    places_m = np.array([one.position_m for one in path.values()])[near]
    degree = 2 if len(near) >= MIN_FOUND else min(1, len(near) - 1)
    terms = np.polyfit((instants[near] - instant) / limits.fps, places_m, degree)
    velocity = terms[-2] if degree else np.zeros(3)
    speed_m_s = max(float(np.linalg.norm(velocity)), 1e-9)
    return terms[-1], velocity * min(1.0, limits.max_speed_m_s / speed_m_s)


def _hidden(
    pixels: Float[np.ndarray, "points cameras 2"], known: KnownDrones
) -> Bool[np.ndarray, "points cameras"]:
    """Which points known drones may hide from the cameras."""
    if known.box_px is None or not len(known.box_px):
        return np.zeros(pixels.shape[:2], bool)
    middle, half = known.box_px[..., :2], known.box_px[..., 2:]
    off = np.abs(pixels[:, None] + 0.5 - middle) / half
    return (np.nan_to_num(off, nan=np.inf).max(axis=-1) < MAX_GROWTH).any(axis=1)


def _is_moving(path: _Path) -> bool:
    """Whether a candidate has moved far, or moves on steadily at both ends of its path.

    A ghost seems to move, by a quarter of its span, while the drone that departs still overlaps it: it stands before,
    or after, or is faster and faster.
    """
    places_m, span_m = path.places_m, float(path.span_m.max())
    if float(np.linalg.norm(places_m[-1] - places_m[0])) > MIN_DISPLACEMENT * span_m:
        return True
    for part_m in (places_m[:WINDOW_FRAMES], places_m[-WINDOW_FRAMES:]):
        count = len(part_m)
        frame = np.arange(count)
        # Way along the straight line that fits the places best, and its standard deviation, from their scatter.
        line = np.polyfit(frame, part_m, 1)
        way_m = float(np.linalg.norm(line[0])) * (count - 1)
        off_m = part_m - frame[:, None] * line[0] - line[1]
        std_m = float(np.sqrt(np.square(off_m).sum() / (3 * max(count - 2, 1))))
        least_m = MIN_TRAVEL * span_m * min(1.0, count / WINDOW_FRAMES)
        if way_m < max(least_m, TRAVEL_SIGMAS * std_m * np.sqrt(12 / count)):
            return False
    return True

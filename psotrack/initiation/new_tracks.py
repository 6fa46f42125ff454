"""Track initiation: find drones without a track in a chunk of frames.

A place where at least three viewpoints show residual foreground, or two if the rig has no third, is followed through
the chunk. It becomes a track candidate if it behaves like a drone: it persists, its speed and its size are a drone's,
it keeps a distance to the floor and to all known drones, and nearly all cameras that should see it do see it.

A drone that is found a second late costs a short gap, but a false track may last to the end of the video. So each rule
prefers to miss a candidate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from psotrack.geometry import Camera, match_views, sizes_m, to_camera, viewpoints
from psotrack.initiation.initialisation import FLOOR_CLEARANCE_M, InitialState, find_drones
from psotrack.initiation.residual_foreground import (
    NOT_FOUND,
    Observation,
    ProjectedDrones,
    ResidualForeground,
    SearchVolume,
    observe,
    project_drones,
)
from psotrack.silhouettes import LEAST_RADIUS_CELLS, border_cells, find_blobs

#: A candidate must be found in at least `MIN_FRAMES` of `WINDOW_FRAMES` consecutive frames.
WINDOW_FRAMES, MIN_FRAMES = 10, 8
#: Largest number of consecutive frames in which a followed place is not found.
MAX_GAP = 5
#: Largest ratio by which the spread of the foreground may grow while a place is followed.
MAX_GROWTH = 1.5
#: Distance between two frames that are searched, frames; less than `WINDOW_FRAMES`, so that no candidate is missed.
SEARCH_STEP = 8
#: Largest ratio between the spans of a candidate and of the known drones; limits of the span without known drones.
SIZE_RATIO, SPANS_M = 2.0, (0.1, 1.5)
#: A candidate that moves by less than this share of its span within `WINDOW_FRAMES` stands still.
MIN_TRAVEL = 0.04
#: A candidate moves if its last place is farther from its first than this share of its span.
MIN_DISPLACEMENT = 0.5
#: Candidates are followed in groups of a multiple of this number, so that few programs are compiled.
_CANDIDATE_STEP = 16


@dataclass(frozen=True)
class KnownDrones:
    """Drones that were tracked in a chunk.

    Attributes:
        position_m: (frames, drones, 3), positions; any value, NaN included, where the drone does not explain
            foreground.
        explains: (frames, drones), whether the position is good enough to explain foreground.
        size_m: (drones, 3), full lengths along the world's axes; NaN for a place in the arrays without a drone.
        moved_m: (frames, drones, cameras, 3), motion of the drones from the instant to each camera's exposure; None
            where all cameras' frames were exposed at the instant.
        is_there: (frames, cameras), whether the camera has a frame at the instant; None where all cameras have one.
        min_viewpoints: smallest number of viewpoints that must see any other drone; None: three, or two if the rig has
            no third.
    """

    position_m: Float[np.ndarray, "frames drones 3"]
    explains: Bool[np.ndarray, "frames drones"]
    size_m: Float[np.ndarray, "drones 3"]
    moved_m: Float[np.ndarray, "frames drones cameras 3"] | None = None
    is_there: Bool[np.ndarray, "frames cameras"] | None = None
    min_viewpoints: int | None = None


@dataclass(frozen=True)
class Sighted:
    """A drone in one frame.

    Attributes:
        frame: the frame, counted from the chunk's first frame.
        position_m, velocity_m_s: (3,), position and velocity in this frame.
    """

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class TrackCandidate:
    """A drone without a track.

    Attributes:
        frame: first frame in which the drone is found, counted from the chunk's first frame.
        position_m, velocity_m_s: (3,), position and velocity in this frame.
        size_m: (3,), full lengths along the world's axes.
        num_cameras: number of cameras that see the drone in this frame.
        moves: whether the drone moves. A candidate that does not move may be a ghost: foreground at a place where a
            drone stood while the background was learned.
    """

    frame: int
    position_m: Float[np.ndarray, "3"]
    velocity_m_s: Float[np.ndarray, "3"]
    size_m: Float[np.ndarray, "3"]
    num_cameras: int
    moves: bool


@dataclass(frozen=True)
class FollowedCandidate(TrackCandidate):
    """A drone without a track that was followed through the frames.

    Attributes:
        last: the drone in the last frame in which it is found.
    """

    last: Sighted


def search_volume(
    cameras: Camera, bounds_m: Float[np.ndarray, "2 3"], reduction: int, min_viewpoints: int | None
) -> SearchVolume:
    """The region where new drones are searched: the room without the floor, on which shadows lie."""
    clear_m = bounds_m + np.array([[0.0, 0.0, FLOOR_CLEARANCE_M], [0.0, 0.0, 0.0]])
    return SearchVolume(cameras, viewpoints(cameras), clear_m, reduction, min_viewpoints)


def find_candidates(  # noqa: PLR0913  # A chunk, the rig, and what drones can do.
    cameras: Camera,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    known: KnownDrones,
    *,
    reduction: int,
    fps: float,
    bounds_m: Float[np.ndarray, "2 3"],
    max_speed_m_s: float,
    measures_sizes: bool = True,
) -> tuple[FollowedCandidate, ...]:
    """Find drones in a chunk of frames that are none of the known drones.

    Args:
        cameras: cameras with one leading axis, for the full image.
        coverage: (frames, cameras, height, width), silhouettes of the chunk.
        known: drones that were tracked in the chunk.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), corners of the room; its lowest z is the floor, on which shadows lie.
        max_speed_m_s: largest speed of a drone.
        measures_sizes: whether a candidate's size is measured in several frames, which takes most of the time; else it
            is the size in the first frame.

    Returns:
        Candidates; an empty tuple for a chunk of fewer than `WINDOW_FRAMES` frames.
    """
    spans_m = _span_limits(known.size_m)
    volume = search_volume(cameras, bounds_m, reduction, known.min_viewpoints)
    drones = _known_ellipses(volume, known)

    # Candidates that appear together are measured in the same frames.
    @cache
    def find(first: int) -> InitialState:
        return find_drones(
            cameras,
            coverage[first : first + WINDOW_FRAMES],
            reduction=reduction,
            fps=fps,
            bounds_m=bounds_m,
            max_speed_m_s=max_speed_m_s,
        )

    found: list[FollowedCandidate] = []
    paths: list[list[Observation]] = []
    for frame in range(0, len(coverage) - WINDOW_FRAMES + SEARCH_STEP, SEARCH_STEP):
        proposals = _propose_places(volume, ResidualForeground(coverage[frame], drones, frame), spans_m)
        next_frame = frame + 1 if frame + 1 < len(coverage) else frame - 1
        next_places = (
            _propose_places(volume, ResidualForeground(coverage[next_frame], drones, next_frame), spans_m)
            if proposals
            else []
        )
        for place, size in proposals:
            shift = (next_frame - frame) * _nearest_shift(place, size, next_places, max_speed_m_s / fps)
            path = _follow_place(volume, coverage, drones, frame, place, size, shift)
            candidate = _make_candidate(path, size, fps, max_speed_m_s)
            if measures_sizes and candidate is not None and candidate.moves:
                # The size decides what foreground is the drone's own, and a single frame in which known drones are near
                # gives a poor size. So measure the size again, in the frames with most cameras.
                best = _best_window(path)
                size = _nearest_size(find(best), path[best], size)
                path = _follow_place(volume, coverage, drones, frame, path[frame].position_m, size, shift)
                candidate = _make_candidate(path, size, fps, max_speed_m_s)
            if candidate is None or not spans_m[0] <= size.max() <= spans_m[1]:
                continue
            if any(_is_continuation(path, earlier, max_speed_m_s / fps) for earlier in paths):
                continue
            paths.append(path)
            found.append(candidate)
            drones = drones.join(project_drones(volume, _places(path)[:, None], size[None]))
    return tuple(found)


def follow_candidates(
    volume: SearchVolume,
    coverage: UInt8[np.ndarray, "cameras height width"],
    known: KnownDrones,
    candidates: tuple[FollowedCandidate, ...],
    *,
    frame: int,
    fps: float,
    max_speed_m_s: float,
) -> tuple[FollowedCandidate, ...]:
    """Look for candidates in a later frame than those that were searched.

    Args:
        volume: the cameras, and the region where drones may be.
        coverage: (cameras, height, width), silhouettes of the frame.
        known: drones that are tracked in the frame: one frame.
        candidates: candidates from `find_candidates`, or from this function.
        frame: number of the frame, counted as the candidates' frames are.
        fps: frames per second.
        max_speed_m_s: largest speed of a drone.

    Returns:
        The candidates; where a candidate is seen, with the drone in this frame as `last`.
    """
    elapsed_s = np.array([(frame - each.last.frame) / fps for each in candidates])[:, None]
    before_m, velocity_m_s = (
        np.array([getattr(each.last, name) for each in candidates]) for name in ("position_m", "velocity_m_s")
    )
    expected_m = before_m + elapsed_s * velocity_m_s
    # Each number of candidates would be compiled.
    missing = -len(candidates) % _CANDIDATE_STEP
    size_m = np.pad([each.size_m for each in candidates], ((0, missing), (0, 0)), constant_values=np.nan)
    padded_m = np.pad(expected_m, ((0, missing), (0, 0)), constant_values=np.nan)
    known_ellipses, ellipses = _known_ellipses(volume, known), project_drones(volume, padded_m[None], size_m)
    followed = []
    for row, before in enumerate(candidates):
        drones = known_ellipses.join(ellipses.without(row))
        seen = observe(volume, ResidualForeground(coverage, drones, 0), expected_m[row], size_m[row])
        candidate = before
        if seen.found:
            # The mean over the last shifts, because a single shift is as noisy as the places.
            velocity = (velocity_m_s[row] + (seen.position_m - before_m[row]) / elapsed_s[row]) / 2
            velocity *= min(1.0, max_speed_m_s / max(float(np.linalg.norm(velocity)), 1e-9))
            distance_m = float(np.linalg.norm(seen.position_m - before.position_m))
            candidate = replace(
                before,
                last=Sighted(frame, seen.position_m, velocity),
                moves=before.moves or distance_m > MIN_DISPLACEMENT * float(before.size_m.max()),
            )
        followed.append(candidate)
    return tuple(followed)


def compile_search(cameras: Camera, num_frames: int, num_drones: int, reduction: int) -> None:
    """Compile what `find_candidates` and `follow_candidates` call, so that no frame of a live camera waits for it.

    Args:
        cameras: cameras with one leading axis, for the full image.
        num_frames: number of frames that will be searched.
        num_drones: number of known drones, or of places for them, with motions to the cameras' exposures.
        reduction: image pixels per silhouette pixel, along each side.
    """
    volume = SearchVolume(cameras, viewpoints(cameras), np.zeros((2, 3)), reduction)
    for frames in (1, num_frames):
        known_m, size_m = np.zeros((frames, num_drones, 3)), np.ones((num_drones, 3))
        project_drones(volume, known_m, size_m, np.zeros((frames, num_drones, len(cameras.K), 3)))
        project_drones(volume, np.zeros((frames, 1, 3)), np.ones((1, 3)))
    project_drones(volume, np.zeros((1, _CANDIDATE_STEP, 3)), np.ones((_CANDIDATE_STEP, 3)))


def _known_ellipses(volume: SearchVolume, known: KnownDrones) -> ProjectedDrones:
    explaining_m = np.where(known.explains[..., None], known.position_m, np.nan)
    return replace(project_drones(volume, explaining_m, known.size_m, known.moved_m), is_there=known.is_there)


def _propose_places(
    volume: SearchVolume, residual: ResidualForeground, spans_m: tuple[float, float]
) -> list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Places in a frame where enough viewpoints show foreground of a drone's size, each with this size."""
    cameras = volume.cameras
    corners = np.stack(np.meshgrid(*volume.bounds_m.T), axis=-1).reshape(-1, 1, 3)
    farthest_m = np.linalg.norm(corners - cameras.centre_world, axis=-1).max(axis=0)
    focal_px = np.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], axis=-1)
    least_px = spans_m[0] * focal_px.min(axis=-1) / farthest_m
    borders = border_cells(cameras.image_size_wh, volume.reduction)
    blobs = [
        find_blobs(residual.part(camera)[0], volume.reduction, border)
        for camera, border in enumerate(borders)
    ]
    large = [view.size_px.max(axis=-1) >= least for view, least in zip(blobs, least_px, strict=True)]
    centre_px = [view.centre_px[keep] for view, keep in zip(blobs, large, strict=True)]
    size_px = [view.size_px[keep] for view, keep in zip(blobs, large, strict=True)]
    # Half of the blob's smaller side is an upper limit of the distance from its middle to the drone's projection.
    radius_px = [np.maximum(size.min(axis=-1) / 2, LEAST_RADIUS_CELLS * volume.reduction) for size in size_px]
    points, support = match_views(
        cameras, centre_px, radius_px, volume.bounds_m, min_viewpoints=volume.required_viewpoints
    )
    points_cam = np.asarray(to_camera(cameras, points[:, None]))
    proposals = []
    for row, point in enumerate(points):
        seen = np.flatnonzero(support[row] >= 0)
        sides_px = np.array([size_px[camera][support[row, camera]] for camera in seen])
        width, height = np.median(sizes_m(cameras[seen], points_cam[row, seen], sides_px), axis=0)
        if spans_m[0] <= width <= spans_m[1]:
            proposals.append((point, np.array([width, width, height])))
    return proposals


def _follow_place(
    volume: SearchVolume,
    coverage: UInt8[np.ndarray, "frames cameras height width"],
    drones: ProjectedDrones,
    frame: int,
    position_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    shift_m: Float[np.ndarray, "3"],
) -> list[Observation]:
    """Observe a drone in one frame, and follow it to the frames before and after: one observation per frame.

    Args:
        volume: the cameras, and the region where drones may be.
        coverage: (frames, cameras, height, width), silhouettes of the chunk.
        drones: the known drones.
        frame: frame in which the drone is at `position_m`.
        position_m: (3,), place of the drone.
        size_m: (3,), full lengths of the drone.
        shift_m: (3,), expected displacement from this frame to the next.
    """

    def observe_at(at: int, place: Float[np.ndarray, "3"]) -> Observation:
        return observe(volume, ResidualForeground(coverage[at], drones, at), place, size_m)

    path = [NOT_FOUND] * len(coverage)
    path[frame] = observe_at(frame, position_m)
    for step, end in ((1, len(coverage)), (-1, -1)):
        place, shift, last = path[frame].position_m, step * shift_m, frame
        for at in range(frame + step, end, step) if path[frame].found else ():
            gap = abs(at - last)
            seen = observe_at(at, place + gap * shift)
            if seen.found and seen.spread > MAX_GROWTH * path[frame].spread:
                # A drone that departs and its ghost are one blob at first. Begin no track before they are apart.
                if step == 1:
                    return [NOT_FOUND] * len(path)
                break
            if seen.found:
                # The mean over the last shifts, because a single shift is as noisy as the places.
                shift = (shift + (seen.position_m - place) / gap) / 2
                place, last, path[at] = seen.position_m, at, seen
            elif gap > MAX_GAP:
                break
    return path


def _nearest_shift(
    place_m: Float[np.ndarray, "3"],
    size_m: Float[np.ndarray, "3"],
    next_places: list[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]],
    reach_m: float,
) -> Float[np.ndarray, "3"]:
    """Shift to the nearest place of similar span in the next frame; 0 if it is farther than a drone can move.

    A flat drone that sinks fast leaves its ellipse within one frame, so the search in the next frame needs this shift.
    """
    span = size_m.max()
    similar = [place for place, size in next_places if 1 / SIZE_RATIO <= size.max() / span <= SIZE_RATIO]
    shifts = np.array([place - place_m for place in similar]).reshape(-1, 3)
    distance = np.linalg.norm(shifts, axis=-1)
    return shifts[distance.argmin()] if (distance <= reach_m).any() else np.zeros(3)


def _make_candidate(
    path: list[Observation], size_m: Float[np.ndarray, "3"], fps: float, max_speed_m_s: float
) -> FollowedCandidate | None:
    """Make a candidate of a followed place; None if the place does not behave like a drone."""
    found = np.array([seen.found for seen in path])
    for frame in np.flatnonzero(found[: max(len(found) - WINDOW_FRAMES + 1, 0)]).tolist():
        rows = frame + np.flatnonzero(found[frame : frame + WINDOW_FRAMES])
        if len(rows) < MIN_FRAMES:
            continue
        places = _places(path)[rows]
        if np.linalg.norm(places[-1] - places[0]) * fps > max_speed_m_s * (rows[-1] - rows[0]):
            continue
        position, velocity = _state_at(frame, rows, places, fps, max_speed_m_s)
        last = np.flatnonzero(found)[-WINDOW_FRAMES:]
        return FollowedCandidate(
            frame=frame,
            position_m=position,
            velocity_m_s=velocity,
            size_m=size_m,
            num_cameras=path[frame].num_cameras,
            moves=_is_moving(_places(path)[found], float(size_m.max())),
            last=Sighted(
                int(last[-1]), *_state_at(int(last[-1]), last, _places(path)[last], fps, max_speed_m_s)
            ),
        )
    return None


def _state_at(
    frame: int,
    rows: Int[np.ndarray, "rows"],
    places_m: Float[np.ndarray, "rows 3"],
    fps: float,
    max_speed_m_s: float,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Position and velocity in a frame, from the places in some frames."""
    # A drone turns within half a second, and the ends of a straight line would be wrong by centimetres.
    _, velocity, position = np.polyfit((rows - frame) / fps, places_m, 2)
    return position, velocity * min(1.0, max_speed_m_s / max(float(np.linalg.norm(velocity)), 1e-9))


def _is_moving(places_m: Float[np.ndarray, "places 3"], span_m: float) -> bool:
    """Whether a candidate has moved far, or moves both in its first and in its last frames.

    A ghost seems to move, by a quarter of its span, while the drone that departs still overlaps it.
    """
    if float(np.linalg.norm(places_m[-1] - places_m[0])) > MIN_DISPLACEMENT * span_m:
        return True
    ends = (places_m[:WINDOW_FRAMES], places_m[-WINDOW_FRAMES:])
    return all(float(np.linalg.norm(np.ptp(end, axis=0))) > MIN_TRAVEL * span_m for end in ends)


def _places(path: list[Observation]) -> Float[np.ndarray, "frames 3"]:
    """(frames, 3), places along a path; NaN where the drone is not found."""
    return np.array([seen.position_m if seen.found else NOT_FOUND.position_m for seen in path])


def _is_continuation(path: list[Observation], earlier: list[Observation], reach_m: float) -> bool:
    """Whether a path begins within reach of the end of an earlier path: a drone that was hidden for a while."""
    begin, end = (np.flatnonzero([seen.found for seen in each]) for each in (path, earlier))
    distance = np.linalg.norm(path[begin[0]].position_m - earlier[end[-1]].position_m)
    return bool(begin[0] > end[-1] and distance <= reach_m * (begin[0] - end[-1]))


def _best_window(path: list[Observation]) -> int:
    """First frame of the `WINDOW_FRAMES` frames in which most cameras see the drone."""
    num_cameras = np.array([seen.num_cameras * seen.found for seen in path])
    total = np.convolve(num_cameras, np.ones(WINDOW_FRAMES), mode="valid")
    return int(np.where(num_cameras[: len(total)] > 0, total, -1).argmax())


def _nearest_size(
    state: InitialState, seen: Observation, size_m: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Size of the drone of an initial state that is at an observed place; `size_m` if there is no such drone."""
    distance = np.linalg.norm(state.position_m - seen.position_m, axis=-1)
    near = np.flatnonzero((distance < size_m.max() / 2) & np.isfinite(state.size_m).all(axis=-1))
    return state.size_m[near[distance[near].argmin()]] if len(near) else size_m


def _span_limits(known_m: Float[np.ndarray, "drones 3"]) -> tuple[float, float]:
    """Smallest and largest span of a candidate, given the sizes of the known drones."""
    spans = known_m.max(axis=-1)
    spans = spans[np.isfinite(spans)]
    return (float(spans.min()) / SIZE_RATIO, float(spans.max()) * SIZE_RATIO) if len(spans) else SPANS_M

"""Localising a camera in all frames: what a recording shows is learned first, then its poses are estimated.

Frames are decoded, and their markers detected, ahead of the poses. A recording shows whether the shutter rolls
(`line_time`), how large the errors of corners are (`pose.estimate_noise`), how wildly the camera moves
(`filtering.choose_agility`), and which markers are not where the map has them: in one frame, markers that disagree say
nothing about which of them is wrong, but over a recording a wrong marker disagrees with all others.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError
from psotrack.foreground.markers import MarkerDetector
from psotrack.foreground.silhouettes import FrameChanges, repeated_frames
from psotrack.geometry import Camera
from psotrack.inside_out import filtering
from psotrack.inside_out.filtering import Agility, PoseFilterParams
from psotrack.inside_out.frames import Frame, FrameSource, map_ahead, read_ahead
from psotrack.inside_out.lens_files import check_size
from psotrack.inside_out.localising.frame_poses import (
    STAGES,
    FollowedFrame,
    LocalisedVideo,
    Localiser,
    LocaliseSettings,
    MotionAround,
    constant_motion,
    own_path,
)
from psotrack.inside_out.mapping.building import complete_map
from psotrack.inside_out.marker_map import MarkerCentres, MarkerMap
from psotrack.inside_out.pose import CornerNoise, estimate_noise
from psotrack.inside_out.rolling_shutter import Detected, estimate_line_time, spline_through
from psotrack.support import Advance, Report, no_progress

#: Largest number of frames from which the errors of corners are learned, and number of estimates.
_NOISE_FRAMES, _NOISE_TURNS = 60, 2
#: Number of times that the motion of a rolling shutter and its poses are estimated by turns, first as of a stream.
_ROLLING_TURNS = 2
#: A marker is wrong if it disagrees in more than this fraction of the poses of its frames; smallest number of these
#: poses that decides.
_WRONG, _LEAST_FRAMES = 0.5, 3
#: Number of right markers that a pose needs where wrong ones are left out.
_ENOUGH = 2
_logger = logging.getLogger(__name__)
#: Number of threads that detect markers, each in a frame of its own; the calling thread has the rest of the work.
_WORKERS = max(1, min(4, (os.cpu_count() or 1) - 1))
#: Largest distance of a converted video's pictures from even times, intervals: half of one, and a tenth for rounding.
_UNEVEN = 0.6
#: Number, time (seconds) and grey image of a frame.
_GreyFrame = tuple[int, float, UInt8[np.ndarray, "height width"]]


def localise_frames(
    detected: Iterable[Detected],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    seconds: dict[str, float] | None = None,
) -> LocalisedVideo:
    """Localise a camera in frames whose markers are detected.

    Args:
        detected: number and time (seconds) of each frame, and its markers, which are all in the map. A list or another
            sequence is a recording; an iterator is a stream, which is localised as its frames come.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings; the dictionary is not used.
        seconds: times by stage; the times of "locate" and "filter" are added.
    """
    localiser = Localiser(marker_map, lens, settings)
    if seconds is not None:
        localiser = replace(localiser, seconds=seconds)
    if not isinstance(detected, Sequence):
        shown, interrupted = list[FollowedFrame](), False
        try:
            shown.extend(localiser.follow(detected, None))
        except KeyboardInterrupt:
            # A recording can be localised again, a stream cannot: the frames of a stream are kept.
            if not shown:
                raise
            interrupted = True
        return replace(_localised(shown, localiser), interrupted=interrupted)
    if settings.filter is not None:
        settings = replace(settings, filter=settings.filter.within(len(detected)))
        localiser = replace(localiser, settings=settings)
    localised, found = _recording(detected, localiser)
    wrong: tuple[int, ...] = ()
    given, fewest = detected, settings.pose.min_markers
    while more := _wrong_markers(detected, found):
        wrong = tuple(sorted((*wrong, *more)))
        if 2 * len(wrong) > len({int(marker) for _, _, markers in given for marker in markers.ids}):
            # Most markers are wrong: nothing says which ones are, or the lens is wrong.
            break
        detected = [
            (number, time_s, markers.select(~np.isin(markers.ids, wrong) & (len(markers) >= fewest)))
            for number, time_s, markers in given
        ]
        localised, found = _recording(detected, localiser.with_pose(min_markers=min(fewest, _ENOUGH)))
    return replace(localised, wrong_markers=wrong)


def _recording(
    detected: Sequence[Detected], localiser: Localiser
) -> tuple[LocalisedVideo, list[FollowedFrame]]:
    """Localise a recording with all its markers."""
    settings = localiser.settings
    line_time = estimate_line_time(detected, localiser.marker_map, localiser.lens, settings.pose)
    if line_time is not None:
        settings = replace(settings, shutter=line_time.shutter(settings.shutter))
        localiser = replace(localiser, settings=settings)
    agility, around = Agility(), None
    for _ in range(_ROLLING_TURNS if localiser.rolls else 0):
        around = _motions_around(list(localiser.follow(detected, agility, around)), localiser.params)
    if settings.pose.noise is None:
        noise = CornerNoise()
        several = [one for one in detected if len(one[2]) >= max(2, settings.pose.min_markers)]
        chosen = np.unique(np.linspace(0, len(several) - 1, min(_NOISE_FRAMES, len(several))).astype(int))
        some = [several[index] for index in chosen]
        single = replace(localiser, settings=replace(settings, filter=None))
        for _ in range(_NOISE_TURNS):
            shown = single.with_pose(noise=noise).follow(some, agility, around)
            poses = [frame.pose for frame in shown if frame.pose is not None]
            noise = estimate_noise([pose.equations for pose in poses if pose.equations is not None], noise)
        localiser = localiser.with_pose(noise=noise)
    found = list(localiser.follow(detected, agility, around))
    return replace(_localised(found, localiser, anew=True), line_time=line_time), found


def _localised(found: Sequence[FollowedFrame], localiser: Localiser, *, anew: bool = False) -> LocalisedVideo:
    """The paths of frames; filtered anew with the agility of all frames, or as they were estimated."""
    settings = localiser.settings
    path = raw = own_path(found, settings.pose)
    constant = np.nan_to_num(filtering.filled([frame.pose for frame in found], "constant", 6, 6))
    if settings.filter is not None:
        estimated = [frame.estimated for frame in found]
        path = (
            filtering.filter_path(raw, settings.filter, constant)
            if anew
            else filtering.path_of(raw, estimated)
        )
    return LocalisedVideo(path, raw, constant, localiser.shutter, localiser.marker_map)


def _motions_around(
    found: Sequence[FollowedFrame], params: PoseFilterParams
) -> Callable[[float], MotionAround | None]:
    """The motion around each frame, by splines through the smoothed poses."""
    times = np.array([frame.time_s for frame in found])
    smoothed = filtering.smoothed_motions(times, [frame.pose for frame in found], params)
    known = {time_s: one.motion for time_s, one in zip(times.tolist(), smoothed, strict=True) if one.motion}
    if not known:
        return lambda time_s: None
    # Beyond the ends, a pose gives the spline the smoothed velocity of the end: it lies as far from the pose inside as
    # the camera moves in the time between the two.
    times_s = sorted(known)
    frame_s = float(np.diff(times).min(initial=1.0))
    poses = {time_s: (motion.position_m, motion.R_world_cam) for time_s, motion in known.items()}
    for end, inside, late_s in (
        (times_s[0], times_s[:2][-1], -frame_s),
        (times_s[-1], times_s[-2:][0], frame_s),
    ):
        rates = {name: getattr(known[end], name) for name in ("velocity_m_s", "rate_rad_s")}
        position_m, R = constant_motion(replace(known[inside], **rates), inside)(np.array([end + late_s]))
        poses[end + late_s] = position_m[0], R[0]
    poses_at = spline_through(sorted(poses), [poses[time_s] for time_s in sorted(poses)])
    # A velocity is the difference of the poses before and after, divided by the time between the two.
    scale = np.sqrt(2) / (2 * frame_s)
    roots = {time_s: scale * np.linalg.cholesky(motion.covariance) for time_s, motion in known.items()}
    for end in (times_s[0], times_s[-1]):
        roots[end] = np.linalg.cholesky(known[end].rate_covariance)

    def around(time_s: float) -> MotionAround | None:
        nearest = min(roots, key=lambda other: abs(other - time_s))
        if abs(nearest - time_s) > params.longest_gap_s:
            return None
        # A frame that was lost has a motion all the same, by its neighbours.
        return MotionAround(poses_at, roots[nearest])

    return around


def _wrong_markers(detected: Sequence[Detected], found: Sequence[FollowedFrame]) -> tuple[int, ...]:
    """Ids of the markers that disagree with most of the poses by two markers and more of their frames."""
    shown: dict[int, list[bool]] = {}
    for (_, _, markers), frame in zip(detected, found, strict=True):
        if frame.pose is not None and frame.pose.used.sum() >= 2:
            for marker, used in zip(markers.ids.tolist(), frame.pose.used, strict=True):
                shown.setdefault(marker, []).append(bool(used))
    return tuple(
        marker
        for marker, used in sorted(shown.items())
        if len(used) >= _LEAST_FRAMES and np.mean(used) < 1 - _WRONG
    )


def localise_video(
    source: FrameSource,
    marker_map: MarkerMap | MarkerCentres,
    lens: Camera,
    settings: LocaliseSettings | None = None,
    report: Report = no_progress,
    *,
    side_m: float | None = None,
) -> LocalisedVideo:
    """Localise a camera in every frame, from markers of known positions.

    A thread decodes frames and converts them to grey, and others detect markers in several frames at once. Markers that
    are not in the map are not detected. In a recording, the markers of all frames are found first, and show the
    shutter, the errors of the corners and the agility of the camera. Where two poses fit a frame's markers about
    equally well, the filter's prediction decides; then the filter uses the pose or gates it. Markers that disagree with
    the others over a recording are left out.

    Args:
        source: frames of the camera.
        marker_map: map of the room; or the centres of its markers, whose corners are then found from the recording.
        lens: intrinsics of the camera, for the size of the frames; the pose in it is ignored.
        settings: settings of detection, pose estimation and filter.
        report: progress is reported to it.
        side_m: side of all markers of which only the centres are known, metres; None estimates each side.

    Returns:
        The path, with all frames of the source. A stream ends by itself or by Ctrl-C.

    Raises:
        InputError: frames cannot be read, or end early; the lens is for another size of images; or too few frames show
            markers of which only the centres are known.
        SettingsError: there is no dictionary of this name, or it has none of the map's markers.
    """
    settings = settings or LocaliseSettings()
    check_size(source.name, lens, source.image_size_wh)
    detector = MarkerDetector(settings.dictionary, lens, ids=marker_map.ids.tolist())
    seconds, unknown = dict.fromkeys(STAGES, 0.0), tuple[int, ...]()
    began_s = time.perf_counter()
    with report("localise", source.num_frames or 0) as done:
        changes = FrameChanges()
        detected: Iterable[Detected] = _detect_markers(source, detector, seconds, changes, done)
        if not source.stream:
            detected = _without_repeats(source.name, list(detected), changes)
        if isinstance(marker_map, MarkerCentres):
            marker_map, unknown, detected = _completed(source, marker_map, lens, detected, side_m)
        found = localise_frames(detected, marker_map, lens, settings, seconds)
    wall_s = time.perf_counter() - began_s
    return replace(found, seconds=seconds, wall_s=wall_s, unknown_markers=unknown)


def _completed(
    source: FrameSource,
    centres: MarkerCentres,
    lens: Camera,
    detected: Iterable[Detected],
    side_m: float | None,
) -> tuple[MarkerMap, tuple[int, ...], list[Detected]]:
    """The map of markers of which only the centres are known, those left out, and the frames with the others."""
    if not isinstance(detected, list):
        raise InputError(
            source.name,
            expected="a recorded video, because only the centres of the markers are known",
            found="a stream",
            remedy="give a table of corners",
        )
    found = [markers for _, _, markers in detected]
    marker_map = complete_map(found, centres, lens, side_m=side_m, name=str(source.name))
    known = marker_map.ids
    frames = [(number, time_s, each.select(np.isin(each.ids, known))) for number, time_s, each in detected]
    seen = {int(marker) for markers in found for marker in markers.ids}
    return marker_map, tuple(sorted(seen - set(known.tolist()))), frames


def _without_repeats(name: str, detected: list[Detected], changes: FrameChanges) -> list[Detected]:
    """The frames without markers in those that repeat the picture before.

    Where the other pictures come evenly, as before a conversion to a higher rate, their times are made even.
    """
    repeated = repeated_frames(changes.found)
    if not repeated.any():
        return detected
    times_s, new = np.array([time_s for _, time_s, _ in detected]), np.flatnonzero(~repeated)
    order = np.arange(len(new))
    even_s = np.polyval(np.polyfit(order, times_s[new], 1), order) if len(new) > 1 else times_s[new]
    longest_s = _UNEVEN * np.median(np.diff(times_s))
    is_converted = len(new) > 2 and bool((np.abs(even_s - times_s[new]) <= longest_s).all())
    if is_converted:
        times_s[new] = even_s
    _logger.warning(
        "%s: %d of %d frames repeat the picture before, and are left out: %s",
        name, np.count_nonzero(repeated), len(detected),
        f"the video was converted from about {1 / np.diff(even_s).mean():.2g} frames per second"
        if is_converted else "a stream that froze, or frames that were lost or are damaged",
    )  # fmt: skip
    return [
        (number, time_s, markers.select(np.full(len(markers), not again)))
        for (number, _, markers), time_s, again in zip(detected, times_s.tolist(), repeated, strict=True)
    ]


def _detect_markers(
    source: FrameSource,
    detector: MarkerDetector,
    seconds: dict[str, float],
    changes: FrameChanges,
    done: Advance,
) -> Iterator[Detected]:
    def found(frame: _GreyFrame) -> tuple[Detected, float]:
        number, time_s, gray = frame
        start_s = time.perf_counter()
        # A map has every marker once.
        markers = detector.detect(gray).of_single_ids()
        return (number, time_s, markers), time.perf_counter() - start_s

    frames = read_ahead(_grey_frames(source, seconds, changes), newest=source.newest)
    # Frames that wait in line would no longer be the newest.
    workers = 0 if source.newest else _WORKERS
    for detected, spent_s in map_ahead(found, frames, workers):
        seconds["detect"] += spent_s
        yield detected
        done(1)


def _grey_frames(
    source: FrameSource, seconds: dict[str, float], changes: FrameChanges
) -> Iterator[_GreyFrame]:
    frames: Iterator[Frame] = source.frames()
    while True:
        start_s = time.perf_counter()
        frame = next(frames, None)
        decoded_s = time.perf_counter()
        seconds["decode"] += decoded_s - start_s
        if frame is None:
            return
        gray = frame.grey()
        if not source.stream:
            changes.add(gray)
        seconds["grey"] += time.perf_counter() - decoded_s
        yield frame.number, frame.time_s, gray

"""Localising a camera in a video: decoding, detection of markers, poses and filter, as one loop over frames."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.geometry import Camera
from psotrack.inside_out.filtering.path_rows import PoseRow, join_rows
from psotrack.inside_out.frames import Frame, FrameSource, map_ahead, read_ahead
from psotrack.inside_out.line_time import Detected, LineTime, estimate_line_time
from psotrack.inside_out.localising.corner_noise import estimate_corner_noise
from psotrack.inside_out.localising.frame_poses import find_first_motion, localise_frames
from psotrack.inside_out.localising.map_evidence import (
    are_few,
    least_markers,
    without_markers,
    wrong_markers,
)
from psotrack.inside_out.localising.records import STAGES, LocalisedVideo, LocaliseSettings
from psotrack.inside_out.mapping.from_centres import complete_map
from psotrack.inside_out.marker_map import MarkerCentres, MarkerMap
from psotrack.support import Advance, Report, no_progress

#: Number of threads that detect markers, each in a frame of its own; the calling thread has the rest of the work.
_WORKERS = max(1, min(4, (os.cpu_count() or 1) - 1))
#: Number, time (seconds) and grey image of a frame.
_GreyFrame = tuple[int, float, UInt8[np.ndarray, "height width"]]


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
    are not in the map are not detected. In a recording, the markers of all frames are found first, and show whether the
    shutter rolls (`line_time`) and how large and how correlated the errors of corners are (`corner_noise`). Where two
    poses fit a frame's markers about equally well, the filter's prediction decides; then the filter uses the pose or
    gates it. Markers that disagree with the others over a recording are left out, and the poses are estimated once more
    without them.

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
    settings = (settings or LocaliseSettings()).within(source.num_frames)
    given = settings
    _check_size(source, lens)
    detector = MarkerDetector(settings.dictionary, lens, ids=marker_map.ids.tolist())
    seconds = dict.fromkeys(STAGES, 0.0)
    raw_rows, rows, interrupted, line_time, first = [], [], False, None, None
    wrong: tuple[int, ...] = ()
    unknown: tuple[int, ...] = ()
    began_s = time.perf_counter()
    try:
        with report("localise", source.num_frames or 0) as done:
            detected: Iterable[Detected] = _counted(_detect_markers(source, detector, seconds), done)
            if not source.stream:
                detected = list(detected)
            if isinstance(marker_map, MarkerCentres):
                room, unknown, detected = _completed(source, marker_map, lens, detected, side_m)
            else:
                room = marker_map
            if isinstance(detected, list):
                line_time, settings = _learned(detected, room, lens, settings, seconds)
                first = find_first_motion(detected, room, lens, settings)
            for raw, row in localise_frames(detected, room, lens, settings, seconds, first):
                raw_rows.append(raw)
                rows.append(row)
    except KeyboardInterrupt:
        # A recording can be localised again, a stream cannot: the frames of a stream are kept.
        if not source.stream or not rows:
            raise
        interrupted = True
    # Ctrl-C may come between the two appends.
    raw_rows = raw_rows[: len(rows)]
    if isinstance(detected, list) and any(map(_disagrees, raw_rows, (markers for _, _, markers in detected))):
        wrong = wrong_markers(detected, room, lens, settings.pose)
        if wrong and are_few(wrong, detected):
            right = list(without_markers(detected, wrong, settings.pose))
            pose = replace(given.pose, min_markers=least_markers(given.pose))
            again = replace(given, pose=pose)
            line_time, settings = _learned(right, room, lens, again, seconds)
            first = find_first_motion(right, room, lens, settings)
            both = list(localise_frames(right, room, lens, settings, seconds, first))
            raw_rows, rows = [raw for raw, _ in both], [row for _, row in both]
    wall_s = time.perf_counter() - began_s
    return LocalisedVideo(
        join_rows(rows),
        join_rows(raw_rows),
        room,
        seconds,
        wall_s,
        interrupted,
        settings.shutter,
        line_time,
        wrong,
        unknown,
    )


def _disagrees(raw: PoseRow, markers: DetectedMarkers) -> bool:
    """Whether a frame's markers do not all agree with one pose."""
    return len(markers) >= 2 and (not np.isfinite(raw.position_m[0]) or raw.num_markers < len(markers))


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
    completed = complete_map(found, centres, lens, side_m=side_m, name=str(source.name))
    known = completed.marker_map.ids
    frames = [(number, time_s, each.select(np.isin(each.ids, known))) for number, time_s, each in detected]
    return completed.marker_map, completed.left_out, frames


def _learned(
    detected: list[Detected],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    seconds: dict[str, float],
) -> tuple[LineTime | None, LocaliseSettings]:
    """The line time that frames show, and settings with the shutter and the errors of corners to use."""
    began_s = time.perf_counter()
    line_time = estimate_line_time(detected, marker_map, lens, settings.pose)
    if line_time is not None:
        settings = replace(settings, shutter=line_time.shutter(settings.shutter))
    if None in (settings.pose.centre_scale, settings.pose.usual_px, settings.pose.usual_place_m):
        noise = estimate_corner_noise(detected, marker_map, lens, settings.pose, settings.shutter)
        settings = replace(settings, pose=noise.settings(settings.pose))
    seconds["locate"] += time.perf_counter() - began_s
    return line_time, settings


def _counted(detected: Iterable[Detected], done: Advance) -> Iterator[Detected]:
    for one in detected:
        yield one
        done(1)


def _detect_markers(
    source: FrameSource, detector: MarkerDetector, seconds: dict[str, float]
) -> Iterator[Detected]:
    def found(frame: _GreyFrame) -> tuple[Detected, float]:
        number, time_s, gray = frame
        start_s = time.perf_counter()
        # A map has every marker once.
        markers = detector.detect(gray).of_single_ids()
        return (number, time_s, markers), time.perf_counter() - start_s

    frames = read_ahead(_grey_frames(source, seconds), newest=source.newest)
    # Frames that wait in line would no longer be the newest.
    workers = 0 if source.newest else _WORKERS
    for detected, spent_s in map_ahead(found, frames, workers):
        seconds["detect"] += spent_s
        yield detected


def _check_size(source: FrameSource, lens: Camera) -> None:
    size_wh = (int(lens.image_size_wh[0]), int(lens.image_size_wh[1]))
    if size_wh != source.image_size_wh:
        raise InputError(
            source.name,
            expected=f"{size_wh[0]} x {size_wh[1]} pixels as the lens is for",
            found=f"{source.image_size_wh[0]} x {source.image_size_wh[1]}",
        )


def _grey_frames(source: FrameSource, seconds: dict[str, float]) -> Iterator[_GreyFrame]:
    frames: Iterator[Frame] = source.frames()
    while True:
        start_s = time.perf_counter()
        frame = next(frames, None)
        decoded_s = time.perf_counter()
        seconds["decode"] += decoded_s - start_s
        if frame is None:
            return
        gray = np.asarray(cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY), np.uint8)
        seconds["grey"] += time.perf_counter() - decoded_s
        yield frame.number, frame.time_s, gray

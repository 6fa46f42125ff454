"""Localising a camera in a video: decoding and detection of markers, ahead of the poses."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from psotrack.errors import InputError
from psotrack.foreground.markers import MarkerDetector
from psotrack.foreground.silhouettes import FrameChanges, repeated_frames
from psotrack.geometry import Camera
from psotrack.inside_out.frames import Frame, FrameSource, map_ahead, read_ahead
from psotrack.inside_out.lens_files import check_size
from psotrack.inside_out.localising.recording import localise_frames
from psotrack.inside_out.localising.records import STAGES, LocalisedVideo, LocaliseSettings
from psotrack.inside_out.mapping.from_centres import complete_map
from psotrack.inside_out.marker_map import MarkerCentres, MarkerMap
from psotrack.inside_out.rolling_shutter import Detected
from psotrack.support import Advance, Report, no_progress

_logger = logging.getLogger(__name__)
#: Number of threads that detect markers, each in a frame of its own; the calling thread has the rest of the work.
_WORKERS = max(1, min(4, (os.cpu_count() or 1) - 1))
#: Largest distance of a converted video's pictures from even times, intervals: half of one, and a tenth for rounding.
_UNEVEN = 0.6
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
        detected: Iterable[Detected] = _counted(_detect_markers(source, detector, seconds, changes), done)
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


def _counted(detected: Iterable[Detected], done: Advance) -> Iterator[Detected]:
    for one in detected:
        yield one
        done(1)


def _detect_markers(
    source: FrameSource, detector: MarkerDetector, seconds: dict[str, float], changes: FrameChanges
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

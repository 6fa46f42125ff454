"""From frames to a path: markers are found in each, the pose they tell is taken, and a filter follows the camera."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import Camera
from psotrack.inside_out.camera_path import CameraPath, Flag
from psotrack.inside_out.detection import DetectedMarkers, MarkerDetector
from psotrack.inside_out.filtering.path_rows import PoseRow, path_of
from psotrack.inside_out.filtering.pose_filter import FilterRun, PoseFilterParams, advance, expected, step
from psotrack.inside_out.frames import Frame, Source, read_ahead
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import Expected, MarkerPose, PoseSettings, locate
from psotrack.support import Report, no_progress
from psotrack.trajectories import Status

#: What a frame goes through; the first two in a thread of their own.
STAGES = ("decode", "grey", "detect", "locate", "filter")
#: Markers that the paper asks for; a pose from fewer is flagged whatever was asked for.
PAPER_MARKERS = 4
#: Probability that another pose is the right one, above which a pose is flagged.
_AMBIGUOUS = 0.05

_Gray = tuple[int, float, UInt8[np.ndarray, "height width"]]


@dataclass(frozen=True)
class LocaliseSettings:
    """How a camera is localised.

    Attributes:
        dictionary: of the markers, such as 4x4_1000.
        pose: how poses are found.
        filter: the causal filter; None takes every pose as it is.
    """

    dictionary: str = "4x4_1000"
    pose: PoseSettings = field(default_factory=PoseSettings)
    filter: PoseFilterParams | None = field(default_factory=PoseFilterParams)

    def within(self, num_frames: int | None) -> LocaliseSettings:
        """The same for a recording of so many frames; None of a stream."""
        return self if self.filter is None else replace(self, filter=self.filter.within(num_frames))


@dataclass(frozen=True)
class LocalisedVideo:
    """A camera's path, and what it took.

    Attributes:
        path: as the filter tells it; `raw` without one.
        raw: each frame's own pose.
        seconds: by stage of `STAGES`, summed over frames; stages run beside one another.
        wall_s: from the first frame to the last.
        interrupted: whether Ctrl-C ended a stream.
    """

    path: CameraPath
    raw: CameraPath
    seconds: Mapping[str, float]
    wall_s: float
    interrupted: bool = False

    @property
    def frames_per_second(self) -> float:
        """Frames per second of wall time."""
        return self.raw.num_frames / max(self.wall_s, 1e-9)


def localise_video(
    source: Source,
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings | None = None,
    report: Report = no_progress,
) -> LocalisedVideo:
    """Where a camera is in every frame, from markers of known places.

    Every frame is decoded and made grey in a thread, ahead of the search for markers. Markers that the map does not
    have are not sought. The pose of the others is taken with a view to where the filter expects the camera, which
    decides between two that fit about as well; then the filter takes it or not.

    Args:
        source: of the frames.
        marker_map: of the room.
        lens: intrinsics of the camera, for the size of the frames; its pose is ignored.
        settings: how.
        report: whom to tell of progress.

    Returns:
        The path, with all frames of the source. A stream ends when it ends, or by Ctrl-C.

    Raises:
        InputError: frames cannot be read, or end early; or the lens is for another size of images.
        SettingsError: there is no such dictionary, or it has none of the map's markers.
    """
    settings = (settings or LocaliseSettings()).within(source.num_frames)
    _check_size(source, lens)
    detector = MarkerDetector(settings.dictionary, lens, ids=marker_map.ids.tolist())
    seconds = dict.fromkeys(STAGES, 0.0)
    raw_rows, rows, interrupted = [], [], False
    began_s = time.perf_counter()
    try:
        with report("localise", source.num_frames or 0) as done:
            for raw, row in follow_markers(
                _detected(source, detector, seconds), marker_map, lens, settings, seconds
            ):
                raw_rows.append(raw)
                rows.append(row)
                done(1)
    except KeyboardInterrupt:
        # A recording can be localised anew, a stream cannot.
        if not source.stream or not rows:
            raise
        interrupted = True
    # Ctrl-C may come between the two.
    raw_rows = raw_rows[: len(rows)]
    wall_s = time.perf_counter() - began_s
    return LocalisedVideo(path_of(rows), path_of(raw_rows), seconds, wall_s, interrupted)


def follow_markers(
    sightings: Iterable[tuple[int, float, DetectedMarkers]],
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    seconds: dict[str, float] | None = None,
) -> Iterator[tuple[PoseRow, PoseRow]]:
    """What each frame says by itself, and what the filter makes of it, frame by frame.

    Args:
        sightings: number and time of each frame, and markers in it that the map has.
        marker_map: of the room.
        lens: intrinsics of the camera.
        settings: how; the dictionary has no say.
        seconds: what "locate" and "filter" take is added to.
    """
    spent_s = dict.fromkeys(STAGES, 0.0) if seconds is None else seconds
    following = FilterRun()
    for number, time_s, seen in sightings:
        began_s = time.perf_counter()
        if settings.filter is not None:
            following = advance(following, time_s, settings.filter)
        foretold_s = time.perf_counter()
        pose = _located(seen, marker_map, lens, settings, following)
        raw = row_of(number, time_s, seen, pose, settings)
        raw = replace(raw, common=_common(seen, pose, marker_map, settings.pose))
        located_s = time.perf_counter()
        row = raw
        if settings.filter is not None:
            following, row = step(following, raw, settings.filter)
        spent_s["locate"] += located_s - foretold_s
        spent_s["filter"] += time.perf_counter() - located_s + foretold_s - began_s
        yield raw, row


def _detected(
    source: Source, detector: MarkerDetector, seconds: dict[str, float]
) -> Iterator[tuple[int, float, DetectedMarkers]]:
    for number, time_s, gray in read_ahead(_greyed(source, seconds), newest=source.newest):
        start_s = time.perf_counter()
        seen = detector.detect(gray)
        seconds["detect"] += time.perf_counter() - start_s
        yield number, time_s, seen


def _check_size(source: Source, lens: Camera) -> None:
    size_wh = (int(lens.image_size_wh[0]), int(lens.image_size_wh[1]))
    if size_wh != source.image_size_wh:
        raise InputError(
            source.name,
            expected=f"{size_wh[0]} x {size_wh[1]} pixels as the lens is for",
            found=f"{source.image_size_wh[0]} x {source.image_size_wh[1]}",
        )


def _greyed(source: Source, seconds: dict[str, float]) -> Iterator[_Gray]:
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


def _located(
    seen: DetectedMarkers,
    marker_map: MarkerMap,
    lens: Camera,
    settings: LocaliseSettings,
    following: FilterRun,
) -> MarkerPose | None:
    told = None if settings.filter is None else expected(following, settings.filter)
    where = None if told is None else Expected(told.position_m, told.R_world_cam, told.covariance)
    return locate(seen.corners_px, marker_map.corners_of(seen.ids.tolist()), lens, settings.pose, where)


def row_of(
    number: int, time_s: float, seen: DetectedMarkers, pose: MarkerPose | None, settings: LocaliseSettings
) -> PoseRow:
    """What one frame says by itself; without a pose, the markers are those that were seen."""
    markers = len(seen) if pose is None else int(pose.used.sum())
    flags = Flag(0)
    if 0 < markers < max(PAPER_MARKERS, settings.pose.min_markers):
        flags |= Flag.FEW_MARKERS
    if pose is not None and pose.ambiguity > _AMBIGUOUS:
        flags |= Flag.AMBIGUOUS
    nothing = np.full(3, np.nan)
    return PoseRow(
        frame=number,
        time_s=time_s,
        position_m=nothing if pose is None else pose.position_m,
        orientation_wxyz=np.full(4, np.nan)
        if pose is None
        else Rotation.from_matrix(pose.R_world_cam).as_quat(scalar_first=True),
        covariance=np.full((6, 6), np.nan) if pose is None else pose.covariance,
        num_markers=markers,
        reprojection_px=np.nan if pose is None else float(pose.reprojection_px),
        ambiguity=np.nan if pose is None else float(pose.ambiguity),
        status=int(Status.LOST if pose is None else Status.TRACKED),
        flags=int(flags),
        velocity_m_s=nothing,
        chance=np.nan if pose is None else pose.chance,
    )


def _common(
    seen: DetectedMarkers, pose: MarkerPose | None, marker_map: MarkerMap, settings: PoseSettings
) -> Float[np.ndarray, "6 errors"]:
    """What errors of the whole map, and of the focal length, do to a pose; none where none are stated."""
    if not settings.map_error_m and not settings.focal_error:
        return np.zeros((6, 0))
    common = np.zeros((6, 3 * len(marker_map) + 1))
    if pose is not None:
        first = 3 * np.searchsorted(marker_map.ids, seen.ids)
        common[:, (first[:, None] + np.arange(3)).ravel()] = pose.common[:, :-1]
        common[:, -1] = pose.common[:, -1]
    return common

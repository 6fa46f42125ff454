"""Markers in the frames of cameras that are carried through a room: input for building and checking a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.geometry import Camera, undistort
from psotrack.inside_out.pose import RollingShutter, row_times_s
from psotrack.recordings import VideoInfo, read_frames
from psotrack.support import Report, no_progress

#: Corners of a marker with sides of 1 in its own axes, x to its right, y up, z out of the print, in OpenCV's order.
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
#: Number of runs of consecutive frames, their length, and the number of a video's first frames in which they lie.
_RUNS, _RUN_FRAMES, _SEARCHED_FRAMES = 8, 9, 1500


@dataclass(frozen=True)
class FrameMarkers:
    """Markers in one frame.

    Attributes:
        source: number of the video.
        time_s: time of the frame in its video, seconds.
        ids: (markers,).
        corners_px: (markers, 4, 2), in the order of OpenCV's ArUco, pixels.
    """

    source: int
    time_s: float
    ids: Int[np.ndarray, " markers"]
    corners_px: Float[np.ndarray, "markers 4 2"]


@dataclass(frozen=True)
class MarkerSightings:
    """Markers in the frames of one or several videos. A view is a frame that shows at least one marker.

    Attributes:
        lenses: lenses of the videos' cameras.
        lens: (views,), number of the view's video.
        time_s: (views,), time in this video, seconds.
        view: (sightings,), number of the view, not decreasing.
        marker: (sightings,), ids. No view has a marker twice.
        corners_px: (sightings, 4, 2), pixels.
        name: name of the videos, for messages.
        shutters: rolling shutters of the videos' cameras; None is a global shutter, and so is an empty tuple for all.
        consecutive: frames of each video that follow one another, number, time (seconds) and markers, to estimate its
            line time; empty where the views follow one another, and for all videos where it is not to be estimated.
    """

    lenses: tuple[Camera, ...]
    lens: Int[np.ndarray, " views"]
    time_s: Float[np.ndarray, " views"]
    view: Int[np.ndarray, " sightings"]
    marker: Int[np.ndarray, " sightings"]
    corners_px: Float[np.ndarray, "sightings 4 2"]
    name: str = "video"
    shutters: tuple[RollingShutter | None, ...] = ()
    consecutive: tuple[tuple[tuple[int, float, DetectedMarkers], ...], ...] = ()

    @property
    def rolls(self) -> bool:
        """Whether any camera has a rolling shutter."""
        return any(shutter is not None and shutter.line_time_s for shutter in self.shutters)

    @cached_property
    def row_times_s(self) -> Float[np.ndarray, "sightings 4"]:
        """(sightings, 4), when the row of each corner was exposed, after the middle row of its image, seconds."""
        time_s = np.zeros(self.corners_px.shape[:2])
        for index, (lens, shutter) in enumerate(zip(self.lenses, self.shutters, strict=False)):
            if shutter is not None:
                rows = self.lens[self.view] == index
                time_s[rows] = row_times_s(self.corners_px[rows], lens, shutter.line_time_s)
        return time_s

    @property
    def num_views(self) -> int:
        """Number of views."""
        return len(self.lens)

    @property
    def ids(self) -> list[int]:
        """Ids of the markers that are seen, in increasing order."""
        return np.unique(self.marker).tolist()

    def select(self, kept: Bool[np.ndarray, " sightings"]) -> MarkerSightings:
        """The sightings that a mask keeps, in the views that still have sightings."""
        views, view = np.unique(self.view[kept], return_inverse=True)
        return MarkerSightings(
            self.lenses,
            self.lens[views],
            self.time_s[views],
            view.reshape(-1),
            self.marker[kept],
            self.corners_px[kept],
            self.name,
            self.shutters,
            self.consecutive,
        )


def find_sightings(
    videos: Sequence[tuple[VideoInfo, Camera]],
    dictionary: str = "4x4_1000",
    *,
    most_frames: int = 300,
    consecutive: bool = False,
    report: Report = no_progress,
) -> MarkerSightings:
    """Find the markers in videos of one room.

    Args:
        videos: videos with the lens of each, for images of its size.
        dictionary: name of the markers' dictionary, such as 4x4_50.
        most_frames: largest number of frames of a video that are searched, evenly spread: neighbouring frames show the
            same.
        consecutive: also search frames that follow one another, where others were left out, to see whether the shutter
            rolls.
        report: progress is reported to it.

    Raises:
        InputError: a video cannot be read, or is of another size than its lens; or no frame shows a marker.
        SettingsError: there is no dictionary of this name.
    """
    for video, lens in videos:
        width, height = (int(side) for side in lens.image_size_wh)
        if (width, height) != video.image_size_wh:
            raise InputError(
                video.path,
                expected=f"{width} x {height} pixels as the lens is for",
                found="{} x {}".format(*video.image_size_wh),
            )
    detectors = [MarkerDetector(dictionary, lens=lens) for _, lens in videos]
    seen = []
    steps = [max(1, -(-video.num_frames // most_frames)) for video, _ in videos]
    total = sum(-(-video.num_frames // step) for (video, _), step in zip(videos, steps, strict=True))
    with report("markers", total) as advance:
        for source, ((video, _), step) in enumerate(zip(videos, steps, strict=True)):
            for index, frame in enumerate(read_frames(video, step)):
                gray = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8)
                found = detectors[source].detect(gray)
                seen.append(FrameMarkers(source, index * step / video.fps, found.ids, found.corners_px))
                advance(1)
    name = ", ".join(str(video.path) for video, _ in videos)
    sightings = collect_sightings(seen, [lens for _, lens in videos], name)
    if not consecutive:
        return sightings
    followed = [
        () if step == 1 else tuple(_consecutive(video, detector))
        for (video, _), step, detector in zip(videos, steps, detectors, strict=True)
    ]
    return replace(sightings, consecutive=tuple(followed))


def _consecutive(video: VideoInfo, detector: MarkerDetector) -> Iterator[tuple[int, float, DetectedMarkers]]:
    """Markers in runs of frames, spread over the beginning of a video."""
    first_frames = min(video.num_frames, _SEARCHED_FRAMES)
    starts = np.linspace(0, max(first_frames - _RUN_FRAMES, 0), _RUNS).astype(int)
    chosen = set((starts[:, None] + np.arange(_RUN_FRAMES)).ravel().tolist())
    for number, frame in enumerate(islice(read_frames(video), first_frames)):
        if number in chosen:
            gray = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8)
            yield number, number / video.fps, detector.detect(gray).of_single_ids()


def collect_sightings(
    seen: Iterable[FrameMarkers], lenses: Sequence[Camera], name: str = "video"
) -> MarkerSightings:
    """The sightings of frames. Two markers with one id in a frame are left out: at least one is misread.

    Raises:
        InputError: no frame shows a marker.
    """
    views: list[tuple[int, float]] = []
    rows: list[tuple[int, int, Float[np.ndarray, "4 2"]]] = []
    for frame in seen:
        ids, counts = np.unique(frame.ids, return_counts=True)
        single = set(ids[counts == 1].tolist())
        found = [
            (len(views), marker, corners.astype(np.float64))
            for marker, corners in zip(frame.ids.tolist(), frame.corners_px, strict=True)
            if marker in single
        ]
        if found:
            views.append((frame.source, frame.time_s))
            rows += found
    if not rows:
        raise InputError(
            name,
            expected="frames that show markers",
            found="none in any frame",
            remedy="check that --dictionary names the printed markers",
        )
    return MarkerSightings(
        tuple(lenses),
        np.array([source for source, _ in views]),
        np.array([time_s for _, time_s in views]),
        np.array([view for view, _, _ in rows]),
        np.array([marker for _, marker, _ in rows]),
        np.array([corners for _, _, corners in rows]),
        name,
    )


def square_poses(
    sightings: MarkerSightings, side_m: float
) -> tuple[Float[np.ndarray, "sightings 2 3 3"], Float[np.ndarray, "sightings 2 3"]]:
    """The two poses of a square that look almost the same, marker to camera, the better one first; NaN without a pose.

    Infinitesimal plane-based pose estimation (IPPE; Collins & Bartoli 2014).

    Args:
        sightings: markers in views.
        side_m: side of all markers, metres.
    """
    R = np.full((len(sightings.view), 2, 3, 3), np.nan)
    t_m = np.full((len(sightings.view), 2, 3), np.nan)
    lens_of = sightings.lens[sightings.view]
    for index, lens in enumerate(sightings.lenses):
        of_lens = np.flatnonzero(lens_of == index)
        normalised = undistort(lens, sightings.corners_px[of_lens])
        for row, corners in zip(of_lens.tolist(), normalised, strict=True):
            if not np.isfinite(corners).all():
                continue
            try:
                _, turns, shifts, _ = cv2.solvePnPGeneric(
                    side_m * SQUARE, corners, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
                )
            except cv2.error:
                # Degenerate corners, such as corners on one line.
                continue
            for which, (turn, shift) in enumerate(zip(turns, shifts, strict=True)):
                R[row, which], t_m[row, which] = cv2.Rodrigues(turn)[0], shift.ravel()
    return R, t_m

"""Markers in the frames of cameras that are carried through a room: input for building and checking a map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration import solve_pnp
from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.geometry import Camera, undistort
from psotrack.inside_out.lens_files import check_size
from psotrack.inside_out.marker_map import SQUARE
from psotrack.recordings import VideoInfo, frame_times, read_frames_at
from psotrack.support import Report, no_progress

#: Largest number of frames of a video that are searched.
MOST_FRAMES = 300


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
    """

    lenses: tuple[Camera, ...]
    lens: Int[np.ndarray, " views"]
    time_s: Float[np.ndarray, " views"]
    view: Int[np.ndarray, " sightings"]
    marker: Int[np.ndarray, " sightings"]
    corners_px: Float[np.ndarray, "sightings 4 2"]
    name: str = "video"

    @cached_property
    def rays(self) -> Float[np.ndarray, "sightings 4 2"]:
        """(sightings, 4, 2), directions x / z, y / z in which the corners are seen."""
        rays = np.empty_like(self.corners_px)
        for index, lens in enumerate(self.lenses):
            rows = self.lens[self.view] == index
            rays[rows] = undistort(lens, self.corners_px[rows])
        return rays

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
        )


def find_sightings(
    videos: Sequence[tuple[VideoInfo, Camera]],
    dictionary: str = "4x4_1000",
    *,
    report: Report = no_progress,
) -> MarkerSightings:
    """Find the markers in videos of one room.

    Args:
        videos: videos with the lens of each, for images of its size.
        dictionary: name of the markers' dictionary, such as 4x4_50.
        report: progress is reported to it.

    Raises:
        InputError: a video cannot be read, or is of another size than its lens; or no frame shows a marker.
        SettingsError: there is no dictionary of this name.
    """
    for video, lens in videos:
        check_size(video.path, lens, video.image_size_wh)
    detectors = [MarkerDetector(dictionary, lens=lens) for _, lens in videos]
    seen = []
    numbers = [_searched(video.num_frames) for video, _ in videos]
    with report("markers", sum(map(len, numbers))) as advance:
        for source, (video, _) in enumerate(videos):
            times_s = frame_times(video).time_s.tolist()
            for number, frame in read_frames_at(video, numbers[source]):
                gray = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8)
                seen.append((source, times_s[number], detectors[source].detect(gray)))
                advance(1)
    name = ", ".join(str(video.path) for video, _ in videos)
    return collect_sightings(seen, [lens for _, lens in videos], name)


def _searched(num_frames: int) -> list[int]:
    """Numbers of frames that are evenly spread, and of the next one of each fourth of them, which shows the motion."""
    if num_frames <= MOST_FRAMES:
        return list(range(num_frames))
    spread = np.linspace(0, num_frames - 2, MOST_FRAMES * 4 // 5).astype(int)
    return np.union1d(spread, spread[::4] + 1).tolist()


def collect_sightings(
    seen: Iterable[tuple[int, float, DetectedMarkers]], lenses: Sequence[Camera], name: str = "video"
) -> MarkerSightings:
    """The sightings of frames. Two markers with one id in a frame are left out: at least one is misread.

    Args:
        seen: for each frame the number of its video, its time (seconds), and its markers.
        lenses: lenses of the videos' cameras.
        name: name of the videos, for messages.

    Raises:
        InputError: no frame shows a marker.
    """
    singles = ((source, time_s, found.of_single_ids()) for source, time_s, found in seen)
    views = [one for one in singles if len(one[2])]
    if not views:
        raise InputError(
            name,
            expected="frames that show markers",
            found="none in any frame",
            remedy="check that --dictionary names the printed markers",
        )
    source, time_s, found = zip(*views, strict=True)
    return MarkerSightings(
        tuple(lenses),
        np.array(source),
        np.array(time_s),
        np.repeat(np.arange(len(views)), [len(one) for one in found]),
        np.concatenate([one.ids for one in found]),
        np.concatenate([one.corners_px for one in found]).astype(np.float64),
        name,
    )


def outward(sightings: MarkerSightings) -> Float[np.ndarray, "sightings 4 2"]:
    """Shift of each corner in the image, along the bisector, when each side of the square moves outwards by 1 px."""
    ahead = _unit(np.roll(sightings.corners_px, -1, axis=1) - sightings.corners_px)
    behind = np.roll(-ahead, 1, axis=1)
    # Two sides with an angle a between them give 1 / sin(a / 2). Markers seen too obliquely are not recognised.
    sine = np.maximum(np.linalg.norm(ahead - behind, axis=-1, keepdims=True) / 2, 0.1)
    return -_unit(ahead + behind) / sine


def _unit(vectors: Float[np.ndarray, "*vectors 2"]) -> Float[np.ndarray, "*vectors 2"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def square_poses(sightings: MarkerSightings) -> Float[np.ndarray, "sightings 2 4 4"]:
    """The two poses of a square with sides of 1 that look almost the same, marker to camera, the better one first.

    NaN where there is no pose, or no second one.
    """
    T = np.full((len(sightings.view), 2, 4, 4), np.nan)
    for row, rays in enumerate(sightings.rays):
        poses = solve_pnp(SQUARE, rays, "ippe")
        T[row, : len(poses)] = poses
    return T

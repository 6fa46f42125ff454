"""Evidence of a whole video against markers of a map: which of them are not where the map has them.

In one frame, two markers that disagree say nothing about which of the two is wrong. Over a video, a wrong marker
disagrees with all others, and a right one only with the wrong ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from psotrack.geometry import NEAR_M, Camera, undistort
from psotrack.inside_out.line_time import Detected
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import PoseSettings

#: Root mean square distance in the image of two markers from their common pose above which the two disagree: as a
#: multiple of the median distance, which a rolling shutter enlarges, between two multiples of the stated deviation.
_DISAGREE, _DISAGREE_LEAST, _DISAGREE_MOST = 3.0, 15.0, 60.0
#: Largest number of frames and of pairs in a frame that are looked at: about 0.1 s. In a room of 40 markers each marker
#: has 100 pairs.
_MOST_FRAMES, _MOST_PAIRS = 60, 36
#: A marker is wrong if it disagrees in more than the share `_WRONG_SHARE` of its pairs, of at least `_LEAST_PAIRS`.
_WRONG_SHARE, _LEAST_PAIRS = 0.5, 3
#: Number of right markers that a pose needs where wrong ones are left out.
_ENOUGH = 2


def wrong_markers(
    frames: Sequence[Detected], marker_map: MarkerMap, lens: Camera, settings: PoseSettings
) -> tuple[int, ...]:
    """Ids of the markers that disagree with most of the markers that frames show beside them.

    The marker that disagrees most is left out first, then the others are counted anew. Two markers that only ever
    appear together and disagree are both wrong: nothing says which one is right.

    Args:
        frames: detected markers of the map, frame by frame.
        marker_map: the map.
        lens: intrinsics of the camera.
        settings: settings of pose estimation.
    """
    of_id = {marker: index for index, marker in enumerate(marker_map.ids.tolist())}
    found: list[tuple[int, int, float]] = []
    rng = np.random.default_rng(0)
    for _, _, markers in _spread(frames):
        corners_m = marker_map.corners_of(markers.ids.tolist())
        rays = undistort(lens, np.asarray(markers.corners_px, np.float64))
        chosen = list(combinations(np.flatnonzero(np.isfinite(rays).all(axis=(1, 2))).tolist(), 2))
        if len(chosen) > _MOST_PAIRS:
            chosen = [chosen[index] for index in rng.permutation(len(chosen))[:_MOST_PAIRS]]
        for pair in chosen:
            first, second = (of_id[int(marker)] for marker in markers.ids[list(pair)])
            found.append((first, second, _common_error_px(corners_m[list(pair)], rays[list(pair)], lens)))
    if not found:
        return ()
    typical_px = float(np.median([off_px for _, _, off_px in found]))
    limit_px = np.clip(
        _DISAGREE * typical_px, _DISAGREE_LEAST * settings.noise_px, _DISAGREE_MOST * settings.noise_px
    )
    pairs, apart = np.zeros((len(of_id), len(of_id))), np.zeros((len(of_id), len(of_id)))
    for first, second, off_px in found:
        for one, other in ((first, second), (second, first)):
            pairs[one, other] += 1
            apart[one, other] += off_px > limit_px
    kept = np.ones(len(of_id), bool)
    while True:
        count, wrong = pairs[:, kept].sum(axis=1), apart[:, kept].sum(axis=1)
        share = np.where(kept & (count >= _LEAST_PAIRS), wrong / np.maximum(count, 1), 0.0)
        if share.max(initial=0.0) <= _WRONG_SHARE:
            return tuple(int(marker) for marker in marker_map.ids[~kept])
        kept &= share < share.max() - 1e-9


def are_few(wrong: Sequence[int], frames: Iterable[Detected]) -> bool:
    """Whether most of the markers that are seen are right: else nothing says which ones are, or the lens is wrong."""
    seen = {int(marker) for _, _, markers in frames for marker in markers.ids}
    return 2 * len(wrong) <= len(seen)


def without_markers(
    frames: Iterable[Detected], wrong: Sequence[int], settings: PoseSettings
) -> Iterator[Detected]:
    """The frames without wrong markers; a frame that showed too few markers at first has none."""
    for number, time_s, markers in frames:
        kept = ~np.isin(markers.ids, wrong) & (len(markers) >= settings.min_markers)
        yield number, time_s, markers.select(kept)


def least_markers(settings: PoseSettings) -> int:
    """Smallest number of right markers for a pose, in frames that show enough markers with the wrong ones."""
    return min(settings.min_markers, _ENOUGH)


def _spread(frames: Sequence[Detected]) -> Sequence[Detected]:
    """Frames with at least two markers, evenly spread over the video."""
    several = [frame for frame in frames if len(frame[2]) >= 2]
    chosen = np.unique(np.linspace(0, len(several) - 1, min(_MOST_FRAMES, len(several))).astype(int))
    return [several[index] for index in chosen]


def _common_error_px(
    corners_m: Float[np.ndarray, "two 4 3"], rays: Float[np.ndarray, "two 4 2"], lens: Camera
) -> float:
    """Root mean square distance of corners from their projections by the best common pose; infinite without a pose."""
    world, seen = corners_m.reshape(-1, 3), rays.reshape(-1, 2)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(world, seen, np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP)
    except cv2.error:
        return np.inf
    best = np.inf
    for turn, shift in zip(turns, shifts, strict=True):
        x_cam = world @ np.asarray(cv2.Rodrigues(turn)[0]).T + shift.ravel()
        if not (x_cam[:, 2] > NEAR_M).all():
            continue
        off_px = (x_cam[:, :2] / x_cam[:, 2:] - seen) * np.diag(lens.K)[:2]
        best = min(best, float(np.sqrt((off_px**2).sum(axis=1).mean())))
    return best

"""A map from a table of centres alone: how each marker is turned, and how large it is, from a video.

A map is built from the video, in the world of its most seen marker. The similarity that brings most of its centres to
those of the table gives the turns and the sides. Each marker is then moved to its centre in the table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration import GATE
from psotrack.errors import InputError
from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera
from psotrack.inside_out.mapping.building import build_map, corners_in_own_frame
from psotrack.inside_out.mapping.sightings import MOST_FRAMES, collect_sightings
from psotrack.inside_out.marker_map import MarkerCentres, MarkerMap
from psotrack.support import similarity

#: Smallest number of centres that must agree: three always agree with some similarity.
_LEAST_CENTRES = 4
#: Number of triples of markers that are tried; among them is one of right centres even if half of all are wrong.
_TRIPLES = 200


def complete_map(
    frames: Sequence[DetectedMarkers],
    centres: MarkerCentres,
    lens: Camera,
    *,
    side_m: float | None = None,
    name: str = "video",
) -> MarkerMap:
    """Find the corners of markers whose centres are known, from the frames of a video.

    Args:
        frames: detected markers of each frame.
        centres: centres of the markers.
        lens: intrinsics of the camera.
        side_m: side of all markers, metres; None estimates each marker's side.
        name: name of the video, for messages.

    Returns:
        The markers whose corners were found: not those that are seen in too few frames beside others, or do not fit.

    Raises:
        InputError: too few markers of the table are seen beside one another, or they do not fit.
    """
    known = [one.select(np.isin(one.ids, centres.ids)) for one in frames]
    several = [(0, float(number), one) for number, one in enumerate(known) if len(one) > 1]
    several = several[:: max(1, -(-len(several) // MOST_FRAMES))]
    sightings = collect_sightings(several, [lens], name) if several else None
    ids: list[int] = [] if sightings is None else sightings.ids
    if sightings is not None and len(ids) >= _LEAST_CENTRES:
        first = int(np.bincount(sightings.marker).argmax())
        built = build_map(
            sightings, {first: corners_in_own_frame(side_m or 1.0)}, estimate_sides=side_m is None
        )
        ids, centre_m = built.ids.tolist(), built.marker_map.centres_m
    if len(ids) < _LEAST_CENTRES:
        raise InputError(
            name,
            expected=f"{_LEAST_CENTRES} markers of the table that frames show beside one another",
            found=f"{len(ids)}",
            remedy="a table of corners needs fewer markers in sight",
        )
    to_m = np.array([centres.centres_m[marker] for marker in ids])
    # Few frames state no standard deviation.
    std_m = np.nan_to_num(np.linalg.norm(built.std_m, axis=1))
    fits, scale, R = _fit(centre_m, to_m, std_m, with_scale=side_m is None)
    if fits.sum() < _LEAST_CENTRES:
        raise InputError(
            name,
            expected="markers where the table has their centres",
            found=f"{fits.sum()} of {len(ids)} that fit one another",
            remedy="check --markers",
        )
    corners_m = {
        ids[row]: to_m[row] + scale * (built.marker_map.corners_m[ids[row]] - centre_m[row]) @ R.T
        for row in np.flatnonzero(fits).tolist()
    }
    return MarkerMap(corners_m)


def _fit(
    from_m: Float[np.ndarray, "markers 3"],
    to_m: Float[np.ndarray, "markers 3"],
    std_m: Float[np.ndarray, " markers"],
    *,
    with_scale: bool,
) -> tuple[Bool[np.ndarray, " markers"], float, Float[np.ndarray, "3 3"]]:
    """Which points fit the similarity whose median distance is smallest; its scale and rotation.

    Least median of squares over triples (P. J. Rousseeuw, 1984), then least squares of the points that fit.
    """

    def left_by(rows: np.ndarray) -> tuple[Float[np.ndarray, " markers"], float, Float[np.ndarray, "3 3"]]:
        scale, R, shift_m = similarity(from_m[rows], to_m[rows], with_scale=with_scale)
        return np.linalg.norm(scale * from_m @ R.T + shift_m - to_m, axis=1), scale, R

    rng = np.random.default_rng(0)
    tried = [left_by(rng.choice(len(from_m), 3, replace=False)) for _ in range(_TRIPLES)]
    distance_m, scale, R = min(tried, key=lambda one: float(np.median(one[0])))
    for _ in range(3):
        # The median of the length of a vector with three normal components is 1.54 standard deviations.
        spread_m = float(np.median(distance_m)) / 1.54
        fits = distance_m <= GATE * np.hypot(spread_m, scale * std_m)
        distance_m, scale, R = left_by(np.flatnonzero(fits))
    return fits, scale, R

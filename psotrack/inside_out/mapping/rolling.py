"""Rolling shutters of the cameras of a map: estimated from frames that follow one another, with a first map.

Errors of a first map, made as if all rows were exposed at once, do not change sign with the motion, so that they hardly
bias the line time (`localising.line_time`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psotrack.foreground.markers import DetectedMarkers
from psotrack.inside_out.line_time import Detected, LineTime, estimate_line_time
from psotrack.inside_out.mapping.sightings import MarkerSightings
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import PoseSettings, RollingShutter

#: Standard deviation of a line time, as a share of it, by the errors of the map that was made from the same video: on
#: drawn walks of 3 s, line times were up to 6 % off where the frames alone agreed to 1 %.
_BY_MAP = 0.05
#: Shutters and what the videos show of them, one for each video.
Shutters = tuple[RollingShutter | None, ...]
LineTimes = tuple[LineTime | None, ...]


def line_times(sightings: MarkerSightings, marker_map: MarkerMap) -> LineTimes:
    """The line time that each video shows, with a map of its markers; None where too few frames follow one another.

    The standard deviation includes errors of a map that was made from the same frames.
    """
    found: list[LineTime | None] = []
    for index, lens in enumerate(sightings.lenses):
        frames = sightings.consecutive[index] if sightings.consecutive else ()
        seen = [_of_map(frame, marker_map) for frame in frames or _views(sightings, index)]
        shown = estimate_line_time(seen, marker_map, lens, PoseSettings(min_markers=2))
        if shown is not None:
            shown = replace(shown, std_s=float(np.hypot(shown.std_s, _BY_MAP * shown.line_time_s)))
        found.append(shown)
    return tuple(found)


def rolling_shutters(shown: LineTimes) -> Shutters:
    """The shutters that certainly roll, as the videos show them."""
    return tuple(one.shutter() if one is not None and one.rolls else None for one in shown)


def with_shutters(sightings: MarkerSightings, shutters: Sequence[RollingShutter | None]) -> MarkerSightings:
    """The sightings by cameras with these shutters."""
    return replace(sightings, shutters=tuple(shutters))


def _views(sightings: MarkerSightings, video: int) -> list[Detected]:
    """The views of a video as frames, numbered by their times."""
    views = np.flatnonzero(sightings.lens == video)
    time_s = sightings.time_s[views]
    step_s = np.diff(time_s).min(initial=np.inf)
    if not np.isfinite(step_s) or step_s <= 0:
        return []
    start = np.searchsorted(sightings.view, np.arange(sightings.num_views + 1))
    found: list[Detected] = []
    for view, at_s in zip(views.tolist(), time_s.tolist(), strict=True):
        rows = slice(start[view], start[view + 1])
        ids = sightings.marker[rows]
        markers = DetectedMarkers(ids, sightings.corners_px[rows], np.full(len(ids), np.nan))
        found.append((round(at_s / step_s), at_s, markers))
    return found


def _of_map(frame: Detected, marker_map: MarkerMap) -> Detected:
    """A frame with the markers that are in the map."""
    number, time_s, markers = frame
    return number, time_s, markers.select(np.isin(markers.ids, marker_map.ids))

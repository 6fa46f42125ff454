"""How the errors of one marker's corners are correlated, estimated from the residuals of a whole video.

A corner is the intersection of two edges, and each edge has two corners. An edge that is found too far outside moves
both of its corners alike; an edge that is found turned moves them in opposite directions, and the mean of the marker's
corners stays. Most of a corner's error is of the second kind, because the ends of a fitted line are less accurate than
its middle. The mean of four corners is therefore more accurate than the mean of four independent errors would be. A
lens model that does not fit the camera does the opposite: it moves all corners of a marker alike.

The residuals say which of the two is stronger. A single frame has few markers, so the frames of a video are counted
together: `PoseSettings.centre_scale` is chosen so that the markers' mean residuals are as large as their covariances
let expect (estimation of variance components: W. Förstner, Ein Verfahren zur Schätzung von Varianz- und
Kovarianzkomponenten, Allgemeine Vermessungs-Nachrichten 86, 1979). The scale has a smallest value, because residuals
do not show all errors: a shift of all corners in the image looks like a turn of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from psotrack.geometry import Camera
from psotrack.inside_out.line_time import Detected
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import PoseSettings, RollingShutter, estimate_pose

#: Smallest scale: edges are straight lines through many points with independent errors. With points over the share 0.7
#: of an edge, an edge's end varies 6.1 times as much by the line's turn as by its shift. Of the eight unit vectors of
#: four corners, two are the shift of the marker and two its sizes, with twice the variance of an edge's shift, and four
#: are turns of edges, with twice 6.1 times this variance: the ratio is sqrt(2 / ((2 x 2 + 4 x 12.2) / 6)).
LEAST_SCALE = 0.48
#: Largest scale: above it, a lens or a map is wrong rather than inaccurate.
MOST_SCALE = 4.0
#: Largest number of frames that are looked at, and number of estimates, each with the covariances by the one before.
_MOST_FRAMES, _TURNS = 60, 4
#: Smallest number of markers whose mean residuals say anything: three give no more equations than unknowns.
_FEWEST_MARKERS = 4
#: Weight of independent errors, as a number of mean residuals.
_PRIOR_RESIDUALS = 10.0


def estimate_centre_scale(
    detected: Sequence[Detected],
    marker_map: MarkerMap,
    lens: Camera,
    settings: PoseSettings,
    shutter: RollingShutter | None = None,
) -> float:
    """Estimate `PoseSettings.centre_scale` from the frames of a video; 1 where they show too few markers.

    Args:
        detected: number and time of each frame, and its markers.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings of pose estimation; their `centre_scale` is not used.
        shutter: the rolling shutter; None is a global shutter.
    """
    usable = [markers for _, _, markers in detected if len(markers) >= _FEWEST_MARKERS]
    chosen = np.unique(np.linspace(0, len(usable) - 1, min(_MOST_FRAMES, len(usable))).astype(int))
    frames = [usable[index] for index in chosen]
    variance = 1.0
    for _ in range(_TURNS):
        observed = expected = 0.0
        for markers in frames:
            pose = estimate_pose(
                markers.corners_px,
                marker_map.corners_of(markers.ids.tolist()),
                lens,
                replace(settings, centre_scale=float(np.sqrt(variance))),
                None,
                shutter,
            )
            if pose is not None and pose.centres is not None:
                observed += pose.centres.observed
                expected += pose.centres.expected
        if not expected:
            return 1.0
        ratio = (_PRIOR_RESIDUALS + observed) / (_PRIOR_RESIDUALS * variance + expected)
        variance = float(np.clip(variance * ratio, LEAST_SCALE**2, MOST_SCALE**2))
    return float(np.sqrt(variance))

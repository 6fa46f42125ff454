"""How large the errors of corners are and how those of one marker are correlated, from the residuals of a whole video.

A corner is the intersection of two edges, and each edge has two corners. An edge that is found too far outside moves
both of its corners alike; an edge that is found turned moves them in opposite directions, and the mean of the marker's
corners stays. Most of a corner's error is of the second kind, because the ends of a fitted line are less accurate than
its middle. The mean of four corners is therefore more accurate than the mean of four independent errors would be. A
lens model that does not fit the camera does the opposite: it moves all corners of a marker alike.

The residuals say which of the two is stronger, and how large the errors are. A single frame has few markers, so the
frames of a video are counted together. Their noise takes the place of the stated one (`PoseSettings.usual_px`), and
each frame's own residuals correct it. `PoseSettings.centre_scale` is chosen so that the markers' mean residuals are as
large as their covariances let expect (estimation of variance components: W. Förstner, Ein Verfahren zur Schätzung von
Varianz- und Kovarianzkomponenten, Allgemeine Vermessungs-Nachrichten 86, 1979). The scale has a smallest value, by how
edges are measured. Where the mean residuals are smaller still, the stated errors of the markers' places
(`PoseSettings.place_m`) are too large, and `PoseSettings.usual_place_m` takes their place. Residuals do not show all
errors: a shift of all corners in the image looks like a turn of the camera, and is stated (`PoseSettings.shift_px`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import Camera
from psotrack.inside_out.line_time import Detected
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import CornerResiduals, PoseSettings, RollingShutter, estimate_pose

#: Smallest scale: edges are straight lines through many points with independent errors. With points over the share 0.7
#: of an edge, an edge's end varies 6.1 times as much by the line's turn as by its shift. Of the eight unit vectors of
#: four corners, two are the shift of the marker and two its sizes, with twice the variance of an edge's shift, and four
#: are turns of edges, with twice 6.1 times this variance: the ratio is sqrt(2 / ((2 x 2 + 4 x 12.2) / 6)).
LEAST_SCALE = 0.48
#: Largest scale: above it, a lens or a map is wrong rather than inaccurate.
MOST_SCALE = 4.0
#: Largest number of frames that are looked at, and number of markers that suffice: the standard error of a deviation
#: from 2 x 600 residuals is 2 %. And number of estimates, each with the covariances by the one before.
_MOST_FRAMES, _ENOUGH_MARKERS, _TURNS = 60, 600, 6
#: Step between the frames of the first estimates.
_FIRST_STEP = 3
#: Smallest deviation of a marker's place, as a share of the stated one.
_LEAST_PLACE = 1 / 3
#: Change of a deviation, as a share, below which it is not estimated once more.
_SAME = 0.02
#: Smallest number of markers whose mean residuals say anything: three give no more equations than unknowns.
_FEWEST_MARKERS = 4
#: Weight of independent errors, as a number of mean residuals.
_PRIOR_RESIDUALS = 10.0


@dataclass(frozen=True)
class CornerNoise:
    """Errors of the corners in a recording.

    Attributes:
        usual_px: standard deviation of a corner's own error along x and along y, pixels.
        centre_scale: deviation of the mean error of a marker's corners, as a multiple of the deviation that it would
            have if the errors of the corners were independent.
        usual_place_m: standard deviation of the error that all corners of a marker share in one frame, along each
            axis, metres.
    """

    usual_px: float
    centre_scale: float
    usual_place_m: float

    def replacing(self, given: PoseSettings) -> PoseSettings:
        """Settings with these errors instead of others."""
        return replace(
            given,
            usual_px=self.usual_px,
            centre_scale=self.centre_scale,
            usual_place_m=self.usual_place_m,
        )

    def settings(self, given: PoseSettings) -> PoseSettings:
        """Settings with these errors, where none are given."""
        return replace(
            given,
            usual_px=given.usual_px or self.usual_px,
            centre_scale=given.centre_scale or self.centre_scale,
            usual_place_m=given.usual_place_m or self.usual_place_m,
        )


def estimate_corner_noise(
    detected: Sequence[Detected],
    marker_map: MarkerMap,
    lens: Camera,
    settings: PoseSettings,
    shutter: RollingShutter | None = None,
) -> CornerNoise:
    """Estimate the errors of corners from the frames of a video; as stated where they show too few markers.

    Args:
        detected: number and time of each frame, and its markers.
        marker_map: map of the room.
        lens: intrinsics of the camera.
        settings: settings of pose estimation; what is estimated here is not used.
        shutter: the rolling shutter; None is a global shutter.
    """
    usable = [markers for _, _, markers in detected if len(markers) >= _FEWEST_MARKERS]
    in_each = np.mean([len(markers) for markers in usable]) if usable else 1.0
    count = min(_MOST_FRAMES, len(usable), int(np.ceil(_ENOUGH_MARKERS / in_each)))
    chosen = np.unique(np.linspace(0, len(usable) - 1, count).astype(int))
    frames = [usable[index] for index in chosen]
    noise = CornerNoise(settings.noise_px, 1.0, settings.place_m)
    # A third of the frames shows nearly the same as all, in less time. The last estimate is by all frames.
    for some, turns in ((frames[::_FIRST_STEP], _TURNS), (frames, 1)):
        for _ in range(turns):
            residuals = _residuals(some, marker_map, lens, noise.replacing(settings), shutter)
            if not residuals:
                break
            before, noise = noise, _improved(noise, residuals, settings)
            changes = [getattr(noise, name) / getattr(before, name) for name in vars(noise)]
            if np.abs(np.log(changes)).max() < _SAME:
                break
    return noise


def _residuals(
    frames: Sequence[DetectedMarkers],
    marker_map: MarkerMap,
    lens: Camera,
    settings: PoseSettings,
    shutter: RollingShutter | None,
) -> list[CornerResiduals]:
    """Residuals of the frames that have a pose."""
    poses = [
        estimate_pose(
            markers.corners_px, marker_map.corners_of(markers.ids.tolist()), lens, settings, None, shutter
        )
        for markers in frames
    ]
    return [pose.residuals for pose in poses if pose is not None and pose.residuals is not None]


def _improved(
    before: CornerNoise, residuals: Sequence[CornerResiduals], settings: PoseSettings
) -> CornerNoise:
    """The errors by residuals that were computed with the estimate before."""
    own = _PRIOR_RESIDUALS * settings.noise_px**2 + sum(one.squares_px2 for one in residuals)
    observed, expected = sum(one.observed for one in residuals), sum(one.expected for one in residuals)
    ratio = (_PRIOR_RESIDUALS + observed) / (_PRIOR_RESIDUALS * before.centre_scale**2 + expected)
    by_places = float(np.mean([one.by_places for one in residuals]))
    return CornerNoise(
        float(np.sqrt(own / (_PRIOR_RESIDUALS + sum(one.freedom for one in residuals)))),
        *_shared_errors(before, ratio, by_places, settings.place_m),
    )


def _shared_errors(
    before: CornerNoise, ratio: float, by_places: float, stated_m: float
) -> tuple[float, float]:
    """The scale, and the deviation of places in metres, by which mean residuals have the variance that is observed.

    The places have their stated deviation as long as the scale alone can explain the residuals.

    Args:
        before: errors with which the residuals were computed.
        ratio: ratio of the observed variance of the means to the variance that these errors let expect.
        by_places: share of the places' errors in the latter variance.
        stated_m: stated deviation of a place, metres.
    """
    if before.usual_place_m < stated_m or (before.centre_scale <= LEAST_SCALE and ratio < 1):
        # Only the part of the places changes.
        factor = max(1 + (ratio - 1) / max(by_places, _LEAST_PLACE**2), _LEAST_PLACE**2)
        place_m = before.usual_place_m * np.sqrt(factor)
        return before.centre_scale, float(np.clip(place_m, _LEAST_PLACE * stated_m, stated_m))
    scale = before.centre_scale * np.sqrt(ratio)
    return float(np.clip(scale, LEAST_SCALE, MOST_SCALE)), before.usual_place_m

"""A check of a map against a video of its room: which markers are wrong, by how much, and what to do.

Cameras are located by the markers that agree with one another. Markers that most frames show elsewhere are then placed
again, and the difference is put into words. The check fails where fewer than half of the markers agree.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.calibration import spread_px
from psotrack.errors import InputError
from psotrack.inside_out.mapping.bundle import adjust, improved
from psotrack.inside_out.mapping.findings import CheckedMarker, MapFinding, find_faults
from psotrack.inside_out.mapping.initial_map import (
    SIDE_FACTORS,
    MarkerPlacer,
    PlacedMarker,
    make_scene,
    placed_markers,
)
from psotrack.inside_out.mapping.rolling import (
    LineTimes,
    Shutters,
    line_times,
    rolling_shutters,
    with_shutters,
)
from psotrack.inside_out.mapping.scene import MappedScene, residuals_px
from psotrack.inside_out.mapping.sightings import MarkerSightings
from psotrack.inside_out.mapping.square_fitting import fit_square
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.inside_out.pose import RollingShutter

#: Median residual of a suspect marker, as a multiple of the usual median residual.
_SUSPECT = 4.0
#: Smallest number of frames from which a suspect marker is placed.
_LEAST_FRAMES = 3
#: Standard deviations of a corner in successive adjustments, from a rough start to the end, pixels.
_NOISES_PX = (8.0, 2.0, 0.5)


@dataclass(frozen=True)
class MapCheck:
    """Result of a check of a map.

    Attributes:
        findings: faults of the map; empty where nothing is wrong.
        markers: measurements by marker id.
        noise_px: standard deviation of a corner along x and along y, pixels.
        num_views: number of frames that show at least two markers of the map.
        not_in_map: ids that are seen but not in the map.
        shutters: (videos,), rolling shutters with which the cameras were located; None is a global shutter.
        line_times: (videos,), what the videos show of their shutters; None where too few frames follow one another.
    """

    findings: tuple[MapFinding, ...]
    markers: Mapping[int, CheckedMarker]
    noise_px: float
    num_views: int
    not_in_map: tuple[int, ...]
    shutters: Shutters
    line_times: LineTimes


def check_map(
    sightings: MarkerSightings, marker_map: MarkerMap, shutter: RollingShutter | None = None
) -> MapCheck:
    """Check a map against sightings.

    Args:
        sightings: markers in the videos.
        marker_map: the map.
        shutter: rolling shutter of all cameras; None is estimated for each video, with the map as it is.

    Raises:
        InputError: no frame shows two markers of the map.
    """
    given = {
        int(marker): PlacedMarker(*fit_square(corners)) for marker, corners in marker_map.corners_m.items()
    }
    not_in_map = tuple(marker for marker in sightings.ids if marker not in given)
    kept = np.isin(sightings.marker, list(given))
    counts = np.bincount(sightings.view[kept], minlength=sightings.num_views)
    kept &= counts[sightings.view] >= 2
    if not kept.any():
        raise InputError(
            sightings.name,
            expected="frames that show two markers of the map",
            found="none",
            remedy="check that the map and the video are of the same room",
        )
    sightings = sightings.select(kept)
    shown = line_times(sightings, marker_map)
    shutters = rolling_shutters(shown) if shutter is None else (shutter,) * len(sightings.lenses)
    sightings = with_shutters(sightings, shutters)
    about = (sightings.num_views, not_in_map, shutters, shown)
    side_m = float(np.median(marker_map.sides_m))
    located = _locate_by_map(sightings, given, side_m)
    residual_px = _by_marker(sightings, residuals_px(sightings, located))
    noise_px = spread_px(np.concatenate([residual_px[marker].ravel() for marker in residual_px]), 0)
    typical = {marker: float(np.median(values)) for marker, values in residual_px.items()}
    # The median of a Rayleigh distribution is 1.18 standard deviations.
    limit_px = _SUSPECT * 1.18 * noise_px
    sound = {marker: given[marker] for marker, value in typical.items() if value <= limit_px}
    checked = {marker: _agreeing_marker(residual_px.get(marker)) for marker in given}
    if 2 * len(sound) <= len(typical) or noise_px > _NOISES_PX[0]:
        finding = MapFinding(
            "map",
            (),
            f"the map as a whole does not fit the video: {len(sound)} of {len(typical)} markers agree with one another",
            "check that lens, dictionary and map are those of this room, and that no axis is mirrored",
        )
        return MapCheck((finding,), checked, noise_px, *about)
    suspects = [marker for marker in typical if marker not in sound]
    if not suspects:
        return MapCheck((), checked, noise_px, *about)
    measured, noise_px = _measure_suspects(sightings, sound, suspects, located, side_m)
    checked |= {
        marker: _compare_marker(given[marker], *one, residual_px[marker]) for marker, one in measured.items()
    }
    findings = find_faults(
        given, {marker: found for marker, (found, _) in measured.items()}, checked, suspects
    )
    return MapCheck(tuple(findings), checked, noise_px, *about)


def _locate_by_map(
    sightings: MarkerSightings, given: Mapping[int, PlacedMarker], side_m: float
) -> MappedScene:
    """The scene in which views agree with the largest number of markers, with all markers at their map positions."""
    placer = MarkerPlacer(sightings, side_m)
    scene = make_scene(
        {marker: given[marker] for marker in sightings.ids},
        placer.locate_views(given),
        np.zeros(len(sightings.lenses)),
    )
    for noise_px in _NOISES_PX:
        scene = improved(sightings, scene, sightings.ids, noise_px=noise_px)
        # With the inset known, a view in a wrong pose may find a better one.
        scene = make_scene(placed_markers(scene), placer.locate_views(given, scene), scene.inset_px)
    return improved(sightings, scene, sightings.ids, noise_px=_NOISES_PX[-1])


def _by_marker(
    sightings: MarkerSightings, residual_px: Float[np.ndarray, "sightings 4"]
) -> dict[int, Float[np.ndarray, " corners"]]:
    return {marker: residual_px[sightings.marker == marker].ravel() for marker in sightings.ids}


def _measure_suspects(
    sightings: MarkerSightings,
    sound: Mapping[int, PlacedMarker],
    suspects: list[int],
    located: MappedScene,
    side_m: float,
) -> tuple[dict[int, tuple[PlacedMarker, Float[np.ndarray, "7 7"]]], float]:
    """Suspect markers as in the video, with covariances, by id; and the standard deviation of a corner, pixels.

    Sound markers stay where the map has them. Suspects that no frame shows beside two sound markers are left out.
    """
    of_sound = np.bincount(
        sightings.view[np.isin(sightings.marker, list(sound))], minlength=sightings.num_views
    )
    kept = of_sound[sightings.view] >= 2
    connected, rows = sightings.select(kept), np.unique(sightings.view[kept])
    placer = MarkerPlacer(connected, side_m)
    before = replace(
        located,
        R_cam_world=located.R_cam_world[rows],
        t_m=located.t_m[rows],
        motion=None if located.motion is None else located.motion[rows],
    )
    views = placer.locate_views(sound, before)
    placed = dict(sound)
    for marker in suspects:
        found = placer.place(marker, views, SIDE_FACTORS)
        if found is not None and (connected.marker == marker).sum() >= _LEAST_FRAMES:
            placed[marker] = found[0]
    connected = connected.select(np.isin(connected.marker, list(placed)))
    start = make_scene({marker: placed[marker] for marker in connected.ids}, views, located.inset_px)
    fixed = [marker for marker in connected.ids if marker in sound]
    adjusted = adjust(connected, start, fixed, noise_px=_NOISES_PX[-1], estimate_sides=True)
    now = placed_markers(adjusted.scene)
    return {
        marker: (now[marker], adjusted.covariance[row])
        for row, marker in enumerate(adjusted.scene.ids.tolist())
        if marker not in sound
    }, adjusted.noise_px


def _agreeing_marker(residual_px: Float[np.ndarray, " corners"] | None) -> CheckedMarker:
    unknown = np.full(3, np.nan)
    count, typical = (
        (0, np.nan) if residual_px is None else (len(residual_px) // 4, float(np.median(residual_px)))
    )
    return CheckedMarker(count, typical, unknown, unknown, np.nan, np.nan, np.nan)


def _compare_marker(
    given: PlacedMarker,
    found: PlacedMarker,
    covariance: Float[np.ndarray, "7 7"],
    residual_px: Float[np.ndarray, " corners"],
) -> CheckedMarker:
    turn = Rotation.from_matrix(found.R_world_marker @ given.R_world_marker.T).as_rotvec()
    std = np.sqrt(np.diag(covariance))
    return CheckedMarker(
        len(residual_px) // 4,
        float(np.median(residual_px)),
        found.centre_m - given.centre_m,
        std[:3],
        float(np.rad2deg(np.linalg.norm(turn))),
        float(np.rad2deg(np.linalg.norm(std[3:6]))),
        found.side_m / given.side_m,
    )

"""Which markers of a map are wrong, by how much, and what to do: the map against a video of its room.

Cameras are located by the markers that agree with one another; what most frames then see somewhere else is placed anew
from them, and its new place is put into words. Nothing is found where fewer than half of the markers agree.
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
from psotrack.inside_out.mapping.findings import CheckedMarker, MapFinding, findings_of
from psotrack.inside_out.mapping.scene import MappedScene, residuals_px
from psotrack.inside_out.mapping.sightings import MarkerSightings
from psotrack.inside_out.mapping.squares import best_square
from psotrack.inside_out.mapping.start import GROWTHS, Beginning, Placed, placed_of, scene_of
from psotrack.inside_out.marker_map import MarkerMap

#: Times the usual residual that half of a marker's corners are off by, where it is not where the map has it.
_SUSPECT = 4.0
#: Frames that tell where a marker is.
_FRAMES = 3
#: Standard deviations of a corner, from a rough start to a good end.
_NOISES_PX = (8.0, 2.0, 0.5)


@dataclass(frozen=True)
class Checkup:
    """A map against a video.

    Attributes:
        findings: none where nothing is wrong.
        markers: what was measured, by id.
        noise_px: standard deviation of a corner along x and along y.
        num_views: frames that show two markers of the map at least.
        strangers: ids that are seen and not in the map.
    """

    findings: tuple[MapFinding, ...]
    markers: Mapping[int, CheckedMarker]
    noise_px: float
    num_views: int
    strangers: tuple[int, ...]


def check_map(sightings: MarkerSightings, marker_map: MarkerMap) -> Checkup:
    """What is wrong with a map.

    Raises:
        InputError: no frame shows two markers of the map.
    """
    given = {int(marker): Placed(*best_square(corners)) for marker, corners in marker_map.corners_m.items()}
    strangers = tuple(marker for marker in sightings.ids if marker not in given)
    kept = np.isin(sightings.marker, list(given))
    counts = np.bincount(sightings.view[kept], minlength=sightings.num_views)
    kept &= counts[sightings.view] >= 2
    if not kept.any():
        raise InputError(
            sightings.name,
            expected="frames that show two markers of the map",
            found="none",
            remedy="is it this room?",
        )
    sightings = sightings.select(kept)
    side_m = float(np.median(marker_map.sides_m))
    located = _located(sightings, given, side_m)
    residual_px = _by_marker(sightings, residuals_px(sightings, located))
    usual_px = spread_px(np.concatenate([residual_px[marker].ravel() for marker in residual_px]), 0)
    typical = {marker: float(np.median(values)) for marker, values in residual_px.items()}
    # The median of a Rayleigh distribution is 1.18 standard deviations.
    limit_px = _SUSPECT * 1.18 * usual_px
    sound = {marker: given[marker] for marker, value in typical.items() if value <= limit_px}
    checked = {marker: _unmoved(residual_px.get(marker)) for marker in given}
    if 2 * len(sound) <= len(typical) or usual_px > _NOISES_PX[0]:
        finding = MapFinding(
            "map",
            (),
            f"the map as a whole does not fit the video: {len(sound)} of {len(typical)} markers agree with one another",
            "check that lens, dictionary and map are those of this room, and that no axis is mirrored",
        )
        return Checkup((finding,), checked, usual_px, sightings.num_views, strangers)
    suspects = [marker for marker in typical if marker not in sound]
    if not suspects:
        return Checkup((), checked, usual_px, sightings.num_views, strangers)
    measured, noise_px = _measured(sightings, sound, suspects, located, side_m)
    checked |= {
        marker: _compared(given[marker], *one, residual_px[marker]) for marker, one in measured.items()
    }
    findings = findings_of(
        given, {marker: found for marker, (found, _) in measured.items()}, checked, suspects
    )
    return Checkup(tuple(findings), checked, noise_px, sightings.num_views, strangers)


def _located(sightings: MarkerSightings, given: Mapping[int, Placed], side_m: float) -> MappedScene:
    """Views that agree with as many markers as can be, all markers being where the map has them."""
    beginning = Beginning(sightings, side_m)
    scene = scene_of(
        {marker: given[marker] for marker in sightings.ids},
        beginning.located(given),
        np.zeros(len(sightings.lenses)),
    )
    for noise_px in _NOISES_PX:
        scene = improved(sightings, scene, sightings.ids, noise_px=noise_px)
        # A view that fell into a wrong pose may find a better one now that the inset is known.
        scene = scene_of(placed_of(scene), beginning.located(given, scene), scene.inset_px)
    return improved(sightings, scene, sightings.ids, noise_px=_NOISES_PX[-1])


def _by_marker(
    sightings: MarkerSightings, residual_px: Float[np.ndarray, "sightings 4"]
) -> dict[int, Float[np.ndarray, " corners"]]:
    return {marker: residual_px[sightings.marker == marker].ravel() for marker in sightings.ids}


def _measured(
    sightings: MarkerSightings,
    sound: Mapping[int, Placed],
    suspects: list[int],
    located: MappedScene,
    side_m: float,
) -> tuple[dict[int, tuple[Placed, Float[np.ndarray, "7 7"]]], float]:
    """Where suspects are in the video, with covariances, the sound markers being where the map has them; and the noise.

    Those are absent that are never seen beside two sound ones.
    """
    of_sound = np.bincount(
        sightings.view[np.isin(sightings.marker, list(sound))], minlength=sightings.num_views
    )
    kept = of_sound[sightings.view] >= 2
    tied, rows = sightings.select(kept), np.unique(sightings.view[kept])
    beginning = Beginning(tied, side_m)
    before = replace(located, R_cam_world=located.R_cam_world[rows], t_m=located.t_m[rows])
    views = beginning.located(sound, before)
    placed = dict(sound)
    for marker in suspects:
        found = beginning.place(marker, views, GROWTHS)
        if found is not None and (tied.marker == marker).sum() >= _FRAMES:
            placed[marker] = found[0]
    tied = tied.select(np.isin(tied.marker, list(placed)))
    start = scene_of({marker: placed[marker] for marker in tied.ids}, views, located.inset_px)
    fixed = [marker for marker in tied.ids if marker in sound]
    adjusted = adjust(tied, start, fixed, noise_px=_NOISES_PX[-1], estimate_sides=True)
    now = placed_of(adjusted.scene)
    return {
        marker: (now[marker], adjusted.covariance[row])
        for row, marker in enumerate(adjusted.scene.ids.tolist())
        if marker not in sound
    }, adjusted.noise_px


def _unmoved(residual_px: Float[np.ndarray, " corners"] | None) -> CheckedMarker:
    unknown = np.full(3, np.nan)
    count, typical = (
        (0, np.nan) if residual_px is None else (len(residual_px) // 4, float(np.median(residual_px)))
    )
    return CheckedMarker(count, typical, unknown, unknown, np.nan, np.nan, np.nan)


def _compared(
    given: Placed,
    found: Placed,
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

"""What a user should know of a run: tracks that bounds or speed limit cut off, and detections that never meet."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, viewpoints
from psotrack.support import evenly_spread
from psotrack.tracking.births.moving_volume import FlightVolume
from psotrack.tracking.matching import Sightings, from_silhouettes, match, wide_bounds
from psotrack.trajectories import Status, Tracks

#: A drone was lost at a bound if it flew towards it this fast, m/s, and would have passed it within this time, seconds.
LEAST_SPEED_M_S, SOON_S = 0.3, 0.2
#: A drone flies at the speed limit if its speed is above this share of it for this time, seconds.
AT_LIMIT, AT_LIMIT_S = 0.99, 0.12
_AXES = "xyz"


def find_cut_off(tracks: Tracks, volume: FlightVolume, fps: float) -> str | None:
    """One line about the first track that the bounds or the speed limit cut off; None if there is none.

    Args:
        tracks: tracks of all frames.
        volume: the bounds and the speed limit that were used.
        fps: frames per second.
    """
    found = np.asarray(tracks.status == Status.TRACKED)
    position_m, velocity_m_s = tracks.position_m, tracks.velocity_m_s
    # (frames, drones, sides, axes): whether a drone that is lost in the next frame flies through the bound.
    sign = np.array([[-1.0], [1.0]])
    outward_m_s, ahead_m = velocity_m_s[:, :, None], (position_m + SOON_S * velocity_m_s)[:, :, None]
    is_fast, is_beyond = sign * outward_m_s > LEAST_SPEED_M_S, sign * (ahead_m - volume.bounds_m) > 0
    is_lost = (found[:-1] & ~found[1:])[..., None, None]
    leaves = np.asarray((is_fast & is_beyond)[:-1] & is_lost)
    speed = np.linalg.norm(np.where(found[..., None], velocity_m_s, 0.0), axis=-1)
    count = min(max(2, round(AT_LIMIT_S * fps)), len(speed))
    is_fastest = sliding_window_view(speed >= AT_LIMIT * volume.max_speed_m_s, count, axis=0)
    at_limit = np.asarray(is_fastest.all(axis=-1))
    cases = []
    for drone in range(tracks.num_drones):
        for frame, side, axis in np.argwhere(leaves[:, drone])[:1].tolist():
            bound = f"{_AXES[axis]} = {volume.bounds_m[side, axis]:.1f} m"
            cases.append(
                (frame, drone, f"was lost at the bound {bound}; if it flies on, pass wider --bounds")
            )
        for (frame,) in np.argwhere(at_limit[:, drone])[:1].tolist():
            times = f"in {at_limit[:, drone].sum()} frames"
            limit = f"{volume.max_speed_m_s:g} m/s {times}; if it is faster, pass a higher --max-speed"
            cases.append((frame, drone, f"flies at the speed limit of {limit}"))
    if not cases:
        return None
    more = f" ({len(cases) - 1} more such cases)" if len(cases) > 1 else ""
    frame, drone, text = min(cases)
    return f"frame {frame}: drone {drone} {text}{more}"


def find_outside(volume: FlightVolume) -> str | None:
    """One line about what moves outside of given bounds or faster than a given speed limit; None if nothing does."""
    if volume.bounds_from == "given" and volume.share_outside > 0:
        share = f"{volume.share_outside:.0%}"
        return f"{share} of what moves is outside of the given bounds; pass wider --bounds to track it"
    if volume.speed_from == "given" and volume.seen_speed_m_s > volume.max_speed_m_s:
        return (
            f"something flies at {volume.seen_speed_m_s:.0f} m/s, faster than the given limit of "
            f"{volume.max_speed_m_s:g} m/s; pass a higher --max-speed to track it"
        )
    return None


#: Largest number of frames that are looked at, and of detections per image: the largest ones count.
_FRAMES, _MOST_SIGHTINGS = 60, 12


def count_common(rig: Rig, found: Sightings | Silhouettes) -> tuple[int, int]:
    """Count the frames in which two viewpoints have detections, and those in which enough viewpoints' detections meet.

    Three are enough where three have the place in view, else two. At most 60 frames are looked at.

    Args:
        rig: the cameras.
        found: detections, or silhouettes whose blobs are the detections.
    """
    viewpoint, wide_m = viewpoints(rig.cameras), wide_bounds(rig)
    seen = met = 0
    frames = evenly_spread(found.num_frames, _FRAMES)
    sightings = found[frames] if isinstance(found, Sightings) else from_silhouettes(found, frames=frames)
    for number in range(len(frames)):
        view = sightings[number].largest(_MOST_SIGHTINGS)
        if len(np.unique(viewpoint[np.isfinite(view.noise_px).any(axis=-1)])) < 2:
            continue
        seen += 1
        met += bool(len(match(rig.cameras, view.centre_px, view.noise_px, bounds_m=wide_m).position_m))
    return seen, met

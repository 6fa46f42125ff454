"""What a user should know of a run: tracks that bounds or speed limit cut off, and detections that never meet."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, viewpoints
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
    lines = []
    for drone in range(tracks.num_drones):
        found = np.asarray(tracks.status[:, drone] == Status.TRACKED)
        state = tracks.position_m[:, drone], tracks.velocity_m_s[:, drone]
        for line in (
            _lost_at_bound(*state, found, volume.bounds_m),
            _at_speed_limit(state[1], found, volume.max_speed_m_s, fps),
        ):
            if line is not None:
                frame, text = line
                lines.append((frame, f"frame {frame}: drone {drone} {text}"))
    if not lines:
        return None
    more = f" ({len(lines) - 1} more such cases)" if len(lines) > 1 else ""
    return min(lines)[1] + more


def _lost_at_bound(
    position_m: Float[np.ndarray, "frames 3"],
    velocity_m_s: Float[np.ndarray, "frames 3"],
    found: Bool[np.ndarray, "frames"],
    bounds_m: Float[np.ndarray, "2 3"],
) -> tuple[int, str] | None:
    """The first frame in which a drone was found last before it was lost on its way through a bound."""
    for frame in np.flatnonzero(found[:-1] & ~found[1:]).tolist():
        after_m = position_m[frame] + SOON_S * velocity_m_s[frame]
        for side, sign in ((0, -1.0), (1, 1.0)):
            leaves = (sign * velocity_m_s[frame] > LEAST_SPEED_M_S) & (sign * (after_m - bounds_m[side]) > 0)
            if leaves.any():
                axis = int(leaves.argmax())
                bound = f"{_AXES[axis]} = {bounds_m[side, axis]:.1f} m"
                return frame, f"was lost at the bound {bound}; if it flies on, pass wider --bounds"
    return None


def _at_speed_limit(
    velocity_m_s: Float[np.ndarray, "frames 3"],
    found: Bool[np.ndarray, "frames"],
    max_speed_m_s: float,
    fps: float,
) -> tuple[int, str] | None:
    """The first frame from which a drone flies as fast as the limit allows."""
    speed = np.linalg.norm(np.where(found[:, None], velocity_m_s, 0.0), axis=-1)
    count = max(2, round(AT_LIMIT_S * fps))
    at_limit = np.convolve(speed >= AT_LIMIT * max_speed_m_s, np.ones(count), mode="valid") >= count
    if len(speed) < count or not at_limit.any():
        return None
    text = f"flies at the speed limit of {max_speed_m_s:g} m/s; if it is faster, pass a higher --max-speed"
    return int(at_limit.argmax()), text


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
    spread = np.linspace(0, found.num_frames - 1, min(found.num_frames, _FRAMES))
    for frame in np.unique(spread.round().astype(int)).tolist():
        if isinstance(found, Sightings):
            sightings = found[frame]
        else:
            sightings = from_silhouettes(found, first=frame, stop=frame + 1)[0]
        view = sightings.largest(_MOST_SIGHTINGS)
        if len(np.unique(viewpoint[np.isfinite(view.noise_px).any(axis=-1)])) < 2:
            continue
        seen += 1
        met += bool(len(match(rig.cameras, view.centre_px, view.noise_px, bounds_m=wide_m).position_m))
    return seen, met

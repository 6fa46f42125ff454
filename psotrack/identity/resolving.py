"""All frames, one after the other, as far as drones meet in them."""

from __future__ import annotations

from itertools import combinations

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.identity.groups import Group, advanced, grouped
from psotrack.identity.records import Identities, IdentityParams
from psotrack.identity.settling import is_settled, settled
from psotrack.identity.tracks import tracks_of
from psotrack.motion import MotionParams, check_measurements


def resolve(
    time_s: Float[np.ndarray, "frames"],
    measured_m: Float[np.ndarray, "frames drones 3"],
    measured_covariance_m2: Float[np.ndarray, "frames drones 3 3"],
    was_measured: Bool[np.ndarray, "frames drones"],
    motion: MotionParams,
    params: IdentityParams = IdentityParams(),  # noqa: B008  frozen
    size_m: Float[np.ndarray, "frames drones 3"] | None = None,
) -> Identities:
    """Find out which track each drone is. In the first frame, and until they meet, labels are taken to be right.

    What is measured must be what a frame says by itself (see `smoothing.smooth`).

    Args:
        time_s: (frames,), increasing.
        measured_m: (frames, drones, 3), world, by tracks; any value, NaN too, where not measured.
        measured_covariance_m2: (frames, drones, 3, 3), symmetric and positive definite where measured.
        was_measured: (frames, drones).
        motion: of the drones, by label.
        params: when labels are in doubt.
        size_m: (frames, drones, 3), apparent sizes; NaN where not known. Whether and how well they tell drones apart
            is learned from the frames before an encounter in which no other drone is near.

    Raises:
        InputError: times do not increase, or a measurement is no number or has no positive definite covariance.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    num_frames, num_drones = was_measured.shape
    tracks = tracks_of(time_s, measured_m, measured_covariance_m2, was_measured, size_m, params.encounter_m)
    pairs = np.array(list(combinations(range(num_drones), 2)), np.int64).reshape(-1, 2)
    order = np.tile(np.arange(num_drones), (num_frames, 1))
    found = Identities(order, pairs, np.zeros((num_frames, len(pairs))), ())
    meetings = np.flatnonzero((tracks.distance_m < params.encounter_m).any(axis=(1, 2)))
    groups: list[Group] = []
    frame = -1
    with jax.enable_x64(True):
        while True:
            frame = frame + 1 if groups else _next(meetings, frame)
            if frame >= num_frames:
                break
            groups = grouped(groups, frame, found.order, tracks, motion, params)
            groups = [advanced(group, frame, tracks, motion, params) for group in groups]
            for group in groups:
                if is_settled(group, time_s[frame], params):
                    found = settled(group, found, tracks, params)
            groups = [group for group in groups if not is_settled(group, time_s[frame], params)]
    for group in groups:
        found = settled(group, found, tracks, params, still_open=True)
    return found


def _next(meetings: Int[np.ndarray, "meetings"], frame: int) -> int:
    """The first frame after this one in which drones are near, or beyond all frames."""
    later = meetings[np.searchsorted(meetings, frame, side="right") :]
    return int(later[0]) if len(later) else np.iinfo(np.int64).max

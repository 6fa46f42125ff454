"""Resolve identity swaps in all frames of a recording, one frame after the other."""

from __future__ import annotations

from itertools import combinations

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.identity.groups import Group, update_group, update_groups
from psotrack.identity.records import Identities, IdentityParams
from psotrack.identity.settling import is_settled, settle
from psotrack.identity.tracks import prepare_tracks
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
    """Find the track of each drone in every frame. Labels are correct until drones meet for the first time.

    Measurements must use only their own frame (see `smoothing.smooth`).

    Args:
        time_s: (frames,), increasing times.
        measured_m: (frames, tracks, 3), measured positions in the world; any value, NaN included, where not measured.
        measured_covariance_m2: (frames, tracks, 3, 3), symmetric and positive definite where measured.
        was_measured: (frames, tracks), whether the track was measured.
        motion: motion parameters of the drones, by label.
        params: parameters that decide when labels are uncertain.
        size_m: (frames, tracks, 3), apparent sizes; NaN where not known. How well they distinguish drones is learned
            from the frames before an encounter in which no other drone is near.

    Raises:
        InputError: times do not increase, or a measurement is not finite, or its covariance is not positive definite.
    """
    check_measurements(time_s, measured_m, measured_covariance_m2, was_measured)
    num_frames, num_drones = was_measured.shape
    tracks = prepare_tracks(
        time_s, measured_m, measured_covariance_m2, was_measured, size_m, params.encounter_m
    )
    pairs = np.array(list(combinations(range(num_drones), 2)), np.int64).reshape(-1, 2)
    order = np.tile(np.arange(num_drones), (num_frames, 1))
    found = Identities(order, pairs, np.zeros((num_frames, len(pairs))), ())
    meetings = np.flatnonzero((tracks.distance_m < params.encounter_m).any(axis=(1, 2)))
    groups: list[Group] = []
    frame = -1
    with jax.enable_x64(True):
        while True:
            frame = frame + 1 if groups else _next_meeting(meetings, frame)
            if frame >= num_frames:
                break
            groups = update_groups(groups, frame, found.order, tracks, motion, params)
            groups = [update_group(group, frame, tracks, motion, params) for group in groups]
            for group in groups:
                if is_settled(group, time_s[frame], params):
                    found = settle(group, found, tracks, params)
            groups = [group for group in groups if not is_settled(group, time_s[frame], params)]
    for group in groups:
        found = settle(group, found, tracks, params, still_open=True)
    return found


def _next_meeting(meetings: Int[np.ndarray, "meetings"], frame: int) -> int:
    """First later frame in which drones are near; a number beyond all frames if there is none."""
    later = meetings[np.searchsorted(meetings, frame, side="right") :]
    return int(later[0]) if len(later) else np.iinfo(np.int64).max

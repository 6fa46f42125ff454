"""Resolve identity swaps: the encounters of all pairs of drones, in the order of their decisions."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from psotrack.support import as_written
from psotrack.tracking.identity.encounters import (
    Encounter,
    FollowedEncounter,
    Identities,
    LabelOutcome,
    follow,
    relabelled,
)
from psotrack.tracking.motion import Measurements, MotionParams

#: Ratio of the jerk density during encounters to the usual jerk density, because drones avoid each other. A larger
#: value leaves more encounters undecided; a smaller value swaps labels wrongly.
_AGILITY = 10.0


def resolve(measured: Measurements, motion: MotionParams, encounter_m: float) -> Identities:
    """Find the track of each drone in every frame. Labels are correct until drones meet for the first time.

    Where three drones meet, each two of them have an encounter. When one is decided and labels are exchanged, the other
    encounters of its two drones are followed anew.

    Args:
        measured: measurements of all tracks.
        motion: motion parameters of the drones, by label.
        encounter_m: drones nearer than this may be taken for each other, metres: about twice a drone's size, because
            their silhouettes then touch in some views.

    Raises:
        InputError: as `Measurements.check` says.
    """
    measured.check()
    num_frames, num_drones = measured.was_measured.shape
    frame, pairs = np.arange(num_frames), list(combinations(range(num_drones), 2))
    order = np.tile(np.arange(num_drones), (num_frames, 1))
    position_m = np.where(measured.was_measured[..., None], measured.position_m, np.nan)
    distance_m = np.linalg.norm(position_m[:, :, None] - position_m[:, None], axis=-1)
    is_near = (distance_m < encounter_m) & ~np.eye(num_drones, dtype=bool)
    # Tracks that are near each other, and whose encounter is not decided yet.
    undecided = is_near.copy()

    def next_meeting(pair: tuple[int, int]) -> FollowedEncounter | None:
        tracks = order[:, pair]
        near = undecided[frame, tracks[:, 0], tracks[:, 1]]
        if not near.any():
            return None
        by_track = (measured.position_m, measured.covariance_m2, measured.was_measured)
        by_drone = (relabelled(value, tracks) for value in by_track)
        density = _AGILITY * np.asarray(motion.jerk_density_m2_s5)[list(pair)]
        of_pair = replace(motion, jerk_density_m2_s5=density)
        known = Measurements(measured.time_s, *by_drone)
        with as_written(float64=True):
            return follow(pair, int(near.argmax()), known, of_pair, encounter_m)

    ambiguity = np.zeros((num_frames, len(pairs)))
    encounters: list[Encounter] = []
    meetings = {pair: next_meeting(pair) for pair in pairs}
    while followed := [meeting for meeting in meetings.values() if meeting is not None]:
        decided = min(followed, key=_turn)
        encounter, exchanged = decided.encounter, decided.exchanged
        encounters.append(encounter)
        pair, rows = encounter.drones, frame[encounter.first_frame : encounter.last_frame + 1]
        ambiguity[rows, pairs.index(pair)] = decided.ambiguity
        one, other = order[rows][:, pair].T
        undecided[rows, one, other] = undecided[rows, other, one] = False
        columns = np.array(pair)
        order[np.ix_(exchanged, columns)] = order[np.ix_(exchanged, columns[::-1])]
        for known in pairs:
            if known == pair or (exchanged.any() and set(known) & set(pair)):
                meetings[known] = next_meeting(known)
    return Identities(order, np.array(pairs, np.int64).reshape(-1, 2), ambiguity, tuple(encounters))


def _turn(meeting: FollowedEncounter) -> tuple[int, bool, float]:
    """Encounters are decided in the order of time; of those decided in the same frame, the most certain first."""
    encounter = meeting.encounter
    return encounter.last_frame, encounter.outcome is LabelOutcome.OPEN, -abs(encounter.log_odds)

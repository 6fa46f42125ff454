"""GOSPA: one figure, in metres, for errors of position, missed drones and false tracks.

A. S. Rahmathullah, A. F. Garcia-Fernandez, L. Svensson, Generalized Optimal Sub-Pattern Assignment Metric,
International Conference on Information Fusion, 2017. Each frame is scored alone, so identities do not matter.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from psotrack.evaluation.records import Gospa
from psotrack.trajectories.association import GATE_M, cheapest_partners, paired_values


def gospa(
    distance_m: Float[np.ndarray, "frames drones estimates"],
    known: Bool[np.ndarray, "frames drones"],
    counted: Bool[np.ndarray, "frames estimates"],
) -> Gospa:
    """GOSPA with alpha = 2, p = 2 and the cut-off c = `GATE_M`, and its three parts.

    In each frame, over all assignments (proposition 1 of the paper):

    GOSPA^2 = min [ sum over pairs of distance^2 + c^2 / 2 (missed + false) ]

    A missed drone costs c / sqrt(2), and a pair further apart than c counts as a missed drone and a false track. The
    result is the root of the mean of GOSPA^2 over frames; it is a metric (section IV of the paper), and its parts add
    up: localisation^2 + missed^2 + false^2 = GOSPA^2.

    GOSPA grows with the number of drones: one drone missed in all frames costs 0.354 m, ten cost 1.118 m.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not known.
        known: (frames, drones), whether the drone's position is known.
        counted: (frames, estimates), whether the estimate counts as a true or false positive.
    """
    cut_m2 = GATE_M**2
    # A pair at the cut-off costs the same as a missed drone and a false track.
    cost_m2 = np.where(distance_m < GATE_M, distance_m**2, cut_m2)
    paired_m2 = paired_values(cost_m2, cheapest_partners(cost_m2))
    matched = paired_m2 < cut_m2
    num_matched = int(matched.sum())
    parts_m2 = np.array(
        [
            paired_m2[matched].sum(),
            cut_m2 / 2 * (known.sum() - num_matched),
            cut_m2 / 2 * (counted.sum() - num_matched),
        ]
    ) / len(distance_m)
    localisation_m, missed_m, false_m = np.sqrt(parts_m2).tolist()
    return Gospa(
        gospa_m=float(np.sqrt(parts_m2.sum())),
        gospa_localisation_m=localisation_m,
        gospa_missed_m=missed_m,
        gospa_false_m=false_m,
    )

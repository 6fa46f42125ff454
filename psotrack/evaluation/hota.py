"""HOTA on 3D distance: detection, association and localisation in one score.

J. Luiten, A. Osep, P. Dendorfer, P. Torr, A. Geiger, L. Leal-Taixe, B. Leibe, HOTA: A Higher Order Metric for
Evaluating Multi-Object Tracking, International Journal of Computer Vision 129, 2021.

The paper leaves the choice of similarity to the user. Here, similarity falls linearly from 1 at distance 0 to 0 at
`GATE_M`, so that the thresholds 0.05, 0.10 ... 0.95 are distances of 0.475 m, 0.450 m ... 0.025 m.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.evaluation.records import Hota
from psotrack.trajectories.association import GATE_M, UNASSIGNED, cheapest_partners, paired_values

_THRESHOLDS = np.linspace(0.05, 0.95, 19)
#: Tolerance for rounding when a similarity is compared with a threshold.
_EPSILON = np.finfo(float).eps


def hota(
    distance_m: Float[np.ndarray, "frames drones estimates"],
    known: Bool[np.ndarray, "frames drones"],
    counted: Bool[np.ndarray, "frames estimates"],
) -> Hota:
    """HOTA, DetA, AssA and LocA, each the mean over the thresholds.

    Each frame has one assignment for all thresholds. The assignment maximises the sum of similarities, each weighted by
    the overlap of the two whole tracks (section 5.2 of the paper). A pair is a match at threshold alpha if its
    similarity is at least alpha. TP, FN and FP are counted over all frames. For a match, TPA is the number of frames in
    which its drone and its track are matched; FNA and FPA are the numbers of the other frames of the drone and of the
    track:

    - DetA_alpha = TP / (TP + FN + FP);
    - AssA_alpha = mean over matches of TPA / (TPA + FNA + FPA);
    - HOTA_alpha = sqrt(DetA_alpha AssA_alpha);
    - LocA_alpha = mean over matches of the similarity; 1 at a threshold without matches, as in the authors' code;
      LocA is None if the lowest threshold has no matches.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not known.
        known: (frames, drones), whether the drone's position is known; each drone's is known in at least one frame.
        counted: (frames, estimates), whether the estimate counts as a true or false positive; the other estimates are
            further than `GATE_M` from all drones.
    """
    similarity = np.where(distance_m < GATE_M, 1.0 - distance_m / GATE_M, 0.0)
    # Number of frames of a drone plus number of frames of a track: (drones, estimates).
    frames_of_both = known.sum(axis=0)[:, None] + counted.sum(axis=0)[None, :]
    weighted = _track_fit(similarity, frames_of_both) * similarity
    partners = cheapest_partners(-weighted)
    reached = np.nan_to_num(paired_values(similarity, partners))
    num_known, num_counted = int(known.sum()), int(counted.sum())
    parts = np.empty((len(_THRESHOLDS), 3))
    for part, threshold in zip(parts, _THRESHOLDS, strict=True):
        matched = reached >= threshold - _EPSILON
        num_matched = int(matched.sum())
        together = _frames_together(matched, partners, similarity.shape[2])
        association = together**2 / np.maximum(1, frames_of_both - together)
        part[:] = (
            num_matched / (num_known + num_counted - num_matched),
            association.sum() / max(1, num_matched),
            reached[matched].mean() if num_matched else 1.0,
        )
    deta, assa, loca = parts.T
    return Hota(
        hota=float(np.sqrt(deta * assa).mean()),
        deta=float(deta.mean()),
        assa=float(assa.mean()),
        loca=float(loca.mean()) if deta[0] > 0 else None,
    )


def _track_fit(
    similarity: Float[np.ndarray, "frames drones estimates"],
    frames_of_both: Int[np.ndarray, "drones estimates"],
) -> Float[np.ndarray, "drones estimates"]:
    """Overlap of each drone with each track over all frames, in [0, 1], used as weight of the matching.

    In each frame, a pair's similarity is divided by the sum of similarities of the drone and of the track.
    """
    total = similarity.sum(axis=1, keepdims=True) + similarity.sum(axis=2, keepdims=True) - similarity
    share = np.divide(similarity, total, out=np.zeros_like(similarity), where=total > _EPSILON)
    overlap = share.sum(axis=0)
    return overlap / (frames_of_both - overlap)


def _frames_together(
    matched: Bool[np.ndarray, "frames drones"], partners: Int[np.ndarray, "frames drones"], num_estimates: int
) -> Int[np.ndarray, "drones estimates"]:
    """Number of frames in which each pair is matched."""
    assigned = matched & (partners != UNASSIGNED)
    _, drones = np.nonzero(assigned)
    together = np.zeros((matched.shape[1], num_estimates), int)
    np.add.at(together, (drones, partners[assigned]), 1)
    return together

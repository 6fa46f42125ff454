"""HOTA on 3D distance: detection, association and localisation in one score.

J. Luiten, A. Osep, P. Dendorfer, P. Torr, A. Geiger, L. Leal-Taixe, B. Leibe, HOTA: A Higher Order Metric for
Evaluating Multi-Object Tracking, International Journal of Computer Vision 129, 2021.

The paper leaves the similarity to the user. Ours falls linearly from 1 at the truth to 0 at `GATE_M`, so that its
thresholds 0.05, 0.10 ... 0.95 stand for distances of 0.475 m, 0.450 m ... 0.025 m.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.evaluation.records import Hota
from psotrack.trajectories.association import GATE_M, UNASSIGNED, cheapest_partners, paired_values

_THRESHOLDS = np.linspace(0.05, 0.95, 19)
#: A similarity counts as reaching a threshold that it misses by no more than rounding.
_EPSILON = np.finfo(float).eps


def hota(
    distance_m: Float[np.ndarray, "frames drones estimates"],
    known: Bool[np.ndarray, "frames drones"],
    counted: Bool[np.ndarray, "frames estimates"],
) -> Hota:
    """HOTA, DetA, AssA and LocA: means over the thresholds.

    In each frame one assignment serves all thresholds. It maximises the sum of similarities, each weighted by how
    well the two whole tracks fit together (section 5.2 of the paper); a pair is a match at threshold alpha
    where its similarity is at least alpha. With TP, FN, FP over the whole run, and TPA, FNA, FPA of a match the
    frames in which its two tracks are matched, and those in which the true one or the estimated one is not:

    - DetA_alpha = TP / (TP + FN + FP);
    - AssA_alpha = mean over matches of TPA / (TPA + FNA + FPA);
    - HOTA_alpha = sqrt(DetA_alpha AssA_alpha);
    - LocA_alpha = mean over matches of the similarity; 1 at a threshold that no pair reaches, as in the
      authors' code, but None where no pair reaches the lowest.

    Args:
        distance_m: (frames, drones, estimates), NaN where either is not seen.
        known: (frames, drones), what is there to be found. Each drone is known in some frame.
        counted: (frames, estimates), what was found; an estimate that is not counted is within `GATE_M` of
            no drone.
    """
    similarity = np.where(distance_m < GATE_M, 1.0 - distance_m / GATE_M, 0.0)
    # Numbers of frames of a true track and of an estimated one, together: (drones, estimates).
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
    """The soft overlap of two whole tracks, before anything is matched; in [0, 1].

    In a frame, a pair gets its similarity as a share of all that either of the two has.
    """
    total = similarity.sum(axis=1, keepdims=True) + similarity.sum(axis=2, keepdims=True) - similarity
    share = np.divide(similarity, total, out=np.zeros_like(similarity), where=total > _EPSILON)
    overlap = share.sum(axis=0)
    return overlap / (frames_of_both - overlap)


def _frames_together(
    matched: Bool[np.ndarray, "frames drones"], partners: Int[np.ndarray, "frames drones"], num_estimates: int
) -> Int[np.ndarray, "drones estimates"]:
    """In how many frames each pair is matched."""
    there = matched & (partners != UNASSIGNED)
    _, drones = np.nonzero(there)
    together = np.zeros((matched.shape[1], num_estimates), int)
    np.add.at(together, (drones, partners[there]), 1)
    return together

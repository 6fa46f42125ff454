"""Metrics compared with the packages trackeval and motmetrics on random flights.

trackeval 1.3.0 is the code of HOTA's authors; motmetrics 1.4.0 is an independent implementation of CLEAR and IDF1.
trackeval depends on opencv-python, which would replace opencv-python-headless. Therefore trackeval is not in the `test`
extra, and its tests are skipped if it is not installed.
"""

from dataclasses import replace

import motmetrics
import numpy as np
import pytest
from evaluation_flights import FPS, ROUNDING, random_flights, seeds
from hypothesis import given, settings

from psotrack.evaluation import evaluate
from psotrack.trajectories import GATE_M, Trajectories


def crowded_flights(seed: int) -> tuple[Trajectories, Trajectories]:
    """Flights within a metre, so that many pairs are possible; some estimates are missing, but no reference."""
    est, _ = random_flights(seed, num_frames=12)
    _, ref = random_flights(seed, num_frames=12, missing=0)
    return est, ref


def separate_flights(seed: int) -> tuple[Trajectories, Trajectories]:
    """Flights 3 m apart, with missing positions, identity switches, distances beyond the gate and a false track."""
    rng = np.random.default_rng(seed)
    num_frames, num_drones = 20, 4
    ref_m = np.zeros((num_frames, num_drones, 3)) + np.arange(num_drones)[:, None] * [3.0, 0.0, 0.0]
    ref_m += rng.normal(0, 0.1, ref_m.shape)
    # A third of the distances exceed the gate.
    est_m = ref_m + rng.normal(0, 0.25, ref_m.shape)
    known, seen = rng.random((2, num_frames, num_drones)) > 0.15
    # Frame 0 defines the identities, and every drone is known in it.
    known[0], seen[0] = True, True
    est_m[~seen] = np.nan
    ref_m[~known] = np.nan
    for start in rng.integers(3, num_frames, 3):
        est_m[start:] = est_m[start:, rng.permutation(num_drones)]
    # Tracks are removed where their drone is unknown; other tests show that such tracks do not count.
    est_m[~known] = np.nan
    false_m = np.where(rng.random((num_frames, 1, 1)) < 0.5, 50.0, np.nan) + np.zeros(3)
    # psotrack ignores frames without any known drone; the other packages count the false track in such frames.
    false_m[~known.any(axis=1)] = np.nan
    frame = np.arange(num_frames)
    return (
        Trajectories(frame, frame / FPS, tuple("abcde"), np.concatenate([est_m, false_m], axis=1)),
        Trajectories(frame, frame / FPS, tuple("wxyz"), ref_m),
    )


def frames(est: Trajectories, ref: Trajectories):
    """Iterate over frames: numbers of the known drones, numbers of the present estimates, and their distances."""
    for ref_m, est_m, known, seen in zip(ref.position_m, est.position_m, ref.seen, est.seen, strict=True):
        drones, estimates = np.flatnonzero(known), np.flatnonzero(seen)
        yield drones, estimates, np.linalg.norm(ref_m[drones, None] - est_m[None, estimates], axis=-1)


def for_trackeval(est: Trajectories, ref: Trajectories):
    """Input of trackeval's metrics, with the similarity 1 - distance / `GATE_M`."""
    drones, estimates, distances_m = zip(*frames(est, ref), strict=True)
    return {
        "num_gt_ids": ref.num_drones,
        "num_tracker_ids": est.num_drones,
        "num_gt_dets": sum(map(len, drones)),
        "num_tracker_dets": sum(map(len, estimates)),
        "gt_ids": list(drones),
        "tracker_ids": list(estimates),
        "similarity_scores": [np.maximum(0, 1 - distance_m / GATE_M) for distance_m in distances_m],
        "num_timesteps": ref.num_frames,
    }


@pytest.mark.parametrize("flights", [crowded_flights, separate_flights])
@given(seed=seeds)
@settings(max_examples=30)
def test_hota_is_that_of_trackeval(flights, seed):
    metrics = pytest.importorskip("trackeval").metrics
    est, ref = flights(seed)
    theirs = metrics.HOTA().eval_sequence(for_trackeval(est, ref))
    ours = evaluate(est, ref)
    for name in ("HOTA", "DetA", "AssA", "LocA"):
        assert getattr(ours, name.lower()) == pytest.approx(theirs[name].mean(), abs=ROUNDING), name


@pytest.mark.parametrize("flights", [crowded_flights, separate_flights])
@given(seed=seeds)
@settings(max_examples=20)
def test_clear_and_identity_are_those_of_motmetrics(flights, seed):
    est, ref = flights(seed)
    if flights is crowded_flights:
        # motmetrics keeps pairs from all earlier frames, psotrack only pairs of the previous frame. Both are the same
        # if no drone is ever missed: all estimates are within the gate of all drones, and there are enough estimates.
        est = replace(est, position_m=0.25 * est.position_m)
        ref = replace(ref, position_m=0.25 * ref.position_m)
        est.position_m[est.seen.sum(axis=1) < ref.num_drones] = 0.1
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for drones, estimates, distance_m in frames(est, ref):
        accumulator.update(drones, estimates, np.where(distance_m <= GATE_M, distance_m, np.nan))
    names = ["mota", "motp", "idf1", "num_switches"]
    theirs, ours = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0], evaluate(est, ref)
    assert ours.id_switches == theirs["num_switches"]
    for name, key in (("mota", "mota"), ("motp_m", "motp"), ("idf1", "idf1")):
        assert getattr(ours, name) == pytest.approx(theirs[key], abs=ROUNDING), name

"""Identity swaps: compared with all label histories, tested on simulated flights, and frequencies of wrong labels."""

from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_textbook import DT_S, Model, joint_gaussian
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from psotrack.settings import IdentitySettings, MotionSettings
from psotrack.tracking.identity import LabelOutcome, postprocess, relabelled, resolve
from psotrack.tracking.motion import Measurements
from psotrack.trajectories import Status, Tracks

ENCOUNTER_M = 0.6
#: Motion model with a low jerk density, like the flights of the simulator and of these tests.
GENTLE = Model(density=1.0)
#: Ratio of the jerk density during encounters to the usual jerk density.
AGILITY = 10.0


@dataclass(frozen=True, kw_only=True)
class LabelledTracks(Measurements):
    """Simulated output of a tracker; `truth`, (frames, drones), is the number of the track that follows each drone."""

    truth: np.ndarray

    def part(self, frames=slice(None), tracks=slice(None)):
        """The measurements of some frames and tracks."""
        return Measurements(
            self.time_s[frames],
            self.position_m[frames][:, tracks],
            self.covariance_m2[frames][:, tracks],
            self.was_measured[frames][:, tracks],
        )


def simulate_tracks(flown_m, std_m=0.01, seed=0, exchanges=()):
    """Measure flights (frames, drones, 3) with white errors; `exchanges` are (first frame, permutation of tracks)."""
    frames, drones, _ = flown_m.shape
    rng = np.random.default_rng(seed)
    std_m = np.broadcast_to(std_m, (frames, drones))
    truth = np.tile(np.arange(drones), (frames, 1))
    for frame, permutation in exchanges:
        truth[frame:] = np.array(permutation)[truth[frame]]
    by_drones = LabelledTracks(
        time_s=np.arange(frames) * DT_S,
        position_m=flown_m + std_m[..., None] * rng.normal(size=flown_m.shape),
        covariance_m2=std_m[..., None, None] ** 2 * np.eye(3),
        was_measured=np.ones((frames, drones), bool),
        truth=truth,
    )
    # The columns of each drone become those of its tracks.
    column = np.argsort(truth, axis=1)
    return replace(
        by_drones,
        position_m=relabelled(by_drones.position_m, column),
        covariance_m2=relabelled(by_drones.covariance_m2, column),
        was_measured=relabelled(by_drones.was_measured, column),
    )


def resolve_tracks(measured, model=GENTLE, encounter_m=ENCOUNTER_M):
    return resolve(measured, model.params(measured.was_measured.shape[1]), encounter_m)


def list_outcomes(found):
    return [encounter.outcome for encounter in found.encounters]


def nearest_distance_m(flown_m):
    """(frames, drones), distance to the nearest other drone, metres."""
    distance_m = np.linalg.norm(flown_m[:, :, None] - flown_m[:, None], axis=-1)
    distance_m[:, np.eye(flown_m.shape[1], dtype=bool)] = np.inf
    return distance_m.min(axis=-1)


#: Times of 100 frames before and after frame 50, seconds.
SECONDS = (np.arange(100) - 50) * DT_S


def passing(side_m=0.3, speed_m_s=1.0):
    """Two drones on straight courses, nearest in frame 50."""
    x, y = speed_m_s * SECONDS, np.full(100, side_m / 2)
    one = np.stack([x, y, np.ones(100)], axis=-1)
    return np.stack([one, one * [-1, -1, 1]], axis=1)


def turning_back(nearest_m=0.3, speed_m_s=1.0):
    """Two drones that approach head on and turn back: a hyperbola over time."""
    x = np.sqrt((speed_m_s * SECONDS) ** 2 + (nearest_m / 2) ** 2)
    one = np.stack([x, np.zeros(100), np.ones(100)], axis=-1)
    return np.stack([one, one * [-1, -1, 1]], axis=1)


def hovering(together_m=0.15, hover_s=1.4):
    """Two drones that meet, stay together, and return to where they came from, in 160 frames."""
    still = np.maximum(np.abs((np.arange(160) - 50) * DT_S) - hover_s / 2, 0.0)
    x = together_m / 2 + still**2 / (still + 0.3)
    one = np.stack([x, np.zeros(160), np.ones(160)], axis=-1)
    return np.stack([one, one * [-1, -1, 1]], axis=1)


def merge_positions(flown_m, merge_m=0.3):
    """Positions that are measured if silhouettes merge below a distance: both drones are at the middle of both."""
    share = np.clip(2 * (1 - nearest_distance_m(flown_m) / merge_m), 0, 1)[..., None]
    return flown_m + share * (flown_m.mean(axis=1, keepdims=True) - flown_m)


class TestTwoDrones:
    @pytest.mark.parametrize(
        ("std_m", "frame"), [(0.005, None), (0.03, None), (0.005, 50), (0.03, 46), (0.03, 53)]
    )
    @pytest.mark.parametrize("flight", [passing, turning_back])
    def test_correct_labels_are_kept_and_swapped_labels_are_corrected(self, flight, frame, std_m):
        exchanges, outcome, sign = [], LabelOutcome.KEPT, -1
        if frame:
            exchanges, outcome, sign = [(frame, (1, 0))], LabelOutcome.SWAPPED, 1
        tracks = simulate_tracks(flight(), std_m, exchanges=exchanges)
        found = resolve_tracks(tracks)
        (encounter,) = found.encounters
        assert encounter.outcome is outcome
        assert encounter.drones == (0, 1)
        assert sign * encounter.log_odds > np.log(99)
        # Errors of a few centimetres shift the frame of the least distance, which is 0.3 m.
        assert abs(encounter.closest_frame - 50) <= 3
        assert encounter.distance_m == pytest.approx(0.3, abs=6 * std_m)
        assert encounter.first_frame < 45 < 55 < encounter.last_frame < 75
        # At distances of 0.3 m and more, labels are wrong in one frame; with errors of 0.03 m, in two frames.
        wrong = (found.order != tracks.truth).any(axis=1)
        assert wrong.sum() <= (2 if frame else 0)

    @pytest.mark.parametrize("exchanged", [False, True])
    def test_drones_that_hover_together_are_ambiguous(self, exchanged):
        """Both drones share a silhouette for more than a second, so their identities after it cannot be known."""
        exchanges = [(50, (1, 0))] * exchanged
        found = resolve_tracks(simulate_tracks(merge_positions(hovering()), exchanges=exchanges))
        (encounter,) = found.encounters
        assert encounter.outcome is LabelOutcome.UNDECIDED
        assert (found.order == [0, 1]).all()
        first, last = encounter.first_frame, encounter.last_frame
        # Odds are nearly even; the course of more than a second ago has little influence. Measured 0.41 to 0.62.
        assert (np.abs(found.ambiguity[[50, 60, 70, last], 0] - 0.5) < 0.15).all()
        # Ambiguity begins with the encounter and ends with it.
        assert (found.ambiguity[:first] == 0).all()
        assert (found.ambiguity[last + 1 :] == 0).all()
        np.testing.assert_array_equal(found.pairs, [[0, 1]])

    @pytest.mark.parametrize("exchanged", [False, True])
    def test_a_pass_that_is_not_seen_or_in_which_silhouettes_merge(self, exchanged):
        """In eight frames around the closest frame, both tracks or one of them have no measurements.

        Or both drones are measured at one place for a few tenths of a second; only their earlier course can decide.
        """
        exchanges = [(50, (1, 0))] * exchanged
        outcome = LabelOutcome.SWAPPED if exchanged else LabelOutcome.KEPT
        tracks = simulate_tracks(passing(0.15), exchanges=exchanges)
        for hidden in ([0, 1], [0]):
            was_measured = tracks.was_measured.copy()
            was_measured[46:54, hidden] = False
            measured_m = np.where(was_measured[..., None], tracks.position_m, np.nan)
            found = resolve_tracks(replace(tracks, was_measured=was_measured, position_m=measured_m))
            assert list_outcomes(found) == [outcome]
            # Labels are undefined in frames without measurements.
            right = (found.order == tracks.truth).all(axis=1)
            assert right[was_measured.all(axis=1)].all()
        tracks = simulate_tracks(merge_positions(passing(0.15)), exchanges=exchanges)
        found = resolve_tracks(tracks)
        assert list_outcomes(found) == [outcome]
        np.testing.assert_array_equal(found.order[[0, -1]], tracks.truth[[0, -1]])

    def test_one_drone_or_distant_drones_have_no_encounter(self):
        distant = resolve_tracks(simulate_tracks(passing(0.8)))
        assert distant.encounters == ()
        assert (distant.ambiguity == 0).all()
        assert (distant.order == [0, 1]).all()
        alone = resolve_tracks(simulate_tracks(passing()[:, :1]))
        assert (alone.order == 0).all()

    def test_a_drone_that_is_lost_in_an_encounter(self):
        """Two seconds after the drones were last near, the encounter ends without a decision."""
        flown_m = passing()
        at_the_end = np.repeat(flown_m[-1:], 20, axis=0)
        tracks = simulate_tracks(np.concatenate([flown_m, at_the_end]))
        was_measured = tracks.was_measured.copy()
        was_measured[50:, 1] = False
        found = resolve_tracks(replace(tracks, was_measured=was_measured))
        (encounter,) = found.encounters
        assert encounter.last_frame == 49 + round(2.0 / DT_S)
        assert encounter.outcome is not LabelOutcome.SWAPPED


def meeting_in_the_middle(drones, nearest_m=0.25, speed_m_s=1.0):
    """(100, drones, 3), drones that come from all sides and pass each other, nearest in frame 50."""
    angle = 2 * np.pi * np.arange(drones) / drones
    ahead = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    aside = ahead[:, [1, 0, 2]] * [-1, 1, 1]
    return speed_m_s * SECONDS[:, None, None] * ahead + nearest_m * aside


def assert_corrected(found, tracks):
    """Assert correct labels, except in two frames near the swaps, because the order of several swaps may differ."""
    wrong = np.flatnonzero((found.order != tracks.truth).any(axis=1))
    assert len(wrong) <= 2
    assert (np.abs(wrong - 50) <= 2).all()


class TestMoreDrones:
    @pytest.mark.parametrize("permutation", list(permutations(range(3))))
    def test_three_drones_that_meet_at_once(self, permutation):
        tracks = simulate_tracks(meeting_in_the_middle(3), exchanges=[(50, permutation)])
        found = resolve_tracks(tracks)
        assert_corrected(found, tracks)
        # A cycle of three drones is two swaps.
        num_moved = np.count_nonzero(np.array(permutation) != np.arange(3))
        assert list_outcomes(found).count(LabelOutcome.SWAPPED) == max(num_moved - 1, 0)
        assert len({encounter.drones for encounter in found.encounters}) == 3

    def test_a_drone_that_passes_two_others_is_decided_while_they_stay(self):
        """Two drones stay side by side, and a third drone passes them."""
        flown_m = np.zeros((100, 3, 3))
        flown_m[..., 1] = [0.0, 0.45, -0.3]
        flown_m[..., 2] = 1.0
        flown_m[:, 2, 0] = 2 * SECONDS
        tracks = simulate_tracks(flown_m, exchanges=[(50, (2, 1, 0))])
        found = resolve_tracks(tracks)
        np.testing.assert_array_equal(found.order, tracks.truth)
        (passed,) = (encounter for encounter in found.encounters if encounter.drones == (0, 2))
        assert passed.outcome is LabelOutcome.SWAPPED
        assert passed.last_frame < 70
        assert found.encounters[-1].outcome is LabelOutcome.OPEN

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=4)
    def test_names_of_drones_do_not_matter(self, seed):
        rng = np.random.default_rng(seed)
        flown_m = meeting_in_the_middle(4, rng.uniform(0.05, 0.4), rng.uniform(0.5, 2.0))
        exchange = rng.integers(44, 57), rng.permutation(4)
        tracks = simulate_tracks(flown_m, rng.uniform(0.005, 0.03), seed, [exchange])
        tracks.was_measured[rng.random((100, 4)) < 0.1] = False
        names = rng.permutation(4)
        found = resolve_tracks(tracks)
        renamed = resolve_tracks(tracks.part(tracks=names))
        # Drone and track `names[i]` have the index i after the permutation.
        np.testing.assert_array_equal(names[renamed.order], found.order[:, names])
        renamed_pairs = np.sort(names[renamed.pairs], axis=1).tolist()
        columns = [renamed_pairs.index(pair) for pair in found.pairs.tolist()]
        # The tolerance is for sums in another order, over a hundred frames.
        np.testing.assert_allclose(renamed.ambiguity[:, columns], found.ambiguity, rtol=0, atol=1e-9)
        assert ((found.ambiguity >= 0) & (found.ambiguity <= 1)).all()

    def test_the_first_frames_alone_give_the_same_result(self):
        """The first frames alone give the same result as all frames, up to the first frame that is still uncertain."""
        time_s = np.arange(300) * DT_S
        x = 1.5 * np.sin(time_s[:, None] * [1.1, 0.9, 1.3] + [0.0, 2.0, 4.0])
        flown_m = np.stack([x, 0.1 * np.arange(3) * np.ones_like(x), np.ones_like(x)], axis=-1)
        tracks = simulate_tracks(flown_m, 0.02, exchanges=[(100, (1, 0, 2)), (200, (0, 2, 1))])
        whole = resolve_tracks(tracks)
        assert len(whole.encounters) > 8
        for frames in (76, 132, 244):
            found = resolve_tracks(tracks.part(slice(frames)))
            still_open = [each for each in found.encounters if each.outcome is LabelOutcome.OPEN]
            safe = min((each.first_frame for each in still_open), default=frames)
            np.testing.assert_array_equal(found.order[:safe], whole.order[:safe])
            np.testing.assert_array_equal(found.ambiguity[:safe], whole.ambiguity[:safe])
            settled = len(found.encounters) - len(still_open)
            assert found.encounters[:settled] == whole.encounters[:settled]


def all_histories(model, tracks, num_before, rate):
    """Exact posterior of the two labellings after the last frame, from all label histories.

    Args:
        model: motion model of both drones.
        tracks: the measurements of the two tracks.
        num_before: frames before the encounter.
        rate: odds of a swap in a frame.
    """
    frames = np.arange(len(tracks.time_s))
    weights = {0: [], 1: []}
    for history in product((0, 1), repeat=len(frames) - num_before):
        labels = np.array([0] * num_before + list(history))
        swaps = np.count_nonzero(np.diff(labels[num_before - 1 :]))
        total = swaps * np.log(rate) - len(history) * np.log1p(rate)
        for drone in (0, 1):
            followed = frames, drone ^ labels
            by_frame = (tracks.position_m, tracks.covariance_m2, tracks.was_measured)
            measured = [part[followed] for part in by_frame]
            mean, _, observed, S = joint_gaussian(model, tracks.time_s, *measured)
            total += multivariate_normal(observed @ mean, S).logpdf(measured[0][1:].ravel())
        weights[history[-1]].append(total)
    totals = np.array([logsumexp(weights[label]) for label in (0, 1)])
    return np.exp(totals - logsumexp(totals))


class TestAmbiguity:
    @pytest.mark.parametrize("share", [0.0, 0.5])
    def test_the_probability_equals_that_of_all_histories(self, share):
        """Exact after one frame. After five frames, with 32 histories, merging changes little."""
        encounter_m = 0.3
        model = Model(density=AGILITY, error_share=share)
        for seed in range(3):
            rng = np.random.default_rng(seed)
            # The drones come near each other in frame 10.
            flown_m = np.zeros((15, 2, 3))
            flown_m[:, 1, 0] = 0.29 - 0.04 * (np.arange(15) - 10)
            flown_m[:, 1, 1:] = 0.02 * rng.normal(size=2)
            # Errors are half as large as stated, so that none is beyond the gate, which the oracle does not have.
            tracks = simulate_tracks(flown_m, 0.004, seed)
            tracks = replace(tracks, covariance_m2=4 * tracks.covariance_m2)
            found = resolve_tracks(tracks, replace(model, density=1.0), encounter_m)
            assert found.encounters[0].first_frame == 10
            # Near tracks attract each other: a tenth of the distance of encounters at distance 0.
            nearness = np.maximum(1 - nearest_distance_m(tracks.position_m) / encounter_m, 0)
            pull_m = 0.1 * encounter_m * nearness**2 * (np.arange(15) >= 10)[:, None]
            spread_m2 = tracks.covariance_m2 + pull_m[..., None, None] ** 2 * np.eye(3)
            pulled = replace(tracks, covariance_m2=spread_m2)
            for frames, limit in ((11, 1e-9), (15, 0.02)):
                exact = all_histories(model, pulled.part(slice(frames)), 10, 0.2)
                assert (found.order[frames - 1] == [0, 1]).all()
                assert found.ambiguity[frames - 1, 0] == pytest.approx(exact[1], abs=limit)


@given(st.lists(st.integers(1, 12), min_size=5, max_size=12), st.integers(0, 99))
@settings(max_examples=20)
def test_smoothing_states_no_place_for_a_lost_drone_and_none_outside_of_the_room(lengths, seed):
    """A drone is seen and not seen in turn, and is lost in the fourth frame of a gap; then it is somewhere else."""
    rng, frame = np.random.default_rng(seed), np.arange(60)
    room_m = np.array([[0.0, 0.0, 0.0], [4.0, 3.0, 2.0]])
    seen = np.resize(np.repeat(np.arange(len(lengths)) % 2 == 0, lengths), 60)
    missed = frame - np.maximum.accumulate(np.where(seen, frame, 0))
    status = np.where(seen, Status.TRACKED, np.where(missed > 3, Status.LOST, Status.COASTING))
    flight = np.cumsum(np.diff(status == Status.LOST, prepend=False))
    began = np.searchsorted(flight, flight)
    place_m, velocity_m_s = rng.uniform(*room_m, (60, 3))[began], rng.normal(0.0, 4.0, (60, 3))[began]
    # It flies against the walls.
    place_m = np.clip(place_m + velocity_m_s * (frame - began)[:, None] * DT_S, *room_m)[:, None]
    spread_m2, number = np.tile(1e-4 * np.eye(3), (60, 1, 1, 1)), np.zeros((60, 1))
    measured = place_m, place_m, spread_m2, place_m, spread_m2, number, number.astype(int), status[:, None]
    tracks = Tracks(*measured, np.full((1, 3), 0.3), np.zeros((1, 3), int))
    how = {"fps": 1 / DT_S, "bounds_m": room_m, "smoothing": MotionSettings()}
    found, _ = postprocess(tracks, MotionSettings(), IdentitySettings(), **how)
    np.testing.assert_array_equal(np.isfinite(found.position_m[:, 0]).all(axis=-1), status != Status.LOST)
    shown_m = found.position_m[found.seen]
    assert ((shown_m >= room_m[0]) & (shown_m <= room_m[1])).all()
    # No path leads from one flight to the next, and bends both.
    assert np.linalg.norm(found.position_m - place_m, axis=-1)[seen].max() < 0.5

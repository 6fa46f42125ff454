"""HOTA and GOSPA: compared with results by hand for five frames; GOSPA satisfies the axioms of a metric."""

import numpy as np
import pytest
from evaluation_flights import ROUNDING, TRUTH, on_x_axis, pairings, random_flights, seeds
from hypothesis import given, settings

from psotrack.evaluation import evaluate
from psotrack.trajectories import GATE_M, UNASSIGNED


def hota_of(est, ref=TRUTH):
    evaluation = evaluate(est, ref)
    return evaluation.hota, evaluation.deta, evaluation.assa, evaluation.loca


def gospa_of(est, ref=TRUTH):
    """Squares of GOSPA's parts for localisation, missed drones and false tracks, and of GOSPA itself, m2."""
    evaluation = evaluate(est, ref)
    parts_m = (evaluation.gospa_localisation_m, evaluation.gospa_missed_m, evaluation.gospa_false_m)
    return [part_m**2 for part_m in (*parts_m, evaluation.gospa_m)]


class TestHota:
    """Tests of HOTA, whose similarity is 1 - distance / 0.5 m and whose 19 thresholds are 0.05 to 0.95."""

    def test_localisation_decides_which_thresholds_are_reached(self):
        # 0.12 m is a similarity of 0.76, which reaches the 15 thresholds up to 0.75. At these 15 thresholds all ten
        # pairs match. At the other four thresholds no pair matches, and LocA is 1 by convention.
        hota, deta, assa, loca = hota_of(on_x_axis([0.12] * 5, [10.12] * 5))
        assert (hota, deta, assa) == pytest.approx((15 / 19,) * 3, abs=ROUNDING)
        assert loca == pytest.approx((15 * 0.76 + 4) / 19, abs=ROUNDING)

    def test_a_swap_lowers_only_the_association_accuracy(self):
        # Each drone matches one track in 3 frames: TPA = 3, FNA = FPA = 2, so 3/7 for each of these 3 matches. It
        # matches the other track in 2 frames: TPA = 2, FNA = FPA = 3, so 2/8 for each of these 2 matches. The mean is
        # (3 x 3/7 + 2 x 1/4) / 5 = 5/14.
        hota, deta, assa, loca = hota_of(on_x_axis([0, 0, 0, 10, 10], [10, 10, 10, 0, 0]))
        assert (deta, loca) == (1, 1)
        assert assa == pytest.approx(5 / 14, abs=ROUNDING)
        assert hota == pytest.approx((5 / 14) ** 0.5, abs=ROUNDING)

    def test_a_split_track_with_a_miss_and_false_positives(self):
        est = on_x_axis([0, 0, None, None, None], [None, None, None, 0, 0], [50] * 5)
        # TP = 4, FN = 1, FP = 5: DetA = 4/10. Each half of the track: TPA = 2, FNA = 3, FPA = 0: AssA = 2/5.
        hota, deta, assa, loca = hota_of(est, on_x_axis([0] * 5))
        assert (hota, deta, assa, loca) == pytest.approx((0.4, 0.4, 0.4, 1), abs=ROUNDING)

    def test_tracks_with_the_best_global_fit_are_matched_although_others_are_nearer(self):
        truth = on_x_axis([0] * 5, [0.4] * 5)
        est = on_x_axis([0, 0, 0.32, 0, 0], [0.4, 0.4, 0.08, 0.4, 0.4])
        # In frame 2 each track is 0.32 m from its own drone (similarity 0.36) and 0.08 m from the other drone (0.84).
        # In the other frames the distances are 0 m (1) and 0.4 m (0.2).
        # The soft overlap of a drone and its own track is 4 x 1 / (1.2 + 1.2 - 1) + 0.36 / (1.2 + 1.2 - 0.36) = 3.0336,
        # which is a global alignment score of 3.0336 / (10 - 3.0336) = 0.4355. With the other track, the overlap is
        # 4 x 0.2 / 2.2 + 0.84 / 1.56 = 0.9021, and the score 0.0992.
        # In frame 2 drones are matched with their own tracks, because 0.4355 x 0.36 > 0.0992 x 0.84.
        # So the 7 thresholds up to 0.35 are perfect. At the other 12 thresholds, frame 2 has two misses and two false
        # positives: DetA = 8 / (8 + 2 + 2), AssA = 4 / (4 + 1 + 1), both 2/3.
        hota, deta, assa, loca = hota_of(est, truth)
        assert (hota, deta, assa) == pytest.approx(((7 + 12 * 2 / 3) / 19,) * 3, abs=ROUNDING)
        assert loca == pytest.approx((7 * (8 + 2 * 0.36) / 10 + 12) / 19, abs=ROUNDING)

    def test_a_track_of_an_unknown_drone_is_no_false_positive(self):
        truth = on_x_axis([0] * 5, [10, 10, None, None, 10])
        assert hota_of(on_x_axis([0] * 5, [10] * 5), truth) == pytest.approx((1,) * 4, abs=ROUNDING)
        # A false track counts: TP = 8, FP = 5.
        deta = hota_of(on_x_axis([0] * 5, [10] * 5, [50] * 5), truth)[1]
        assert deta == pytest.approx(8 / 13, abs=ROUNDING)

    def test_nothing_matches(self):
        assert hota_of(on_x_axis([None] * 5)) == (0, 0, 0, None)
        assert hota_of(on_x_axis([50] * 5)) == (0, 0, 0, None)
        # The lowest threshold corresponds to 0.475 m.
        assert hota_of(on_x_axis([0.48] * 5)) == (0, 0, 0, None)


class TestGospa:
    """Tests of GOSPA with the cut-off c = 0.5 m: a missed drone and a false track cost c^2 / 2 = 0.125 m2 each."""

    def test_decomposition(self):
        est = on_x_axis([0.1] * 5, [10, 10, 10.6, None, 10.3], [None, 50, None, None, None])
        # Costs in m2, frame: 0     1             2                   3              4
        # localisation        0.01  0.01          0.01                0.01           0.01 + 0.09
        # missed                                  0.125 (0.6 > 0.5)   0.125
        # false                     0.125         0.125
        localisation, missed, false, total = gospa_of(est)
        assert localisation == pytest.approx(0.14 / 5, abs=ROUNDING)
        assert missed == pytest.approx(0.25 / 5, abs=ROUNDING)
        assert false == pytest.approx(0.25 / 5, abs=ROUNDING)
        assert total == pytest.approx(0.64 / 5, abs=ROUNDING)

    def test_identities_do_not_matter(self):
        assert gospa_of(on_x_axis([0, 0, 10, 10, 0], [10, 10, 0, 0, 10])) == [0, 0, 0, 0]

    def test_one_perfect_pair_may_be_worth_more_than_two_poor_ones(self):
        # Two pairs of 0.49 m would cost 2 x 0.2401 = 0.4802; a pair of 0 m, a miss and a false track cost 0.25.
        parts = gospa_of(on_x_axis([0.98] * 5, [0.49] * 5), on_x_axis([0] * 5, [0.49] * 5))
        assert parts == pytest.approx([0, 0.125, 0.125, 0.25], abs=ROUNDING)

    def test_a_pair_at_the_cut_off_costs_as_much_as_a_miss_and_a_false_track(self):
        assert gospa_of(on_x_axis([0] * 5, [10.5] * 5))[3] == pytest.approx(0.25, abs=ROUNDING)

    def test_nothing_found(self):
        # Two missed drones in each frame.
        assert gospa_of(on_x_axis([None] * 5)) == pytest.approx([0, 0.25, 0, 0.25], abs=ROUNDING)

    @pytest.mark.parametrize("seed", range(5))
    def test_against_all_pairings(self, seed):
        est, ref = random_flights(seed, missing=0)
        distance_m = np.linalg.norm(ref.position_m[:, :, None] - est.position_m[:, None], axis=-1)

        def cost_m2(here_m, pairing):
            lengths_m = [here_m[d, e] for d, e in enumerate(pairing) if e != UNASSIGNED]
            unpaired = here_m.shape[0] + here_m.shape[1] - 2 * len(lengths_m)
            return sum(length_m**2 for length_m in lengths_m) + GATE_M**2 / 2 * unpaired

        least_m2 = [min(cost_m2(here_m, pairing) for pairing in pairings(3, 4)) for here_m in distance_m]
        assert gospa_of(est, ref)[3] == pytest.approx(np.mean(least_m2), abs=ROUNDING)

    @given(seeds)
    @settings(max_examples=30)
    @pytest.mark.slow
    def test_it_is_a_metric(self, seed):
        four, three = random_flights(seed, missing=0)
        two, _ = random_flights(seed + 1, missing=0, num_estimates=2)

        def distance_m(est, ref):
            return evaluate(est, ref).gospa_m

        assert distance_m(four, three) == pytest.approx(distance_m(three, four), abs=ROUNDING)
        for first, second, third in ((four, three, two), (three, four, two), (four, two, three)):
            detour_m = distance_m(first, second) + distance_m(second, third)
            assert distance_m(first, third) <= detour_m + ROUNDING
        forward, reverse = evaluate(four, three), evaluate(three, four)
        assert forward.gospa_missed_m == pytest.approx(reverse.gospa_false_m, abs=ROUNDING)

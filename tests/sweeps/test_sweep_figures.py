"""The figure of Table 5, whose lines and bars must equal the results; and errors over time."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.errors import SettingsError
from psotrack.evaluation import errors_over_time, evaluate
from psotrack.trajectories import Status, Trajectories

sys.path.append(str(Path(__file__).parents[2] / "experiments" / "table5"))
import _pareto

NUM_FRAMES = 50


def flights():
    """An estimate and a reference of two drones that are 3 m apart.

    The estimate has an error of 20 mm, misses the second drone for ten frames, and swaps the drones from frame 40 on.
    """
    frame = np.arange(NUM_FRAMES)
    ref_m = np.zeros((NUM_FRAMES, 2, 3)) + np.array([[0.0, 0, 1], [3.0, 0, 1]])
    est_m = ref_m + np.array([0.02, 0, 0])
    est_m[40:] = est_m[40:, ::-1]
    status = np.full((NUM_FRAMES, 2), Status.TRACKED)
    status[10:20, 1] = Status.LOST
    estimate = Trajectories(frame, frame / 25, ("0", "1"), est_m, status=status)
    return estimate, Trajectories(frame, frame / 25, ("dron1", "dron2"), ref_m)


class TestErrorsOverTime:
    def test_by_hand(self):
        errors = errors_over_time(*flights())
        assert list(errors) == ["frame", "time_s", "drone", "error_m", "switch"]
        assert list(errors["drone"]) == ["dron1"] * NUM_FRAMES + ["dron2"] * NUM_FRAMES
        assert list(errors["frame"]) == [*range(NUM_FRAMES)] * 2
        np.testing.assert_allclose(errors["time_s"], errors["frame"] / 25)
        np.testing.assert_allclose(errors["error_m"][:40], 0.02)
        # The distance to the other drone, plus or minus 20 mm.
        np.testing.assert_allclose(errors["error_m"][40:50], 3.02)
        np.testing.assert_allclose(errors["error_m"][90:], 2.98)
        assert list(np.flatnonzero(errors["error_m"].isna())) == [*range(60, 70)]
        assert list(np.flatnonzero(errors["switch"])) == [40, 90]

    def test_summaries_equal_those_of_evaluate(self):
        errors, evaluation = errors_over_time(*flights()), evaluate(*flights())
        assert errors["error_m"].mean() == pytest.approx(evaluation.mean_error_m)
        assert errors["error_m"].isna().mean() == pytest.approx(evaluation.missed_rate)
        assert errors["switch"].sum() == evaluation.id_switches

    def test_frames_without_a_reference_have_no_row(self):
        estimate, reference = flights()
        reference.position_m[5:8, 0] = np.nan
        assert len(errors_over_time(estimate, reference)) == 2 * NUM_FRAMES - 3


numbers = st.one_of(st.integers(0, 5).map(float), st.just(float("nan")))


@given(st.lists(st.tuples(numbers, numbers), max_size=12))
def test_no_cell_dominates_a_cell_of_the_front(cells):
    """Compared with a search through all pairs of cells; of equal cells only the first is on the front."""
    work, error = np.array(cells, float).reshape(-1, 2).T

    def dominated(one):
        return any(
            (
                (work[other], error[other]) != (work[one], error[one])
                and work[other] <= work[one]
                and error[other] <= error[one]
            )
            or (other < one and (work[other], error[other]) == (work[one], error[one]))
            for other in range(len(cells))
        )

    expected = [one for one in range(len(cells)) if np.isfinite(cells[one]).all() and not dominated(one)]
    front = _pareto.pareto_front(work, error)
    assert sorted(front) == expected
    assert (np.diff(work[front]) > 0).all()
    assert (np.diff(error[front]) < 0).all()


def rows():
    """Two runs of three cells: errors of 30 and 50 mm of one method, and of 20 mm of the other.

    The work is proportional to particles times iterations.
    """
    table = [
        (sequence, method, particles, iterations, seed, particles * iterations / 100, error_m + 0.001 * seed)
        for sequence in ("S01", "S02")
        for method, particles, iterations, error_m in (
            ("paper", 20, 50, 0.05),
            ("paper", 50, 50, 0.03),
            ("ours", 30, 50, 0.02),
        )
        for seed in (0, 1)
    ]
    names = ("sequence", "method", "settings.swarm.particles", "settings.swarm.iterations", "seed")
    return pd.DataFrame(table, columns=[*names, "track_ms_per_frame", "mean_error_m"])


def lines_of(axes):
    return {line.get_label(): line.get_xydata() for line in axes.lines}


class TestErrorAgainstWork:
    def test_points_front_and_published(self):
        figure = _pareto.error_against_work(rows(), published={"S02": (0.068, 0.068)})
        first, second = figure.axes
        assert [axes.get_title(loc="left") for axes in (first, second)] == ["S01", "S02"]
        # The paper's method with 20 x 50 has the smallest work, ours with 30 x 50 the smallest error.
        np.testing.assert_allclose(lines_of(first)["Pareto front"], [(10, 50.5), (15, 20.5)])
        assert [text.get_text() for text in first.texts] == ["20 x 50", "30 x 50"]
        bars = {container.get_label(): container for container in first.containers}
        np.testing.assert_allclose(bars["paper"].lines[0].get_xydata(), [(10, 50.5), (25, 30.5)])
        np.testing.assert_allclose(bars["ours"].lines[0].get_xydata(), [(15, 20.5)])
        assert [patch.get_label() for patch in second.patches] == ["published"]
        assert not first.patches
        assert first.get_xlabel() == "track stage (ms per frame)"
        assert first.get_ylabel() == "mean error (mm)"

    def test_a_missing_column_is_an_error(self):
        with pytest.raises(SettingsError, match="track_ms_per_frame"):
            _pareto.error_against_work(rows().drop(columns="track_ms_per_frame"))


def test_a_method_has_one_colour_whatever_the_order_of_the_rows():
    """The order was that of digests."""
    (first, _), (second, _) = (_pareto.error_against_work(each).axes for each in (rows(), rows().iloc[::-1]))
    bars = [{of.get_label(): of.lines[0].get_color() for of in axes.containers} for axes in (first, second)]
    assert bars[0] == bars[1]

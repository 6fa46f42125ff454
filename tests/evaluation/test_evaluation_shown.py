"""Offsets of tracked points, and tables and plots of an evaluation: they show its numbers, and fit in a terminal."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clock_worlds import FPS, LATE_S, make_late_videos
from evaluation_flights import NUM_FRAMES, ROUNDING, with_covariance
from evaluation_flights import circling_flights as flights
from helpers import fading, make_once
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from psotrack.evaluation import evaluate, plots, tables
from psotrack.support import drone_colour, standard_error
from psotrack.trajectories import Status, Trajectories

ARM_M = np.array([0.03, -0.02, -0.117])
#: Labels of the reference's drones, with the numbers of their tracks.
LABELS = ["dron0 (track 0)", "dron1 (track 1)", "dron2 (track 2)"]


def turning_flight(num_frames=400):
    """Estimate and reference of a drone that flies and turns; the tracked point is at the end of the lever arm."""
    rng = np.random.default_rng(0)
    frame = np.arange(num_frames)
    time_s = frame / 25
    ref_m = np.stack([np.cos(time_s), np.sin(0.7 * time_s), 1 + 0.2 * np.sin(2 * time_s)], axis=-1)
    angles = np.stack([2 * time_s, 0.1 * np.sin(time_s), 0 * time_s], axis=-1)
    turn = Rotation.from_euler("ZYX", angles)
    est_m = ref_m + turn.apply(ARM_M) + rng.normal(0, 0.02, ref_m.shape)
    ref = Trajectories(frame, time_s, ("dron1",), ref_m[:, None])
    est = Trajectories(frame, time_s, ("0",), est_m[:, None])
    turns_wxyz = turn.as_quat(scalar_first=True)
    return est, replace(ref, orientation_wxyz=turns_wxyz[:, None])


class TestOffsets:
    @pytest.mark.parametrize("persistence", [0.0, 0.5, 0.9])
    def test_the_standard_error_equals_the_spread_of_means(self, persistence):
        """The oracle is the spread of the means of 300 series of 1000 frames."""
        rng = np.random.default_rng(1)
        series = fading(rng.normal(size=(1000, 300)), persistence)
        spread = series.mean(axis=0).std()
        # The spread of 300 means has an error of 4 %; blocks of 50 frames miss 10 % where 19 frames count as one.
        assert np.sqrt((standard_error(series) ** 2).mean()) == pytest.approx(spread, rel=0.15)

    def test_standard_errors_by_hand(self):
        # s² = (0.1² + 0.1²) / (2 - 1), divided by 2: 0.1².
        assert standard_error(np.array([[0.1], [0.3]])) == pytest.approx(0.1)
        # It is not below the standard error of independent frames.
        assert standard_error(np.tile([[1.0], [-1.0]], (50, 1)))[0] == pytest.approx(1 / np.sqrt(99))
        # Rows with NaN are ignored.
        values = np.random.default_rng(2).normal(size=(50, 3))
        with_gaps = np.insert(values, [20, 50], np.nan, axis=0)
        np.testing.assert_allclose(standard_error(with_gaps), standard_error(values), atol=ROUNDING)
        for unknown in (values[:1], np.full((5, 2), np.nan)):
            assert np.isnan(standard_error(unknown)).all()

    def test_in_the_world_frame_the_offset_of_a_turning_drone_is_less_certain(self):
        est, ref = turning_flight()
        evaluation = evaluate(est, ref)
        (body,) = evaluation.per_drone
        (world,) = evaluate(est, replace(ref, orientation_wxyz=None)).per_drone
        assert (body.offset_frame, world.offset_frame) == ("body", "world")
        # The standard error is 20 mm / √400 = 1 mm, estimated from 20 blocks, with an error of √(1/38) = 16 %.
        np.testing.assert_allclose(body.offset_standard_error_m, 1e-3, rtol=0.5)
        assert np.abs(np.subtract(body.offset_m, ARM_M)).max() < 4e-3
        # The horizontal components, 36 mm, turn with the drone, so that their mean over five turns is nearly 0.
        assert world.offset_standard_error_m[0] > 2 * body.offset_standard_error_m[0]
        assert world.offset_m[2] == pytest.approx(ARM_M[2], abs=5e-3)
        largest_mm = 1e3 * max(body.offset_standard_error_m)
        assert f"drone's offset (body frame, known to {largest_mm:.1f} mm)" in tables.as_text(evaluation)


class TestTable:
    def test_rows(self):
        evaluation = evaluate(*flights())
        text = tables.as_text(evaluation, "S02_D4_A")
        lines = text.splitlines()
        assert lines[0].strip() == "S02_D4_A: 50 frames, 3 drones, errors in mm"
        rows = {line[:15].strip(): line[15:].split() for line in lines}
        errors = ["20.0", "20.0", "0.0", "20.0", "20.0"]
        assert rows["dron0 (track 0)"] == [*errors, "0.0%", "0.0", "+20", "+0", "+0"]
        # The third drone is lost in 10 of its 50 frames; of all 150 positions, that is 6.7 %.
        assert rows["dron2 (track 2)"][5] == "20.0%"
        assert rows["all"] == [*errors, "6.7%", "0.0"]
        assert "MOTA 0.933, MOTP 20.0 mm, IDF1 0.966, identity switches 0" in text
        # 0.02 m reaches all thresholds: DetA = 140/150, and AssA is the mean of 100 matches of 1 and 40 of 40/50.
        assert "HOTA      0.938: DetA 0.933, AssA 0.943, LocA 0.960" in text
        # Mean squares: 2.8 drones with 400 mm2 each, and 0.2 missed drones with 125,000 mm2 each.
        assert "GOSPA     162 mm: localisation 33.5, missed 158, false 0.0" in text
        assert "RMSE      ATE 20.0 mm (0.0 aligned), RPE over 1 s 0.0 mm" in text
        assert "ellipsoid" not in text
        assert repr(evaluation).startswith("Evaluation(mean error 20.0 mm, missed 6.7%, MOTA 0.933, ")
        assert str(evaluation) == tables.as_text(evaluation)

    def test_covariances_orientations_and_a_missed_drone(self):
        est, ref = flights()
        est.status[:, 2] = Status.LOST
        orientation_wxyz = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (NUM_FRAMES, 3, 4))
        est, ref = (replace(flight, orientation_wxyz=orientation_wxyz) for flight in (est, ref))
        text = tables.as_text(evaluate(with_covariance(est, 1e-4 * np.eye(3)), ref))
        # The error of 20 mm is two standard deviations of 10 mm, so NEES is 4; without the offset, NEES is 0.
        assert "ellipsoid of 90 % holds 100.0% (100.0% centred), mean NEES 4 (" in text
        assert "RPE over 1 s 0.0 mm and 0.00 deg" in text
        row = next(line for line in text.splitlines() if line.startswith("dron2"))
        assert row.split() == ["dron2", "-", "-", "-", "-", "-", "100.0%", "-", "-"]

    def test_ten_drones_with_large_errors_fit_into_eighty_columns(self):
        est, ref = flights(10, swap=True, names=tuple(f"[red]d_{number}" for number in range(10)))
        est.position_m[30:, :5] += 3.0
        lines = tables.as_text(evaluate(with_covariance(est, 1e-8 * np.eye(3)), ref), "S04_D10").splitlines()
        assert max(map(len, lines)) <= 80
        # No name is cut off, and no part of a name is interpreted as a style.
        assert [line.split()[0] for line in lines if "d_" in line] == [f"[red]d_{n}" for n in range(10)]
        assert not any("…" in line for line in lines)
        # No line of the scores is folded.
        scores = lines[next(n for n, line in enumerate(lines) if line.startswith("all")) + 1 :]
        first_words = [line[:10].strip() for line in scores]
        assert first_words == ["CLEAR", "", "HOTA", "GOSPA", "RMSE", "ellipsoid", "centred"]

    def test_large_errors_are_shown_in_metres(self):
        est, ref = flights()
        est.position_m[:, :, 2] += 4.0
        lines = tables.as_text(evaluate(est, ref)).splitlines()
        assert lines[0].strip() == "50 frames, 3 drones, errors in m"
        row = next(line for line in lines if line.startswith("dron0")).split()
        assert (row[3], row[-3:]) == ("4.00", ["+0.0", "+0.0", "+4.0"])

    def test_tracks_of_the_first_frames_are_said_to_end_early(self, caplog):
        """Found: "missed 84 %" without a word after `track --frames 40`."""
        est, ref = flights()
        evaluate(est.at_frames(np.arange(48)), ref)
        assert not caplog.messages
        assert evaluate(est.at_frames(np.arange(8)), ref).missed_rate == pytest.approx(0.84)
        (line,) = caplog.messages
        assert "end with frame 7, the reference with frame 49" in line
        assert "missed in the last 84 % of the frames" in line

    def test_tracks_in_millimetres_are_suspected(self, caplog):
        est, ref = flights()
        evaluate(replace(est, position_m=5 + est.position_m), ref)
        assert not caplog.messages
        evaluate(replace(est, position_m=1e3 * est.position_m), ref)
        assert "near the reference as millimetres" in caplog.text


@pytest.fixture
def drawn(monkeypatch):
    """Axes of the overview of an estimate and its reference: both views, and the errors."""

    def draw_overview(est, ref):
        figure = Figure()
        monkeypatch.setattr(plots, "save_figure", lambda path, size, draw, force: draw(figure))
        plots.save_overview("overview.png", est, ref)
        return figure.axes

    return draw_overview


class TestPictures:
    def test_views_of_one_scale_and_errors_with_gaps_where_a_drone_is_missed(self, drawn):
        est, ref = flights()
        above, side, errors = drawn(est, ref)
        for axes, two in ((above, [0, 1]), (side, [0, 2])):
            np.testing.assert_array_equal(axes.lines[0].get_xydata(), ref.position_m[:, 0, two])
            np.testing.assert_array_equal(axes.lines[3].get_xydata(), est.position_m[:, 0, two])
            for drone in range(3):
                assert axes.lines[3 + drone].get_color() == drone_colour(drone)
            assert axes.get_aspect() == 1
        assert above.get_xlim() == side.get_xlim()
        expected_mm = np.full(NUM_FRAMES, 20.0)
        expected_mm[10:20] = np.nan
        np.testing.assert_allclose(errors.lines[2].get_ydata(), expected_mm, rtol=1e-12)
        assert [text.get_text() for text in above.get_legend().get_texts()] == ["reference", *LABELS]
        assert errors.get_yscale() == "linear"

    def test_a_swap_is_marked_and_makes_the_scale_logarithmic(self, drawn):
        _, _, errors = drawn(*flights(swap=True))
        (mark,) = errors.lines[3:]
        assert list(mark.get_xdata()) == [40 / 25, 40 / 25]
        assert errors.get_yscale() == "log"

    def test_lines_have_gaps_at_frames_without_reference_and_a_false_track_is_named(self, drawn):
        est, ref = flights()
        ref.position_m[25:30] = np.nan
        all_axes = drawn(est, ref.of_drones([0, 1]))
        for axes in all_axes:
            # A line has 45 frames with a reference, and one NaN for the gap.
            line = axes.lines[0].get_ydata()
            assert len(line) == 46
            assert np.flatnonzero(np.isnan(line)).tolist() == [25]
        assert all_axes[0].get_legend().get_texts()[-1].get_text() == "false track 2"


def test_the_clock_of_the_reference_is_searched_or_given(run_psotrack, tmp_path_factory):
    root = make_once(tmp_path_factory, "late_videos", make_late_videos)
    words = ("evaluate", root / "tracks.csv", root / "Real_Data" / "R12_D2", "--json", "-")
    late = json.loads(run_psotrack(*words).out)
    auto = json.loads(run_psotrack(*words, "--offset", "auto").out)
    given = json.loads(run_psotrack(*words, "--offset", LATE_S).out)
    assert "reference_offset_s" not in late
    assert given["reference_offset_s"] == LATE_S
    assert auto["reference_offset_s"] == pytest.approx(LATE_S, abs=0.1 / FPS)
    # Drones at about 1 m/s fly 0.4 m in this time. The tracks have a noise of 1 cm along each axis.
    assert late["offset_removed_mean_error_m"] > 0.2
    for errors in (auto, given):
        assert (errors["id_switches"], errors["missed_rate"]) == (0, 0.0)
        assert errors["offset_removed_mean_error_m"] < 0.02
    refused = run_psotrack(*words, "--offset", "soon")
    assert "expected a number of seconds, or auto, found 'soon'" in refused.err


def test_importing_loads_neither_pandas_nor_matplotlib_and_drawing_no_pyplot(tmp_path):
    """In a process of its own, because other tests may have imported them. Pyplot has global state."""
    picture = tmp_path / "picture.png"
    code = (
        "import sys; from psotrack.evaluation import plots, tables; import psotrack.trajectories.files;"
        "assert not {'matplotlib', 'pandas', 'pyarrow'} & set(sys.modules), set(sys.modules);"
        "import evaluation_flights as flights;"
        f"plots.save_overview({str(picture)!r}, *flights.circling_flights());"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
    assert picture.read_bytes().startswith(b"\x89PNG")

"""Tables and plots of an evaluation: they show the evaluation's numbers, and tables fit in a terminal."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from psotrack.errors import InputError
from psotrack.evaluation import evaluate, plots, tables
from psotrack.trajectories import Status, Trajectories

NUM_FRAMES = 50
#: Labels of the reference's drones, with the numbers of their tracks.
LABELS = ["dron0 (track 0)", "dron1 (track 1)", "dron2 (track 2)"]


def flights(num_drones: int = 3, *, swap: bool = False, names: tuple[str, ...] = ()):
    """Estimate and reference of drones on circles.

    The estimate has an offset of 20 mm, and drone 2 is lost in frames 10 to 19. With `swap`, the first two tracks are
    exchanged from frame 40 on.
    """
    frame = np.arange(NUM_FRAMES)
    angle = frame[:, None] / 10 + np.arange(num_drones)
    ref_m = np.stack([np.cos(angle) + 2 * np.arange(num_drones), np.sin(angle), 1 + 0 * angle], axis=-1)
    est_m = ref_m + np.array([0.02, 0, 0])
    if swap:
        est_m[40:, [0, 1]] = est_m[40:, [1, 0]]
    status = np.full((NUM_FRAMES, num_drones), Status.TRACKED)
    status[10:20, 2] = Status.LOST
    numbers = tuple(str(number) for number in range(num_drones))
    return (
        Trajectories(frame, frame / 25, numbers, est_m, status=status),
        Trajectories(frame, frame / 25, names or tuple(f"dron{number}" for number in numbers), ref_m),
    )


class TestTable:
    def test_rows(self):
        lines = tables.as_text(evaluate(*flights()), "S02_D4_A").splitlines()
        assert lines[0].strip() == "S02_D4_A: 50 frames, 3 drones, errors in mm"
        rows = {line[:15].strip(): line[15:].split() for line in lines}
        assert rows["dron0 (track 0)"] == [
            "20.0",
            "20.0",
            "0.0",
            "20.0",
            "20.0",
            "0.0%",
            "0.0",
            "+20",
            "+0",
            "+0",
        ]
        # The third drone is lost in 10 of its 50 frames; of all 150 positions, that is 6.7 %.
        assert rows["dron2 (track 2)"][5] == "20.0%"
        assert rows["all"] == ["20.0", "20.0", "0.0", "20.0", "20.0", "6.7%", "0.0"]
        text = "\n".join(lines)
        assert "MOTA 0.933, MOTP 20.0 mm, IDF1 0.966, identity switches 0" in text
        # 0.02 m reaches all thresholds: DetA = 140/150, and AssA is the mean of 100 matches of 1 and 40 of 40/50.
        assert "HOTA      0.938: DetA 0.933, AssA 0.943, LocA 0.960" in text
        # Mean squares: 2.8 drones with 400 mm2 each, and 0.2 missed drones with 125,000 mm2 each.
        assert "GOSPA     162 mm: localisation 33.5, missed 158, false 0.0" in text
        assert "RMSE      ATE 20.0 mm (0.0 aligned), RPE over 1 s 0.0 mm" in text
        assert "ellipsoid" not in text
        assert "world frame" in text

    def test_covariances(self):
        est, ref = flights()
        covariance_m2 = np.broadcast_to(1e-4 * np.eye(3), (NUM_FRAMES, 3, 3, 3))
        lines = tables.as_text(evaluate(replace(est, covariance_m2=covariance_m2), ref)).splitlines()
        # The error of 20 mm is two standard deviations of 10 mm, so NEES is 4; without the offset, NEES is 0.
        row = "ellipsoid of 90 % holds 100.0% (100.0% centred), mean NEES 4 ("
        assert any(line.startswith(row) for line in lines)

    def test_orientations(self):
        est, ref = flights()
        orientation_wxyz = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (NUM_FRAMES, 3, 4))
        both = (replace(flight, orientation_wxyz=orientation_wxyz) for flight in (est, ref))
        text = tables.as_text(evaluate(*both))
        assert "RPE over 1 s 0.0 mm and 0.00 deg" in text

    def test_ten_drones_with_large_errors_fit_into_eighty_columns(self):
        est, ref = flights(10, swap=True, names=tuple(f"[red]d_{number}" for number in range(10)))
        est.position_m[30:, :5] += 3.0
        covariance_m2 = np.broadcast_to(1e-8 * np.eye(3), (NUM_FRAMES, 10, 3, 3))
        est = replace(est, covariance_m2=covariance_m2)
        lines = tables.as_text(evaluate(est, ref), "S04_D10").splitlines()
        assert max(map(len, lines)) <= 80
        # No name is cut off, and no part of a name is interpreted as a style.
        assert [line.split()[0] for line in lines if "d_" in line] == [f"[red]d_{n}" for n in range(10)]
        assert sum("…" in line for line in lines) == 0
        # No line of the scores is folded.
        scores = lines[next(n for n, line in enumerate(lines) if line.startswith("all")) + 1 :]
        first_words = [line[:10].strip() for line in scores]
        assert first_words == ["CLEAR", "", "HOTA", "GOSPA", "RMSE", "ellipsoid", "centred"]

    def test_long_names_are_folded_and_not_cut(self):
        names = tuple(f"interceptor_of_the_left_hand_side_{number}" for number in range(3))
        est, ref = flights(names=names)
        est.position_m[:, 1] = np.nan
        lines = tables.as_text(evaluate(est, ref)).splitlines()
        assert max(map(len, lines)) <= 80
        assert not any("…" in line for line in lines)
        width = lines[1].index("mean") - 2
        shown = "".join(line[:width].replace(" ", "") for line in lines)
        assert all(name in shown for name in names)

    def test_large_errors_are_shown_in_metres(self):
        est, ref = flights()
        est.position_m[:, :, 2] += 4.0
        lines = tables.as_text(evaluate(est, ref)).splitlines()
        assert lines[0].strip() == "50 frames, 3 drones, errors in m"
        row = next(line for line in lines if line.startswith("dron0")).split()
        assert (row[3], row[-3:]) == ("4.00", ["+0.0", "+0.0", "+4.0"])

    def test_a_missed_drone(self):
        est, ref = flights()
        est.status[:, 2] = Status.LOST
        lines = tables.as_text(evaluate(est, ref)).splitlines()
        row = next(line for line in lines if line.startswith("dron2"))
        assert row.split() == ["dron2", "-", "-", "-", "-", "-", "100.0%", "-", "-"]

    def test_text_begins_with_the_mean_error_and_prints_the_table(self):
        evaluation = evaluate(*flights())
        assert repr(evaluation).startswith("Evaluation(mean error 20.0 mm, missed 6.7%, MOTA 0.933, ")
        assert str(evaluation).splitlines()[0].strip() == "50 frames, 3 drones, errors in mm"
        assert str(evaluation) == tables.as_text(evaluation)
        assert next(iter(evaluation.to_dict())) == "mean_error_m"

    def test_tracks_of_the_first_frames_are_said_to_end_early(self, caplog):
        """Found: "missed 84 %" without a word after `track --frames 40`."""
        est, ref = flights()
        evaluate(est.at_frames(np.arange(48)), ref)
        assert not caplog.messages
        assert evaluate(est.at_frames(np.arange(8)), ref).missed_rate == pytest.approx(0.84)
        (line,) = caplog.messages
        assert "end with frame 7, the reference with frame 49" in line
        assert "missed in the last 84 % of the frames" in line


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
    def test_errors_in_millimetres_have_gaps_where_a_drone_is_missed(self, drawn):
        above, _, errors = drawn(*flights())
        expected_mm = np.full(NUM_FRAMES, 20.0)
        expected_mm[10:20] = np.nan
        np.testing.assert_allclose(errors.lines[2].get_ydata(), expected_mm, rtol=1e-12)
        assert [text.get_text() for text in above.get_legend().get_texts()] == ["reference", *LABELS]
        assert errors.get_yscale() == "linear"

    def test_a_swap_is_marked_and_makes_the_scale_logarithmic(self, drawn):
        errors = drawn(*flights(swap=True))[2]
        assert [list(mark.get_xdata()) for mark in errors.lines[3:]] == [[40 / 25] * 2]
        assert errors.get_yscale() == "log"

    def test_lines_have_gaps_at_frames_without_reference(self, drawn):
        est, ref = flights()
        ref.position_m[25:30] = np.nan
        for axes in drawn(est, ref):
            # A line has 45 frames with a reference, and one NaN for the gap.
            assert len(axes.lines[0].get_ydata()) == 46
            assert np.flatnonzero(np.isnan(axes.lines[0].get_ydata())).tolist() == [25]

    def test_views_have_one_scale(self, drawn):
        est, ref = flights()
        above, side, _ = drawn(est, ref)
        for axes, two in ((above, [0, 1]), (side, [0, 2])):
            np.testing.assert_array_equal(axes.lines[0].get_xydata(), ref.position_m[:, 0, two])
            np.testing.assert_array_equal(axes.lines[3].get_xydata(), est.position_m[:, 0, two])
            assert axes.get_aspect() == 1
        assert above.get_xlim() == side.get_xlim()

    def test_a_false_track_is_named(self, drawn):
        est, ref = flights()
        two = Trajectories(ref.frame, ref.time_s, ref.drones[:2], ref.position_m[:, :2])
        assert drawn(est, two)[0].get_legend().get_texts()[-1].get_text() == "false track 2"

    def test_a_png_file_has_the_colour_of_each_drone(self, tmp_path):
        path = tmp_path / "picture.png"
        est, ref = flights()
        # Each drone has a different error, so that no line hides another.
        est.position_m[..., 1] += [0.0, 0.03, 0.06]
        plots.save_overview(path, est, ref)
        rgb = cv2.imread(str(path))[..., ::-1].reshape(-1, 3).astype(int)
        for drone in range(3):
            colour = np.round(np.array(to_rgb(plots.drone_colour(drone))) * 255)
            # Lines are a few hundred pixels long; a line behind the line of its reference still has visible edges.
            assert (np.abs(rgb - colour).max(axis=1) <= 2).sum() > 100

    def test_recordings_without_common_frames_leave_no_file(self, tmp_path):
        est, ref = flights()
        later = Trajectories(ref.frame + 1000, ref.time_s, ref.drones, ref.position_m)
        with pytest.raises(InputError, match="frames of the reference"):
            plots.save_overview(tmp_path / "picture.png", est, later)
        assert not list(tmp_path.iterdir())


def test_importing_loads_neither_pandas_nor_matplotlib(tmp_path):
    """Drawing does not load pyplot either, which has global state."""
    code = (
        "import sys; from psotrack.evaluation import plots, tables; import psotrack.trajectories.files;"
        "assert not {'matplotlib', 'pandas', 'pyarrow'} & set(sys.modules), set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    # A separate process is needed, because other tests may have imported pyplot.
    code = (
        "import sys, test_evaluation_shown as shown;"
        f"shown.plots.save_overview({str(tmp_path / 'picture.png')!r}, *shown.flights());"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])

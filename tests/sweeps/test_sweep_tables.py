"""Tables: figures equal those of the standard library; layouts equal texts written by hand."""

import csv
import io
import itertools
import logging
import math
import statistics

import pandas as pd
import pytest
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.sweeps import pivot, render_table

#: Two methods at two swarm sizes, three runs each; errors in metres.
ERRORS_M = {
    ("paper", 20): [0.070, 0.074, 0.072],
    ("paper", 100): [0.040, 0.042, 0.041],
    ("ours", 20): [0.010, 0.012, 0.011],
    ("ours", 100): [0.0050, 0.0070, 0.0060],
}
FIGURES = "mean_error_mm: mean ± standard deviation over 3 runs"


def results(errors_m=ERRORS_M, **more):
    names = ("sequence", "method", "settings.swarm.particles", "settings.seed", "mean_error_m")
    table = []
    for (method, particles), runs in errors_m.items():
        for seed, error_m in enumerate(runs):
            table.append(("S01_D2_A", method, particles, seed, error_m))
    return pd.DataFrame(table, columns=names).assign(**more)


def in_mm(rows, rows_by=("method",), columns_by=("particles",)):
    return pivot(rows, rows_by=list(rows_by), columns_by=list(columns_by), value="mean_error_m", scale=1000.0)


def labels(rows, name, value="v"):
    return list(pivot(rows, rows_by=[name], columns_by=[], value=value).index)


def test_figures_equal_the_standard_librarys():
    table = in_mm(results())
    assert table.attrs["value"] == "mean_error_mm"
    for (method, particles), runs in ERRORS_M.items():
        found = table.loc[method, particles]
        assert found["mean"] == pytest.approx(1000 * statistics.mean(runs), rel=1e-12)
        assert found["std"] == pytest.approx(1000 * statistics.stdev(runs), rel=1e-12)
        assert found["runs"] == 3
    assert list(table.index) == ["ours", "paper"]
    assert list(table.columns.names) == ["particles", "figure"]


def test_labels_are_numbers_and_words_in_their_order_lists_and_what_is_missing():
    rows = pd.DataFrame({"cameras": ["all", "10", "4", "cam10", "cam2"], "n": [100, 20, 3, 1, 2], "v": 1.0})
    assert labels(rows, "n") == [1, 2, 3, 20, 100]
    assert labels(rows, "cameras") == ["4", "10", "all", "cam2", "cam10"]
    windows = pd.DataFrame({"settings.windows": [(0.5, 1.0), (1.0,), None], "v": [1, 2, 3]})
    assert labels(windows, "windows") == ["0.5 1", "1", "-"]
    missing = pd.DataFrame({"frames": [100.0, None], "v": [1, 2]})
    assert labels(missing, "frames") == [100, "-"]
    # A column with the exact name is preferred.
    two_columns = pd.DataFrame({"frames": [1], "settings.frames": [2], "v": [3]})
    assert labels(two_columns, "frames") == [1]


def test_failed_runs_do_not_count_and_a_single_run_has_no_spread():
    table = in_mm(results({("paper", 20): [0.070, None, 0.074], ("paper", 100): [None, None]}))
    assert table.loc["paper", (20, "mean")] == pytest.approx(72.0)
    assert table.loc["paper", (20, "runs")] == 2
    assert math.isnan(table.loc["paper", (100, "mean")])
    assert render_table(table).splitlines()[-1].split() == ["paper", "72.0", "±", "2.8", "-"]
    rows = results({("paper", 20): [0.07], ("ours", 100): [0.04]}, sequence=["S01", "S02"])
    by_sequence = in_mm(rows, ("sequence",), ("method", "particles"))
    assert by_sequence.loc["S02", ("paper", 20, "runs")] == 0
    single = in_mm(results({("paper", 20): [0.0712], ("paper", 100): [0.0412]}))
    assert render_table(single) == "mean_error_mm\n\nparticles    20   100\nmethod\npaper      71.2  41.2\n"


#: An argument of the call, its wrong value, and words of the line.
BAD = [
    ("value", "mean_eror_m", "found mean_eror_m; did you mean mean_error_m?"),
    ("value", "mean", "found mean; did you mean mean_error_m?"),
    ("value", "median", "found median; it may be median_a_m or median_b_m"),
    ("value", "zzz", "found zzz; there are sequence, method, settings.swarm.particles, "),
    ("value", "sequence", "value: expected a column of numbers, found sequence"),
    ("rows_by", [], "rows: expected at least one column, and each only once, found none"),
    ("rows_by", ["particles"], "found settings.swarm.particles twice"),
]


@pytest.mark.parametrize(("argument", "value", "words"), BAD)
def test_wrong_columns_are_one_line(argument, value, words, tmp_path):
    rows = results(median_a_m=1.0, median_b_m=1.0)
    names = {"rows_by": ["method"], "columns_by": ["settings.swarm.particles"], "value": "mean_error_m"}
    names[argument] = value
    assert_refused(lambda: pivot(rows, **names), words, unchanged=tmp_path)


def test_a_warning_names_what_a_figure_mixes_besides_draws(caplog):
    said = "figures are not only over runs: they mix different"
    rows = results()
    rows["perturbation.draw"] = rows["settings.seed"]
    with caplog.at_level(logging.WARNING):
        in_mm(rows)
        assert caplog.messages == []
        in_mm(rows, columns_by=())
        rows["code"] = rows["settings.seed"].map({0: "a", 1: "b", 2: "b"})
        in_mm(rows)
    assert caplog.messages == [f"{said} settings.swarm.particles", f"{said} code"]


# --- layouts


def test_text():
    table = in_mm(results(), ("sequence", "method"))
    assert render_table(table) == (
        f"{FIGURES}\n"
        "\n"
        "particles                20         100\n"
        "sequence method\n"
        "S01_D2_A ours    11.0 ± 1.0   6.0 ± 1.0\n"
        "         paper   72.0 ± 2.0  41.0 ± 1.0\n"
    )
    assert "72 ± 2" in render_table(table, decimals=0)
    assert "72.000 ± 2.000" in render_table(table, decimals=3)
    # Whole numbers have no decimals.
    rows = pd.DataFrame({"a": [1], "switches": [12]})
    text = render_table(pivot(rows, rows_by=["a"], columns_by=[], value="switches"))
    assert text.splitlines()[-1].split() == ["1", "12"]


@settings(max_examples=12)
@given(outer=st.integers(1, 3), inner=st.integers(1, 12), magnitude=st.sampled_from([1e-4, 1.0, 1e3]))
def test_text_is_at_most_80_characters_wide_and_complete(outer, inner, magnitude):
    """For any number of columns, no line is wider than 80, and every figure is printed once per row."""
    table = itertools.product(["S0", "S1"], range(outer), range(inner), [99, 101])
    rows = pd.DataFrame(table, columns=["sequence", "outer", "inner", "v"])
    rows["v"] = magnitude * (rows["v"] + 10 * rows["outer"] + rows["inner"])
    text = render_table(pivot(rows, rows_by=["sequence"], columns_by=["outer", "inner"], value="v"))
    for line in text.splitlines():
        assert len(line) <= 80
    assert text.count("±") == 1 + 2 * outer * inner
    # Where columns are continued, the outer level's labels are repeated.
    for block in text.split("\n\n")[1:]:
        name, *labels = block.splitlines()[0].split()
        assert name == "outer"
        assert labels


def test_markdown():
    rows = results(sequence="S|1*")
    assert render_table(in_mm(rows, ("sequence",), ("method", "particles")), "markdown") == (
        f"{FIGURES}\n"
        "\n"
        "| sequence | method ours, particles 20 | method ours, particles 100 |"
        " method paper, particles 20 | method paper, particles 100 |\n"
        "| --- | ---: | ---: | ---: | ---: |\n"
        "| S\\|1\\* | 11.0 ± 1.0 | 6.0 ± 1.0 | 72.0 ± 2.0 | 41.0 ± 1.0 |\n"
    )


def test_latex():
    table = in_mm(results(), ("sequence",), ("method", "particles"))
    assert render_table(table, "latex") == (
        f"% {FIGURES}; \\usepackage{{booktabs}}\n"
        "\\begin{tabular}{lrrrr}\n"
        "\\toprule\n"
        "method & \\multicolumn{2}{c}{ours} & \\multicolumn{2}{c}{paper} \\\\\n"
        "particles & 20 & 100 & 20 & 100 \\\\\n"
        "sequence &  &  &  &  \\\\\n"
        "\\midrule\n"
        "S01\\_D2\\_A & $11.0 \\pm 1.0$ & $6.0 \\pm 1.0$ & $72.0 \\pm 2.0$ & $41.0 \\pm 1.0$ \\\\\n"
        "\\bottomrule\n"
        "\\end{tabular}\n"
    )
    rows = pd.DataFrame({"name": [r"a\b~c^d&%$#_{}"], "v": [math.nan]})
    text = render_table(pivot(rows, rows_by=["name"], columns_by=[], value="v"), "latex")
    assert (
        text.splitlines()[-3] == r"a\textbackslash b\textasciitilde c\textasciicircum d\&\%\$\#\_\{\} & -- \\"
    )


def test_csv_has_all_digits():
    table = in_mm(results({("a, b", 20): [0.1, 0.2], ("a, b", 100): [1 / 3]}))
    (row,) = csv.DictReader(io.StringIO(render_table(table, "csv")))
    assert row["method"] == "a, b"
    assert float(row["particles 20 mean"]) == table.iloc[0, 0]
    assert float(row["particles 20 std"]) == table.iloc[0, 1]
    assert row["particles 20 runs"] == "2"
    assert float(row["particles 100 mean"]) == table.iloc[0, 3]
    assert row["particles 100 std"] == ""
    assert row["particles 100 runs"] == "1"

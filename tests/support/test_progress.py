"""Progress where there is no terminal: lines now and then, and one tidy output per stage in a notebook."""

import io
import sys

import nbformat
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nbclient import NotebookClient

from psotrack.pipeline import speed_in_words
from psotrack.support import joined, no_progress, progress_bar, progress_lines, terminal_bar


def lines_of(steps, total, long_s=0.0):
    """Lines about a stage whose steps take some seconds each."""
    written = []
    now_s = 0.0
    with progress_lines(written.append, long_s=long_s, clock=lambda: now_s)("track", total) as advance:
        for seconds, count in steps:
            now_s += seconds
            advance(count)
    return written


def test_lines_of_a_stage_of_two_minutes():
    assert lines_of([(1.0, 5)] * 120, 600) == [
        "track: 100 of 600 (17%), 20 s",
        "track: 200 of 600 (33%), 40 s, about 80 s left",
        "track: 300 of 600 (50%), 60 s, about 60 s left",
        "track: 400 of 600 (67%), 80 s, about 40 s left",
        "track: 500 of 600 (83%), 2 min, about 20 s left",
        "track: 600 of 600 in 2 min",
    ]


def test_the_rest_is_not_as_slow_as_a_step_that_waited_for_a_compilation():
    """Found: "about 13 h 57 min left", and the end a minute later."""
    assert lines_of([(80.0, 25)] + [(1.0, 1)] * 50, 75) == [
        "track: 25 of 75 (33%), 80 s",
        "track: 45 of 75 (60%), 2 min, about 30 s left",
        "track: 65 of 75 (87%), 2 min, about 10 s left",
        "track: 75 of 75 in 2 min",
    ]


@given(seconds=st.lists(st.floats(0, 50), min_size=1, max_size=60), long_s=st.sampled_from([0.0, 20.0]))
def test_few_lines_and_none_about_short_stages(seconds, long_s):
    lines = lines_of([(each, 1) for each in seconds], len(seconds), long_s)
    if sum(seconds) < long_s:
        assert lines == []
    else:
        # Ten tenths, the first line, and one per five minutes, or at the end of a step that is longer.
        assert max(1, sum(seconds) // 350) <= len(lines) <= 12 + sum(seconds) // 300
        assert lines[-1].startswith(f"track: {len(seconds)} of {len(seconds)} in ")


def test_a_stage_that_an_error_ends_says_so_and_joined_reports_count_the_same_steps():
    written = [], []
    report = joined(*(progress_lines(each.append, clock=lambda: 0.0) for each in written), no_progress)

    def work():
        with report("track", 10) as advance:
            advance(1)
            advance(3)
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        work()
    assert written == (["track: 4 of 10, stopped after 0.0 s"],) * 2


def test_lines_go_to_stderr_and_short_work_is_quiet(capfd, monkeypatch):
    for report in (no_progress, progress_bar):
        with report("track", 2) as advance:
            advance(2)
        assert capfd.readouterr() == ("", "")
    with progress_lines()("track", 2) as advance:
        advance(2)
    assert capfd.readouterr() == ("", "psotrack: track: 2 of 2 in 0.0 s\n")
    # A bar in any case.
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with terminal_bar("track", 7) as advance:
        advance(7)
    assert "7/7" in stream.getvalue()


def test_a_speed_in_words():
    assert speed_in_words(0.0077) == "130 times slower than the video"
    assert speed_in_words(0.99) == "as fast as the video"


@pytest.mark.nightly
# The kernel of Jupyter leaves sockets to the garbage collector.
@pytest.mark.filterwarnings("ignore")
def test_a_saved_notebook_has_one_output_per_stage():
    source = """
import time
from psotrack.support import progress_bar
with progress_bar("silhouettes", 300) as advance:
    for _ in range(300):
        time.sleep(0.003)  # the bar is drawn again several times
        advance(1)
with progress_bar("<b>track", 0) as advance:
    advance(7)
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    NotebookClient(notebook, kernel_name="python3", timeout=120).execute()
    outputs = notebook.cells[0].outputs
    texts = [output["data"]["text/plain"] for output in outputs]
    assert [text.rpartition(" in ")[0] for text in texts] == ["silhouettes: 300 of 300", "<b>track: 7"]

"""`psotrack run`: from the videos of a rig to a report, and on from where it was stopped."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from worlds import NUM_FRAMES, REFERENCE, make_sequence

import psotrack as pt
from psotrack.recordings import VideoWriter
from psotrack.show.flights import find_recording


def commands_in(output):
    """The commands that a run says that it runs."""
    return [line.split()[2] for line in output.out.splitlines() if line.startswith("$ psotrack ")]


def test_a_rig_without_a_board_is_said_also_the_second_time(run_psotrack, tmp_path):
    """The first run drafts a recording without places; the second one does not take it for calibrated."""
    for name in ("left.avi", "right.avi"):
        with VideoWriter(tmp_path / name, 25.0, (64, 48)) as video:
            video.write(np.zeros((48, 64, 3), np.uint8))
    for _ in range(2):
        stopped = run_psotrack("run", tmp_path)
        assert (stopped.code, stopped.err.count("\n")) == (2, 1)
        expected = f"expected videos of a board in {tmp_path / 'board'}, or a rig file, found neither"
        assert expected in stopped.err
    (tmp_path / "board").mkdir()
    assert "--square: expected the side of a square" in run_psotrack("run", tmp_path).err
    assert "expected a video of each camera" in run_psotrack("run", tmp_path / "board").err


@pytest.mark.slow
def test_videos_and_a_rig_file_become_a_report(run_psotrack, tmp_path):
    lab = make_sequence(tmp_path / "lab")
    for made in ("recording.toml", *(f"{name}.csv" for name in REFERENCE)):
        (lab / made).unlink()
    done = run_psotrack("run", lab).ended()
    assert commands_in(done) == ["init", "doctor", "track", "report", "overlay"]
    assert "3 videos" in done.out
    results = lab / "results"
    summary = done.out[done.out.rindex("\nlab\n") :]
    # How many of the flat drones are found in half a second is a matter of the tracker.
    drones = pd.read_csv(results / "tracks.csv")["drone"].nunique()
    assert drones
    for line in (
        f"drones      {drones}",
        f"frames      {NUM_FRAMES}, in 0.5 s",
        "doctor",
        "clocks",
        "report.html",
    ):
        assert line in summary
    assert find_recording(results / "tracks.csv").resolve() == lab.resolve()
    # A step whose result is gone is done again with those after it, the others are not.
    before = (results / "tracks.csv").stat().st_mtime_ns
    (results / "report.html").unlink()
    again = run_psotrack("run", lab)
    assert commands_in(again) == ["report", "overlay"]
    # The summary comes also where nothing was left to do, and is the same in Python.
    said = []
    found = pt.run(lab, say=said.append, progress=False)
    assert [line.split()[2] for line in said if line.startswith("$")] == ["overlay"]
    assert str(found) in again.out
    assert found.to_dict()["drones"] == drones
    assert (results / "tracks.csv").stat().st_mtime_ns == before
    assert "tracked in  not recorded" in str(replace(found, record={}))


@pytest.mark.nightly
def test_videos_and_a_board_become_a_report(run_psotrack, tmp_path):
    lab = tmp_path / "lab"
    options = ("--as-own-cameras", "--frames", 50, "--scale", 0.5, "--out", lab, "--quiet")
    assert run_psotrack("simulate", "S02_D4_A", *options).code == 0
    done = run_psotrack("run", lab, "--square", 0.25, "--floor", 0).ended()
    assert "the board is a ChArUco board of 4 x 5 squares of 250 mm" in done.out
    assert commands_in(done) == ["calibrate", "init", "doctor", "track", "report", "overlay"]
    assert "drones      4" in done.out

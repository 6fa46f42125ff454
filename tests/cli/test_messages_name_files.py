"""A command that finds fault with the content of a file names the file, also where several files meet."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import worlds
from helpers import make_once
from test_bad_input_limits import check_line

ROW = "frame,time_s,drone,x_m,y_m,z_m\n"
POINTS = "camera,frame,x_px,y_px\n"


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return make_once(tmp_path_factory, "limits", worlds.make_sequence)


@pytest.fixture
def files(flight, tmp_path, monkeypatch):
    """A folder of files that can be read, and that fit nothing."""
    monkeypatch.chdir(tmp_path)
    texts = {
        "unseen.csv": f"{ROW}0,0,a,,,\n1,0.04,a,,,\n",
        "late.csv": f"{ROW}5000,5000,a,0,0,1\n5001,5001,a,0,0,1\n",
        "one.csv": f"{ROW}0,0,a,0,0,1\n",
        "apart.csv": f"{POINTS}c0,0,1,1\nc1,5,2,2\n",
        "alone.csv": f"{POINTS}c0,0,1,1\n",
        "ends.csv": f"{POINTS[:-1]},point\nc0,0,1,1,1\nc1,5,2,2,1\n",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for number in range(3):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((48, 64), 128, np.uint8))
    cameras = "".join(
        f'[cameras.{name}]\nvideo = "{flight / name}.avi"\ntime_offset_s = {{}}\n' for name in ("c0", "c1")
    )
    for name, offset_s in (("early", -1000.0), ("far", 1e9)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "recording.toml").write_text(
            f'version = 1\ncalibration = "{flight / "rig.toml"}"\n{cameras.format(offset_s, offset_s + 1)}'
        )
    return tmp_path


BOARD = ("--squares", "10x7", "--square", "0.025", "--out", "out.toml")
BY_POINT = ("--points", "--lenses", "{flight}/rig.toml", "--out", "out.toml")


def test_a_setting_of_a_config_names_the_file_and_a_typed_one_does_not(files, flight, run_psotrack):
    (files / "run.toml").write_text("swarm.particles = -5\n")
    words = ("track", flight, "--config", "run.toml", "--out", "out.csv")
    check_line(run_psotrack(*words), "run.toml, swarm.particles: expected", "found -5")
    typed = run_psotrack("track", flight, "--out", "out.csv", "--particles", "-6")
    check_line(typed, "psotrack: swarm.particles: expected", "found -6")


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("evaluate", "late.csv", "{flight}"), ("late.csv", "{flight}")),
        (("evaluate", "unseen.csv", "{flight}", "--offset", "auto"), ("unseen.csv", "{flight}")),
        (("doctor", "{flight}", "--tracks", "unseen.csv"), ("unseen.csv", "{flight}")),
        (("doctor", "{flight}", "--tracks", "one.csv"), ("one.csv", "{flight}")),
        (("calibrate", "rig", "left", "right", *BOARD), ("left and 1 more",)),
        (("calibrate", "rig", "apart.csv", *BY_POINT, "--distance", "c0,c1=1"), ("apart.csv",)),
        (("calibrate", "rig", "alone.csv", *BY_POINT, "--distance", "c0,c1=1"), ("alone.csv",)),
        (("calibrate", "rig", "ends.csv", *BY_POINT, "--stick", "0.5"), ("ends.csv",)),
        (("init", "--show", "early"), ("early, frame times",)),
        (("track", "far", "--out", "out.csv"), ("far, frame times",)),
    ],
    ids=lambda each: " ".join(each[:2]),
)
def test_the_line_names_the_file(words, names, files: Path, flight, run_psotrack):
    before = set(files.rglob("*"))
    output = run_psotrack(*(word.format(flight=flight) for word in words))
    check_line(output, *(name.format(flight=flight) for name in names))
    assert set(files.rglob("*")) == before

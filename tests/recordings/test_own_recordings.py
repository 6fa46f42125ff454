"""Recordings of own cameras, end to end: cameras that differ in size, rate and start, with detections and no video."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from helpers import ring_rig

import psotrack as pt
from psotrack.cli import cli
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections, write_detections
from psotrack.recordings.datasets import open_recording
from psotrack.trajectories import Trajectories, read_trajectories
from psotrack.trajectories.tum import write_tum

LASTS_S = 1.0
#: Rate and time of frame 0 of each camera.
CLOCKS = ((25.0, 0.0), (50.0, 0.0), (25.0, 0.013), (30.0, 0.2), (25.0, 0.0))


def path_m(time_s):
    """A drone that flies a curve at about 1.5 m/s."""
    return np.stack([np.cos(1.5 * time_s), np.sin(1.5 * time_s), 1.2 + 0.2 * time_s], axis=-1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with detections of five cameras, a rig file and a reference, and its `recording.toml`."""
    folder = tmp_path_factory.mktemp("own")
    rig = ring_rig(5, image_size_wh=(640, 480))
    # The last camera has twice the resolution.
    rig.cameras.K[4, :2] *= 2
    rig.cameras.image_size_wh[4] *= 2
    write_rig(folder / "rig.toml", rig)
    for index, (name, (fps, begins_s)) in enumerate(zip(rig.names, CLOCKS, strict=True)):
        time_s = begins_s + np.arange(int((LASTS_S - begins_s) * fps)) / fps
        centre_px = project(rig.cameras[index], path_m(time_s))[0] + 0.5
        side_px = 12.0 * (1 + (index == 4))
        xyxy = np.hstack([centre_px - side_px, centre_px + side_px])
        write_detections(
            folder / f"{name}.csv", Detections(np.arange(len(time_s)), xyxy, np.ones(len(time_s)))
        )
    time_s = np.arange(0, LASTS_S, 0.01)
    position_m = path_m(time_s)[:, None]
    write_tum(folder, Trajectories(np.arange(len(time_s)), time_s, ("drone",), position_m))
    run("init", folder, "--fps", 25)
    file = folder / "recording.toml"
    text = file.read_text()
    for name, (fps, begins_s) in zip(rig.names, CLOCKS, strict=True):
        table = f'(detections = "{name}.csv"\n.*?)fps = 25.0\n'
        text, count = re.subn(table, rf"\1fps = {fps}\ntime_offset_s = {begins_s}\n", text, flags=re.DOTALL)
        assert count == 1
    file.write_text(text)
    return folder


def run(*arguments):
    result = CliRunner().invoke(cli, [str(one) for one in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.output


@pytest.mark.slow
def test_detections_without_videos_are_tracked(folder, tmp_path):
    run("track", folder, "--method", "projection-lines", "--out", tmp_path / "tracks.csv", "--quiet")
    tracks = read_trajectories(tmp_path / "tracks.csv")
    recording = open_recording(folder)
    assert (recording.fps, recording.num_frames) == (50.0, tracks.num_frames)
    assert tracks.num_drones == 1
    np.testing.assert_allclose(tracks.time_s, recording.timeline().time_s, rtol=0, atol=1e-9)
    seen = tracks.seen[:, 0]
    assert seen.mean() > 0.9
    error_m = np.linalg.norm(tracks.position_m[seen, 0] - path_m(tracks.time_s[seen]), axis=-1)
    # At 1.5 m/s half an interval of the slow cameras is 30 mm.
    assert np.median(error_m) < 0.01
    run("evaluate", tmp_path / "tracks.csv", folder, "--json", tmp_path / "errors.json", "--quiet")
    assert json.loads((tmp_path / "errors.json").read_text())["mean_error_m"] < 0.01


def test_chosen_cameras_and_first_frames(folder):
    recording = pt.read_recording(folder, cameras="C-2", num_frames=20)
    assert len(recording.rig) == 1
    assert recording.num_frames == 20
    with pytest.raises(SettingsError, match="cameras: expected some of"):
        pt.read_recording(folder, cameras="camera9")


def test_a_method_that_needs_silhouettes_says_that_there_are_no_videos(folder, tmp_path):
    with pytest.raises(InputError, match=r"expected a video for each of the cameras .* found none"):
        run("track", folder, "--out", tmp_path / "tracks.csv", "--quiet")


class Own:
    """A method of the caller."""

    reads_detections = True

    def __call__(self, inputs, report=None):
        raise AssertionError("never called: there are no videos")


def test_an_own_method_beside_projection_lines_needs_videos(folder, tmp_path):
    with pytest.raises(InputError, match="expected at least one video"):
        pt.track(folder, {"method": "projection-lines"}, method=Own(), cache=tmp_path)


def test_doctor_and_info_read_recordings_without_videos(folder):
    shown = run("init", "--show", folder)
    assert "no video" in shown
    assert "1280 x 960" in shown
    assert "50 Hz" in shown

"""Detections: their files, and recordings of cameras that differ in size, rate and start and have nothing else."""

import json

import numpy as np
import pytest
from dpjait_folders import write_tum
from helpers import assert_refused, make_once, ring_rig
from hypothesis import given
from hypothesis import strategies as st

import psotrack as pt
from psotrack.geometry import project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections, read_detections, write_detections
from psotrack.recordings.datasets import open_recording
from psotrack.trajectories import read_trajectories

LINE = "4,10,20,30,40,25,40,0.9"


def write_file(tmp_path, text):
    path = tmp_path / "cam1i_s.csv"
    path.write_bytes(text.encode())
    return path


def test_a_file_is_read(tmp_path):
    detections = read_detections(write_file(tmp_path, f"{LINE}\n7\n9,{LINE[2:]},1,2,3,4,2.5,4,0.25\n"))
    assert detections.frame.tolist() == [4, 9, 9]
    assert detections.xyxy.tolist() == [[10, 20, 40, 60], [10, 20, 40, 60], [1, 2, 4, 6]]
    assert detections.confidence.tolist() == [0.9, 0.9, 0.25]
    assert detections.in_frame(9).confidence.tolist() == [0.9, 0.25]
    assert len(detections.in_frame(7)) == 0
    assert len(read_detections(write_file(tmp_path, ""))) == 0


#: Name of the case -> text of a file, the frames of its detections, which are all equal.
VARIANTS = {
    "byte order mark": (f"\ufeff{LINE}\n", [4]),
    "Windows": (f"{LINE}\r\n\r\n", [4]),
    "blank lines and last comma": (f"\n\n{LINE},\n\n", [4]),
    "spaces": (LINE.replace(",", " , "), [4]),
    "out of order, frame as 2.0": (f"{LINE}\n2.0,{LINE[2:]}", [2, 4]),
    "padded with empty fields": (f"{LINE},,,,\n2,{LINE[2:]}{7 * ','}\n3,,,,\n,,,,", [2, 4]),
    "an empty detection between two": (f"{LINE},,,,,,,,{LINE[2:]}", [4, 4]),
    # Some exports of YOLO have the middle of the box as x and y.
    "middles": ("0,25,40,30,40,25,40,0.9", [0]),
}


@pytest.mark.parametrize(("text", "frames"), VARIANTS.values(), ids=VARIANTS)
def test_variants_of_the_format_are_read(tmp_path, text, frames):
    detections = read_detections(write_file(tmp_path, text))
    assert detections.frame.tolist() == frames
    assert detections.xyxy.tolist() == [[10, 20, 40, 60]] * len(frames)


pixels = st.floats(-1e4, 1e4)
boxes = st.tuples(pixels, pixels, st.floats(0, 1e4), st.floats(0, 1e4), st.floats(0, 1))


@given(found=st.lists(st.tuples(st.integers(0, 9), boxes), max_size=12))
def test_detections_are_read_as_they_were_written(tmp_path_factory, found):
    found = sorted(found, key=lambda item: item[0])
    values = np.array([box for _, box in found], np.float64).reshape(-1, 5)
    xyxy = np.hstack([values[:, :2], values[:, :2] + values[:, 2:4]])
    detections = Detections(np.array([frame for frame, _ in found], np.int64), xyxy, values[:, 4])
    path = tmp_path_factory.getbasetemp() / "round_trip.csv"
    write_detections(path, detections)
    again = read_detections(path)
    np.testing.assert_array_equal(again.frame, detections.frame)
    # The file has a corner and a size per box: a few roundings of numbers up to 2e4.
    np.testing.assert_allclose(again.xyxy, detections.xyxy, rtol=0, atol=1e-10)
    np.testing.assert_array_equal(again.confidence, detections.confidence)


# --- recordings without videos

LASTS_S = 1.0
#: Rate and time of frame 0 of each camera.
CLOCKS = {"c0": (25.0, 0.0), "c1": (50.0, 0.0), "c2": (25.0, 0.013), "c3": (30.0, 0.2), "c4": (25.0, 0.0)}


def path_m(time_s):
    """A drone that flies a curve at about 1.5 m/s."""
    return np.stack([np.cos(1.5 * time_s), np.sin(1.5 * time_s), 1.2 + 0.2 * time_s], axis=-1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A recording with detections of five cameras, a rig file and a reference."""

    def make(folder):
        rig = ring_rig(5, image_size_wh=(640, 480))
        # The last camera has twice the resolution.
        rig.cameras.K[4, :2] *= 2
        rig.cameras.image_size_wh[4] *= 2
        write_rig(folder / "rig.toml", rig)
        text = 'version = 1\ncalibration = "rig.toml"\n[reference]\nfiles = ["drone.tum"]\n'
        for index, (name, (fps, begins_s)) in enumerate(CLOCKS.items()):
            time_s = begins_s + np.arange(int((LASTS_S - begins_s) * fps)) / fps
            centre_px = project(rig.cameras[index], path_m(time_s))[0] + 0.5
            side_px = 24.0 if index == 4 else 12.0
            xyxy = np.hstack([centre_px - side_px, centre_px + side_px])
            found = Detections(np.arange(len(time_s)), xyxy, np.ones(len(time_s)))
            write_detections(folder / f"{name}.csv", found)
            text += f'[cameras.{name}]\ndetections = "{name}.csv"\nfps = {fps}\ntime_offset_s = {begins_s}\n'
        (folder / "recording.toml").write_text(text)
        time_s = np.arange(0, LASTS_S, 0.01)
        write_tum(folder / "drone.tum", time_s, path_m(time_s))

    return make_once(tmp_path_factory, "detections_alone", make)


@pytest.mark.slow
def test_detections_without_videos_are_tracked(run_psotrack, folder, tmp_path):
    out = tmp_path / "tracks.csv"
    tracked = run_psotrack("track", folder, "--method", "projection-lines", "--out", out)
    assert tracked.code == 0, tracked.err
    tracks, recording = read_trajectories(out), open_recording(folder)
    assert (recording.fps, recording.num_frames) == (50.0, tracks.num_frames)
    assert tracks.num_drones == 1
    np.testing.assert_allclose(tracks.time_s, recording.timeline().time_s, rtol=0, atol=1e-9)
    seen = tracks.seen[:, 0]
    assert seen.mean() > 0.9
    error_m = np.linalg.norm(tracks.position_m[seen, 0] - path_m(tracks.time_s[seen]), axis=-1)
    # At 1.5 m/s half an interval of the slow cameras is 30 mm.
    assert np.median(error_m) < 0.01
    assert json.loads(run_psotrack("evaluate", out, folder, "--json", "-").out)["mean_error_m"] < 0.01


class Own:
    """A method of the caller."""

    reads_detections = True

    def __call__(self, inputs, report=None):
        raise AssertionError("never called: there are no videos")


def test_recordings_without_videos(run_psotrack, folder, tmp_path):
    recording = open_recording(folder)
    assert not recording.videos
    assert recording.usable(videos=False).rig.names == tuple(CLOCKS)
    longer = tmp_path / "longer.csv"
    longer.write_text("99,10,20,30,40,25,40,0.9\n")
    assert recording.with_detections({"c1": longer}).usable(videos=False).num_frames == 100
    chosen = pt.read_recording(folder, cameras="C-2", num_frames=20)
    assert (chosen.rig.names, chosen.num_frames) == (("c2",), 20)
    shown = run_psotrack("init", "--show", folder).out
    for word in ("no video", "1280 x 960", "50 Hz"):
        assert word in shown
    for bad, words in (
        (lambda: pt.read_recording(folder, cameras="camera9"), ("cameras: expected some of",)),
        (
            lambda: run_psotrack("track", folder, "--out", tmp_path / "tracks.csv", "--quiet"),
            ("expected a video for each of the cameras c0, c1, ", "found none"),
        ),
        (
            lambda: pt.track(folder, {"method": "projection-lines"}, method=Own(), cache=tmp_path),
            ("expected at least one video",),
        ),
    ):
        assert_refused(bad, *words, unchanged=tmp_path)

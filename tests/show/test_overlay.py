"""`psotrack overlay`: what is drawn where, numbers of frames, interrupted runs, codecs, and wrong input."""

from __future__ import annotations

import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from helpers import assert_refused, with_cameras
from worlds import (
    CAMERAS,
    IMAGE_SIZE_WH,
    LOST_FROM,
    NUM_FRAMES,
    make_sequence,
    make_tracks,
    make_tracks_file,
)

from psotrack.errors import OutputError
from psotrack.recordings import VideoWriter, probe, read_frames, view_in_images
from psotrack.show.flights import read_flight, status_rgb
from psotrack.show.overlay import Codec, OverlayOptions, find_codec, write_overlays
from psotrack.support import COLOURS
from psotrack.trajectories import Status, write_trajectories


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the sequence `flight` and the tracks `tracks.csv`, which no test changes."""
    folder = tmp_path_factory.mktemp("overlay")
    make_sequence(folder / "flight")
    make_tracks_file(folder / "tracks.csv", error_m=0.0)
    return folder


@pytest.fixture
def run(run_psotrack):
    """Runs `psotrack overlay`."""
    return partial(run_psotrack, "overlay")


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def colour_bgr(drone, status):
    return status_rgb(np.array([int(status)]), [COLOURS[drone]], lighter=0.2)[0, ::-1].astype(float)


def nearest_colour(image, box_px, colour):
    """Smallest difference of a pixel about the middle of the box's lower edge from a colour, of 255."""
    column, row = round(box_px[[0, 2]].mean()), round(box_px[3] - 0.5)
    near = image[row - 2 : row + 3, column - 3 : column + 4].reshape(-1, 3).astype(float)
    return np.abs(near - colour).mean(axis=1).min()


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_boxes_are_drawn_where_the_drones_are(run, folder, tmp_path, scale):
    code, out, err = run(
        *(folder / "tracks.csv", folder / "flight", "--out", tmp_path / "videos"),
        *("--scale", scale, "--jobs", 1),
    )
    assert (code, err) == (0, "")
    assert out.endswith("3 videos in MPEG-4\n") or out.endswith("3 videos in H.264\n")
    assert names_in(tmp_path / "videos") == [*(f"{name}.mp4" for name in CAMERAS), "overlay.json"]
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    views = view_in_images(flight.recording, flight.tracks[0].trajectories, flight.tracks[0].size_m)
    for index, name in enumerate(CAMERAS):
        video = probe(tmp_path / "videos" / f"{name}.mp4")
        width, height = (round(scale * side) for side in IMAGE_SIZE_WH)
        assert (video.num_frames, video.fps, video.image_size_wh) == (NUM_FRAMES, 25.0, (width, height))
        for frame, image in enumerate(read_frames(video)):
            for drone in range(2):
                status = make_tracks().status[frame, drone]
                box_px = views.boxes_px[frame, drone, index] * scale
                if status == Status.LOST:
                    assert np.isnan(box_px).all()
                    continue
                # The codec halves the resolution of colours and mixes a line of two pixels with the grey around it.
                off = {
                    other: nearest_colour(image, box_px, colour_bgr(drone, other))
                    for other in (Status.TRACKED, Status.COASTING)
                }
                assert min(off, key=off.get) == status, (name, frame, drone, off)
                assert off[status] < 40, (name, frame, drone, off)


def test_nothing_is_drawn_without_drones(folder, tmp_path):
    flight = read_flight([folder / "tracks.csv"], folder / "flight", cameras=["c0"])
    lost = np.full((NUM_FRAMES, 2), int(Status.LOST))
    tracks = replace(flight.tracks[0], trajectories=replace(make_tracks(), status=lost))
    write_overlays(tmp_path, replace(flight, tracks=(tracks,)), jobs=1)
    given = read_frames(flight.recording.videos["c0"])
    for image, before in zip(read_frames(probe(tmp_path / "c0.mp4")), given, strict=True):
        # Below the heading only the codec changes the image: noise of 30 levels loses some of them.
        assert np.abs(image[40:].astype(float) - before[40:]).mean() < 8


def test_the_mosaic_has_all_cameras_and_a_map(run, folder, tmp_path):
    assert run(folder / "tracks.csv", folder / "flight", "--out", tmp_path, "--mosaic").code == 0
    assert names_in(tmp_path) == ["mosaic.mp4", "overlay.json"]
    video = probe(tmp_path / "mosaic.mp4")
    assert video.num_frames == NUM_FRAMES
    width, height = video.image_size_wh
    # Three cameras and the map are two columns of 960 pixels; the images are 4 to 3.
    assert (width, height) == (1920, 1440)
    images = list(read_frames(video))
    tiles = [images[0][:720, :960], images[0][:720, 960:], images[0][720:, :960]]
    for tile, name in zip(tiles, CAMERAS, strict=True):
        given = next(read_frames(probe(folder / "flight" / f"{name}.avi")))
        scaled = cv2.resize(given, (960, 720), interpolation=cv2.INTER_AREA)
        assert np.abs(tile[100:].astype(float) - scaled[100:]).mean() < 12
    # The map is dark, with drones in their colours where the positions say: x to the right, y upwards.
    seen = {}
    for frame in (0, LOST_FROM - 1):
        view = images[frame][720:, 960:].astype(float)
        for drone in range(2):
            near = np.abs(view - colour_bgr(drone, Status.TRACKED)).mean(axis=2) < 25
            rows, columns = np.nonzero(near)
            seen[frame, drone] = np.median(columns), np.median(rows)
    assert seen[0, 0][0] < seen[0, 1][0], "drone 0 has the smaller x"
    assert seen[LOST_FROM - 1, 1][1] < seen[0, 1][1], "drones fly towards larger y"


def test_cameras_of_another_shape_keep_their_aspect_ratio_in_the_mosaic(folder, tmp_path):
    """One of three cameras shows the left 200 of 320 columns: its image is narrower, and boxes sit on the drones."""
    flight = read_flight([folder / "tracks.csv"], folder / "flight")
    recording, index = flight.recording, CAMERAS.index("c1")
    with VideoWriter(tmp_path / "narrow.avi", 25.0, (200, 240)) as writer:
        for frame in read_frames(recording.videos["c1"]):
            writer.write(frame[:, :200].copy())
    sizes_wh = recording.rig.cameras.image_size_wh.copy()
    sizes_wh[index] = 200, 240
    rig = replace(recording.rig, cameras=replace(recording.rig.cameras, image_size_wh=sizes_wh))
    narrow = with_cameras(recording.with_rig(rig), video={"c1": probe(tmp_path / "narrow.avi")})
    flight = replace(flight, recording=narrow)
    write_overlays(tmp_path / "out", flight, OverlayOptions(mosaic=True), jobs=1)
    tile = next(read_frames(probe(tmp_path / "out" / "mosaic.mp4")))[:720, 960:]
    # 200 x 240 pixels in a place of 960 x 720 are three times as large, with 180 black columns at both sides.
    assert tile[:, :170].max() < 40
    assert tile[:, 790:].max() < 40
    views = view_in_images(flight.recording, flight.tracks[0].trajectories, flight.tracks[0].size_m)
    shown = [drone for drone in range(2) if views.boxes_px[0, drone, index, 2] < 200]
    assert shown
    for drone in shown:
        box_px = views.boxes_px[0, drone, index] * 3 + [180, 0, 180, 0]
        assert nearest_colour(tile, box_px, colour_bgr(drone, Status.TRACKED)) < 40


@pytest.mark.parametrize("change", ["lens", "times", "video"])
def test_a_video_of_other_inputs_is_not_kept(folder, tmp_path, change):
    flight = read_flight([folder / "tracks.csv"], folder / "flight", cameras=["c0"])
    video = tmp_path / "c0.avi"
    video.write_bytes((folder / "flight" / "c0.avi").read_bytes())
    flight = replace(flight, recording=with_cameras(flight.recording, video={"c0": probe(video)}))
    assert len(write_overlays(tmp_path / "out", flight, jobs=1).written) == 1
    assert len(write_overlays(tmp_path / "out", flight, jobs=1).kept) == 1
    recording = flight.recording
    if change == "lens":
        cameras = replace(recording.rig.cameras, dist=np.zeros((1, 4)), fisheye=np.array([True]))
        flight = replace(flight, recording=recording.with_rig(replace(recording.rig, cameras=cameras)))
    elif change == "times":
        late = {"c0": replace(recording.exposed["c0"], time_offset_s=0.01)}
        flight = replace(flight, recording=with_cameras(recording, times=late))
    else:
        video.write_bytes((folder / "flight" / "c1.avi").read_bytes())
    with pytest.raises(OutputError, match=r"c0\.mp4: .*--force"):
        write_overlays(tmp_path / "out", flight, jobs=1)


@pytest.mark.slow
def test_finished_videos_are_kept_and_others_are_made(run, folder, tmp_path):
    command = (folder / "flight", "--out", tmp_path / "out", "--scale", 0.5, "--jobs", 1)
    tracks, video = folder / "tracks.csv", tmp_path / "out" / "c1.mp4"
    assert run(tracks, *command, "--cameras", "c1").code == 0
    first = video.stat().st_mtime_ns
    said = run(tracks, *command).out
    assert "2 videos" in said
    assert "1 were there already" in said
    assert video.stat().st_mtime_ns == first
    assert "0 videos" in run(tracks, *command).out
    # Other tracks: refused as a whole, and made anew with --force.
    other = make_tracks_file(tmp_path / "other.csv", 0.3)
    assert_refused(lambda: run(other, *command), "--force", unchanged=tmp_path)
    assert "3 videos" in run(other, *command, "--force").out
    assert video.stat().st_mtime_ns != first
    assert "0 videos" in run(other, *command).out


@pytest.mark.nightly
def test_a_killed_run_leaves_no_partial_video_and_can_be_continued(run, folder, tmp_path):
    """The run kills itself before the second video gets its name."""
    program = """
import os, signal, sys

def kill(event, arguments):
    if event == "os.rename" and str(arguments[1]).endswith("c1.mp4"):
        os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(kill)
from psotrack.__main__ import main
main()
"""
    words = ["overlay", folder / "tracks.csv", folder / "flight", "--out", tmp_path / "out", "--jobs", "1"]
    killed = subprocess.run([sys.executable, "-c", program, *words], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert [path.name for path in (tmp_path / "out").glob("c*.mp4")] == ["c0.mp4"]
    first = (tmp_path / "out" / "c0.mp4").stat().st_mtime_ns
    assert f"{len(CAMERAS) - 1} videos" in run(*words[1:]).out
    assert (tmp_path / "out" / "c0.mp4").stat().st_mtime_ns == first
    assert sorted(path.name for path in (tmp_path / "out").glob("*c*.mp4")) == [
        f"{name}.mp4" for name in CAMERAS
    ]
    for name in CAMERAS:
        assert probe(tmp_path / "out" / f"{name}.mp4").num_frames == NUM_FRAMES


def test_the_next_codec_is_used_where_the_first_one_fails():
    wrong, right = Codec("none", "zzzz"), Codec("MPEG-4", "mp4v")
    assert find_codec([wrong, right]) == right
    with pytest.raises(OutputError, match="none"):
        find_codec([wrong])


def test_wrong_input_is_one_line(run, folder, tmp_path):
    tracks, sequence = folder / "tracks.csv", folder / "flight"
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "rig.toml").write_bytes((sequence / "rig.toml").read_bytes())
    cameras = "".join(f"[cameras.{name}]\nfps = 25\ndetections = '{name}.csv'\n" for name in CAMERAS)
    (bare / "recording.toml").write_text(f"version = 1\ncalibration = 'rig.toml'\n{cameras}")
    for name in CAMERAS:
        (bare / f"{name}.csv").write_text(
            "".join(f"{frame},1,1,9,9,5,5,0.9\n" for frame in range(NUM_FRAMES))
        )
    late = replace(make_tracks(), time_s=make_tracks().time_s + 100)
    write_trajectories(tmp_path / "late.csv", late)
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "overlay.json").write_text("[]")
    out = ("--out", tmp_path / "out")
    for arguments, word in (
        ((tracks, bare, *out), "videos"),
        ((tmp_path / "late.csv", sequence, *out), "times from"),
        ((tracks, sequence, *out, "--cameras", "c9"), "c9"),
        ((tracks, sequence, "--out", tmp_path / "broken"), "overlay.json"),
    ):
        assert_refused(lambda arguments=arguments: run(*arguments), word, unchanged=tmp_path)

"""Detections: their files, recordings of nothing else, and what `detect` makes of pictures without a calibration."""

import json
import shutil
from functools import partial

import cv2
import numpy as np
import pytest
from dpjait_folders import write_tum
from helpers import assert_refused, made_once, make_once, ring_rig
from hypothesis import given
from hypothesis import strategies as st

import psotrack as pt
from psotrack.geometry import project
from psotrack.geometry.rig_files import write_rig
from psotrack.recordings import Detections, VideoWriter, probe, read_detections, read_frames, write_detections
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
sizes = st.floats(0, 1e4)
boxes = st.tuples(st.integers(0, 9), pixels, pixels, sizes, sizes, st.floats(0, 1))


@given(found=st.lists(boxes, max_size=12))
def test_detections_are_read_as_they_were_written(tmp_path_factory, found):
    values = np.array(sorted(found)).reshape(-1, 6)
    frame, corner, size = values[:, 0].astype(np.int64), values[:, 1:3], values[:, 3:5]
    detections = Detections(frame, np.hstack([corner, corner + size]), values[:, 5])
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


def make_detections(folder):
    """A recording with detections of five cameras, a rig file and a reference."""
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


folder = made_once("detections_alone", make_detections)


@pytest.mark.slow
def test_detections_without_videos_are_tracked(run_psotrack, folder, tmp_path):
    out = tmp_path / "tracks.csv"
    run_psotrack("track", folder, "--method", "projection-lines", "--out", out).ended()
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
    refused = partial(assert_refused, unchanged=tmp_path)
    refused(lambda: pt.read_recording(folder, cameras="camera9"), "cameras: expected some of")
    command = ("track", folder, "--out", tmp_path / "tracks.csv", "--quiet")
    refused(lambda: run_psotrack(*command), "a video for each of the cameras", "projection-lines` needs")


# --- pictures as the video of a camera

WIDTH, HEIGHT, FRAMES = 96, 64, 12
#: Side of the moving square, pixels.
SIDE = 16


def place(index):
    """Left and top of the moving square."""
    return 4 + 6 * index, 8 + 3 * index


def picture(index):
    """A still background with a little noise, and a square that moves."""
    noise = np.random.default_rng(index).normal(0, 1, (HEIGHT, WIDTH, 3))
    image = np.tile(np.linspace(60, 120, WIDTH), (HEIGHT, 1))[..., None] + noise
    x, y = place(index)
    image[y : y + SIDE, x : x + SIDE] = [230, 20, 20]
    return image.clip(0, 255).astype(np.uint8)


def overlap(mask, index):
    """Intersection over union of a mask and the square."""
    x, y = place(index)
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[y : y + SIDE, x : x + SIDE] = True
    found = mask > 127
    return float((found & truth).sum() / (found | truth).sum())


@pytest.fixture
def pictures(tmp_path_factory, tmp_path):
    """A folder of numbered pictures, beside files that are none."""

    def make(folder):
        for index in range(FRAMES):
            cv2.imwrite(str(folder / f"frame{index}.png"), picture(index))
        (folder / "notes.txt").write_text("none of the pictures")
        (folder / "._frame0.png").write_bytes(b"Mac OS X")

    return shutil.copytree(make_once(tmp_path_factory, "pictures_of_a_square", make), tmp_path / "left")


@pytest.fixture
def detect(run_psotrack, tmp_path):
    """Runs `psotrack detect` with a cache of its own, and gives what it prints."""

    def call(*arguments):
        return run_psotrack("detect", *arguments, *cache_of(arguments, tmp_path)).ended().out

    return call


def cache_of(arguments, tmp_path):
    return () if "--masks" in arguments else ("--cache", tmp_path / "cache")


def write_recording(folder, *lines):
    (folder / "recording.toml").write_text("\n".join(["version = 1", "[cameras.left]", *lines]) + "\n")


def test_pictures_are_the_video_of_a_camera_with_a_rate_or_times(run_psotrack, pictures, caplog):
    """Times make up for missing pictures. Cameras whose place is not known are recordings, too."""
    folder = pictures.parent
    write_recording(folder, 'video = "left/"', "fps = 20")
    video = open_recording(folder).videos["left"]
    assert (video.num_frames, video.fps, video.image_size_wh) == (FRAMES, 20.0, (WIDTH, HEIGHT))
    np.testing.assert_array_equal([*read_frames(video, 5)], [picture(index) for index in (0, 5, 10)])
    assert "left" in run_psotrack("init", "--show", folder).out
    (pictures / "frame4.png").unlink()
    write_recording(folder, 'images = "left/*.png"', "fps = 20")
    frames = read_frames(open_recording(folder).videos["left"], 5)
    np.testing.assert_array_equal([*frames], [picture(index) for index in (0, 6, 11)])
    assert [message.split("left: ")[1] for message in caplog.messages] == [
        "no pictures with the numbers 4: the pictures count as frames without a gap"
    ]
    caplog.clear()
    rows = "".join(f"{index},{0.1 * index}\n" for index in range(FRAMES - 1))
    (folder / "times.csv").write_text("frame,time_s\n" + rows)
    write_recording(folder, 'images = "left/*.png"', 'timestamps = "times.csv"')
    assert open_recording(folder).fps == pytest.approx(10)
    assert not caplog.records


def test_blobs_of_pictures_are_detections(detect, pictures, tmp_path):
    """The boxes are whole cells of 4 pixels around the square, and `read_detections` takes them back."""
    detect(pictures, "--blobs", "--out", tmp_path / "boxes")
    found = read_detections(tmp_path / "boxes" / "left.csv")
    assert sorted(set(found.frame)) == list(range(FRAMES))
    assert (found.xyxy >= 0).all()
    assert (found.xyxy <= [WIDTH, HEIGHT, WIDTH, HEIGHT]).all()
    assert ((found.confidence > 0.2) & (found.confidence <= 1)).all()
    for index in range(FRAMES):
        boxes_px = found.in_frame(index).xyxy
        x, y = place(index)
        best = boxes_px[np.abs(boxes_px[:, 0] - x).argmin()]
        # A cell belongs to a blob if a quarter of it does: edges are off by less than a cell, and the closing of gaps.
        assert np.abs(best - [x, y, x + SIDE, y + SIDE]).max() <= 8
    # The silhouettes of the folder are those of its camera in a recording.
    write_recording(tmp_path, 'video = "left"', "fps = 20")
    assert "1 cameras, 12 frames: already there" in detect("--silhouettes", tmp_path)


def test_masks_of_pictures(detect, pictures, tmp_path):
    out = tmp_path / "masks"
    assert f"{FRAMES} masks of 1 cameras" in detect(pictures, "--masks", out)
    files = sorted((out / "left").iterdir())
    assert [file.name for file in files] == [f"{index:06d}.png" for index in range(FRAMES)]
    for index, file in enumerate(files):
        mask = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert (mask.shape, mask.dtype) == ((HEIGHT, WIDTH), np.uint8)
        # The mask has single pixels, and the square has sharp edges.
        assert overlap(mask, index) > 0.95
    detect(pictures, "--masks", out, "--frames", 5, "--force", "--working-reduction", 2)
    files = sorted((out / "left").iterdir())
    assert len(files) == 5
    reduced = cv2.imread(str(files[2]), cv2.IMREAD_UNCHANGED)
    assert reduced.shape == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(reduced[::2, ::2], reduced[1::2, 1::2])
    detect(pictures, "--masks", tmp_path / "mask.mp4")
    masks = probe(tmp_path / "mask.mp4")
    assert masks.num_frames == FRAMES
    for index, frame in enumerate(read_frames(masks)):
        assert overlap(frame[..., 0], index) > 0.95


def test_a_single_video(detect, tmp_path):
    """Names are those of the file."""
    flight = tmp_path / "flight.avi"
    with VideoWriter(flight, 25.0, (WIDTH, HEIGHT)) as writer:
        for index in range(FRAMES):
            writer.write(picture(index))
    detect(flight, "--blobs", "--out", tmp_path / "boxes")
    assert set(read_detections(tmp_path / "boxes" / "flight.csv").frame) == set(range(FRAMES))


def two_cameras(folder):
    shutil.copytree(folder / "left", folder / "right")
    write_recording(folder, 'video = "left"', "fps = 20", "[cameras.right]", 'video = "right"', "fps = 20")


def nothing(folder):
    return None


NO_VIDEO = "expected a video, a folder of pictures, or a recording, found no such file or folder"
#: Name of the case -> change of the folder that holds the pictures in `left`, words of `detect`, words of the line.
BAD = {
    "a missing folder": (nothing, "{0}/pictures/ --blobs --out {0}/out", NO_VIDEO),
    "neither blobs nor a detector": (nothing, "{0}/left --out {0}/out", "found none of them"),
    "both": (nothing, "{0}/left --out {0}/out --blobs --detector a.onnx", "--detector and --blobs"),
    "masks of a bad picture": (
        lambda folder: (folder / "left" / "frame7.png").write_text("no picture"),
        "{0}/left --masks {0}/a.mp4",
        "frame7.png: expected an image",
    ),
    "no folder": (nothing, "{0}/left --masks {0}/left/notes.txt", "a folder, or a file that ends in .mp4, .avi"),
    "two cameras in a video": (two_cameras, "{0} --masks {0}/a.mp4", "one camera by --cameras, found a.mp4 for 2"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "words", "refusal"), BAD.values(), ids=BAD)
def test_what_cannot_be_detected_is_refused(
    run_psotrack, pictures, tmp_path, tmp_path_factory, change, words, refusal
):
    change(tmp_path)
    arguments = words.format(tmp_path).split()
    cache = cache_of(arguments, tmp_path_factory.mktemp("cache"))
    assert_refused(lambda: run_psotrack("detect", *arguments, *cache), refusal, unchanged=tmp_path)

"""What `detect` makes of pictures or a video without a calibration: blobs, masks; pictures as the video of a camera."""

import shutil

import cv2
import numpy as np
import pytest
from helpers import assert_refused, make_once

from psotrack.foreground.silhouettes import SilhouetteSettings, compute, find_blobs
from psotrack.recordings import (
    VideoWriter,
    check_end,
    open_video,
    probe,
    read_detections,
    read_frames,
    recording_of_video,
)
from psotrack.recordings.datasets import open_recording

WIDTH, HEIGHT, FRAMES = 96, 64, 12
#: Side of the moving square, pixels.
SIDE = 16


def place(index: int) -> tuple[int, int]:
    """Left and top of the moving square."""
    return 4 + 6 * index, 8 + 3 * index


def picture(index: int) -> np.ndarray:
    """A still background with a little noise, and a square that moves."""
    noise = np.random.default_rng(index).normal(0, 1, (HEIGHT, WIDTH, 3))
    image = np.tile(np.linspace(60, 120, WIDTH), (HEIGHT, 1))[..., None] + noise
    x, y = place(index)
    image[y : y + SIDE, x : x + SIDE] = [230, 20, 20]
    return image.clip(0, 255).astype(np.uint8)


def overlap(mask: np.ndarray, index: int) -> float:
    """Intersection over union of a mask and the square."""
    x, y = place(index)
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[y : y + SIDE, x : x + SIDE] = True
    return float(((mask > 127) & truth).sum() / ((mask > 127) | truth).sum())


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
        result = run_psotrack("detect", *arguments, *cache_of(arguments, tmp_path))
        assert result.code == 0, result.err
        return result.out

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
    check_end(video)
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
    made = compute(
        recording_of_video(open_video(pictures, 1.0)), SilhouetteSettings(), cache=tmp_path / "cache"
    )
    for index in range(FRAMES):
        boxes = found.in_frame(index)
        x, y = place(index)
        best = boxes.xyxy[np.abs(boxes.xyxy[:, 0] - x).argmin()]
        # A cell belongs to a blob if a quarter of it does: edges are off by less than a cell, and the closing of gaps.
        assert np.abs(best - [x, y, x + SIDE, y + SIDE]).max() <= 8
        blobs = find_blobs(np.asarray(made.arrays[0][index]), made.reduction, made.borders[0])
        np.testing.assert_allclose(boxes.xyxy[:, :2], blobs.centre_px + 0.5 - blobs.size_px / 2)
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
    assert len(list((out / "left").iterdir())) == 5
    reduced = cv2.imread(str(out / "left" / "000002.png"), cv2.IMREAD_UNCHANGED)
    assert reduced.shape == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(reduced[::2, ::2], reduced[1::2, 1::2])
    assert not list(out.glob(".*"))
    for name in ("mask.mp4", "mask.avi"):
        detect(pictures, "--masks", tmp_path / name)
        masks = probe(tmp_path / name)
        assert (masks.num_frames, masks.image_size_wh) == (FRAMES, (WIDTH, HEIGHT))
        for index, frame in enumerate(read_frames(masks)):
            assert overlap(frame[..., 0], index) > 0.95


def test_a_single_video(detect, tmp_path):
    """Names are those of the file; the codec of the video blurs the edges of the square."""
    flight = tmp_path / "flight.avi"
    with VideoWriter(flight, 25.0, (WIDTH, HEIGHT)) as writer:
        for index in range(FRAMES):
            writer.write(picture(index))
    detect(flight, "--masks", tmp_path / "masks")
    mask = cv2.imread(str(tmp_path / "masks" / "flight" / "000003.png"), cv2.IMREAD_UNCHANGED)
    assert overlap(mask, 3) > 0.6
    detect(flight, "--blobs", "--out", tmp_path / "boxes")
    assert set(read_detections(tmp_path / "boxes" / "flight.csv").frame) == set(range(FRAMES))


def spoil(folder):
    (folder / "left" / "frame7.png").write_text("no picture")


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
    "masks of a bad picture": (spoil, "{0}/left --masks {0}/a.mp4", "frame7.png: expected an image"),
    "blobs of a bad picture": (spoil, "{0}/left --blobs --out {0}/out", "frame7.png: expected an image"),
    "no folder": (nothing, "{0}/left --masks {0}/left/notes.txt", "a folder, or a file that ends in .mp4, .avi"),
    "below a file": (nothing, "{0}/left --masks {0}/left/notes.txt/out", "notes.txt, which is no folder"),
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

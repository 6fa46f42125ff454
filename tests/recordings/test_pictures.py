"""Folders of pictures wherever a video is taken, and what is made of videos without a calibration: blobs and masks."""

import shutil

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from psotrack.cli import cli
from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
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
    rng = np.random.default_rng(index)
    image = np.tile(np.linspace(60, 120, WIDTH), (HEIGHT, 1))[..., None] + rng.normal(
        0, 1, (HEIGHT, WIDTH, 3)
    )
    x, y = place(index)
    image[y : y + SIDE, x : x + SIDE] = [230, 20, 20]
    return image.clip(0, 255).astype(np.uint8)


@pytest.fixture
def pictures(tmp_path):
    """A folder of numbered pictures, beside files that are none."""
    folder = tmp_path / "left"
    folder.mkdir()
    for index in range(FRAMES):
        cv2.imwrite(str(folder / f"frame{index}.png"), picture(index))
    (folder / "Thumbs.db").write_bytes(b"\0\1")
    (folder / "notes.txt").write_text("none of the pictures")
    (folder / "._frame0.png").write_bytes(b"Mac OS X")
    return folder


def run(*arguments):
    result = CliRunner().invoke(cli, list(map(str, arguments)), standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.output


def refusal(*arguments) -> str:
    with pytest.raises(PsotrackError) as error:
        run(*arguments)
    assert "\n" not in str(error.value)
    return str(error.value)


# --- one reader


def test_pictures_are_a_video_in_the_order_of_their_numbers(pictures, caplog):
    video = open_video(pictures, 25.0)
    assert (video.num_frames, video.fps, video.image_size_wh) == (FRAMES, 25.0, (WIDTH, HEIGHT))
    for index, frame in enumerate(read_frames(video)):
        np.testing.assert_array_equal(frame, picture(index))
    assert not caplog.records
    check_end(video)


def test_grey_pictures_and_pictures_of_16_bits(tmp_path):
    """10 to 16 bits of a camera become 8; a folder has one depth, whatever the single picture shows."""
    grey = cv2.cvtColor(picture(3), cv2.COLOR_BGR2GRAY)
    for bits in (8, 10, 12, 16):
        folder = tmp_path / f"{bits}"
        folder.mkdir()
        for index, values in enumerate((grey, grey // 8)):
            image = values if bits == 8 else (values.astype(np.uint16) << (bits - 8))
            cv2.imwrite(str(folder / f"{index}.tif"), image)
        bright, dark = read_frames(open_video(folder, 10.0))
        np.testing.assert_array_equal(bright, np.repeat(grey[..., None], 3, axis=2))
        np.testing.assert_array_equal(dark[..., 1], grey // 8)


def test_bad_pictures_are_one_line(pictures):
    with pytest.raises(InputError, match=r"left: expected the rate of its pictures, .* state it as fps"):
        open_video(pictures)
    with pytest.raises(
        InputError, match=r"frame1\.png: expected a video, or a folder of pictures, found one picture"
    ):
        open_video(pictures / "frame1.png")
    shutil.copy(pictures / "notes.txt", pictures / "frame11.png")
    with pytest.raises(InputError, match=r"frame11\.png: expected an image, found a file that is no PNG"):
        list(read_frames(open_video(pictures, 25.0)))
    with pytest.raises(InputError, match=r"frame11\.png: expected an image"):
        check_end(open_video(pictures, 25.0))
    cv2.imwrite(str(pictures / "frame11.png"), picture(0)[:32])
    with pytest.raises(
        InputError, match=r"frame11\.png: expected 96 x 64 pixels as in frame0\.png, found 96 x 32"
    ):
        list(read_frames(open_video(pictures, 25.0)))


def test_missing_numbers_are_said(pictures, caplog):
    (pictures / "frame4.png").unlink()
    (pictures / "frame7.png").unlink()
    assert open_video(pictures, 25.0).num_frames == FRAMES - 2
    assert (
        "left: no pictures with the numbers 4, 7: the pictures count as frames without a gap" in caplog.text
    )


def test_missing_numbers_are_said_of_a_pattern(pictures, caplog):
    """What `init` writes for a folder is a pattern. Times that the user states make up for missing pictures."""
    folder = pictures.parent
    table = '[cameras.left]\nimages = "left/*.png"\nfps = 20\n' + CAMERA.format(turn=0)
    (pictures / "frame4.png").unlink()
    (folder / "recording.toml").write_text("version = 1\n" + table)
    open_recording(folder)
    assert [message.split("left: ")[1] for message in caplog.messages] == [
        "no pictures with the numbers 4: the pictures count as frames without a gap"
    ]
    caplog.clear()
    rows = "".join(f"{index},{0.1 * index}\n" for index in range(FRAMES - 1))
    (folder / "times.csv").write_text("frame,time_s\n" + rows)
    (folder / "recording.toml").write_text(
        "version = 1\n" + table.replace("fps = 20", 'timestamps = "times.csv"')
    )
    open_recording(folder)
    assert not caplog.records


@pytest.mark.parametrize("arguments", [["detect", "--masks"], ["detect", "--blobs", "--out"]])
@pytest.mark.parametrize("name", ["flight.mp4", "pictures/"])
def test_a_missing_video_is_no_missing_recording(tmp_path, arguments, name):
    message = refusal(*arguments, tmp_path / "out", tmp_path / name)
    assert "expected a video, a folder of pictures, or a recording, found no such file or folder" in message


def test_an_empty_folder(tmp_path):
    with pytest.raises(InputError, match=r"expected images, which end in \.png, .*, found none"):
        open_video(tmp_path, 25.0)


# --- commands


CAMERA = "\nsize = [96, 64]\nK = [[90, 0, 48], [0, 90, 32], [0, 0, 1]]\nrvec = [1.5, {turn}, 0]\ntvec = [0, 0, 5]\n"


def test_a_folder_is_the_video_of_a_camera(pictures):
    folder = pictures.parent
    table = '[cameras.left]\nvideo = "left/"\nfps = 20\n' + CAMERA.format(turn=0)
    (folder / "recording.toml").write_text("version = 1\n" + table)
    recording = open_recording(folder).usable()
    assert recording.videos["left"].num_frames == FRAMES
    assert recording.fps == 20
    assert "left" in run("init", "--show", folder)
    (folder / "recording.toml").write_text("version = 1\n" + table.replace("fps = 20\n", ""))
    assert "cameras.left.fps: expected frames per second of the pictures, or timestamps" in refusal(
        "init", "--show", folder
    )
    rows = "".join(f"{index},{0.1 * index}\n" for index in range(FRAMES))
    (folder / "times.csv").write_text("frame,time_s\n" + rows)
    timed = table.replace("fps = 20", 'timestamps = "times.csv"')
    (folder / "recording.toml").write_text("version = 1\n" + timed)
    assert open_recording(folder).usable().fps == pytest.approx(10)
    shutil.rmtree(pictures)
    pictures.mkdir()
    assert "left: expected images, which end in" in refusal("init", "--show", folder)


def test_blobs_of_pictures_are_detections(pictures, tmp_path):
    """The boxes are whole cells of 4 pixels around the square, and `read_detections` takes them back."""
    out = tmp_path / "boxes"
    arguments = ["detect", pictures, "--blobs", "--out", out, "--cache", tmp_path / "cache"]
    assert "left" not in run(*arguments).replace(str(tmp_path), "")
    found = read_detections(out / "left.csv")
    assert sorted(set(found.frame)) == list(range(FRAMES))
    for index in range(FRAMES):
        boxes = found.in_frame(index)
        x, y = place(index)
        best = boxes.xyxy[np.abs(boxes.xyxy[:, 0] - x).argmin()]
        # A cell belongs to a blob if a quarter of it does: edges are off by less than a cell, and the closing of gaps.
        assert np.abs(best - [x, y, x + SIDE, y + SIDE]).max() <= 8
    assert (found.xyxy >= 0).all()
    assert (found.xyxy <= [WIDTH, HEIGHT, WIDTH, HEIGHT]).all()
    assert ((found.confidence > 0.2) & (found.confidence <= 1)).all()
    assert "left.csv: expected a path that does not exist yet" in refusal(*arguments)
    made = compute(
        recording_of_video(open_video(pictures, 1.0)), SilhouetteSettings(), cache=tmp_path / "cache"
    )
    for index in range(FRAMES):
        blobs = find_blobs(np.asarray(made.arrays[0][index]), made.reduction, made.borders[0])
        np.testing.assert_allclose(
            found.in_frame(index).xyxy[:, :2], blobs.centre_px + 0.5 - blobs.size_px / 2
        )


def test_detect_takes_blobs_or_a_detector(pictures, tmp_path):
    assert "found none of them" in refusal("detect", pictures, "--out", tmp_path)
    both = refusal("detect", pictures, "--out", tmp_path, "--blobs", "--detector", "a.onnx")
    assert "--detector and --blobs" in both


def overlap(mask: np.ndarray, index: int) -> float:
    """Intersection over union of a mask and the square."""
    x, y = place(index)
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[y : y + SIDE, x : x + SIDE] = True
    return float(((mask > 127) & truth).sum() / ((mask > 127) | truth).sum())


def test_masks_of_pictures(pictures, tmp_path):
    out = tmp_path / "masks"
    assert f"{FRAMES} masks of 1 cameras" in run("detect", pictures, "--masks", out)
    files = sorted((out / "left").iterdir())
    assert [file.name for file in files] == [f"{index:06d}.png" for index in range(FRAMES)]
    for index, file in enumerate(files):
        mask = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert (mask.shape, mask.dtype) == ((HEIGHT, WIDTH), np.uint8)
        assert overlap(mask, index) > 0.95
    assert "masks/left: expected a path that does not exist yet" in refusal(
        "detect", pictures, "--masks", out
    )
    run("detect", pictures, "--masks", out, "--frames", 5, "--force", "--working-reduction", 2)
    assert len(list((out / "left").iterdir())) == 5
    reduced = cv2.imread(str(out / "left" / "000002.png"), cv2.IMREAD_UNCHANGED)
    assert reduced.shape == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(reduced[::2, ::2], reduced[1::2, 1::2])
    assert not list(out.glob(".*"))


@pytest.mark.parametrize("name", ["mask.mp4", "mask.avi"])
def test_masks_as_a_video(pictures, tmp_path, name):
    run("detect", pictures, "--masks", tmp_path / name)
    masks = probe(tmp_path / name)
    assert (masks.num_frames, masks.image_size_wh) == (FRAMES, (WIDTH, HEIGHT))
    for index, frame in enumerate(read_frames(masks)):
        assert overlap(frame[..., 0], index) > 0.95
    assert "expected a path that does not exist yet" in refusal(
        "detect", pictures, "--masks", tmp_path / name
    )


def test_a_single_video(tmp_path):
    """Names are those of the file; the codec of the video blurs the edges of the square."""
    with VideoWriter(tmp_path / "flight.avi", 25.0, (WIDTH, HEIGHT)) as writer:
        for index in range(FRAMES):
            writer.write(picture(index))
    run("detect", tmp_path / "flight.avi", "--masks", tmp_path / "masks")
    mask = cv2.imread(str(tmp_path / "masks" / "flight" / "000003.png"), cv2.IMREAD_UNCHANGED)
    assert overlap(mask, 3) > 0.6
    run(
        "detect",
        tmp_path / "flight.avi",
        "--blobs",
        "--out",
        tmp_path / "boxes",
        "--cache",
        tmp_path / "cache",
    )
    assert set(read_detections(tmp_path / "boxes" / "flight.csv").frame) == set(range(FRAMES))


def test_where_masks_cannot_go(pictures, tmp_path):
    (tmp_path / "file").write_text("")
    assert "expected a folder, or a file that ends in .mp4, .avi" in refusal(
        "detect", pictures, "--masks", tmp_path / "file"
    )
    shutil.copytree(pictures, tmp_path / "right")
    table = "".join(
        f'[cameras.{name}]\nvideo = "{name}"\nfps = 20\n' + CAMERA.format(turn=turn)
        for turn, name in enumerate(("left", "right"))
    )
    (tmp_path / "recording.toml").write_text("version = 1\n" + table)
    found = refusal("detect", tmp_path, "--masks", tmp_path / "a.mp4")
    assert "expected a folder, or one camera by --cameras, found a.mp4 for 2 cameras" in found
    run("detect", tmp_path, "--masks", tmp_path / "masks", "--jobs", 1)
    assert sorted(path.name for path in (tmp_path / "masks").iterdir()) == ["left", "right"]


def test_cameras_without_a_place_have_masks_and_blobs(pictures, tmp_path):
    """Neither needs a calibration."""
    (tmp_path / "recording.toml").write_text('version = 1\n[cameras.left]\nvideo = "left"\nfps = 20\n')
    run("detect", tmp_path, "--masks", tmp_path / "masks")
    assert len(list((tmp_path / "masks" / "left").iterdir())) == FRAMES
    run("detect", tmp_path, "--blobs", "--out", tmp_path / "boxes", "--cache", tmp_path / "cache")
    assert len(read_detections(tmp_path / "boxes" / "left.csv")) >= FRAMES
    shown = run("detect", "--silhouettes", tmp_path / "left", "--cache", tmp_path / "cache")
    assert "1 cameras, 12 frames: already there" in shown


def test_a_picture_that_is_none_ends_masks_and_blobs_in_one_line(pictures, tmp_path):
    shutil.copy(pictures / "notes.txt", pictures / "frame7.png")
    for arguments in (["detect", pictures, "--masks", tmp_path / "m"],
                      ["detect", pictures, "--blobs", "--out", tmp_path / "b", "--cache", tmp_path / "c"]):  # fmt: skip
        assert "frame7.png: expected an image" in refusal(*arguments)
    assert not (tmp_path / "m").exists() or not list((tmp_path / "m").iterdir())
    assert not (tmp_path / "b").exists()


def test_masks_that_cannot_be_written(pictures, tmp_path):
    (tmp_path / "blocked").write_text("")
    with pytest.raises((OutputError, InputError, SettingsError)):
        run("detect", pictures, "--masks", tmp_path / "blocked" / "masks")


def test_pictures_are_read_as_the_sensor_saw_them(tmp_path):
    """A phone that is held upright notes that its pictures are to be turned; a lens is calibrated for the sensor."""
    there, coded = cv2.imencode(".jpg", picture(0))
    # EXIF with one entry: orientation (0x112), a short, one value, 6: turn by 90 degrees.
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    data = coded.tobytes()
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    assert there
    for index in range(2):
        (tmp_path / f"{index}.jpg").write_bytes(turned)
    assert cv2.imread(str(tmp_path / "0.jpg")).shape == (WIDTH, HEIGHT, 3)
    video = open_video(tmp_path, 25.0)
    assert video.image_size_wh == (WIDTH, HEIGHT)
    assert next(read_frames(video)).shape == (HEIGHT, WIDTH, 3)

"""Images and videos whose headers claim gigapixels are refused in one line, before they take memory."""

import itertools
import os
import struct
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import assert_refused

from psotrack.recordings import probe, read_frames, read_image

pytestmark = pytest.mark.usefixtures("little_memory")

WIDTH, HEIGHT = 24, 16
PICTURE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def encoded(suffix: str, *flags: int) -> bytes:
    there, data = cv2.imencode(suffix, PICTURE, flags)
    assert there
    return data.tobytes()


def with_bytes(data: bytes, at: int, new: bytes) -> bytes:
    return data[:at] + new + data[at + len(new) :]


def png(width: int, height: int) -> bytes:
    data = encoded(".png")
    start = data.index(b"IHDR")
    header = with_bytes(data[start : start + 17], 4, struct.pack(">II", width, height))
    return with_bytes(data, start, header + struct.pack(">I", zlib.crc32(header)))


def jpeg(width: int, height: int, *flags: int, frame: bytes = b"\xff\xc0") -> bytes:
    data = encoded(".jpg", *flags)
    return with_bytes(data, data.index(frame) + 5, struct.pack(">HH", height, width))


def progressive_jpeg(width: int, height: int) -> bytes:
    return jpeg(width, height, cv2.IMWRITE_JPEG_PROGRESSIVE, 1, frame=b"\xff\xc2")


def jpeg_with_a_comment(width: int, height: int) -> bytes:
    """A comment that looks like the header of a small frame, junk, and a fill byte, as decoders accept them."""
    comment = b"\xff\xc0\0\x11\x08\0\1\0\1"
    data = jpeg(width, height)
    return data[:2] + b"\xff\xfe" + struct.pack(">H", 2 + len(comment)) + comment + b"junk\xff" + data[2:]


def bmp(width: int, height: int) -> bytes:
    return with_bytes(encoded(".bmp"), 18, struct.pack("<ii", width, -height))


def bmp_of_runs(width: int, height: int) -> bytes:
    """Runs of equal pixels (RLE8): the end of the image in two bytes."""
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 1, 0, 0, 0, 256, 0)
    return b"BM" + struct.pack("<IHHI", 1080, 0, 0, 1078) + header + bytes(1024) + b"\0\1"


def tiff(width: int, height: int, order: str = "<") -> bytes:
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 200), (277, 1), (278, height)]
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags)
    start = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    return (start + entries).ljust(200, b"\0") + bytes(1000)


def pnm(width: int, height: int) -> bytes:
    return b"P6\n# 1 1\n%d #\n %d\n255\n" % (width, height) + bytes(1152)


#: What writes an image of a claimed size, or the beginning of one.
IMAGES, BEGINNINGS = (
    [png, jpeg, progressive_jpeg, jpeg_with_a_comment, bmp, pnm],
    [bmp_of_runs, tiff, partial(tiff, order=">")],
)


# OpenCV itself refuses 2^30 pixels, and asks for the memory of fewer. A JPEG has sides of 16 bits, a PNG of 31.
@pytest.mark.parametrize(
    ("make", "size_wh"),
    [*itertools.product(IMAGES + BEGINNINGS, [(65_000, 65_000), (16_500, 16_500)]), (png, (2**31 - 1, 1))],
)
def test_an_image_that_claims_to_be_huge(make, size_wh, tmp_path):
    path = tmp_path / "a.png"  # OpenCV goes by the content.
    path.write_bytes(make(*size_wh))
    found = "a.png: expected images of at most 178956970 pixels, found "
    assert_refused(lambda: read_image(path), found, unchanged=tmp_path)
    # Found: a traceback of `cv2.remap`, in the detection of markers.
    path.write_bytes(make(100, 40_000))
    found = "images of at most 32766 pixels a side, found 100 x 40000 pixels"
    assert_refused(lambda: read_image(path), found, unchanged=tmp_path)
    # Where its size is true, it is an image.
    if make in IMAGES:
        path.write_bytes(make(WIDTH, HEIGHT))
        assert read_image(path).shape == PICTURE.shape


#: Suffix -> flags with which OpenCV writes it.
WRITTEN = {
    ".png": [()],
    ".jpg": [(cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 1)],
    ".bmp": [()],
    ".tif": [(), (cv2.IMWRITE_TIFF_COMPRESSION, 1)],
    ".webp": [(), (cv2.IMWRITE_WEBP_QUALITY, 50)],
    ".ppm": [(), (cv2.IMWRITE_PXM_BINARY, 0)],
}


@pytest.mark.parametrize("suffix", WRITTEN)
def test_images_as_programs_write_them_are_read(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    for flags in WRITTEN[suffix]:
        path.write_bytes(encoded(suffix, *flags))
        assert read_image(path).shape == PICTURE.shape


def test_what_others_write_while_an_image_is_decoded_stays_theirs(tmp_path, monkeypatch, capfd, caplog):
    """Found: the process's stderr was taken for each image, so that the line of another thread became a warning."""
    path, decode = tmp_path / "a.jpg", cv2.imdecode
    path.write_bytes(encoded(".jpg"))

    def decode_beside_another_thread(*arguments):
        os.write(2, b"a line of another thread\n")
        return decode(*arguments)

    monkeypatch.setattr(cv2, "imdecode", decode_beside_another_thread)
    read_image(path)
    assert capfd.readouterr().err == "a line of another thread\n"
    assert not caplog.records


def test_a_photograph_with_damaged_data_is_named(tmp_path, capfd, caplog):
    """libjpeg's own line, which does not name the file, is not shown; a cut one is refused."""
    path, data = tmp_path / "a.jpg", bytearray(encoded(".jpg"))
    data[-len(data) // 4 : -len(data) // 4 + 2] = b"\xff\xd5"
    path.write_bytes(data)
    assert read_image(path).shape == PICTURE.shape
    assert f"{path} is damaged (Corrupt JPEG data" in caplog.text
    sound = encoded(".jpg")
    path.write_bytes(sound[: int(0.9 * len(sound))])
    assert_refused(lambda: read_image(path), "a.jpg: expected an image", unchanged=tmp_path)
    assert capfd.readouterr().err == ""


def test_an_image_of_another_format(tmp_path):
    """OpenCV needs 10 GiB and a minute for this GIF."""
    path, data = tmp_path / "a.png", encoded(".gif")
    place = data.index(b",\0\0\0\0") + 5
    data = with_bytes(data, 6, struct.pack("<HH", 30_000, 30_000))
    path.write_bytes(with_bytes(data, place, b"\x30\x75\x30\x75"))
    found = "expected an image, found a file that is no PNG, JPEG, BMP, TIFF, WEBP, PPM, or"
    assert_refused(lambda: read_image(path), found, unchanged=tmp_path)


BOARD = "--squares 10x7 --square 0.03"


@pytest.mark.parametrize(
    "words",
    [
        "onboard localise {folder} --fps 25 --fov 70,55 --markers m.csv --out out.csv",
        "onboard map {folder} --fov 70,55 --side 0.2 --known 1 --out out.csv",
        "onboard detect {folder}/a0.jpg --out out.csv",
        "onboard detect {folder} --out out.csv",
        f"calibrate rig {{folder}} {BOARD} --out out.toml",
        f"calibrate rig {{folder}} {{flight}}/c1.avi {BOARD} --out out.toml",
        "detect {folder} --blobs --out out",
        "detect {folder} --masks out",
        "init --show recording.toml",
        "track recording.toml --out out.csv",
        "init recordings --fps 25",
    ],
)
def test_commands_that_read_images(words, flight, run_psotrack, tmp_path, monkeypatch):
    """Every command names the image, and writes nothing."""
    folder = tmp_path / "recordings" / "c0"
    folder.mkdir(parents=True)
    (folder / "a0.jpg").write_bytes(jpeg(30_000, 30_000))
    names = ";".join(f"{axis}{corner}" for corner in "1234" for axis in "xyz")
    (tmp_path / "m.csv").write_text(f"id;{names}\n1;0;0;0;1;0;0;1;0;1;0;0;1\n")
    (tmp_path / "recording.toml").write_text(
        f'version = 1\ncalibration = "{flight / "rig.toml"}"\n'
        f'[cameras.c0]\nimages = "recordings/c0/*.jpg"\nfps = 25.0\n[cameras.c1]\nvideo = "{flight / "c1.avi"}"\n'
    )
    monkeypatch.chdir(tmp_path)
    words = words.format(folder=folder, flight=flight).split()
    found = "found 900000000 pixels\n"
    assert_refused(lambda: run_psotrack(*words), "a0.jpg", found, unchanged=tmp_path)


# --- videos


def little_video(path: Path, codec: str) -> bytes:
    """Write three frames; the file's content."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 25.0, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    return path.read_bytes()


def raw_avi(path: Path, width: int, height: int) -> None:
    """A video of raw images, of which the header, and the header of its stream, claim a size."""
    data = little_video(path, "I420")
    data = with_bytes(data, data.index(b"avih") + 8 + 32, struct.pack("<II", width, height))
    path.write_bytes(with_bytes(data, data.index(b"strf") + 8 + 4, struct.pack("<ii", width, height)))


def avi_of_jpegs(path: Path, width: int, height: int) -> None:
    """A small video, of which one image claims to be huge."""
    parts = little_video(path, "MJPG").split(b"\xff\xc0")
    assert len(parts) == 4
    parts[2] = with_bytes(parts[2], 3, struct.pack(">HH", height, width))
    path.write_bytes(b"\xff\xc0".join(parts))


@pytest.mark.parametrize("size_wh", [(30_000, 30_000), (60_000, 60_000)])
@pytest.mark.parametrize("make", [raw_avi, avi_of_jpegs])
def test_a_video_of_huge_images(make, size_wh, tmp_path):
    path = tmp_path / "a.avi"
    make(path, *size_wh)
    assert_refused(lambda: list(read_frames(probe(path))), f"{path}: expected", unchanged=tmp_path)


def test_a_video_that_claims_to_last_for_days(tmp_path):
    """Found: the message did not name the file."""
    path = tmp_path / "a.avi"
    data = little_video(path, "XVID")
    for part, at in ((b"avih", 16), (b"strh", 32)):
        data = with_bytes(data, data.index(part) + 8 + at, struct.pack("<I", 20_000_000))
    path.write_bytes(data)
    found = (f"{path}: expected a video of at most", "found 20000000")
    assert_refused(lambda: probe(path), *found, unchanged=tmp_path)

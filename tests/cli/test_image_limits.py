"""Images and videos whose headers claim gigapixels are refused in one line, before they take memory."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import test_bad_input_limits
import worlds
from helpers import make_once
from test_bad_input_limits import check_line

from psotrack.errors import InputError
from psotrack.recordings import probe, read_frames, read_image

little_memory = test_bad_input_limits.little_memory

WIDTH, HEIGHT = 24, 16
#: Options of a chessboard.
BOARD = ("--squares", "10x7", "--square", "0.03")
PICTURE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def encoded(suffix: str, *flags: int) -> bytes:
    there, data = cv2.imencode(suffix, PICTURE, flags)
    assert there
    return data.tobytes()


def with_bytes(data: bytes, at: int, new: bytes) -> bytes:
    return data[:at] + new + data[at + len(new) :]


def png(width: int, height: int) -> bytes:
    return test_bad_input_limits.png_header(width, height)


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


def tiff_of_motorola(width: int, height: int) -> bytes:
    return tiff(width, height, ">")


def pnm(width: int, height: int) -> bytes:
    return b"P6\n# 1 1\n%d #\n %d\n255\n" % (width, height) + bytes(1000)


FORMATS = [
    png,
    jpeg,
    progressive_jpeg,
    jpeg_with_a_comment,
    bmp,
    bmp_of_runs,
    tiff,
    tiff_of_motorola,
    pnm,
]


# OpenCV itself refuses 2^30 pixels, and asks for the memory of fewer. A JPEG has sides of 16 bits.
@pytest.mark.parametrize("size_wh", [(30_000, 30_000), (65_000, 65_000), (16_500, 16_500)])
@pytest.mark.parametrize("make", FORMATS)
def test_an_image_that_claims_to_be_huge(make, size_wh, tmp_path, little_memory):
    path = tmp_path / "a.png"  # OpenCV goes by the content.
    path.write_bytes(make(*size_wh))
    width, height = size_wh
    found = rf"a\.png: expected images of at most 178956970 pixels, found ({width} x {height}|{width * height}) pixels"
    with pytest.raises(InputError, match=f"{found}$"):
        read_image(path)


@pytest.mark.parametrize("make", FORMATS)
def test_an_image_that_is_longer_than_opencv_warps(make, tmp_path):
    """Found: a traceback of `cv2.remap`, in the detection of markers."""
    path = tmp_path / "a.png"
    path.write_bytes(make(100, 40_000))
    with pytest.raises(InputError, match=r"images of at most 32766 pixels a side, found 100 x 40000 pixels"):
        read_image(path)


@pytest.mark.parametrize("make", [png, bmp, tiff, pnm])
def test_sides_of_more_than_16_bits(make, tmp_path, little_memory):
    path = tmp_path / "a.png"
    path.write_bytes(make(100_000, 100_000))
    with pytest.raises(InputError, match=r"found (100000 x 100000|10000000000) pixels"):
        read_image(path)


@pytest.mark.parametrize(
    ("suffix", "flags"),
    [
        (".png", ()),
        (".jpg", ()),
        (".jpg", (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)),
        (".jpg", (cv2.IMWRITE_JPEG_RST_INTERVAL, 1)),
        (".bmp", ()),
        (".tif", ()),
        (".tif", (cv2.IMWRITE_TIFF_COMPRESSION, 1)),
        (".webp", ()),
        (".webp", (cv2.IMWRITE_WEBP_QUALITY, 50)),
        (".ppm", ()),
        (".ppm", (cv2.IMWRITE_PXM_BINARY, 0)),
    ],
)
def test_images_as_programs_write_them_are_read(suffix, flags, tmp_path):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(suffix, *flags))
    assert read_image(path).shape == PICTURE.shape


@pytest.mark.parametrize("make", [jpeg, jpeg_with_a_comment, bmp])
def test_the_made_images_are_images_where_their_size_is_true(make, tmp_path):
    """Without this, the tests above might hold because the files are no images."""
    path = tmp_path / "a.png"
    path.write_bytes(make(WIDTH, HEIGHT))
    assert read_image(path).shape == PICTURE.shape


@pytest.mark.parametrize("make", FORMATS)
def test_headers_that_are_cut_short(make, tmp_path):
    path, data = tmp_path / "a.png", make(WIDTH, HEIGHT)
    for length in range(1, 40, 3):
        path.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"a\.png: expected an image, found"):
            read_image(path)


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
    """libjpeg's own line, which does not name the file, is not shown."""
    path, data = tmp_path / "a.jpg", bytearray(encoded(".jpg"))
    data[-len(data) // 4 : -len(data) // 4 + 2] = b"\xff\xd5"
    path.write_bytes(data)
    assert read_image(path).shape == PICTURE.shape
    assert capfd.readouterr().err == ""
    assert f"{path} is damaged (Corrupt JPEG data" in caplog.text


@pytest.mark.parametrize("kept", [0.3, 0.9])
def test_a_photograph_that_is_cut_short(kept, tmp_path, capfd):
    path, data = tmp_path / "a.jpg", encoded(".jpg")
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"a\.jpg: expected an image"):
        read_image(path)
    assert capfd.readouterr().err == ""


def test_an_image_of_another_format(tmp_path, little_memory):
    """OpenCV needs 10 GiB and a minute for this GIF."""
    path, data = tmp_path / "a.png", encoded(".gif")
    place = data.index(b",\0\0\0\0") + 5
    path.write_bytes(
        with_bytes(with_bytes(data, 6, struct.pack("<HH", 30_000, 30_000)), place, b"\x30\x75\x30\x75")
    )
    with pytest.raises(
        InputError, match="expected an image, found a file that is no PNG, JPEG, BMP, TIFF, WEBP, PPM, or"
    ):
        read_image(path)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return make_once(tmp_path_factory, "limits", worlds.make_sequence)


@pytest.mark.parametrize(
    "words",
    [
        (
            "onboard",
            "localise",
            "{folder}",
            "--fps",
            "25",
            "--fov",
            "70,55",
            "--markers",
            "m.csv",
            "--out",
            "{out}.csv",
        ),
        (
            "onboard",
            "map",
            "{folder}",
            "--fov",
            "70,55",
            "--side",
            "0.2",
            "--known",
            "1",
            "--out",
            "{out}.csv",
        ),
        ("onboard", "detect", "{image}", "--out", "{out}.csv"),
        ("onboard", "detect", "{folder}", "--out", "{out}.csv"),
        ("calibrate", "rig", "{folder}", *BOARD, "--out", "{out}.toml"),
        ("calibrate", "rig", "{folder}", "{flight}/c1.avi", *BOARD, "--out", "{out}.toml"),
        ("detect", "{folder}", "--blobs", "--out", "{out}"),
        ("detect", "{folder}", "--masks", "{out}"),
        ("init", "--show", "{recording}"),
        ("track", "{recording}", "--out", "{out}.csv"),
        ("init", "{recordings}", "--fps", "25"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_commands_that_read_images(words, flight, run_psotrack, tmp_path, monkeypatch, little_memory):
    """Every command names the image, and writes nothing."""
    folder = tmp_path / "recordings" / "c0"
    folder.mkdir(parents=True)
    image = folder / "a0.jpg"
    image.write_bytes(jpeg(30_000, 30_000))
    names = ";".join(f"{axis}{corner}" for corner in "1234" for axis in "xyz")
    (tmp_path / "m.csv").write_text(f"id;{names}\n1;0;0;0;1;0;0;1;0;1;0;0;1\n")
    recording = tmp_path / "recording.toml"
    recording.write_text(
        f'version = 1\ncalibration = "{flight / "rig.toml"}"\n'
        f'[cameras.c0]\nimages = "recordings/c0/*.jpg"\nfps = 25.0\n[cameras.c1]\nvideo = "{flight / "c1.avi"}"\n'
    )
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    places = {
        "folder": folder,
        "image": image,
        "flight": flight,
        "recording": recording,
        "recordings": folder.parent,
        "out": tmp_path / "out",
    }
    output = run_psotrack(*(word.format(**places) for word in words))
    check_line(output, image.name, "found 900000000 pixels\n")
    assert set(tmp_path.rglob("*")) == before


# Videos


def little_video(path: Path, codec: str) -> bytes:
    """Write three frames; the file's content."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 25.0, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    return path.read_bytes()


def avi(path: Path, width: int, height: int, codec: str = "XVID") -> None:
    """A video of which the header, and the header of its stream, claim a size."""
    data = little_video(path, codec)
    data = with_bytes(data, data.index(b"avih") + 8 + 32, struct.pack("<II", width, height))
    path.write_bytes(with_bytes(data, data.index(b"strf") + 8 + 4, struct.pack("<ii", width, height)))


def raw_avi(path: Path, width: int, height: int) -> None:
    avi(path, width, height, "I420")


def mp4(path: Path, width: int, height: int) -> None:
    data = little_video(path, "mp4v")
    # The sizes of the track (16.16) and of its description (16 bits).
    data = with_bytes(data, data.index(b"tkhd") + 4 + 76, struct.pack(">HHHH", width, 0, height, 0))
    path.write_bytes(with_bytes(data, data.index(b"mp4v") + 4 + 24, struct.pack(">HH", width, height)))


def avi_of_jpegs(path: Path, width: int, height: int) -> None:
    """A small video, of which one image claims to be huge."""
    parts = little_video(path, "MJPG").split(b"\xff\xc0")
    assert len(parts) == 4
    parts[2] = with_bytes(parts[2], 3, struct.pack(">HH", height, width))
    path.write_bytes(b"\xff\xc0".join(parts))


SIZES_WH = [(30_000, 30_000), (60_000, 60_000)]


@pytest.mark.parametrize("size_wh", SIZES_WH)
@pytest.mark.parametrize(("make", "name"), [(raw_avi, "a.avi"), (avi_of_jpegs, "a.avi")])
def test_a_video_of_huge_images(make, name, size_wh, tmp_path, little_memory):
    path = tmp_path / name
    make(path, *size_wh)
    with pytest.raises(InputError, match=rf"{path}: expected"):
        list(read_frames(probe(path)))


def test_a_video_that_claims_to_last_for_days(tmp_path):
    """Found: the message did not name the file."""
    path = tmp_path / "a.avi"
    data = little_video(path, "XVID")
    for part, at in ((b"avih", 16), (b"strh", 32)):
        data = with_bytes(data, data.index(part) + 8 + at, struct.pack("<I", 20_000_000))
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"{path}: expected a video of at most \d+ frames, found 20000000"):
        probe(path)


@pytest.mark.parametrize("size_wh", SIZES_WH)
@pytest.mark.parametrize(("make", "name"), [(avi, "a.avi"), (mp4, "a.mp4")])
def test_a_video_of_which_only_the_container_claims_a_size(make, name, size_wh, tmp_path, little_memory):
    """The codec knows the size of its images."""
    path = tmp_path / name
    make(path, *size_wh)
    assert {frame.shape for frame in read_frames(probe(path))} == {(48, 64, 3)}

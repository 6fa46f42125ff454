"""Wrong options and files: one line that names what is wrong, before hours are spent; nothing is written."""

import json
import math
import os
import struct
import zipfile
import zlib

import archives_made
import cv2
import numpy as np
import onnx_models
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import assert_refused

from psotrack.foreground.detection import DetectorSettings, OnnxDetector
from psotrack.pipeline import archives
from psotrack.recordings import probe, read_frames, read_image
from psotrack.recordings.datasets import open_recording, read_poses
from psotrack.recordings.exchange import read_tracks
from psotrack.recordings.mocap import read_c3d
from psotrack.settings import SwarmSettings, TrackSettings
from psotrack.trajectories import read_trajectories

HUGE = "9" * 5000
HEAD = "frame,time_s,drone,x_m,y_m,z_m\n"
CORNERS = f"id;{';'.join(f'{axis}{corner}' for corner in '1234' for axis in 'xyz')}\n"
ZEROS = f"{';0' * 12}\n"


# --- commands

BOARD = "--squares 10x7 --square 0.025 --out out.toml"
HUGE_IMAGE = ["a0.jpg", "found 900000000 pixels\n"]
#: Options of `track`, or of `track --causal` -> words of the line.
TRACK = {
    "--body-offset 1,2": ["--body-offset", "1,2"],
    "--particles 1000000000": ["swarm.particles"],
    f"--particles {HUGE[:400]}": ["swarm.particles"],
    "--drones 1000000000": ["drones.count"],
    "--causal --most-drones 1000000000": ["--most-drones"],
    "--cameras ,": ["--cameras", "names with commas"],
    "--cameras c0,c9": ["c9"],
    "--cameras c1": ["at least two cameras", "found c1"],
    "--min-cameras 1": ["min_cameras_to_begin"],
    "--frames 0": ["frames"],
    "--score sofd": ["score.kind", "did you mean soft?"],
    "--init none.csv": ["none.csv"],
    "--method projection-lines --detections nowhere": ["nowhere", "c0.csv", "no such folder"],
    "--method projection-lines --detections empty": ["drones", "none in any frame"],
    "--config run.toml": ["run.toml, swarm.particles: expected", "found -5"],
    "--save-config run": ["expected a file that ends in .toml"],
    # The name of an option of which a part was typed.
    "--speed 4": ["'--max-speed'"],
    "--ouut y": ["Did you mean one of: '--out'"],
}
#: Other commands -> words of the line. Where a fault is in the content of a file, the line names the file.
COMMANDS = {
    "trakc": ["trakc", "track", "psotrack --help"],
    "track": ["SEQ", "psotrack track --help"],
    "track {flight} --out t.xlsx": [".csv or .parquet", "t.xlsx"],
    "track nowhere --out out.csv": ["nowhere", "found nothing"],
    # Found: options without a default were not asked for, and the command failed later.
    "simulate fly": ["--device", "psotrack simulate fly --help"],
    "simulate S99 --out out": ["S99", "S02_D4_A"],
    "simulate S02_D4_A --out out --frames 100000": ["frames"],
    "evaluate late.csv {flight}": ["late.csv", "0 to 0.52 s, found 5000 to 5001 s"],
    "evaluate ms.csv {flight}": ["ms.csv", "found 0 to 520, which look like milliseconds; write seconds"],
    "evaluate one.csv {flight} --plot my.jpg": ["--plot", "ends in .png", "my.jpg"],
    f"calibrate rig left right {BOARD}": ["left and 1 more"],
    "track one_video --out out.csv --method fused": [
        "videos of at least two cameras",
        "found c0",
        "projection-lines",
    ],
    "init --show long": ["long", "c0.csv"],
    "onboard localise {flight}/c0.avi --markers digits.csv --out out.csv": ["digits.csv"],
    f"live {{flight}} --replay --out out.csv --udp 127.0.0.1:{HUGE}": ["--udp"],
    "report results --table": ["results"],
    # Every command that reads images names the one that claims to be huge.
    "onboard detect huge/c0/a0.jpg --out out.csv": HUGE_IMAGE,
    f"calibrate rig huge/c0 {BOARD}": HUGE_IMAGE,
    "detect huge/c0 --blobs --out out": HUGE_IMAGE,
    "init --show huge.toml": HUGE_IMAGE,
    "track huge.toml --out out.csv": HUGE_IMAGE,
    "init huge --fps 25": HUGE_IMAGE,
}


@pytest.fixture
def files(flight, tmp_path, monkeypatch):
    """The current folder: files that can be read, and that fit nothing."""
    monkeypatch.chdir(tmp_path)
    texts = {
        "late.csv": f"{HEAD}5000,5000,a,0,0,1\n5001,5001,a,0,0,1\n",
        "ms.csv": HEAD + "".join(f"{k},{40 * k},a,0,0,1\n" for k in range(14)),
        "one.csv": f"{HEAD}0,0,a,0,0,1\n",
        "digits.csv": f"{CORNERS}{HUGE}{ZEROS}",
        "run.toml": "swarm.particles = -5\n",
        "empty/c0.csv": "",
        "one_video/c1.csv": "0,1,1,5,5,3,3,0.9\n",
        "long/c0.csv": "2000000000,1,1,5,5,3,3,0.9\n",
        "results/cells/x.parquet": "junk",
    }
    rig = f'version = 1\ncalibration = "{flight / "rig.toml"}"\n'
    texts["one_video/recording.toml"] = (
        f'{rig}[cameras.c0]\nvideo = "{flight / "c0.avi"}"\n'
        '[cameras.c1]\ndetections = "c1.csv"\nfps = 25.0\nsize = [320, 240]\n'
    )
    # A camera without a video lasts until its last detection.
    texts["long/recording.toml"] = (
        f'{rig}[cameras.c0]\ndetections = "c0.csv"\nfps = 25.0\nsize = [320, 240]\n'
    )
    texts["huge.toml"] = (
        f'{rig}[cameras.c0]\nimages = "huge/c0/*.jpg"\nfps = 25.0\n'
        f'[cameras.c1]\nvideo = "{flight / "c1.avi"}"\n'
    )
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "huge" / "c0").mkdir(parents=True)
    (tmp_path / "huge" / "c0" / "a0.jpg").write_bytes(jpeg(30_000, 30_000))
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        for number in range(3):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((48, 64), 128, np.uint8))
    return tmp_path


for options, said in TRACK.items():
    COMMANDS[f"track {{flight}} --out out.csv --cache cache {options}"] = said


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[:60])
def test_a_command_refuses(command, files, flight, run_psotrack, little_memory):
    words = [word.format(flight=flight) for word in command.split()]
    said = [each.format(flight=flight) for each in COMMANDS[command]]
    assert_refused(lambda: run_psotrack(*words), *said, unchanged=files)


# --- settings

#: Name of a setting, a value, and how the line goes on.
SETTINGS = [
    ("swarm.particles", 1, "expected a whole number of at least 2, found 1"),
    # JAX takes the last 32 bits: found, seeds 0 and 2^32 gave the same run.
    ("seed", 2**32, "expected a whole number of at most 4294967295, found 4294967296"),
    ("bounds_m", (0, 1), "expected a list of length 6, found [0, 1]"),
    ("bounds_m", (0, 1, 0, 1, 2, 1), "expected x0 < x1, y0 < y1, z0 < z1, found (0, 1, 0, 1, 2, 1)"),
    ("smooth", "yes", 'expected true or false, found "yes"'),
    ("swarm.partikles", 20, "found swarm.partikles; did you mean swarm.particles?"),
    ("swarm.kind", "both", "expected one of joint, per-drone, found both"),
    ("swarm.inertia", math.inf, "expected finite numbers, found inf"),
    ("drones.body_offset_m", (0.0, math.nan, 0.0), "expected finite numbers, found (0.0, nan, 0.0)"),
    ("drones.size_m", (0.4, 0.4, 0.0), "expected a number above 0, found [0.4, 0.4, 0.0]"),
    ("score.windows", (), "expected a list of length at least 1, found []"),
    ("status.min_fitness", 1.5, "expected a number of at most 1, found 1.5"),
]


@pytest.mark.parametrize(("name", "value", "said"), SETTINGS)
def test_a_wrong_setting_is_named(name, value, said, tmp_path):
    line = f"psotrack: {name}: "
    assert_refused(lambda: TrackSettings().changed({name: value}), line, said, unchanged=tmp_path)


def test_a_record_made_in_python_has_the_limits(tmp_path):
    assert_refused(lambda: SwarmSettings(spread_m=0), "swarm.spread_m: expected a number", unchanged=tmp_path)


# --- files

LFS = "version https://git-lfs.github.com/spec/v1"
NUL = "expected UTF-8 text, found a NUL"
FRAME = "line 2: expected a whole number from 0 in frame"
POINT, POINTER = "decimals with a point", "found a Git LFS pointer"


def rows_of(count, row):
    return "".join(row.format(number, number + 1) for number in range(count))


def json_of_empty_drones():
    frames = list(range(20_000))
    content = {"format": "psotrack tracks", "version": 1, "frame": frames, "time_s": frames}
    return json.dumps(content | {"drones": [{"name": "a", "position_m": []}] * len(frames)})


MOTIVE = "Format Version,1.23,Take Name,a\n\n,,Type\n"
#: Name of the case -> name of the file, the function that reads it, its text, words of the line.
TEXTS = {
    "a huge frame of poses": (
        *("dron1_pos_25.csv", read_poses, "id;pos_x[m];pos_y[m];pos_z[m]\n0;0;0;0\n300000000;1;2;3\n"),
        *("line 3, column id: expected a frame number", "found 300000000"),
    ),
    "a frame of 300 digits": ("t.csv", read_trajectories, f"{HEAD}1e300,0,a,0,0,1\n", FRAME),
    # Arrays over frames and drones would have a cell for each pair: 10^10 for 3 MB of text.
    "a drone of its own in each row": (
        *("t.csv", read_trajectories, HEAD + rows_of(100_000, "{0},{0},d{0},0,0,1\n")),
        "found 100000 frames and 100000 drones in 100000 rows",
    ),
    "an identity of its own in each row": (
        "tracks.txt",
        lambda path: (path.with_name("seqinfo.ini").exists(), read_tracks(path)),
        rows_of(20_000, "{1},{1},-1,-1,-1,-1,1,0,0,1\n"),
        "tracks.txt: expected drones that are there in most frames",
    ),
    "thousands of empty drones": ("t.json", read_tracks, json_of_empty_drones(), "t.json"),
    "a NUL in a row": ("t.csv", read_trajectories, f"{HEAD}0,0,a\0,0,0,1\n", "t.csv", NUL),
    "semicolons": ("t.csv", read_trajectories, HEAD.replace(",", ";"), "by commas, found semicolons"),
    "a decimal comma": ("t.csv", read_trajectories, f'{HEAD}0,0,a,"0,5",0,1\n', "line 2", POINT),
    "a pointer of Git LFS": ("a.c3d", read_c3d, f"{LFS}\noid sha256:0\n", "a.c3d", POINTER, "git lfs pull"),
    "a video that is a pointer": ("a.mp4", probe, f"{LFS}\n", "a.mp4: expected a video, ", POINTER),
    "a ROS 1 bag": ("a.bag", read_tracks, "#ROSBAG V2.0\n", "found a ROS 1 bag", "rosbags-convert"),
    "a table of Motive": ("a.csv", read_tracks, f"\ufeff{MOTIVE}", "OptiTrack Motive; export C3D"),
    "poses of Motive": ("a.csv", read_poses, MOTIVE, "OptiTrack Motive; export C3D"),
    "a table of Nexus": ("a.csv", read_poses, "Trajectories\n100\n", "table of Vicon Nexus; export C3D"),
    "a NUL in TOML": ("recording.toml", open_recording, "version = 1\n#\0\n", "recording.toml", NUL),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_is_refused(name, tmp_path, little_memory):
    file, read, text, *said = TEXTS[name]
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nframeRate=25\n")
    (tmp_path / file).write_text(text, encoding="utf-8")
    assert_refused(lambda: read(tmp_path / file), *said, unchanged=tmp_path)


def test_tracks_of_huge_frames_are_sparse(tmp_path, little_memory):
    (tmp_path / "t.csv").write_text(f"{HEAD}0,0,a,0,0,1\n2000000000,8e7,a,0,0,1\n")
    assert read_trajectories(tmp_path / "t.csv").num_frames == 2


def test_a_parquet_file_of_one_repeated_row(tmp_path, little_memory):
    """Three million rows in a few kilobytes; more would take gigabytes."""
    path, rows = tmp_path / "t.parquet", 3_000_000
    columns = {"frame": np.zeros(rows, np.int64), "drone": pa.array(["a"] * rows)}
    pq.write_table(pa.table(columns | {name: np.zeros(rows) for name in ("x_m", "y_m", "z_m")}), path)
    assert path.stat().st_size < 100_000
    limit = "t.parquet: expected at most 1000000 rows in a file of"
    assert_refused(lambda: read_trajectories(path), limit, unchanged=tmp_path)


def test_an_archive_that_unpacks_to_far_more_than_it_is(tmp_path, monkeypatch):
    """The limit is lowered, so that the test needs no 256 MiB."""
    path = tmp_path / "a.psotrack"
    with (
        zipfile.ZipFile(archives_made.OLD) as before,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as after,
    ):
        manifest = json.loads(before.read("psotrack.json"))
        for name in manifest["files"]:
            after.writestr(name, before.read(name))
        after.writestr("zeros.csv", bytes(8 << 20))
        after.writestr("psotrack.json", json.dumps(manifest | {"files": [*manifest["files"], "zeros.csv"]}))
    archives.unpack(path, tmp_path / "usual")
    monkeypatch.setattr("psotrack.pipeline.archives.archive_file._SMALL", 1 << 20)
    limit = "a.psotrack: expected files of at most"
    assert_refused(lambda: archives.unpack(path, tmp_path / "folder"), limit, unchanged=tmp_path)


# --- pictures whose headers claim gigapixels

WIDTH, HEIGHT = 24, 16
PICTURE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)


def encoded(suffix, *flags):
    there, data = cv2.imencode(suffix, PICTURE, flags)
    assert there
    return data.tobytes()


def with_bytes(data, at, new):
    return data[:at] + new + data[at + len(new) :]


def png(width, height):
    data = encoded(".png")
    start = data.index(b"IHDR")
    header = with_bytes(data[start : start + 17], 4, struct.pack(">II", width, height))
    return with_bytes(data, start, header + struct.pack(">I", zlib.crc32(header)))


def jpeg(width, height, *flags, frame=b"\xff\xc0"):
    data = encoded(".jpg", *flags)
    return with_bytes(data, data.index(frame) + 5, struct.pack(">HH", height, width))


def progressive_jpeg(width, height):
    return jpeg(width, height, cv2.IMWRITE_JPEG_PROGRESSIVE, 1, frame=b"\xff\xc2")


def jpeg_with_a_comment(width, height):
    """A comment that looks like the header of a small frame, junk, and a fill byte, as decoders accept them."""
    comment = b"\xff\xc0\0\x11\x08\0\1\0\1"
    data = jpeg(width, height)
    return data[:2] + b"\xff\xfe" + struct.pack(">H", 2 + len(comment)) + comment + b"junk\xff" + data[2:]


def bmp(width, height):
    return with_bytes(encoded(".bmp"), 18, struct.pack("<ii", width, -height))


def bmp_of_runs(width, height):
    """Runs of equal pixels (RLE8): the end of the image in two bytes."""
    header = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 1, 0, 0, 0, 256, 0)
    return b"BM" + struct.pack("<IHHI", 1080, 0, 0, 1078) + header + bytes(1024) + b"\0\1"


def tiff(width, height, order="<"):
    tags = [(256, width), (257, height), (258, 8), (259, 1), (262, 1), (273, 200), (277, 1), (278, height)]
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in tags)
    start = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(tags))
    return (start + entries).ljust(200, b"\0") + bytes(1000)


def pnm(width, height):
    return b"P6\n# 1 1\n%d #\n %d\n255\n" % (width, height) + bytes(1152)


#: What writes an image of a claimed size.
IMAGES = [png, jpeg, progressive_jpeg, jpeg_with_a_comment, bmp, pnm]
#: What writes the beginning of one.
BEGINNINGS = [bmp_of_runs, tiff, lambda *size: tiff(*size, order=">")]


@pytest.mark.parametrize("make", IMAGES + BEGINNINGS)
def test_an_image_that_claims_to_be_huge(make, tmp_path, little_memory):
    path = tmp_path / "a.png"  # OpenCV goes by the content.
    found = "a.png: expected images of at most 178956970 pixels, found "
    # OpenCV itself refuses 2^30 pixels, and asks for the memory of fewer.
    for side in (65_000, 16_500):
        path.write_bytes(make(side, side))
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
def test_images_as_programs_write_them_are_read(suffix, tmp_path, little_memory):
    path = tmp_path / f"a{suffix}"
    for flags in WRITTEN[suffix]:
        path.write_bytes(encoded(suffix, *flags))
        assert read_image(path).shape == PICTURE.shape


def test_what_others_write_while_an_image_is_decoded_stays_theirs(
    tmp_path, monkeypatch, capfd, caplog, little_memory
):
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


def test_a_photograph_with_damaged_data_is_named(tmp_path, capfd, caplog, little_memory):
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
    """OpenCV needs 10 GiB and a minute for a GIF that claims gigapixels."""
    path = tmp_path / "a.png"
    path.write_bytes(encoded(".gif"))
    found = "expected an image, found a file that is no PNG, JPEG, BMP, TIFF, WEBP, PPM, or"
    assert_refused(lambda: read_image(path), found, unchanged=tmp_path)


def little_video(path, codec):
    """Write three frames; the file's content."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 25.0, (64, 48))
    for _ in range(3):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    return path.read_bytes()


def raw_avi(path, width, height):
    """A video of raw images, of which the header, and the header of its stream, claim a size."""
    data = little_video(path, "I420")
    data = with_bytes(data, data.index(b"avih") + 8 + 32, struct.pack("<II", width, height))
    path.write_bytes(with_bytes(data, data.index(b"strf") + 8 + 4, struct.pack("<ii", width, height)))


def avi_of_jpegs(path, width, height):
    """A small video, of which one image claims to be huge."""
    parts = little_video(path, "MJPG").split(b"\xff\xc0")
    assert len(parts) == 4
    parts[2] = with_bytes(parts[2], 3, struct.pack(">HH", height, width))
    path.write_bytes(b"\xff\xc0".join(parts))


def test_a_video_of_huge_images(tmp_path, little_memory):
    path = tmp_path / "a.avi"
    raw_avi(path, 30_000, 30_000)
    assert_refused(lambda: list(read_frames(probe(path))), f"{path}: expected", unchanged=tmp_path)


def test_a_frame_that_claims_to_be_huge_shows_the_picture_before(tmp_path, little_memory):
    path = tmp_path / "a.avi"
    avi_of_jpegs(path, 30_000, 30_000)
    assert [frame.shape for frame in read_frames(probe(path))] == [(48, 64, 3)] * 3


def test_a_video_that_claims_to_last_for_days(tmp_path, little_memory, caplog):
    path = tmp_path / "a.avi"
    data = little_video(path, "XVID")
    for part, at in ((b"avih", 16), (b"strh", 32)):
        data = with_bytes(data, data.index(part) + 8 + at, struct.pack("<I", 20_000_000))
    path.write_bytes(data)
    assert probe(path).num_frames == 3
    assert "its header says 20000000 frames" in caplog.text


# --- networks


#: Name of the case -> whether the tensor is an initializer or the value of a node, the file that the tensor names, and
#: the bytes of the word "location", whose length may have more bytes than it needs.
OTHER_FILES = {
    "initializer": (True, "secret.bin", b"\x08location"),
    "node": (False, "secret.bin", b"\x08location"),
    "folder above": (True, "../secret.bin", b"\x08location"),
    "superfluous zero": (False, "secret.bin", b"\x88\x00location"),
}


@pytest.mark.parametrize("name", OTHER_FILES)
def test_a_network_that_reads_another_file(name, tmp_path, monkeypatch):
    """OpenCV reads every file that a tensor names."""
    is_initializer, place, word = OTHER_FILES[name]
    shape = (1, 3, 64, 64)
    values = np.full(shape, 7, np.float32)
    path = tmp_path / "in" / "net.onnx"
    path.parent.mkdir()
    (path.parent / place).write_bytes(values.tobytes())
    message = onnx_models._message
    location = message((1, "location"), (2, place)).replace(b"\x08location", word)
    sides = [(1, side) for side in shape]
    tensor = message(*sides, (2, 1), (8, "secret"), (13, location), (14, 1))
    add = onnx_models._node("Add", ["images", "secret"], "output")
    if is_initializer:
        monkeypatch.setattr(onnx_models, "_tensor", lambda name, values: tensor)
        content = onnx_models.model([add], {"secret": values}, shape, shape)
    else:
        value = message((1, "value"), (5, tensor), (20, 4))
        constant = message((2, "secret"), (4, "Constant"), (5, value))
        content = onnx_models.model([constant, add], {}, shape, shape)
    path.write_bytes(content)
    found = "found tensors in other files"
    assert_refused(lambda: OnnxDetector(path, DetectorSettings(size=64)), path, found, unchanged=tmp_path)


def test_a_network_of_terabytes(tmp_path):
    """A constant of 10^12 numbers in a few bytes; a trial process ends."""
    path, shape = tmp_path / "net.onnx", np.array([1000, 1000, 1000, 1000], np.int64)
    node = onnx_models._node("ConstantOfShape", ["shape"], "output")
    path.write_bytes(onnx_models.model([node], {"shape": shape}, (1, 3, 64, 64), (1, 1, 1, 1)))
    image, settings = np.zeros((64, 64, 3), np.uint8), DetectorSettings(size=64)
    assert_refused(
        lambda: OnnxDetector(path, settings).boxes(image), "net.onnx: expected", unchanged=tmp_path
    )

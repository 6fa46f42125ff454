"""Numbers in files and options that would take gigabytes or hours, or mean nothing, are refused in one line."""

import io
import resource
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
import onnx_models
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import test_archives
import worlds
from helpers import make_once

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.detection import DetectorSettings, OnnxDetector
from psotrack.pipeline import archives
from psotrack.recordings import read_image
from psotrack.recordings.datasets import (
    open_recording,
    read_marker_corners,
    read_masks,
    read_poses,
)
from psotrack.recordings.exchange import read_tracks
from psotrack.settings import DroneSettings, SwarmSettings, TrackSettings
from psotrack.sweeps import Store
from psotrack.trajectories import read_trajectories

HUGE = "9" * 5000


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return make_once(tmp_path_factory, "limits", worlds.make_sequence)


@pytest.fixture
def little_memory():
    """A wrong allocation is an error, not a machine that swaps; the limit is far above what the tests need."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def check_line(output, *words: object) -> None:
    """The command ended with one short line that has some words."""
    assert output.code == 2, output.err
    assert output.err.count("\n") == 1, output.err
    # A long place, such as the folder of the tests, is not cut.
    assert len(output.err) <= len("psotrack: ") + 301 + 75, output.err
    for word in words:
        assert str(word) in output.err


# Options


@pytest.mark.parametrize(
    ("options", "name"),
    [
        (("--body-offset", "inf,0,0"), "drones.body_offset_m"),
        (("--body-offset", "0,nan,0"), "drones.body_offset_m"),
        (("--bounds", "0,1,0,1,0,nan"), "bounds_m"),
        (("--bounds", "0,inf,0,1,0,1"), "bounds_m"),
        (("--particles", "1000000000"), "swarm.particles"),
        (("--particles", HUGE[:400]), "swarm.particles"),
        (("--iterations", "1000000000"), "swarm.iterations"),
        (("--iterations", "-1"), "swarm.iterations"),
        (("--drones", "1000000000"), "drones.count"),
        (("--drones", "0"), "drones.count"),
        (("--seed", "9" * 30), "seed"),
        (("--causal", "--most-drones", "1000000000"), "--most-drones"),
        (("--cameras", ""), "--cameras"),
        (("--cameras", "c0,,c1"), "--cameras"),
        (("--min-cameras", "1"), "min_cameras_to_begin"),
        (("--frames", "0"), "frames"),
    ],
)
def test_options_of_track(flight, run_psotrack, tmp_path, options, name):
    """Refused before the work; nothing is written."""
    output = run_psotrack(
        "track", flight, "--out", tmp_path / "out.csv", "--cache", tmp_path / "cache", *options
    )
    check_line(output, name)
    assert not list(tmp_path.glob("out*"))


@pytest.mark.parametrize("command", ["silhouettes", "detect"])
def test_no_camera_is_no_camera(command, flight, run_psotrack, tmp_path):
    words = {
        "silhouettes": ("detect", flight, "--masks", tmp_path / "o"),
        "detect": ("detect", flight, "--blobs", "--out", tmp_path / "o"),
    }[command]
    check_line(run_psotrack(*words, "--cameras", ""), "--cameras")


def test_settings_in_python_have_the_limits():
    for make in (
        lambda: SwarmSettings(particles=10**9),
        lambda: SwarmSettings(iterations=10**9),
        lambda: DroneSettings(count=10**9),
        lambda: DroneSettings(body_offset_m=(0.0, 0.0, float("inf"))),
        lambda: TrackSettings(seed=2**63),
    ):
        with pytest.raises(SettingsError):
            make()
    assert TrackSettings(seed=2**63 - 1).seed == 2**63 - 1


# Numbers of frames


@pytest.mark.parametrize("frame", [2_000_000_000, 300_000_000])
def test_a_huge_frame_in_poses(frame, tmp_path, little_memory):
    path = write(tmp_path / "dron1_pos_25.csv", f"id;pos_x[m];pos_y[m];pos_z[m]\n0;0;0;0\n{frame};1;2;3\n")
    with pytest.raises(InputError, match=rf"line 3, column id: expected a frame number .* found {frame}"):
        read_poses(path)


def test_a_huge_frame_in_detections_of_a_camera_without_video(flight, run_psotrack, tmp_path, little_memory):
    """Such a camera lasts until its last detection."""
    boxes = write(tmp_path / "c0.csv", "2000000000,1,1,5,5,3,3,0.9\n")
    content = (
        f'version = 1\ncalibration = "{flight / "rig.toml"}"\n[cameras.c0]\ndetections = "c0.csv"\nfps = 25.0\n'
        "size = [320, 240]\n"
    )
    recording = write(tmp_path / "recording.toml", content)
    check_line(run_psotrack("init", "--show", tmp_path), boxes)
    recording.write_text(
        content.replace('detections = "c0.csv"', 'detections = "c0.csv"\nframes = 2000000000')
    )
    check_line(run_psotrack("init", "--show", tmp_path), recording, "cameras.c0.frames")


def test_tracks_of_huge_frames_are_sparse(tmp_path, little_memory):
    text = "frame,time_s,drone,x_m,y_m,z_m\n0,0,a,0,0,1\n2000000000,8e7,a,0,0,1\n"
    assert read_trajectories(write(tmp_path / "t.csv", text)).num_frames == 2


@pytest.mark.parametrize("frame", ["1e300", "9223372036854775808", HUGE[:400]])
def test_a_frame_that_no_integer_holds(frame, tmp_path):
    path = write(tmp_path / "t.csv", f"frame,time_s,drone,x_m,y_m,z_m\n{frame},0,a,0,0,1\n")
    with pytest.raises(InputError, match="line 2: expected a whole number from 0 in frame"):
        read_trajectories(path)


def test_a_drone_of_its_own_in_every_row(tmp_path, little_memory):
    """Arrays over frames and drones would have a cell for each pair: 10^10 for 3 MB of text."""
    rows = "".join(f"{row},{row},d{row},0,0,1\n" for row in range(100_000))
    path = write(tmp_path / "t.csv", f"frame,time_s,drone,x_m,y_m,z_m\n{rows}")
    with pytest.raises(InputError, match="found 100000 frames and 100000 drones in 100000 rows"):
        read_trajectories(path)


def test_an_identity_of_its_own_in_every_row(tmp_path, little_memory):
    rows = "".join(f"{row + 1},{row + 1},-1,-1,-1,-1,1,0,0,1\n" for row in range(20_000))
    path = write(tmp_path / "tracks.txt", rows)
    write(tmp_path / "seqinfo.ini", "[Sequence]\nframeRate=25\n")
    with pytest.raises(InputError, match=r"tracks\.txt: expected drones that are there in most frames"):
        read_tracks(path)


def test_json_with_thousands_of_empty_drones(tmp_path, little_memory):
    drones = ",".join('{"name":"a","position_m":[]}' for _ in range(20_000))
    frames = ",".join(map(str, range(20_000)))
    head = '"format":"psotrack tracks","version":1,"frame":'
    path = write(tmp_path / "t.json", f'{{{head}[{frames}],"time_s":[{frames}],"drones":[{drones}]}}')
    with pytest.raises(InputError, match=r"t\.json"):
        read_tracks(path)


def test_a_parquet_file_of_one_repeated_row(tmp_path, little_memory):
    """Three million rows in a few kilobytes; more would take gigabytes."""
    path, rows = tmp_path / "t.parquet", 3_000_000
    columns = {"frame": np.zeros(rows, np.int64), "drone": pa.array(["a"] * rows)}
    columns |= {name: np.zeros(rows) for name in ("x_m", "y_m", "z_m")}
    pq.write_table(pa.table(columns), path)
    assert path.stat().st_size < 100_000
    with pytest.raises(InputError, match=r"t\.parquet: expected at most 1000000 rows in a file of"):
        read_trajectories(path)


# Numbers of markers


@pytest.mark.parametrize("header", ["id;x;y;z", f"id;{';'.join(f'{a}{c}' for c in '1234' for a in 'xyz')}"])
def test_a_marker_of_thousands_of_digits(header, flight, run_psotrack, tmp_path):
    values = ";".join(["0"] * header.count(";"))
    path = write(tmp_path / "m.csv", f"{header}\n{HUGE[:900]};{values}\n")
    output = run_psotrack(
        "onboard", "localise", flight / "c0.avi", "--markers", path, "--out", tmp_path / "o.csv"
    )
    check_line(output, path)
    path.write_text(f"{header}\n{HUGE};{values}\n")
    output = run_psotrack(
        "onboard", "localise", flight / "c0.avi", "--markers", path, "--out", tmp_path / "o.csv"
    )
    check_line(output, path)


@pytest.mark.parametrize(
    "words",
    [
        ("calibrate", "convert", "rig.toml", "out.toml", "--size", f"{HUGE},720"),
        ("onboard", "map", "c0.avi", "--known", HUGE, "--side", "0.2", "--out", "m.csv"),
        ("live", ".", "--out", "o.csv", "--udp", f"127.0.0.1:{HUGE}"),
    ],
)
def test_options_of_thousands_of_digits(words, flight, run_psotrack, monkeypatch):
    monkeypatch.chdir(flight)
    check_line(run_psotrack(*words))


# Texts


@pytest.mark.parametrize(
    ("name", "text", "read"),
    [
        ("t.csv", "frame,time_s,drone,x_m,y_m,z_m,\0\n0,0,a,0,0,1,\n", read_trajectories),
        ("t.csv", "frame,time_s,drone,x_m,y_m,z_m\n0,0,a\0,0,0,1\n", read_trajectories),
        ("dron1_pos_25.csv", "id;pos_x[m];pos_y[m];pos_z[m];\0\n0;0;0;0;0\n", read_poses),
        ("m.csv", "id;x1\0;y1\n1;0;0\n", read_marker_corners),
        ("recording.toml", "version = 1\n#\0\n", open_recording),
    ],
)
def test_a_nul_in_a_text(name, text, read, tmp_path):
    with pytest.raises(InputError, match=rf"{name}.*: expected UTF-8 text, found a NUL"):
        read(write(tmp_path / name, text))


# Files that unpack or decode to far more than they are


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("size_wh", [(60_000, 60_000), (30_000, 30_000), (2**31 - 1, 1)])
def test_an_image_that_claims_to_be_huge(size_wh, tmp_path, little_memory):
    path = tmp_path / "a.png"
    path.write_bytes(png_header(*size_wh))
    with pytest.raises(InputError, match=r"a\.png: expected images of at most \d+ pixels"):
        read_image(path)


def test_masks_that_unpack_to_gigabytes(tmp_path, little_memory):
    """Zeros of 80 MiB are 80 kB in a zip file."""
    path = tmp_path / "drone_masks.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("cam1i/dron1/000000.png", bytes(80 << 20))
    assert path.stat().st_size < 100_000
    with read_masks(path) as masks, pytest.raises(InputError, match="expected an image of at most"):
        masks.mask("cam1i", 1, 0)


def test_masks_that_unpack_to_more_than_they_state(tmp_path):
    """`zipfile` unpacks as many bytes as are stated, and finds that their checksum differs."""
    path = tmp_path / "drone_masks.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("cam1i/dron1/000000.png", bytes(80 << 20))
    content = path.read_bytes().replace(struct.pack("<I", 80 << 20), struct.pack("<I", 100))
    path.write_bytes(content)
    with read_masks(path) as masks, pytest.raises(InputError, match=r"000000\.png: expected an image"):
        masks.mask("cam1i", 1, 0)


def test_an_archive_that_unpacks_to_far_more_than_it_is(tmp_path, monkeypatch):
    """The limit is lowered, so that the test needs no 256 MiB."""
    path = test_archives.crafted(
        tmp_path / "a.psotrack", [*test_archives.FILES.items(), ("x.csv", bytes(4 << 20))]
    )
    compressed = io.BytesIO()
    with zipfile.ZipFile(path) as stored, zipfile.ZipFile(compressed, "w", zipfile.ZIP_DEFLATED) as zipped:
        for name in stored.namelist():
            zipped.writestr(name, stored.read(name))
    path.write_bytes(compressed.getvalue())
    archives.unpack(path, tmp_path / "usual")
    monkeypatch.setattr("psotrack.pipeline.archives.zip_file._SMALL", 1 << 20)
    with pytest.raises(
        InputError, match=r"a\.psotrack: expected files of at most \d+ bytes in an archive of \d+"
    ):
        archives.unpack(path, tmp_path / "folder")
    assert not (tmp_path / "folder").exists()


def test_numbers_of_thousands_of_digits_in_names_of_masks(tmp_path):
    path = tmp_path / "drone_masks.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"cam1i/dron1/{HUGE}.png", b"")
    with pytest.raises(InputError, match=r"drone_masks\.zip: expected images such as"):
        read_masks(path)


# Results of sweeps


@pytest.fixture
def sweep_folder(tmp_path):
    """Results of one cell."""
    rows = pd.DataFrame({"seed": [0], "mean_error_m": [0.01]})
    store = Store(tmp_path / "results")
    store.add("a" * 40, rows)
    return store.folder


JUNK = [b"", b"junk", b"PAR1" + bytes(40) + b"PAR1", b"[1, 2]", b'{"runs": 3}', b"\xff\xfe\x00"]


@pytest.mark.parametrize("junk", JUNK)
def test_junk_in_a_cell_of_a_sweep(junk, sweep_folder, run_psotrack):
    path = sweep_folder / "cells" / f"{'a' * 40}.parquet"
    path.write_bytes(junk)
    check_line(run_psotrack("report", sweep_folder, "--table"), path)
    assert path.read_bytes() == junk


# Networks


@pytest.mark.parametrize("place", ["../secret.bin", "secret.bin", "{folder}/secret.bin"])
@pytest.mark.parametrize(
    "inside", ["initializer", "attribute", "attribute, a length with a superfluous zero"]
)
def test_a_network_that_reads_another_file(place, inside, tmp_path, monkeypatch):
    """OpenCV reads every file that a tensor names; here it is not asked to."""
    values = np.full((1, 3, 64, 64), 7, np.float32)
    (tmp_path / "in").mkdir()
    for folder in (tmp_path, tmp_path / "in"):
        (folder / "secret.bin").write_bytes(values.tobytes())
    message, path = onnx_models._message, tmp_path / "in" / "net.onnx"
    location = message((1, "location"), (2, place.format(folder=tmp_path)))
    if "zero" in inside:
        location = location.replace(b"\x08location", b"\x88\x00location")
    shape = [(1, side) for side in values.shape]
    tensor = message(*shape, (2, 1), (8, "secret"), (13, location), (14, 1))
    if inside == "initializer":
        monkeypatch.setattr(onnx_models, "_tensor", lambda name, values: tensor)
        nodes, tensors = [onnx_models._node("Add", ["images", "secret"], "output")], {"secret": values}
    else:
        constant = message((2, "secret"), (4, "Constant"), (5, message((1, "value"), (5, tensor), (20, 4))))
        nodes, tensors = [constant, onnx_models._node("Add", ["images", "secret"], "output")], {}
    path.write_bytes(onnx_models.model(nodes, tensors, (1, 3, 64, 64), (1, 3, 64, 64)))
    with pytest.raises(InputError, match=r"net\.onnx: .* found tensors in other files"):
        OnnxDetector(path, DetectorSettings(size=64))


def test_a_network_that_asks_for_terabytes(tmp_path):
    """A constant of 10^12 numbers in a few bytes."""
    path = tmp_path / "net.onnx"
    shape = np.array([1000, 1000, 1000, 1000], np.int64)
    node = onnx_models._node("ConstantOfShape", ["shape"], "output")
    path.write_bytes(onnx_models.model([node], {"shape": shape}, (1, 3, 64, 64), (1, 1, 1, 1)))
    with pytest.raises(InputError, match=r"net\.onnx: expected"):
        OnnxDetector(path, DetectorSettings(size=64)).boxes(np.zeros((64, 64, 3), np.uint8))


@pytest.mark.parametrize(
    "write_network",
    [
        pytest.param(lambda path: path.write_bytes(b""), id="empty"),
        pytest.param(lambda path: path.write_bytes(bytes(100)), id="zeros"),
        pytest.param(lambda path: path.write_text('{"a": 1}'), id="text"),
    ],
)
def test_what_is_no_network(write_network, tmp_path):
    path = tmp_path / "net.onnx"
    write_network(path)
    with pytest.raises(InputError, match=r"net\.onnx: expected an ONNX model"):
        OnnxDetector(path, DetectorSettings(size=64))

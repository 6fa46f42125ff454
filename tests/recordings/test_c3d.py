"""C3D files of any maker: byte orders, integers and reals, numbers of frames, units; ezc3d is the oracle.

The files are written byte by byte here, after the format's user guide, so that neither ezc3d nor psotrack makes them.
Damaged files are a matter of the fuzzer (`recording-c3d`, `tracks-c3d`).
"""

import math
import struct
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from helpers import assert_refused
from real_data import published

from psotrack.recordings.mocap import Markers, read_c3d, write_c3d

INTEL, DEC, SGI = 84, 85, 86
LABELS = ("LASI", "RASI", "SACR")


def real(value: float, processor: int) -> bytes:
    """One real; VAX has the words exchanged and an exponent that is larger by 2 (except for zero)."""
    if processor == DEC:
        low, high = struct.unpack("<2H", struct.pack("<f", 4 * value))
        return struct.pack("<2H", high, low)
    return struct.pack(">f" if processor == SGI else "<f", value)


def parameters(processor: int, values: dict[str, object]) -> bytes:
    """Section of parameters: POINT, and what else `values` names as GROUP:NAME; None leaves a parameter out."""
    order = ">" if processor == SGI else "<"
    groups = {
        name: number for number, name in enumerate(dict.fromkeys(key.split(":")[0] for key in values), 1)
    }
    items = [struct.pack("2b", len(name), -number) + name.encode() + struct.pack(order + "H", 3) + b"\0"
             for name, number in groups.items()]  # fmt: skip
    for key, value in values.items():
        group, name = key.split(":")
        if value is None:
            continue
        if isinstance(value, tuple) and isinstance(value[0], str):
            width = max(len(text.encode()) for text in value)
            data = struct.pack("bBBB", -1, 2, width, len(value))
            data += b"".join(text.encode().ljust(width) for text in value)
        elif isinstance(value, float):
            data = struct.pack("bB", 4, 0) + real(value, processor)
        else:
            numbers = value if isinstance(value, tuple) else (value,)
            data = struct.pack("bB", 2, len(numbers) > 1) + (
                bytes([len(numbers)]) if len(numbers) > 1 else b""
            )
            data += b"".join(struct.pack(order + "H", number) for number in numbers)
        data += b"\0"
        items.append(struct.pack("2b", len(name), groups[group]) + name.encode()
                     + struct.pack(order + "H", 2 + len(data)) + data)  # fmt: skip
    section = b"".join(items) + b"\0\0"
    blocks = math.ceil((4 + len(section)) / 512)
    return (bytes([1, 80, blocks, processor]) + section).ljust(512 * blocks, b"\0")


def make_c3d(
    path: Path,
    points: np.ndarray,
    *,
    processor: int = INTEL,
    scale: float = -0.1,
    header_frames: int | None = None,
    analog: int = 0,
    **changed: object,
) -> Path:
    """Write a C3D file of (frames, points, 4); the fourth value is the residual. Keywords change POINT's parameters."""
    order = ">" if processor == SGI else "<"
    num_frames, num_points, _ = points.shape
    values: dict[str, object] = {
        "POINT:USED": num_points, "POINT:FRAMES": num_frames, "POINT:SCALE": scale, "POINT:RATE": 50.0,
        "POINT:DATA_START": 0, "POINT:LABELS": LABELS[:num_points] or ("-",), "POINT:UNITS": ("mm",),
        "ANALOG:USED": analog,
    }  # fmt: skip
    values |= {
        name.replace("__", ":") if "__" in name else f"POINT:{name}": each for name, each in changed.items()
    }
    section = parameters(processor, values)
    count = num_frames if header_frames is None else header_frames
    header = bytes([2, 80]) + struct.pack(order + "5H", num_points, analog, 1, count % 2**16, 0)
    header += real(scale, processor) + struct.pack(order + "2H", 2 + len(section) // 512, min(analog, 1))
    header += real(50.0, processor)
    frames = []
    for frame in points:
        for point in frame:
            if scale < 0:
                frames += [real(value, processor) for value in point]
            else:
                words = [*np.round(point[:3] / scale).astype(int), int(point[3])]
                frames.append(struct.pack(order + "4h", *words))
        frames += [real(7.0, processor) if scale < 0 else struct.pack(order + "h", 7)] * analog
    path.write_bytes(header.ljust(512, b"\0") + section + b"".join(frames))
    return path


def make_points(num_frames: int = 20, num_points: int = 3) -> np.ndarray:
    """(frames, points, 4): whole millimetres, so that integers are exact; a point is not seen in frame 3."""
    points = np.random.default_rng(1).integers(-2000, 2000, (num_frames, num_points, 4)).astype(float)
    points[..., 3] = 0
    points[3:4, -1] = [0, 0, 0, -1]
    return points


@pytest.mark.parametrize("analog", [0, 5])
@pytest.mark.parametrize("scale", [-0.1, 0.25])
@pytest.mark.parametrize("processor", [INTEL, DEC, SGI])
def test_byte_orders_integers_and_reals(tmp_path, processor, scale, analog, caplog):
    points = make_points()
    path = make_c3d(tmp_path / "a.c3d", points, processor=processor, scale=scale, analog=analog)
    markers = read_c3d(path)
    assert markers.labels == LABELS
    assert markers.rate_hz == 50
    assert np.argwhere(np.isnan(markers.position_m[..., 0])).tolist() == [[3, 2]]
    seen = points[..., 3] >= 0
    np.testing.assert_allclose(markers.position_m[seen], points[seen][:, :3] / 1e3, rtol=1e-12)
    assert not caplog.records
    # ezc3d does not read SGI, and asks for parameters of analogue channels.
    if processor != SGI and not analog:
        independent = ezc3d.c3d(str(path))["data"]["points"][:3].transpose(2, 1, 0)
        np.testing.assert_allclose(markers.position_m[seen], independent[seen] / 1e3, rtol=1e-12)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"header_frames": 1149}, 20),
        ({"FRAMES": 12}, 12),
        ({"header_frames": 20, "FRAMES": 21}, 20),
        ({"header_frames": 9, "FRAMES": 0}, 9),
        ({"header_frames": 9, "FRAMES": 65535, "LONG_FRAMES": 20.0}, 20),
        ({"header_frames": 9, "FRAMES": None, "TRIAL__ACTUAL_START_FIELD": (5, 0),
          "TRIAL__ACTUAL_END_FIELD": (24, 0)}, 20),
    ],
)  # fmt: skip
def test_frames_by_what_the_parameters_say_and_what_is_there(tmp_path, caplog, changed, expected):
    """A header of 1149 frames over 29 that are there was found in a published file."""
    markers = read_c3d(make_c3d(tmp_path / "a.c3d", make_points(), **changed))
    assert len(markers.position_m) == expected
    differ = changed.get("header_frames", 20) != expected or changed.get("FRAMES") == 21
    assert len(caplog.records) == differ
    if differ:
        assert "a.c3d: its header says" in caplog.text


def test_more_frames_than_16_bits_hold(tmp_path, caplog):
    points = np.ones((70_000, 1, 4))
    for changed in (
        {"FRAMES": 65535, "LONG_FRAMES": 70_000.0},
        {"FRAMES": 65535, "TRIAL__ACTUAL_START_FIELD": (1, 0),
         "TRIAL__ACTUAL_END_FIELD": (70_000 - 65536, 1)},
        {"FRAMES": 65535},
    ):  # fmt: skip
        path = make_c3d(tmp_path / "a.c3d", points, header_frames=65535, **changed)
        assert len(read_c3d(path).position_m) == 70_000
    assert not caplog.records


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        *[("m", 1), ("M", 1), ("mete", 1), ("METERS", 1), ("metres", 1), ("dm", 0.1), ("cm", 0.01)],
        *[("um", 1e-6), ("in", 0.0254), ("feet", 0.3048), (None, 1e-3)],
    ],
)
def test_units(tmp_path, caplog, unit, metres):
    points = make_points()
    markers = read_c3d(make_c3d(tmp_path / "a.c3d", points, UNITS=unit and (unit,)))
    np.testing.assert_allclose(markers.position_m[0], points[0, :, :3] * metres, rtol=1e-6)
    warning = f"{tmp_path / 'a.c3d'}: it has no POINT:UNITS; its coordinates are read as millimetres"
    assert caplog.messages == ([] if unit else [warning])


def test_a_file_without_parameters_is_read_by_its_header(tmp_path, caplog):
    """Found in a published file: an empty section of parameters before frames of points."""
    points = make_points()
    path = make_c3d(tmp_path / "a.c3d", points)
    content = bytearray(path.read_bytes())
    end = 512 * (struct.unpack_from("<H", content, 16)[0] - 1)
    content[514] = 0
    content[516:end] = bytes(end - 516)
    path.write_bytes(content)
    markers = read_c3d(path)
    assert markers.labels == ("*1", "*2", "*3")
    assert markers.rate_hz == 50
    np.testing.assert_allclose(markers.position_m[0], points[0, :, :3] / 1e3, rtol=1e-6)
    content[530] = 1
    path.write_bytes(content)
    assert_refused(
        lambda: read_c3d(path), "parameters that are damaged: none can be read", unchanged=tmp_path
    )


def test_analogue_samples_counted_as_channels(tmp_path):
    """Some makers write the number of channels into the header, where the number of samples per frame belongs."""
    points = make_points()
    path = make_c3d(tmp_path / "a.c3d", points, analog=6)
    content = bytearray(path.read_bytes())
    content[4:6], content[18:20] = struct.pack("<H", 2), struct.pack("<H", 3)
    path.write_bytes(bytes(content).replace(b"USED\x05\x00\x02\x00\x06", b"USED\x05\x00\x02\x00\x02"))
    np.testing.assert_allclose(read_c3d(path).position_m[0], points[0, :, :3] / 1e3, rtol=1e-6)


#: Name of the case -> points, keywords of `make_c3d`, share of the file that is there, words of the line.
BAD = {
    # Integers times one scale or the other: positions would be wrong by an unknown factor.
    "two scales": (make_points(), {"scale": 0.25, "SCALE": 0.5}, 1, "0.25 in its header and 0.5 in POINT:SCALE"),
    "no points": (np.zeros((20, 0, 4)), {"analog": 8}, 1, "found none, only 8 analogue samples"),
    "an unknown unit": (make_points(), {"UNITS": ("furlong",)}, 1, "a unit of um, mm, cm, dm, m, in, ft, found"),
    "far away": (1e9 * np.ones((2, 1, 4)), {}, 1, "positions of at most 100000 m, found 1e+06 m for marker 1"),
    "a rate of none": (make_points(), {"RATE": 1e-9}, 1, "frames per second"),
    "no scale": (make_points(), {"scale": 0.25, "SCALE": math.nan}, 1, "a scale of the coordinates, found nan"),
    # ezc3d reads a file that is cut short without an error.
    "cut short": (np.ones((400, 3, 4)), {}, 0.9, "400 frames as its parameters say"),
    "cut short in its parameters": (make_points(), {}, 0.4, "cut short in its parameters: copy it again"),
    "empty": (make_points(), {}, 0, "expected a C3D file, found an empty file"),
}  # fmt: skip


@pytest.mark.parametrize(("points", "changed", "share", "words"), BAD.values(), ids=BAD)
def test_bad_files_are_refused(tmp_path, points, changed, share, words):
    path = make_c3d(tmp_path / "a.c3d", points, **changed)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    assert_refused(lambda: read_c3d(path), "a.c3d: expected", words, unchanged=tmp_path)


# --- writing


def test_written_markers_are_read_back_and_by_ezc3d(tmp_path):
    """LABELS holds 255 labels, and LABELS2 holds the rest: recordings have many unlabelled reflections."""
    position_m = np.random.default_rng(0).uniform(1, 2, (5, 310, 3))
    position_m[3, 1] = np.nan
    markers = Markers(tuple(f"*{number}" for number in range(310)), position_m, 100.0)
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(tmp_path / "a.c3d")
    assert (again.labels, again.rate_hz) == (markers.labels, 100.0)
    # The file stores float32 millimetres: half of 2^-23 times 2 m is 0.12 micrometres.
    np.testing.assert_allclose(again.position_m, position_m, rtol=0, atol=2e-7)
    independent = ezc3d.c3d(str(tmp_path / "a.c3d"))
    assert independent["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    # ezc3d gives NaN for a point whose residual is -1: the format's mark of an unseen point.
    assert np.isnan(independent["data"]["points"][:3, 1, 3]).all()
    assert np.argwhere(independent["data"]["meta_points"]["residuals"][0] < 0).tolist() == [[1, 3]]
    np.testing.assert_allclose(independent["data"]["points"][:3, 2, 4], 1e3 * position_m[4, 2], rtol=1e-6)


def test_the_largest_number_of_frames_that_is_written(tmp_path):
    """The header counts frames in 16 bits: at most 65,535 (11 minutes at 100 Hz). ezc3d silently drops the rest."""
    path = tmp_path / "a.c3d"
    write_c3d(path, Markers(("Dron1:1",), np.ones((65_535, 1, 3)), 100.0))
    assert len(read_c3d(path).position_m) == 65_535
    too_long = Markers(("Dron1:1",), np.ones((65_536, 1, 3)), 100.0)
    words = "expected at most 65535 frames in a C3D file, found 65536"
    assert_refused(lambda: write_c3d(path, too_long), words, unchanged=tmp_path)
    shape = "expected positions of shape (frames, 1, 3), found (3, 2, 3)"
    assert_refused(lambda: Markers(("a",), np.zeros((3, 2, 3)), 100.0), shape, unchanged=tmp_path)


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["Biomechanical-ToolKit/BTKData", "cadop/pyCGM", "felixchenier/kineticstoolkit"]
)
def test_published_files_have_the_numbers_of_ezc3d(name):
    """All C3D files of the recorded data that ezc3d reads, but four, in which it does not find the frames."""
    misread = {"dynamic.C3D", "standing.C3D", "type1.C3D", "561xxa01_anonym.C3D"}
    paths = [path for path in sorted(published(name).rglob("*")) if path.suffix.lower() == ".c3d"]
    compared = 0
    for path in paths:
        try:
            content = ezc3d.c3d(str(path))
        except (OSError, RuntimeError, ValueError):
            continue
        points = content["data"]["points"][:3].transpose(2, 1, 0)
        if not points.size or path.name in misread:
            continue
        markers = read_c3d(path)
        unit = content["parameters"]["POINT"]["UNITS"]["value"][0].strip()
        metres = 1.0 if unit.startswith("me") or unit == "m" else 1e-3
        seen = (content["data"]["meta_points"]["residuals"][0].T >= 0) & (points != 0).any(axis=-1)
        seen &= np.isfinite(points).all(axis=-1)
        assert (np.isfinite(markers.position_m).all(axis=-1) == seen).all(), path
        np.testing.assert_allclose(
            markers.position_m[seen], metres * points[seen], rtol=1e-6, err_msg=str(path)
        )
        compared += 1
    assert compared

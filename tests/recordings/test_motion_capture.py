"""Motion capture: C3D files of any maker, which markers are a drone's, the shape of its cross, and its poses.

The C3D files are written byte by byte here, after the format's user guide, so that neither ezc3d nor psotrack makes
them; ezc3d is the oracle. Damaged files are a matter of the fuzzer (`recording-c3d`, `tracks-c3d`).
"""

import math
import struct
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import assume, given
from hypothesis import strategies as st
from real_data import published
from scipy.spatial.transform import Rotation

from psotrack.recordings.exchange import read_tracks
from psotrack.recordings.mocap import Markers, marker_bodies, read_c3d, write_c3d
from psotrack.recordings.mocap.marker_crosses import (
    correct_labels,
    cross_poses,
    fit_rigid,
    identify_markers,
    learn_cross,
)
from psotrack.trajectories import Status, resample

# --- C3D files of any maker

INTEL, DEC, SGI = 84, 85, 86
#: Processor -> order of bytes.
ORDERS = {INTEL: "<", DEC: "<", SGI: ">"}
LABELS = ("LASI", "RASI", "SACR")


def reals(values, processor):
    """VAX has the words of a real exchanged and an exponent that is larger by 2 (except for zero)."""
    if processor == DEC:
        words = (4 * np.asarray(values, "<f4")).view("<u2")
        return words.reshape(-1, 2)[:, ::-1].tobytes()
    return np.asarray(values, ORDERS[processor] + "f4").tobytes()


def value_of(value, processor):
    """Type, shape and content of a parameter: texts, a real, or whole numbers of 16 bits."""
    if isinstance(value, float):
        return bytes([4, 0]) + reals([value], processor)
    if isinstance(value, tuple) and isinstance(value[0], str):
        width = max(len(text) for text in value)
        texts = b"".join(text.encode().ljust(width) for text in value)
        return struct.pack("bBBB", -1, 2, width, len(value)) + texts
    numbers = np.array(value, ORDERS[processor] + "u2")
    return bytes([2, numbers.ndim, *numbers.shape]) + numbers.tobytes()


def item(name, number, content, processor):
    """A group (of a negative number) or a parameter (of its group's number)."""
    start = struct.pack("2b", len(name), number)
    length = struct.pack(ORDERS[processor] + "H", 3 + len(content))
    return start + name.encode() + length + content + b"\0"


def parameters(processor, values):
    """Section of parameters, which `values` names as GROUP:NAME."""
    numbers = {}
    items = []
    for key, value in values.items():
        group, _, name = key.partition(":")
        if group not in numbers:
            numbers[group] = len(numbers) + 1
            items.append(item(group, -numbers[group], b"", processor))
        items.append(item(name, numbers[group], value_of(value, processor), processor))
    section = b"".join(items) + b"\0\0"
    blocks = math.ceil((4 + len(section)) / 512)
    start = bytes([1, 80, blocks, processor])
    return (start + section).ljust(512 * blocks, b"\0")


def make_c3d(path, points, *, processor=INTEL, scale=-0.1, header_frames=None, first=1, analog=0, **changed):
    """Write a C3D file of (frames, points, 4), of which the last value is the residual.

    Keywords change parameters of POINT, or of a group in GROUP__NAME; None leaves one out.
    """
    order = ORDERS[processor]
    num_frames, num_points, _ = points.shape
    values = {
        "POINT:USED": num_points,
        "POINT:FRAMES": num_frames,
        "POINT:SCALE": scale,
        "POINT:RATE": 50.0,
        "POINT:DATA_START": 0,
        "POINT:LABELS": LABELS[:num_points] or ("-",),
        "POINT:UNITS": ("mm",),
        "ANALOG:USED": analog,
    }
    for name, value in changed.items():
        key = name.replace("__", ":") if "__" in name else f"POINT:{name}"
        values[key] = value
    section = parameters(processor, {key: value for key, value in values.items() if value is not None})
    count = num_frames if header_frames is None else header_frames
    header = bytes([2, 80])
    header += struct.pack(order + "5H", num_points, analog, first, (first + count - 1) % 2**16, 0)
    header += reals([scale], processor)
    header += struct.pack(order + "2H", 2 + len(section) // 512, min(analog, 1))
    header += reals([50.0], processor)
    if scale > 0:
        points = points / [scale, scale, scale, 1]
    frames = np.hstack([points.reshape(num_frames, -1), np.full((num_frames, analog), 7.0)])
    if scale < 0:
        data = reals(frames, processor)
    else:
        data = np.round(frames).astype(order + "i2").tobytes()
    path.write_bytes(header.ljust(512, b"\0") + section + data)
    return path


def make_points(num_frames=20, num_points=3):
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


FIELDS = {"FRAMES": None, "TRIAL__ACTUAL_START_FIELD": (5, 0), "TRIAL__ACTUAL_END_FIELD": (24, 0)}


@pytest.mark.parametrize(
    ("header_frames", "changed", "expected"),
    [
        (1149, {}, 20),
        (1149, {"FRAMES": 1149}, 20),
        (20, {"FRAMES": 12}, 12),
        (9, {"FRAMES": 0}, 9),
        (9, {"FRAMES": 65535, "LONG_FRAMES": 20.0}, 20),
        (9, FIELDS, 20),
    ],
)
def test_frames_by_what_the_parameters_say_and_what_is_there(
    tmp_path, caplog, header_frames, changed, expected
):
    """A header of 1149 frames over 29 that are there was found in a published file."""
    path = make_c3d(tmp_path / "a.c3d", make_points(), header_frames=header_frames, **changed)
    assert len(read_c3d(path).position_m) == expected
    assert ("a.c3d: its header says" in caplog.text) == (header_frames != expected)


def test_more_frames_than_16_bits_hold(tmp_path, caplog):
    points = np.ones((70_000, 1, 4))
    fields = {"TRIAL__ACTUAL_START_FIELD": (1, 0), "TRIAL__ACTUAL_END_FIELD": (70_000 - 65536, 1)}
    for changed in ({}, fields):
        path = make_c3d(tmp_path / "a.c3d", points, header_frames=65535, FRAMES=65535, **changed)
        assert len(read_c3d(path).position_m) == 70_000
    assert not caplog.records


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("M", 1), ("METERS", 1), ("cm", 0.01), ("um", 1e-6), ("in", 0.0254), ("feet", 0.3048), (None, 0.001)],
)
def test_units(tmp_path, unit, metres, caplog):
    points = make_points()
    markers = read_c3d(make_c3d(tmp_path / "a.c3d", points, UNITS=unit and (unit,)))
    np.testing.assert_allclose(markers.position_m[0], points[0, :, :3] * metres, rtol=1e-6)
    said = "a.c3d: it has no POINT:UNITS; its coordinates are read as millimetres"
    assert (said in caplog.text) == (unit is None)


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


def test_analogue_samples_counted_as_channels(tmp_path):
    """Some makers write the number of channels into the header, where the number of samples per frame belongs."""
    points = make_points()
    path = make_c3d(tmp_path / "a.c3d", points, analog=6)
    content = bytearray(path.read_bytes())
    content[4:6], content[18:20] = struct.pack("<H", 2), struct.pack("<H", 3)
    path.write_bytes(bytes(content).replace(b"USED\x05\x00\x02\x00\x06", b"USED\x05\x00\x02\x00\x02"))
    np.testing.assert_allclose(read_c3d(path).position_m[0], points[0, :, :3] / 1e3, rtol=1e-6)


# --- C3D files that are written


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


# --- bodies in flight

#: Positions of the markers A (front), B (left), C (back), D (right), metres; `FIVE_M` has a fifth marker on a mast.
FOUR_M = np.array([[0.055, 0, 0.1], [0, 0.085, 0.1], [-0.115, 0, 0.1], [0, -0.105, 0.1]])
FIVE_M = np.vstack([FOUR_M, [0.03, 0.02, 0.15]])
SQUARE_M = np.array([[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, -0.1, 0]])
NOISE_M = 0.0003
RATE_HZ = 100.0


def flight(time_s):
    """Rotations and positions of a drone on a realistic flight."""
    t = np.asarray(time_s)
    position_m = np.stack([1.5 * np.sin(1.5 * t), 1.2 * np.cos(1.3 * t), 1.5 + 0.3 * np.sin(t)], axis=-1)
    angles = np.stack([0.7 * t, 0.15 * np.sin(1.5 * t), 0.15 * np.cos(1.3 * t)], axis=-1)
    return Rotation.from_euler("ZYX", angles), position_m


def centroids(markers_m, time_s):
    turn, position_m = flight(time_s)
    return position_m + turn.apply(markers_m.mean(axis=0))


def record_markers(markers_m, num_frames=120, begin_s=0, noise_m=0.0, rate_hz=RATE_HZ):
    """The measured markers of a body in flight, (frames, markers, 3), metres."""
    turn, position_m = flight(np.arange(num_frames) / rate_hz + begin_s)
    turned_m = [turn.apply(marker_m) for marker_m in markers_m]
    markers = np.stack(turned_m, axis=1) + position_m[:, None]
    return markers + noise_m * np.random.default_rng(begin_s).standard_normal(markers.shape)


def make_markers(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=RATE_HZ):
    """Markers of drones that fly the same way one after the other, a second apart."""
    labels, position_m = [], []
    for begin_s, drone in enumerate(drones):
        labels += [f"{drone}:{drone}{number}" for number in (1, 2, 3, 4, 5)]
        position_m.append(record_markers(FIVE_M, num_frames, begin_s, rate_hz=rate_hz))
    return Markers(tuple(labels), np.concatenate(position_m, axis=1), rate_hz)


def pairwise_distances_m(points_m):
    return np.linalg.norm(points_m[:, None] - points_m[None], axis=-1)


# --- the rigid fit


@given(seed=st.integers(0, 10_000), num_markers=st.integers(3, 6), noise_mm=st.sampled_from([0.0, 0.5, 5.0]))
def test_the_rigid_fit_agrees_with_scipy(seed, num_markers, noise_mm):
    rng = np.random.default_rng(seed)
    body_m = rng.uniform(-0.15, 0.15, (num_markers, 3))
    body_m -= body_m.mean(axis=0)
    # Markers on a line have no rotation; another test checks them.
    width_m = np.linalg.svd(body_m)[1][1] / np.sqrt(num_markers)
    assume(width_m > 0.0051)
    world_m = Rotation.random(rng=rng).apply(body_m) + rng.uniform(-3, 3, 3)
    world_m += noise_mm / 1e3 * rng.standard_normal(body_m.shape)
    centre_m = world_m.mean(axis=0)
    found = fit_rigid(body_m, world_m[None])
    expected, rssd = Rotation.align_vectors(world_m - centre_m, body_m)
    # Both compute the least-squares rotation in double precision; thin triangles give fewer exact digits.
    np.testing.assert_allclose(found.rotation[0], expected.as_matrix(), rtol=0, atol=1e-9)
    # SciPy's residual is the root of a difference of squares: 1e-8 instead of 0.
    np.testing.assert_allclose(found.residual_m[0], rssd / np.sqrt(num_markers), rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.position_m[0], centre_m, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_markers", [1, 2, 3])
def test_markers_on_a_line_have_a_position_but_no_rotation(num_markers):
    line_m = np.outer(np.arange(num_markers), [0.1, 0.1, 0.1])
    markers_m = record_markers(line_m, 20)
    markers_m[10:15, 0] = np.nan
    position_m, orientation_wxyz, bridged = cross_poses(learn_cross(markers_m), markers_m, RATE_HZ)
    assert np.isnan(orientation_wxyz).all()
    assert np.isfinite(position_m).all()
    assert np.flatnonzero(bridged).tolist() == [10, 11, 12, 13, 14]
    np.testing.assert_allclose(position_m[:10], markers_m[:10].mean(axis=1), rtol=0, atol=1e-12)


# --- learning the shape


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M], ids=["four", "five"])
def test_the_frame_of_a_learned_cross_depends_on_its_shape_only(markers_m):
    """Two recordings of different flights give the same frame: x points to the first marker, and z up."""
    first = learn_cross(record_markers(markers_m, begin_s=1))
    second = learn_cross(record_markers(markers_m, begin_s=2))
    np.testing.assert_allclose(first, second, rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(pairwise_distances_m(first), pairwise_distances_m(markers_m), atol=1e-9)
    assert first[0, 0] > 0
    assert first[0, 1] == pytest.approx(0, abs=1e-9)
    # The markers of `FOUR_M` are in a plane that is level in the drone's own frame; the mast of `FIVE_M` stands up.
    if len(markers_m) == 5:
        assert first[4, 2] > first[:4, 2].max()
    else:
        np.testing.assert_allclose(first[:, 2], 0, atol=1e-9)


def test_a_cross_is_learned_despite_swapped_labels_and_unseen_markers():
    """A quarter of the frames has two swapped labels, a tenth has a stray marker; no frame sees all markers."""
    markers_m = record_markers(FIVE_M, 400, noise_m=NOISE_M)
    markers_m[:100, [0, 1]] = markers_m[:100, [1, 0]]
    markers_m[100:140, 2] += 0.5
    markers_m[np.arange(400), np.arange(400) % 5] = np.nan
    cross = learn_cross(markers_m)
    # Each marker has 208 correct positions with noise of 0.3 mm.
    np.testing.assert_allclose(pairwise_distances_m(cross), pairwise_distances_m(FIVE_M), rtol=0, atol=1.5e-4)


# --- identification of markers


def test_markers_of_a_large_body_are_found_at_once():
    """All subsets of the right labelling of 20 markers fit too: a million, which must not be tried."""
    rng = np.random.default_rng(0)
    body_m = rng.uniform(-0.4, 0.4, (20, 3))
    body_m -= body_m.mean(axis=0)
    np.testing.assert_array_equal(identify_markers(body_m, rng.permutation(body_m)), body_m)


def test_points_that_are_not_the_cross():
    cross = learn_cross(record_markers(FOUR_M))
    assert np.isnan(identify_markers(cross, FOUR_M * 1.5)).all()
    # A symmetric cross fits itself in more than one way.
    assert np.isnan(identify_markers(SQUARE_M, SQUARE_M + 1.0)).all()
    # All distances of a mirror image fit, but no rotation does.
    body_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.07, 0, 0], [0.01, 0.02, 0.12]])
    cross = learn_cross(record_markers(body_m))
    np.testing.assert_array_equal(identify_markers(cross, body_m), body_m)
    assert np.isnan(identify_markers(cross, body_m * [1, 1, -1])).any()


# --- poses over time


def test_stray_markers_are_left_out_and_frames_in_which_nothing_fits_are_gaps():
    markers_m = record_markers(FIVE_M)
    cross = learn_cross(markers_m)
    # A marker jumps to another body, and later all markers are anywhere.
    markers_m[20:30, 2] = [3.0, 3.0, 1.0]
    markers_m[50:55] = np.random.default_rng(0).uniform(-1, 1, (5, 5, 3))
    position_m, _, bridged = cross_poses(cross, markers_m, RATE_HZ)
    assert np.isnan(correct_labels(cross, markers_m)[50:55]).all()
    assert np.flatnonzero(bridged).tolist() == [50, 51, 52, 53, 54]
    expected_m = centroids(FIVE_M, np.arange(120) / RATE_HZ)
    np.testing.assert_allclose(position_m[~bridged], expected_m[~bridged], rtol=0, atol=1e-9)


WHERE = Path("R01_D2.c3d")


@pytest.mark.parametrize(
    ("gap", "status"), [(1, Status.COASTING), (20, Status.COASTING), (50, Status.COASTING), (51, Status.LOST)]
)
def test_gaps_are_bridged_to_half_a_second(gap, status):
    markers_m = record_markers(FOUR_M, 300)
    expected = np.full(300, Status.TRACKED)
    # Two markers are left, which is no pose. Gaps at the ends are not bridged.
    markers_m[100 : 100 + gap, :2] = np.nan
    expected[100 : 100 + gap] = status
    for end in (slice(5), slice(295, None)):
        markers_m[end] = np.nan
        expected[end] = Status.LOST
    labels = ("Dron1:A", "Dron1:B", "Dron1:C", "Dron1:D")
    bodies = marker_bodies(Markers(labels, markers_m, RATE_HZ), WHERE)
    assert bodies.status[:, 0].tolist() == expected.tolist()
    known = expected != Status.LOST
    assert np.isfinite(bodies.position_m[:, 0, 0]).tolist() == known.tolist()
    assert np.isfinite(bodies.orientation_wxyz[:, 0, 0]).tolist() == known.tolist()
    time_s = np.flatnonzero(known) / RATE_HZ
    off_m = bodies.position_m[known, 0] - centroids(FOUR_M, time_s)
    # The error of a cubic over the time T is T^4 / 384 times the fourth derivative, 1.5 m (1.5 / s)^4: 1.2 mm in half
    # a second. The error of its slopes, a tenth of the jerk of 5 m/s^3 times (0.1 s)^2, adds T / 8 times that: 0.5 mm.
    # The error of a straight line would be 104 mm.
    assert np.linalg.norm(off_m, axis=1).max() < 0.003
    # T^2 / 8 times the tilt acceleration of 0.34 rad/s^2, about two axes.
    assert turned_rad(bodies.orientation_wxyz[known, 0], time_s).max() < np.deg2rad(1.0)


def turned_rad(orientation_wxyz, time_s):
    """Angles between a drone's orientations and those of its flight, but for the turn at the first time."""
    body = Rotation.from_quat(orientation_wxyz, scalar_first=True)
    turn, _ = flight(time_s)
    off = turn.inv() * body
    return (off[0].inv() * off).magnitude()


# --- bodies of a recording


def with_markers(markers, labels, position_m):
    """The recording with more markers: positions (frames, more, 3), or one position of all frames."""
    more_m = np.broadcast_to(position_m, (len(markers.position_m), len(labels), 3))
    whole_m = np.concatenate([markers.position_m, more_m], axis=1)
    return Markers((*markers.labels, *labels), whole_m, markers.rate_hz)


def at_frames(markers, fps=25.0, num_frames=9, offset_s=0.0):
    """The drones of a recording at the frames of a video."""
    frame = np.arange(num_frames)
    return resample(marker_bodies(markers, WHERE), frame, frame / fps, later_s=offset_s)


def expected_m(time_s):
    """(times, 2, 3), the centroids of the drones of `make_markers`."""
    return np.stack([centroids(FIVE_M, time_s), centroids(FIVE_M, time_s + 1)], axis=1)


def test_the_drones_of_a_recording():
    """A video frame takes every fourth frame of motion capture; a marker that was never seen does not count."""
    markers = make_markers(num_frames=17)
    markers.position_m[5:12, 6] = np.nan
    markers.position_m[8, [0, 1]] = markers.position_m[8, [1, 0]]
    markers.position_m[12:16, [5, 6, 7]] = markers.position_m[12:16, [7, 5, 6]]
    truth = at_frames(with_markers(markers, ["Dron2:Dron26", "*12", "Wand:Wand1"], [np.nan, 9, 9]))
    # Sorted by number; as text, `dron10` would come first.
    assert truth.drones == ("dron2", "dron10")
    assert truth.seen[:5].all()
    assert not truth.seen[5:].any()
    time_s = np.arange(9) / 25
    np.testing.assert_allclose(truth.time_s, time_s)
    # The tolerance covers the rounding of fits in double precision. The centroid of the visible markers would have an
    # error of centimetres.
    np.testing.assert_allclose(truth.position_m[:5], expected_m(time_s[:5]), rtol=0, atol=1e-9)
    for drone in (0, 1):
        # An angle of 1e-8 has the cosine 1 in double precision.
        assert turned_rad(truth.orientation_wxyz[:5, drone], time_s[:5] + drone).max() < 1e-7


def test_a_drone_whose_markers_are_never_seen_together_is_lost(caplog):
    markers = make_markers()
    markers.position_m[:20, 1] = np.nan
    markers.position_m[20:, 3] = np.nan
    truth = at_frames(markers)
    words = "R01_D2.c3d: no reference for dron2: cross dron2: expected every two markers seen together in some frame"
    assert f"{words}, found 2 and 4 never" in caplog.text
    assert np.isnan(truth.position_m[:, 0]).all()
    assert truth.seen[:, 1].all()


@pytest.mark.parametrize("fps", [25.0, 29.97])
@pytest.mark.parametrize("rate_hz", [100.0, 25.0, 119.88])
@pytest.mark.parametrize("offset_s", [0.0, 0.2, -0.08, -0.1])
def test_any_rates_and_offsets_of_recording_and_video(rate_hz, fps, offset_s):
    markers = make_markers(num_frames=200, rate_hz=rate_hz)
    truth = at_frames(markers, fps, 12, offset_s)
    # A frame at the very beginning of the recording has a position, whatever the rounding of its time.
    first = max(0, math.ceil(-offset_s * fps - 1e-9))
    assert np.flatnonzero(truth.seen[:, 0])[0] == first
    time_s = np.arange(first, 12) / fps + offset_s
    # The error of a cubic spline: 5/384 dt^4 times 8 m/s^4, larger at its ends; a straight line has 0.7 mm at 25 Hz.
    atol = 3e-5 * (25 / rate_hz) ** 2
    np.testing.assert_allclose(truth.position_m[first:], expected_m(time_s), rtol=0, atol=atol)


def walking(num_markers=12, num_frames=100):
    """(frames, markers, 3): markers of a person, which swing by 5 to 25 cm relative to each other."""
    rng = np.random.default_rng(3)
    t = np.arange(num_frames)[:, None, None] / RATE_HZ
    place_m = rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (num_markers, 3))
    reach_m = rng.uniform(0.05, 0.25, (num_markers, 3))
    phase = rng.uniform(0, 6, (num_markers, 1))
    return place_m + reach_m * np.sin(6 * t + phase) + t * [1.2, 0, 0]


def person_and_box():
    box = make_markers(100, drones=("boite",))
    return with_markers(box, [f"Anna:M{number}" for number in range(12)], walking())


@pytest.mark.parametrize("named", [["boite:"], ["boite:boite1", "boite2", "boite3", "boite4", "boite5"]])
def test_the_user_says_which_markers_are_a_drone(named, caplog):
    truth = marker_bodies(person_and_box(), WHERE, {"cf1": named})
    assert truth.drones == ("cf1",)
    np.testing.assert_allclose(truth.position_m[:, 0], centroids(FIVE_M, truth.time_s), rtol=0, atol=1e-9)
    assert not caplog.records
    marker_bodies(person_and_box(), WHERE, {"Anna": ["Anna:"]})
    assert "body Anna is not rigid" in caplog.text


def test_rigid_bodies_with_names_of_their_own_are_taken_with_a_line(caplog):
    """A single marker beside them is left out: a flash for synchronisation, say."""
    markers = make_markers(400, drones=("cf1", "cf2"))
    # Noise of a motion-capture system and swapped labels leave a body rigid.
    markers.position_m[:] += np.random.default_rng(0).normal(0, 5e-4, markers.position_m.shape)
    markers.position_m[:80, [0, 1]] = markers.position_m[:80, [1, 0]]
    assert marker_bodies(with_markers(markers, ["Sync:Sync"], 0.0), WHERE).drones == ("cf1", "cf2")
    assert "taken for drones, because their markers are rigid: cf1 (cf1:cf11, " in caplog.text
    # Labels without a colon are one drone.
    unlabelled = Markers(tuple("ABCDE"), make_markers(drones=("Dron2",)).position_m, RATE_HZ)
    assert marker_bodies(with_markers(unlabelled, ["*7"], 9.0), WHERE).drones == ("dron1",)


# --- what is refused


def people(position_m):
    labels = tuple(f"M{number}" for number in range(position_m.shape[1]))
    return Markers(labels, position_m, RATE_HZ)


#: A person who stands still is rigid, but larger than a drone.
STILL_M = np.random.default_rng(0).uniform(0, [0.5, 0.4, 1.8], (12, 3))
TWO_OF_A_NAME = with_markers(make_markers(drones=("cf1",)), ["cf2:cf11"], 0.0)
#: Name of the case -> markers, words of the line, and the label of the drone, if it is given.
BODIES = {
    # Found: a person's C3D in a sequence's folder became drones without a word.
    "a person": (
        people(walking()),
        "dron1, not rigid, distances vary by 386 mm (M0, M1, M2, M3, M4, M5 and 6 more); say which",
    ),
    "a person who stands still": (people(np.tile(STILL_M, (50, 1, 1))), "dron1, 1.8 m large"),
    "many markers": (people(np.zeros((50, 40, 3))), "dron1, 40 markers"),
    "a box beside a person": (person_and_box(), "boite, rigid (boite:boite1, boite:boite2 and 3 more); anna"),
    "no labels": (
        Markers(("*1", "*2", "*3", "*4"), walking(4), RATE_HZ),
        "found unidentified markers only (*1, *2, *3, *4); say which markers are a drone's with --body",
    ),
    "one frame": (make_markers(1, drones=("cf1",)), "cf1, seen together in one frame at most"),
    "nothing seen": (
        Markers(("Dron2:1",), np.full((9, 1, 3), np.nan), RATE_HZ),
        "expected three markers of a drone in some frame, found none",
    ),
    "the label of none": (TWO_OF_A_NAME, "body cf1, R01_D2.c3d: expected labels of cf1:cf11, cf1:c", "b9"),
    "the label of two": (TWO_OF_A_NAME, "one marker called 'cf11', found 2", "cf11"),
}


@pytest.mark.parametrize("case", BODIES)
def test_what_is_no_drone_for_certain_is_refused(tmp_path, case):
    markers, words, *label = BODIES[case]
    bodies = {"cf1": label} if label else None
    assert_refused(lambda: marker_bodies(markers, WHERE, bodies), f"{WHERE}", words, unchanged=tmp_path)


#: Words of the line -> points, keywords of `make_c3d`.
FILES = {
    # Integers times one scale or the other: positions would be wrong by an unknown factor.
    "0.25 in its header and 0.5 in POINT:SCALE": (make_points(), {"scale": 0.25, "SCALE": 0.5}),
    "a scale of the coordinates, found nan": (make_points(), {"scale": 0.25, "SCALE": math.nan}),
    "found none, only 8 analogue samples": (np.zeros((20, 0, 4)), {"analog": 8}),
    "a unit of um, mm, cm, dm, m, in, ft, found": (make_points(), {"UNITS": ("furlong",)}),
    "positions of at most 100000 m, found 1e+06 m for marker 1": (1e9 * np.ones((2, 1, 4)), {}),
    "frames per second": (make_points(), {"RATE": 1e-9}),
}


@pytest.mark.parametrize("words", FILES)
def test_what_is_no_motion_capture_is_refused(tmp_path, words):
    points, changed = FILES[words]
    path = make_c3d(tmp_path / "a.c3d", points, **changed)
    assert_refused(lambda: read_c3d(path), "a.c3d: expected", words, unchanged=tmp_path)


def test_of_a_file_that_is_cut_short_the_whole_frames_are_read(tmp_path, caplog):
    """As ezc3d does, but with a warning."""
    points = np.random.default_rng(0).uniform(1, 2, (400, 3, 4))
    path = make_c3d(tmp_path / "a.c3d", points)
    content = path.read_bytes()
    # A frame has 48 bytes.
    path.write_bytes(content[:-1000])
    np.testing.assert_allclose(read_c3d(path).position_m, points[:379, :, :3] / 1e3, rtol=1e-6)
    assert "it holds 379, of which 379 are read; was it cut short?" in caplog.text
    path.write_bytes(content[:1000])
    assert_refused(lambda: read_c3d(path), "cut short in its parameters: copy it again", unchanged=tmp_path)


@pytest.mark.parametrize("fields", [{}, {"TRIAL__ACTUAL_START_FIELD": (51, 0), "first": 1}])
def test_a_file_whose_first_frames_were_cut_off_keeps_its_times(tmp_path, caplog, fields):
    """Found: a reference that was half a second early, in silence."""
    points = np.dstack([1e3 * record_markers(FOUR_M, 120), np.zeros((120, 4))])
    labels = {"LABELS": ("Dron1:1", "Dron1:2", "Dron1:3", "Dron1:4")}
    whole = marker_bodies(read_c3d(make_c3d(tmp_path / "a.c3d", points, **labels)), WHERE)
    assert not caplog.records
    path = make_c3d(tmp_path / "b.c3d", points[50:], **({"first": 51} | labels | fields))
    late = marker_bodies(read_c3d(path), WHERE)
    assert "b.c3d: its first frame has the number 51, and so the time 1.000 s; if the videos" in caplog.text
    np.testing.assert_array_equal(late.time_s, whole.time_s[50:])
    np.testing.assert_allclose(late.position_m, whole.position_m[50:], atol=1e-6)
    assert read_tracks(path).time_s[0] == 1


def test_more_frames_than_a_file_holds_are_refused(tmp_path):
    markers = Markers(("Dron1:1",), np.ones((65_536, 1, 3)), 100.0)
    words = ("at most 65535 frames in a C3D file", "found 65536")
    assert_refused(lambda: write_c3d(tmp_path / "a.c3d", markers), *words, unchanged=tmp_path)


# --- recordings of other people


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["Biomechanical-ToolKit/BTKData", "cadop/pyCGM", "felixchenier/kineticstoolkit"]
)
def test_published_files_have_the_numbers_of_ezc3d(name):
    """All C3D files of the recorded data that ezc3d reads, but four, in which it does not find the frames."""
    misread = {"dynamic.C3D", "standing.C3D", "type1.C3D", "561xxa01_anonym.C3D"}
    compared = 0
    for path in sorted(published(name).rglob("*")):
        if path.suffix.lower() != ".c3d" or path.name in misread:
            continue
        try:
            content = ezc3d.c3d(str(path))
        except (OSError, RuntimeError, ValueError):
            continue
        points = content["data"]["points"][:3].transpose(2, 1, 0)
        if not points.size:
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

"""Motion capture: C3D files of any maker, which markers are a drone's, the shape of its cross, and its poses.

The C3D files are written byte by byte here, after the format's user guide, so that neither ezc3d nor psotrack makes
them; ezc3d is the oracle. Damaged files are a matter of the fuzzer (`recording-c3d`, `tracks-c3d`).
"""

import itertools
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

from psotrack.recordings.mocap import Markers, marker_bodies, read_c3d, write_c3d
from psotrack.recordings.mocap.marker_cross_poses import correct_labels, cross_poses, identify_markers
from psotrack.recordings.mocap.marker_crosses import fit_rigid, learn_cross
from psotrack.trajectories import Status, Trajectories, resample

# --- C3D files of any maker

INTEL, DEC, SGI = 84, 85, 86
LABELS = ("LASI", "RASI", "SACR")


def reals(values, processor: int) -> bytes:
    """VAX has the words of a real exchanged and an exponent that is larger by 2 (except for zero)."""
    if processor == DEC:
        return (4 * np.asarray(values, "<f4")).view("<u2").reshape(-1, 2)[:, ::-1].tobytes()
    return np.asarray(values, ">f4" if processor == SGI else "<f4").tobytes()


def parameters(processor: int, values: dict[str, object]) -> bytes:
    """Section of parameters, which `values` names as GROUP:NAME."""
    order = ">" if processor == SGI else "<"
    groups = list(dict.fromkeys(key.partition(":")[0] for key in values))

    def item(name: str, number: int, content: bytes) -> bytes:
        start = struct.pack("2b", len(name), number) + name.encode()
        return start + struct.pack(order + "H", 3 + len(content)) + content + b"\0"

    items = [item(group, -number, b"") for number, group in enumerate(groups, 1)]
    for key, value in values.items():
        group, _, name = key.partition(":")
        if isinstance(value, tuple) and isinstance(value[0], str):
            width = max(map(len, value))
            content = struct.pack("bBBB", -1, 2, width, len(value))
            content += b"".join(text.encode().ljust(width) for text in value)
        elif isinstance(value, float):
            content = bytes([4, 0]) + reals([value], processor)
        else:
            numbers = np.array(value, order + "u2")
            content = bytes([2, numbers.ndim, *numbers.shape]) + numbers.tobytes()
        items.append(item(name, 1 + groups.index(group), content))
    section = b"".join(items) + b"\0\0"
    blocks = math.ceil((4 + len(section)) / 512)
    return (bytes([1, 80, blocks, processor]) + section).ljust(512 * blocks, b"\0")


def make_c3d(path, points, *, processor=INTEL, scale=-0.1, header_frames=None, analog=0, **changed) -> Path:
    """Write a C3D file of (frames, points, 4), of which the last value is the residual.

    Keywords change parameters of POINT, or of a group in GROUP__NAME; None leaves one out.
    """
    order = ">" if processor == SGI else "<"
    num_frames, num_points, _ = points.shape
    values: dict[str, object] = {
        "POINT:USED": num_points, "POINT:FRAMES": num_frames, "POINT:SCALE": scale, "POINT:RATE": 50.0,
        "POINT:DATA_START": 0, "POINT:LABELS": LABELS[:num_points] or ("-",), "POINT:UNITS": ("mm",),
        "ANALOG:USED": analog,
    }  # fmt: skip
    for name, value in changed.items():
        values[name.replace("__", ":") if "__" in name else f"POINT:{name}"] = value
    section = parameters(processor, {key: value for key, value in values.items() if value is not None})
    count = num_frames if header_frames is None else header_frames
    header = bytes([2, 80]) + struct.pack(order + "5H", num_points, analog, 1, count % 2**16, 0)
    header += reals([scale], processor) + struct.pack(order + "2H", 2 + len(section) // 512, min(analog, 1))
    header += reals([50.0], processor)
    if scale > 0:
        points = points / [scale, scale, scale, 1]
    frames = np.hstack([points.reshape(num_frames, -1), np.full((num_frames, analog), 7.0)])
    data = reals(frames, processor) if scale < 0 else np.round(frames).astype(order + "i2").tobytes()
    path.write_bytes(header.ljust(512, b"\0") + section + data)
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
        *[("M", 1), ("mete", 1), ("METERS", 1), ("dm", 0.1), ("cm", 0.01)],
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


def test_the_largest_number_of_frames_that_is_written(tmp_path):
    """The header counts frames in 16 bits: at most 65,535 (11 minutes at 100 Hz). ezc3d silently drops the rest."""
    path = tmp_path / "a.c3d"
    write_c3d(path, Markers(("Dron1:1",), np.ones((65_535, 1, 3)), 100.0))
    assert len(read_c3d(path).position_m) == 65_535


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
    markers = np.einsum("fij,mj->fmi", turn.as_matrix(), markers_m) + position_m[:, None]
    return markers + noise_m * np.random.default_rng(begin_s).standard_normal(markers.shape)


def make_markers(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=RATE_HZ) -> Markers:
    """Markers of drones that fly the same way one after the other, a second apart."""
    position_m = [record_markers(FIVE_M, num_frames, begin_s=i, rate_hz=rate_hz) for i in range(len(drones))]
    labels = tuple(f"{drone}:{drone}{i + 1}" for drone in drones for i in range(len(FIVE_M)))
    return Markers(labels, np.concatenate(position_m, axis=1), rate_hz)


def pairwise_distances_m(points_m):
    return np.linalg.norm(points_m[:, None] - points_m[None], axis=-1)


# --- the rigid fit


@given(seed=st.integers(0, 10_000), num_markers=st.integers(3, 6), noise_mm=st.sampled_from([0.0, 0.5, 5.0]))
def test_the_rigid_fit_agrees_with_scipy(seed, num_markers, noise_mm):
    rng = np.random.default_rng(seed)
    body_m = rng.uniform(-0.15, 0.15, (num_markers, 3))
    body_m -= body_m.mean(axis=0)
    # Markers on a line have no rotation; another test checks them.
    assume(np.linalg.svd(body_m)[1][1] / np.sqrt(num_markers) > 0.0051)
    turn, shift_m = Rotation.random(rng=rng), rng.uniform(-3, 3, 3)
    world_m = turn.apply(body_m) + shift_m + noise_mm / 1e3 * rng.standard_normal(body_m.shape)
    found = fit_rigid(body_m, world_m[None])
    expected, rssd = Rotation.align_vectors(world_m - world_m.mean(axis=0), body_m)
    # Both compute the least-squares rotation in double precision; thin triangles give fewer exact digits.
    np.testing.assert_allclose(found.rotation[0], expected.as_matrix(), rtol=0, atol=1e-9)
    # SciPy's residual is the root of a difference of squares: 1e-8 instead of 0.
    np.testing.assert_allclose(found.residual_m[0], rssd / np.sqrt(num_markers), rtol=0, atol=1e-7)
    np.testing.assert_allclose(found.position_m[0], world_m.mean(axis=0), rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_markers", [1, 2, 3])
def test_markers_on_a_line_have_a_position_but_no_rotation(num_markers):
    line_m = np.array([[0.1, 0.1, 0.1]]) * np.arange(num_markers)[:, None]
    markers_m = record_markers(line_m, 20)
    markers_m[10:15, 0] = np.nan
    position_m, orientation_wxyz, bridged = cross_poses(learn_cross(markers_m), markers_m, RATE_HZ)
    assert np.isnan(orientation_wxyz).all()
    assert np.isfinite(position_m).all()
    assert bridged.tolist() == [False] * 10 + [True] * 5 + [False] * 5
    np.testing.assert_allclose(position_m[:10], markers_m[:10].mean(axis=1), rtol=0, atol=1e-12)


# --- learning the shape


@pytest.mark.parametrize("markers_m", [FOUR_M, FIVE_M, FOUR_M[:3]], ids=["four", "five", "three"])
def test_the_frame_of_a_learned_cross_depends_on_its_shape_only(markers_m):
    """Two recordings of different flights give the same frame: x points to the first marker, and z up."""
    first, second = (learn_cross(record_markers(markers_m, begin_s=begin_s)) for begin_s in (1, 2))
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


def test_every_permutation_is_found():
    cross = learn_cross(record_markers(FOUR_M))
    points_m = record_markers(FOUR_M, 1, begin_s=3, noise_m=NOISE_M)[0]
    for order in itertools.permutations(range(4)):
        np.testing.assert_array_equal(identify_markers(cross, points_m[list(order)]), points_m)
        without_m = points_m.copy()
        without_m[order[3]] = np.nan
        np.testing.assert_array_equal(identify_markers(cross, points_m[list(order[:3])]), without_m)


def test_markers_among_stray_points_and_of_a_large_body():
    cross = learn_cross(record_markers(FIVE_M))
    points_m = record_markers(FIVE_M, 1, begin_s=3, noise_m=NOISE_M)[0]
    strays_m = points_m[0] + np.random.default_rng(0).uniform(-1, 1, (20, 3))
    mixed_m = np.vstack([strays_m[:7], points_m[[3, 0]], strays_m[7:], points_m[[4, 1, 2]]])
    np.testing.assert_array_equal(identify_markers(cross, mixed_m), points_m)
    # All subsets of the right labelling of 20 markers fit too: a million, which must not be tried.
    body_m = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    order = np.random.default_rng(1).permutation(20)
    np.testing.assert_array_equal(identify_markers(body_m - body_m.mean(axis=0), body_m[order]), body_m)


def test_points_that_are_not_the_cross():
    cross = learn_cross(record_markers(FOUR_M))
    for points_m in (np.zeros((0, 3)), FOUR_M[:2], FOUR_M * 1.5, SQUARE_M * 3):
        assert np.isnan(identify_markers(cross, points_m)).all()
    # A symmetric cross fits itself in more than one way.
    assert np.isnan(identify_markers(SQUARE_M, SQUARE_M + 1.0)).all()
    # All distances of a mirror image fit, but no rotation does.
    body_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.07, 0, 0], [0.01, 0.02, 0.12]])
    cross = learn_cross(record_markers(body_m))
    np.testing.assert_array_equal(identify_markers(cross, body_m), body_m)
    assert np.isnan(identify_markers(cross, body_m * [1, 1, -1])).any()


# --- poses over time


def test_swapped_labels_change_no_pose():
    cross = learn_cross(record_markers(FOUR_M))
    markers_m = record_markers(FOUR_M, noise_m=NOISE_M)
    expected_m, expected_wxyz, _ = cross_poses(cross, markers_m, RATE_HZ)
    swapped_m = markers_m.copy()
    swapped_m[30:40, [0, 1]] = markers_m[30:40, [1, 0]]
    swapped_m[60, [0, 1, 2, 3]] = markers_m[60, [3, 0, 1, 2]]
    swapped_m[70, [0, 1]], swapped_m[70, 3] = markers_m[70, [1, 0]], np.nan
    position_m, orientation_wxyz, bridged = cross_poses(cross, swapped_m, RATE_HZ)
    # In frame 70, the fourth marker is missing too.
    others = np.arange(120) != 70
    assert not bridged.any()
    np.testing.assert_array_equal(position_m[others], expected_m[others])
    np.testing.assert_array_equal(orientation_wxyz[others], expected_wxyz[others])
    # Without one marker with noise of 0.3 mm the centroid moves by less than a millimetre.
    np.testing.assert_allclose(position_m[70], expected_m[70], rtol=0, atol=1e-3)


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


@pytest.mark.parametrize(("gap", "short"), [(1, True), (20, True), (50, True), (51, False)])
def test_gaps_are_bridged_to_half_a_second(gap, short):
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 300)
    # Two markers are left, which is no pose. Gaps at the ends are not bridged.
    markers_m[100 : 100 + gap, :2] = np.nan
    markers_m[:5] = markers_m[295:] = np.nan
    position_m, orientation_wxyz, bridged = cross_poses(cross, markers_m, RATE_HZ)
    inside, ends = np.zeros(300, bool), np.ones(300, bool)
    inside[100 : 100 + gap], ends[5:295] = True, False
    assert bridged.tolist() == (inside & short).tolist()
    assert np.isnan(position_m[:, 0]).tolist() == (ends | (inside & (not short))).tolist()
    assert np.isnan(orientation_wxyz[:, 0]).tolist() == (ends | (inside & (not short))).tolist()
    if short:
        time_s = np.arange(5, 295) / RATE_HZ
        off_m = np.linalg.norm(position_m[~ends] - centroids(FOUR_M, time_s), axis=1)
        # The error of a cubic over the time T is T^4 / 384 times the fourth derivative, 1.5 m (1.5 / s)^4: 1.2 mm in
        # half a second. The error of its slopes, a tenth of the jerk of 5 m/s^3 times (0.1 s)^2, adds T / 8 times that:
        # 0.5 mm. The error of a straight line would be 104 mm.
        assert off_m.max() < 0.003
        body, (turn, _) = Rotation.from_quat(orientation_wxyz[~ends], scalar_first=True), flight(time_s)
        off_deg = np.degrees((turn[0].inv() * body[0] * body.inv() * turn).magnitude())
        # T^2 / 8 times the tilt acceleration of 0.34 rad/s^2, about two axes.
        assert off_deg.max() < 1.0


def test_a_single_pose_between_gaps_no_frames_and_no_markers_seen():
    cross, markers_m = learn_cross(record_markers(FOUR_M)), record_markers(FOUR_M, 3, rate_hz=20.0)
    markers_m[1] = np.nan
    position_m, _, _ = cross_poses(cross, markers_m, 20.0)
    np.testing.assert_allclose(position_m[1], position_m[[0, 2]].mean(axis=0), rtol=0, atol=1e-12)
    assert cross_poses(cross, np.zeros((0, 4, 3)), RATE_HZ)[0].shape == (0, 3)
    position_m, orientation_wxyz, bridged = cross_poses(cross, np.full((5, 4, 3), np.nan), RATE_HZ)
    assert np.isnan(position_m).all()
    assert np.isnan(orientation_wxyz).all()
    assert not bridged.any()


# --- bodies of a recording

WHERE = Path("R01_D2.c3d")


def with_markers(markers, labels, position_m) -> Markers:
    """The recording with more markers: positions (frames, more, 3), or one position of all frames."""
    more_m = np.broadcast_to(position_m, (len(markers.position_m), len(labels), 3))
    whole_m = np.concatenate([markers.position_m, more_m], axis=1)
    return Markers((*markers.labels, *labels), whole_m, markers.rate_hz)


def at_frames(markers, fps=25.0, num_frames=9, offset_s=0.0) -> Trajectories:
    """The drones of a recording at the frames of a video."""
    frame = np.arange(num_frames)
    return resample(marker_bodies(markers, WHERE), frame, frame / fps, later_s=offset_s)


def expected_m(time_s):
    """(times, 2, 3), the centroids of the drones of `make_markers`."""
    return np.stack([centroids(FIVE_M, time_s + begin_s) for begin_s in (0, 1)], axis=1)


def test_the_drones_of_a_recording():
    """A video frame takes every fourth frame of motion capture; a marker that was never seen does not count."""
    markers = make_markers(num_frames=17)
    markers.position_m[5:12, 6] = np.nan
    markers.position_m[8, [0, 1]] = markers.position_m[8, [1, 0]]
    markers.position_m[12:16, [5, 6, 7]] = markers.position_m[12:16, [7, 5, 6]]
    truth = at_frames(with_markers(markers, ["Dron2:Dron26", "*12", "Wand:Wand1"], [np.nan, 9, 9]))
    # Sorted by number; as text, `dron10` would come first.
    assert truth.drones == ("dron2", "dron10")
    assert truth.seen.tolist() == [[True, True]] * 5 + [[False, False]] * 4
    time_s = np.arange(9) / 25
    np.testing.assert_allclose(truth.time_s, time_s)
    # The tolerance covers the rounding of fits in double precision. The centroid of the visible markers would have an
    # error of centimetres.
    np.testing.assert_allclose(truth.position_m[:5], expected_m(time_s[:5]), rtol=0, atol=1e-9)
    for drone, begin_s in enumerate((0, 1)):
        turn = Rotation.from_quat(truth.orientation_wxyz[:5, drone], scalar_first=True)
        off = flight(time_s[:5] + begin_s)[0].inv() * turn
        # An angle of 1e-8 has the cosine 1 in double precision.
        assert (off[0].inv() * off).magnitude().max() < 1e-7


def test_short_gaps_are_flagged_and_long_gaps_remain():
    """dron2 has a gap of 0.3 s; dron10 has a gap of 0.6 s, because two of its five markers determine no pose."""
    markers = make_markers(num_frames=141)
    markers.position_m[40:70, :5] = np.nan
    markers.position_m[40:100, 5:8] = np.nan
    status = marker_bodies(markers, WHERE).status
    assert np.flatnonzero(status[:, 0] == Status.COASTING).tolist() == [*range(40, 70)]
    assert np.flatnonzero(status[:, 1] == Status.LOST).tolist() == [*range(40, 100)]
    assert (status == Status.TRACKED).sum() == 2 * 141 - 30 - 60


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
@pytest.mark.parametrize("rate_hz", [100.0, 25.0, 119.88, 240.0])
@pytest.mark.parametrize("offset_s", [0.0, 0.2, -0.08, -0.1])
def test_any_rates_and_offsets_of_recording_and_video(rate_hz, fps, offset_s):
    truth = at_frames(make_markers(num_frames=200, rate_hz=rate_hz), fps, 12, offset_s)
    # A frame at the very beginning of the recording has a position, whatever the rounding of its time.
    first = max(0, int(np.ceil(-offset_s * fps - 1e-9)))
    assert np.flatnonzero(truth.seen[:, 0])[0] == first
    # The error of a cubic spline: 5/384 dt^4 times 8 m/s^4, larger at its ends; a straight line has 0.7 mm at 25 Hz.
    atol = 3e-5 * (25 / rate_hz) ** 2
    np.testing.assert_allclose(
        truth.position_m[first:], expected_m(np.arange(first, 12) / fps + offset_s), rtol=0, atol=atol
    )


def walking(num_markers=12, num_frames=100) -> np.ndarray:
    """(frames, markers, 3): markers of a person, which swing by 5 to 25 cm relative to each other."""
    rng = np.random.default_rng(3)
    t = np.arange(num_frames)[:, None, None] / RATE_HZ
    place_m = rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (num_markers, 3))
    swing_m = rng.uniform(0.05, 0.25, (num_markers, 3)) * np.sin(6 * t + rng.uniform(0, 6, (num_markers, 1)))
    return place_m + swing_m + t * [1.2, 0, 0]


def person_and_box() -> Markers:
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


def people(position_m) -> Markers:
    return Markers(tuple(f"M{number}" for number in range(position_m.shape[1])), position_m, RATE_HZ)


#: A person who stands still is rigid, but larger than a drone, or with more markers.
STILL_M = np.repeat(np.random.default_rng(0).uniform(0, [0.5, 0.4, 1.8], (12, 3))[None], 50, axis=0)
NOBODY_M = np.full((9, 5, 3), np.nan)
ONE = make_markers(drones=("cf1",))
#: Name of the case -> markers, what the user says, words of the line.
BODIES = {
    # Found: a person's C3D in a sequence's folder became drones without a word.
    "a person": (people(walking()), None,
                 "dron1, not rigid, distances vary by 386 mm (M0, M1, M2, M3, M4, M5 and 6 more); say which"),
    "a person who stands still": (people(STILL_M), None, "dron1, 1.8 m large"),
    "many markers": (people(np.repeat(STILL_M, 4, axis=1)[:, :40]), None, "dron1, 40 markers"),
    "a box beside a person": (person_and_box(), None, "boite, rigid (boite:boite1, boite:boite2 and 3 more); anna"),
    "no labels": (Markers(("*1", "*2", "*3", "*4"), walking(4), RATE_HZ), None,
                  "found unidentified markers only (*1, *2, *3, *4); say which markers are a drone's with --body"),
    "one frame": (make_markers(1, drones=("cf1",)), None, "cf1, seen together in one frame at most"),
    "nothing seen": (Markers(make_markers(9).labels[:5], NOBODY_M, 100.0), None,
                     "expected three markers of a drone in some frame, found none"),
    "a name of none": (ONE, {"cf1": ["b9"]}, "body cf1, R01_D2.c3d: expected labels of cf1:cf11, cf1:cf12, "),
    "a name of two": (with_markers(ONE, ["cf2:cf11"], 0.0), {"cf1": ["cf11"]}, "one marker called 'cf11', found 2"),
}  # fmt: skip
#: Name of the case -> points, keywords of `make_c3d`, share of the file that is there, words of the line.
FILES = {
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
}  # fmt: skip
TOO_LONG = Markers(("Dron1:1",), np.ones((65_536, 1, 3)), 100.0)


#: Name of the case, points and keywords and share of a C3D file or None, what is done with its path, words of the line.
BAD = [
    *(
        (name, None, lambda _, markers=markers, named=named: marker_bodies(markers, WHERE, named), f"{WHERE}", words)
        for name, (markers, named, words) in BODIES.items()
    ),
    *((name, file, read_c3d, "a.c3d: expected", words) for name, (*file, words) in FILES.items()),
    ("frames", None, lambda path: write_c3d(path, TOO_LONG), "at most 65535 frames in a C3D file", "found 65536"),
    ("a shape", None, lambda _: Markers(("a",), NOBODY_M, 100.0), "of shape (frames, 1, 3)", "found (9, 5, 3)"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("file", "call", "words"), [(*row[1:3], row[3:]) for row in BAD], ids=[row[0] for row in BAD]
)
def test_what_is_no_motion_capture_of_drones_is_refused(tmp_path, file, call, words):
    path = tmp_path / "a.c3d"
    if file is not None:
        points, changed, share = file
        content = make_c3d(path, points, **changed).read_bytes()
        path.write_bytes(content[: int(share * len(content))])
    assert_refused(lambda: call(path), *words, unchanged=tmp_path)


# --- recordings of other people


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

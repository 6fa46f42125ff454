"""Tracks in the formats of other programs: there and back, read by the other programs' own libraries, and bad input.

evo (GPL) runs in a process of its own, as TrackEval and the others are: as judges of the files. TrackEval and evo are
installed without their dependencies (see the Makefile), so that their tests are skipped where they are missing.
"""

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from dpjait_folders import UPRIGHT
from helpers import LENSES, assert_refused, cameras_of, content_of, ring_rig, sphere_points
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation
from worlds import IMAGE_SIZE_WH, NUM_FRAMES, RATE_HZ, make_tracks, make_tracks_file

from psotrack.errors import InputError
from psotrack.evaluation import evaluate
from psotrack.geometry import make_camera, project
from psotrack.recordings import FrameTimes, Recording, Reference, probe, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.exchange import FORMATS, Footage, export_tracks, read_tracks
from psotrack.recordings.exchange.mcap_files import DEFINITIONS, camera_message
from psotrack.trajectories import Status, Trajectories, read_trajectories

#: Names of outputs that hold all of the small tracks, per format.
OUTPUTS = {
    "tum": "tum",
    "kitti": "kitti",
    "mot": "mot.txt",
    "c3d": "tracks.c3d",
    "mcap": "tracks.mcap",
    "csv": "again.csv",
    "parquet": "again.parquet",
    "json": "again.json",
}
#: Sizes of the two drones.
SIZES_M = np.array([[0.5, 0.5, 0.2], [0.4, 0.4, 0.15]])
LASTS_S = 0.8
#: Rate, time of frame 0 and time per row of each camera. The instants are those of the fastest camera.
CLOCKS = {"c0": (25.0, 0.0, 0.0), "c1": (50.0, 0.0, 0.0), "c2": (25.0, 0.013, 2e-5)}


def path_m(drone, time_s):
    """(times, 3), a curve at about 1.5 m/s."""
    angle = 1.5 * time_s + 2.5 * drone
    return np.stack([np.cos(angle), np.sin(angle), 1.2 + 0.2 * time_s + 0.3 * drone], axis=-1)


def small_tracks(rate_hz=RATE_HZ):
    """The small world's tracks beside their places, with a gap and with orientations."""
    tracks, rng = make_tracks(), np.random.default_rng(4)
    tracks.status[2:4, 0] = Status.LOST
    turn = Rotation.random(2 * tracks.num_frames, rng=rng).as_quat(scalar_first=True, canonical=True)
    return replace(
        tracks,
        time_s=tracks.frame / rate_hz,
        position_m=tracks.position_m + rng.normal(0, 0.02, tracks.position_m.shape),
        velocity_m_s=rng.normal(0, 1, tracks.position_m.shape),
        orientation_wxyz=turn.reshape(tracks.num_frames, 2, 4),
    )


@pytest.fixture
def tracks_file(tmp_path):
    """Tracks of the recording, with a record of the run."""
    return make_tracks_file(tmp_path / "tracks.csv")


@pytest.fixture(scope="module")
def footage():
    """Three cameras that differ in rate and start, the last with a rolling shutter, and where the drones are."""
    rig = ring_rig(3, coefficients=5, image_size_wh=IMAGE_SIZE_WH)
    times, line_times_s = {}, {}
    for name, (fps, begins_s, line_time_s) in CLOCKS.items():
        num_frames = int((LASTS_S - begins_s) * fps)
        times[name] = FrameTimes(num_frames, fps, begins_s)
        line_times_s[name] = line_time_s
    recording = Recording("clocks", Path("clocks"), cameras_of(rig, times=times, line_time_s=line_times_s))
    time_s = recording.timeline().time_s
    position_m = np.stack([path_m(0, time_s), path_m(1, time_s)], axis=1)
    truth = Trajectories(np.arange(len(time_s)), time_s, ("0", "1"), position_m)
    return Footage(replace(recording, reference=Reference(truth)), SIZES_M)


def instants(num_frames, fps=25.0):
    """A recording that has nothing but instants."""
    times = {"c0": FrameTimes(num_frames, fps)}
    return Recording("any", Path("any"), cameras_of(ring_rig(1), times=times))


# There and back


@st.composite
def with_gaps(draw):
    """Arguments of `Trajectories`: random positions of 1 to 3 drones in some of 40 frames; each drone is seen."""
    drones = draw(st.integers(1, 3))
    frame = np.array(sorted(draw(st.sets(st.integers(0, 39), min_size=2, max_size=12))))
    # Up to 60 m, and not nearer to 0 than float32 millimetres can say: C3D takes the origin itself for a gap.
    numbers = st.floats(1e-3, 60.0) | st.floats(-60.0, -1e-3)
    position_m = draw(hnp.arrays(float, (len(frame), drones, 3), elements=numbers))
    seen = draw(hnp.arrays(bool, (len(frame), drones)))
    seen[0] = True
    # Each frame is seen by some drone: a frame without any has no row in most formats.
    seen[:, 0] |= ~seen.any(axis=1)
    position_m[~seen] = np.nan
    names = tuple(str(number + 1) for number in range(drones))
    return {"frame": frame, "time_s": frame / 25.0, "drones": names, "position_m": position_m}


@pytest.mark.parametrize("to", OUTPUTS)
@given(arguments=with_gaps())
@settings(max_examples=12)
def test_positions_and_gaps_come_back(to, arguments, tmp_path_factory):
    out = tmp_path_factory.getbasetemp() / "there_and_back" / OUTPUTS[to]
    written = Trajectories(**arguments)
    export_tracks(written, to, out, force=True)
    read = read_tracks(out, recording=instants(40))
    assert read.drones == written.drones
    np.testing.assert_array_equal(read.at_frames(written.frame).seen, written.seen)
    assert read.seen.sum() == written.seen.sum(), "no position between the written ones"
    np.testing.assert_allclose(read.time_s, read.frame / 25.0, rtol=0, atol=1e-12)
    # C3D has float32 millimetres: half of 2^-23 times 64 m is 3.8 micrometres. The other formats have all digits.
    atol = 4e-6 if to == "c3d" else 0
    read_m = read.at_frames(written.frame).position_m
    np.testing.assert_allclose(read_m, written.position_m, rtol=0, atol=atol)


@pytest.mark.parametrize("to", OUTPUTS)
def test_what_each_format_keeps(tmp_path, to):
    tracks, out = small_tracks(), tmp_path / OUTPUTS[to]
    export_tracks(tracks, to, out)
    read = read_tracks(out, recording=instants(NUM_FRAMES))
    seen = tracks.seen
    if to in ("tum", "kitti", "mcap", "csv", "parquet", "json"):
        # A quaternion that was a matrix in between has an error of a few roundings.
        turns = read.at_frames(tracks.frame).orientation_wxyz
        np.testing.assert_allclose(turns[seen], tracks.orientation_wxyz[seen], atol=1e-14)
        export_tracks(replace(tracks, orientation_wxyz=None), to, out, force=True)
        assert read_tracks(out, recording=instants(NUM_FRAMES)).orientation_wxyz is None
    if to in ("mcap", "csv", "parquet", "json"):
        np.testing.assert_array_equal(read.covariance_m2[seen], tracks.covariance_m2[seen])
    if to in ("csv", "parquet", "json"):
        np.testing.assert_array_equal(read.status, tracks.status)
        np.testing.assert_array_equal(read.velocity_m_s, tracks.velocity_m_s)


def test_every_format_is_tested_and_the_folder_of_a_bag_is_read(tmp_path):
    assert set(OUTPUTS) == set(FORMATS)
    tracks = small_tracks()
    export_tracks(tracks, "mcap", tmp_path / "bag_0.mcap")
    (tmp_path / "metadata.yaml").touch()
    np.testing.assert_array_equal(read_tracks(tmp_path, recording=instants(NUM_FRAMES)).seen, tracks.seen)


K = np.arange(NUM_FRAMES)
#: Name of the case -> numbers of frames, and times in intervals of the recording.
NUMBERINGS = {
    "those of the recording": (K, K),
    "from elsewhere": (K + 5, K),
    "from 0 where the times begin later": (K[:-4], K[4:]),
    "a frame was dropped": (K[:-1], np.delete(K, 6)),
    "every second": (K[::2], K[::2]),
    "half the rate": (K[:7], K[::2]),
    "half the rate, later": (K[1:7], K[2::2]),
    "twice the rate": (np.arange(27), np.arange(27) / 2),
    "between the instants": (K[:-1], K[:-1] + 0.3),
    "milliseconds": (K, K + 0.0125),
}


@pytest.mark.parametrize("case", NUMBERINGS)
def test_one_track_has_the_same_figures_in_every_format(case, run_psotrack, flight, tmp_path, caplog):
    """Times decide: found, 764 mm in CSV and 17 mm in TUM."""
    frame, interval = NUMBERINGS[case]
    time_s = interval / RATE_HZ
    position_m = make_tracks(0.01).position_m[np.zeros(len(frame), int)]
    position_m[..., 1] += time_s[:, None]
    tracks, found, disagree = Trajectories(frame, time_s, ("0", "1"), position_m), {}, set()
    rate = (len(frame) - 1) / np.ptp(interval)
    for to, name in OUTPUTS.items():
        lost = export_tracks(tracks, to, tmp_path / name)
        if "times" not in lost and (to != "mot" or rate == 1):
            caplog.clear()
            figures = json.loads(run_psotrack("evaluate", tmp_path / name, flight, "--json", "-").out)
            found[to] = [figures[key] for key in ("frames", "missed_rate", "mean_error_m", "mota", "hota")]
            disagree |= {to} if "and the times decide: frame " in caplog.text else set()
    assert found["csv"][2] == pytest.approx(0.01, abs=2e-5)
    for to, each in found.items():
        # C3D has float32 millimetres.
        assert each == pytest.approx(found["csv"], abs=1e-6), to
    is_odd = {
        "from elsewhere",
        "from 0 where the times begin later",
        "a frame was dropped",
        "between the instants",
    }
    assert disagree == ({"csv", "json", "parquet"} if case in is_odd else set())


def test_times_between_the_instants_are_interpolated_and_gaps_stay(tmp_path):
    """TUM's own files end in .txt. The drone has the name of the file, however long."""
    path = tmp_path / f"{'long' * 42}.txt"
    time_s = 0.0137 + np.arange(40) / 25
    # The missing sample is between instants 15 and 16.
    frame = np.delete(np.arange(40), 15)
    own = Trajectories(frame, time_s[frame], ("drone",), path_m(0, time_s[frame])[:, None])
    export_tracks(own, "tum", path)
    read = read_tracks(path, recording=instants(50))
    assert read.drones == (path.stem,)
    there = read.seen[:, 0]
    assert np.flatnonzero(~there).tolist() == [0, 15, 16, *range(40, 50)]
    # A cubic spline over 40 ms of a curve of 1.5 rad/s: 5/384 (1.5 x 0.04)^4 = 2e-7 m, more at the ends.
    np.testing.assert_allclose(read.position_m[there, 0], path_m(0, read.time_s[there]), atol=3e-6)


def test_a_flipped_bit_of_an_mcap_file_is_noticed_or_harmless(tmp_path):
    """Checksums are checked. Only names, which are metadata without one, may change."""
    path, rng = tmp_path / "tracks.mcap", np.random.default_rng(0)
    export_tracks(small_tracks(), "mcap", path)
    content, sound, refused = path.read_bytes(), read_tracks(path), 0
    for at in rng.integers(200, len(content), 100).tolist():
        changed = bytearray(content)
        changed[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        try:
            read = read_tracks(path)
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(read.time_s, sound.time_s)
            np.testing.assert_array_equal(read.position_m, sound.position_m)
    assert refused > 20


# Judged by the other programs

EVO = """
import sys, json
from evo.core import metrics, sync
from evo.tools import file_interface as files
reference, estimate, poses = sys.argv[1:]
pair = sync.associate_trajectories(*map(files.read_tum_trajectory_file, (reference, estimate)), max_diff=1e-4)
ape = metrics.APE(metrics.PoseRelation.translation_part)
ape.process_data(pair)
kitti = files.read_kitti_poses_file(poses)
print(json.dumps({"rmse": ape.get_statistic(metrics.StatisticsType.rmse), "poses": pair[1].num_poses,
                  "kitti": kitti.positions_xyz.tolist(), "turns": kitti.orientations_quat_wxyz.tolist()}))
"""


@pytest.mark.skipif(find_spec("evo") is None, reason="evo is not installed; see the Makefile")
def test_evo_reads_tum_and_kitti_and_finds_the_same_error(tmp_path):
    tracks, perfect = small_tracks(), replace(make_tracks(), status=None)
    export_tracks(tracks, "tum", tmp_path / "tum")
    export_tracks(tracks, "kitti", tmp_path / "kitti")
    export_tracks(perfect, "tum", tmp_path / "truth")
    result = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", EVO, "truth/0.tum", "tum/0.tum", "kitti/poses/0.txt"],
        cwd=tmp_path,
        env=os.environ | {"HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    by_evo = json.loads(result.stdout.splitlines()[-1])
    seen = tracks.seen[:, 0]
    assert by_evo["poses"] == seen.sum()
    figures = evaluate(tracks, perfect).to_dict()["per_drone"]
    ours = next(drone for drone in figures if drone["estimate"] == "0")
    assert by_evo["rmse"] == pytest.approx(ours["ate_rmse_m"], abs=1e-12)
    np.testing.assert_array_equal(by_evo["kitti"], tracks.position_m[seen, 0])
    turns = np.abs(tracks.orientation_wxyz[seen, 0])
    np.testing.assert_allclose(np.abs(by_evo["turns"]), turns, atol=1e-12)


def trackeval_clear(folder):
    """CLEAR by TrackEval for each sequence in a folder that was exported."""
    import trackeval

    for name, kind in (("float", float), ("int", int), ("bool", bool)):
        if not hasattr(np, name):  # TrackEval's code is older than NumPy 1.24.
            setattr(np, name, kind)
    quiet = {"PRINT_CONFIG": False, "PRINT_RESULTS": False}
    folders = {"GT_FOLDER": str(folder / "gt"), "TRACKERS_FOLDER": str(folder / "trackers")}
    benchmark = {"BENCHMARK": "MOT15", "SPLIT_TO_EVAL": "train"}
    data = trackeval.datasets.MotChallenge2DBox(quiet | folders | benchmark)
    metric = trackeval.metrics.CLEAR({"PRINT_CONFIG": False})
    results = {}
    for name in data.seq_list:
        raw = data.get_raw_seq_data("psotrack", name)
        results[name] = metric.eval_sequence(data.get_preprocessed_seq_data(raw, "pedestrian"))
    return results


@pytest.fixture(scope="module")
def boxes(tmp_path_factory, footage):
    """A folder of the boxes of the reference, as if they were tracks."""
    folder = tmp_path_factory.mktemp("boxes") / "mot"
    export_tracks(footage.recording.truth, "mot", folder, footage=footage)
    return folder


@pytest.mark.skipif(find_spec("trackeval") is None, reason="trackeval is not installed; see the Makefile")
def test_trackeval_reads_the_boxes_of_every_camera(boxes, footage):
    recording = footage.recording
    results = trackeval_clear(boxes)
    assert set(results) == {f"{recording.name}-{name}" for name in CLOCKS}
    for name, result in results.items():
        frames = int(LASTS_S * CLOCKS[name[-2:]][0])
        assert result["MOTA"] == 1.0
        assert result["MOTP"] == pytest.approx(1.0, abs=1e-3)
        # The last camera's last frames are after the last instant.
        assert frames < result["CLR_TP"] <= 2 * frames


def test_boxes_are_around_the_drones_at_the_exposure(boxes, footage):
    """The oracle projects points of the ellipsoids' surface, at the time of the frame or of the drone's row."""
    rig = footage.recording.rig
    folder = boxes / "trackers" / "MOT15-train" / "psotrack" / "data"
    sphere = sphere_points(4000)
    for index, (name, (fps, begins_s, line_time_s)) in enumerate(CLOCKS.items()):
        table = np.loadtxt(folder / f"clocks-{name}.txt", delimiter=",")
        for row in table[:: max(1, len(table) // 12)]:
            frame, number, left, top, width, height = row[:6]
            drone = int(number) - 1
            # The exposure of a rolling shutter is counted from the first row.
            time_s = begins_s + (frame - 1) / fps + line_time_s * (top - 1 + height / 2)
            points_m = path_m(drone, np.array([time_s])) + sphere * SIZES_M[drone] / 2
            pixels = project(rig.cameras[index], points_m)[0] + 0.5
            # 4000 points miss the outermost ones by up to 0.02 px here; boxes with distortion are exact up to the
            # square of the angular size, and float32 has a thousandth of a pixel.
            np.testing.assert_allclose([left - 1, top - 1], pixels.min(axis=0), atol=0.1)
            far_corner = [left - 1 + width, top - 1 + height]
            np.testing.assert_allclose(far_corner, pixels.max(axis=0), atol=0.1)


def test_a_drone_that_is_lost_has_no_box(tmp_path, footage):
    tracks = small_tracks(footage.recording.fps)
    export_tracks(tracks, "mot", tmp_path / "mot", footage=footage)
    # This camera has a frame at each instant.
    path = tmp_path / "mot" / "trackers" / "MOT15-train" / "psotrack" / "data" / "clocks-c1.txt"
    table = np.loadtxt(path, delimiter=",")
    assert sorted(table[:, :2].tolist()) == (np.argwhere(tracks.seen) + 1).tolist()


def test_boxes_have_the_size_that_the_command_is_told(run_psotrack, flight, tracks_file, tmp_path):
    size = ("--drone-size", "0.4,0.5,0.2")
    command = ("export", tracks_file, flight, "--to", "mot", *size, "--out", tmp_path / "by command")
    assert run_psotrack(*command).code == 0
    told = Footage(open_recording(flight), np.tile([0.4, 0.5, 0.2], (2, 1)))
    export_tracks(read_trajectories(tracks_file), "mot", tmp_path / "mot", footage=told)
    assert content_of(tmp_path / "by command") == content_of(tmp_path / "mot")


class Message(NamedTuple):
    """A message of a bag, read by rosbags."""

    topic: str
    time_ns: int
    content: Any


@pytest.fixture(scope="module")
def messages(tmp_path_factory, flight):
    """The messages in a bag of the small tracks without orientations."""
    from rosbags.highlevel import AnyReader

    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    tracks = replace(small_tracks(), orientation_wxyz=None)
    lost = export_tracks(tracks, "mcap", path, footage=Footage(open_recording(flight), images=True))
    assert lost == ("velocities", "fitness", "numbers of cameras", "status", "5 positions of lost drones")
    found = []
    with AnyReader([path]) as bag:
        for connection, time_ns, raw in bag.messages():
            content = bag.deserialize(raw, connection.msgtype)
            found.append(Message(connection.topic, time_ns, content))
    return found


def on_topic(messages, topic):
    return [message for message in messages if message.topic == topic]


def transforms_to(messages, child):
    """The transforms to the frame of a drone or a camera."""
    found = []
    for message in on_topic(messages, "/tf"):
        found += [each for each in message.content.transforms if each.child_frame_id == child]
    return found


def test_rosbags_reads_the_poses(messages):
    tracks = small_tracks()
    rows = np.flatnonzero(tracks.seen[:, 0])
    poses = on_topic(messages, "/drone_0/pose")
    for row, (_, time_ns, content) in zip(rows, poses, strict=True):
        assert time_ns == 40_000_000 * tracks.frame[row]
        stamp = content.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == time_ns
        assert content.header.frame_id == "world"
        place = content.pose.pose.position
        assert [place.x, place.y, place.z] == tracks.position_m[row, 0].tolist()
        covariance = np.reshape(content.pose.covariance, (6, 6))
        np.testing.assert_array_equal(covariance[:3, :3], tracks.covariance_m2[row, 0])
        assert np.diag(covariance)[3:].tolist() == [1e9] * 3, "the orientation is not known"
    assert len(transforms_to(messages, "drone_0")) == len(rows)
    # Cameras at 0 s and at the end, 0.52 s.
    assert len(transforms_to(messages, "c1")) == 2


def test_rosbags_reads_the_images(messages, flight):
    images = on_topic(messages, "/c1/image/compressed")
    assert len(images) == NUM_FRAMES
    data = np.frombuffer(bytes(images[9].content.data), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int)
    # JPEG of a noisy image is near it, and nearer than to the images in which the drones are elsewhere.
    off = [np.abs(picture - frame).mean() for frame in read_frames(probe(flight / "c1.avi"))]
    assert np.argmin(off) == 9
    # At 0 and with every later image.
    assert len(on_topic(messages, "/c1/camera_info")) == NUM_FRAMES


def test_a_camera_info_and_its_transform_project_as_the_camera_does(messages, flight):
    """The oracle is OpenCV, with the numbers that ROS programs get."""
    info = on_topic(messages, "/c2/camera_info")[0].content
    assert (info.width, info.height) == IMAGE_SIZE_WH
    pose = transforms_to(messages, "c2")[0].transform
    turn, place = pose.rotation, pose.translation
    R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix().T
    t = -R @ [place.x, place.y, place.z]
    K = np.reshape(info.k, (3, 3))
    point_m = np.array([[0.3, 0.2, 1.0]])
    expected, _ = cv2.projectPoints(point_m, cv2.Rodrigues(R)[0], t, K, np.array(info.d))
    camera = open_recording(flight).rig.cameras[2]
    np.testing.assert_allclose(project(camera, point_m)[0], expected[0], atol=1e-9)


FISHEYE = (0.1, 0.01, -0.01, 0.001)


@pytest.mark.parametrize(
    ("model", "lens", "coefficients"),
    [
        ("plumb_bob", {"dist": LENSES[4]}, [*LENSES[4], 0]),
        ("plumb_bob", {"dist": LENSES[5]}, [*LENSES[5]]),
        ("rational_polynomial", {"dist": LENSES[8]}, [*LENSES[8]]),
        ("equidistant", {"dist": FISHEYE, "fisheye": True}, [*FISHEYE]),
    ],
)
def test_the_lens_models_of_ros(model, lens, coefficients):
    message = camera_message({}, make_camera(**UPRIGHT | lens))
    assert message["distortion_model"] == model
    assert message["d"] == coefficients


@pytest.mark.parametrize("more", [(1e-3, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.01, 0.0)])
def test_ros_has_no_thin_prisms_and_no_tilted_sensors(more):
    assert camera_message({}, make_camera(**UPRIGHT | {"dist": LENSES[8] + more})) is None


def test_the_definitions_of_the_messages_are_those_of_ros():
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in DEFINITIONS.items():
        for part, fields in get_types_from_msg(text, name).items():
            assert fields[1] == store.fielddefs[part][1], part


# What is said, and what is refused


def test_export_says_what_is_lost(run_psotrack, tracks_file, tmp_path):
    result = run_psotrack("export", tracks_file, "--to", "kitti", "--out", tmp_path / "kitti")
    assert result.out == (
        f"{tmp_path / 'kitti'}: kitti, 2 drones, 14 frames; not in this format: covariances, velocities, fitness, "
        "numbers of cameras, status, 3 positions of lost drones\n"
    )


def test_inputs_are_not_replaced_even_with_force_and_images_need_mcap(run_psotrack, tracks_file, tmp_path):
    for words, said in (
        (f"csv --out {tracks_file}", "found TRACKS"),
        (f"json --out {tmp_path / 'tracks.json'}", "record of TRACKS"),
        ("mcap --images", "no SEQ"),
        ("tum --images", "--to tum"),
    ):
        command = ("export", tracks_file, "--to", *words.split(), "--force")
        assert_refused(lambda command=command: run_psotrack(*command), said, unchanged=tmp_path)


def test_the_missing_extra_is_named(tmp_path, monkeypatch):
    export_tracks(small_tracks(), "mcap", tmp_path / "tracks.mcap")
    for name in ("mcap.reader", "mcap_ros2.writer"):
        monkeypatch.setitem(sys.modules, name, None)
    remedy = "pip install '.[ros]'"
    again = tmp_path / "again.mcap"
    assert_refused(lambda: export_tracks(small_tracks(), "mcap", again), remedy, unchanged=tmp_path)
    assert_refused(lambda: read_tracks(tmp_path / "tracks.mcap"), remedy, unchanged=tmp_path)


def test_a_file_beside_the_positions_states_their_rate(tmp_path):
    (tmp_path / "seqinfo.ini").write_text("[Sequence]\nframeRate=10\n")
    (tmp_path / "mot.txt").write_text("1,12,-1,-1,-1,-1,1,1,2,3\n4,7,-1,-1,-1,-1,1,4,5,6\n")
    read = read_tracks(tmp_path / "mot.txt")
    assert read.drones == ("7", "12")
    assert read.frame.tolist() == [0, 3]
    assert read.time_s.tolist() == [0.0, 0.3]
    assert read.position_m[1, 0].tolist() == [4, 5, 6]

"""Simulated sequences on disk: file layout, determinism, resuming after interruptions, and refused input."""

import contextlib
import errno
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from helpers import read_mocap_markers
from placed_drones import drone_masks

from psotrack import __version__
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import project
from psotrack.recordings import VideoWriter, probe, read_detections, read_frames
from psotrack.recordings.datasets import (
    DETECTIONS,
    MARKER_CORNERS,
    read_marker_corners,
    read_masks,
    read_sequence,
)
from psotrack.simulation import (
    CameraRenderer,
    SimulationSettings,
    build,
    change_scenario,
    scenario,
    segments,
    simulate,
)
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.segments import unfinished

NAME = "S02_D4_A"
SMALL = SimulationSettings(num_frames=3, scale=0.1)
#: A scenario of two cameras and two drones, for the tests that interrupt the simulation.
PAIR = msgspec.structs.replace(
    change_scenario(
        scenario(NAME),
        {
            "cameras": [
                {"position_m": [3.0, -2.5, 2.6], "target_m": [0.0, 0.0, 1.2]},
                {"position_m": [-3.0, -2.5, 2.6], "target_m": [0.0, 0.0, 1.2]},
            ]
        },
    ),
    drones=scenario(NAME).drones[:2],
)
TINY = SimulationSettings(num_frames=7, scale=0.04)
#: Smallest accepted similarity of a decoded and a rendered frame, dB. The MPEG-4 encoder at its lowest quality in
#: use is above this limit; a wrong frame is near 15 dB.
MIN_PSNR_DB = 28.0


@pytest.fixture(scope="module")
def sequence_folder(tmp_path_factory):
    return simulate(NAME, tmp_path_factory.mktemp("once"), SMALL, jobs=1)


@pytest.fixture(scope="module")
def pair_folder(tmp_path_factory):
    """Folder of an uninterrupted simulation, to which interrupted simulations are compared."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "SEGMENT_FRAMES", 2)
        return simulate(PAIR, tmp_path_factory.mktemp("pair"), TINY, jobs=1)


@pytest.fixture
def short_segments(monkeypatch):
    monkeypatch.setattr(segments, "SEGMENT_FRAMES", 2)


def read_contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def names_in_parent(folder):
    return sorted(path.name for path in folder.parent.iterdir())


def test_read_sequence_finds_every_file(sequence_folder, tmp_path):
    assert sequence_folder.parts[-2:] == ("Simulated_Data", NAME)
    recording = read_sequence(sequence_folder).usable()
    assert list(recording.videos) == list(recording.rig.names)
    assert [video.path.name for video in recording.videos.values()] == [f"cam{i}i_s.avi" for i in range(1, 9)]
    for video in recording.videos.values():
        assert (video.num_frames, video.fps, video.image_size_wh) == (3, 25.0, (192, 108))
    scene = build(scenario(NAME), scale=0.1)
    assert {path.name for path in (sequence_folder / DETECTIONS).iterdir()} == {
        f"cam{i}i_s.csv" for i in range(1, 9)
    }
    assert set(recording.onboard) == {"dron1", "dron2", "dron3", "dron4"}
    for field in ("T_cam_world", "K"):
        np.testing.assert_allclose(
            getattr(recording.rig.cameras, field), getattr(scene.rig.cameras, field), atol=1e-9
        )
    markers = read_marker_corners(sequence_folder / MARKER_CORNERS)
    assert set(markers) == set(range(1, 42))
    assert [path.name for path in sequence_folder.parent.iterdir()] == [NAME], "no temporary file is left"


def test_the_ground_truth_is_the_flight_and_is_missing_in_frame_0(sequence_folder):
    truth = read_sequence(sequence_folder).truth
    scene = build(scenario(NAME), scale=0.1)
    assert np.isnan(truth.position_m[0]).all()
    time_s = np.array([1, 2]) / 25
    for drone, flight in enumerate(scene.flights):
        # The text files hold sixteen digits.
        np.testing.assert_allclose(truth.position_m[1:, drone], flight.position_m(time_s), atol=1e-12)
        np.testing.assert_allclose(
            truth.orientation_wxyz[1:, drone], flight.orientation_wxyz(time_s), atol=1e-9
        )


def test_videos_show_the_rendered_frames(sequence_folder):
    scene = build(scenario(NAME), scale=0.1)
    drawn = {f"cam{i + 1}i_s.avi": CameraRenderer(scene, i) for i in (1, 6)}
    drawn["dron3_cam_s.avi"] = OnboardRenderer(scene, 2)
    for name, renderer in drawn.items():
        frames = list(read_frames(probe(sequence_folder / name)))
        assert len(frames) == 3
        for frame, shown in enumerate(frames):
            assert cv2.PSNR(shown, renderer.frame(frame)) > MIN_PSNR_DB


def test_masks_agree_with_the_renderer_for_every_drone_camera_and_frame(sequence_folder):
    scene = build(scenario(NAME), scale=0.1)
    with read_masks(sequence_folder) as masks:
        assert masks.cameras == tuple(f"{name}i" for name in scene.rig.names)  # named like the video files
        assert (masks.drones, masks.frames) == ((1, 2, 3, 4), (0, 1, 2))
        for index, camera in enumerate(scene.rig.names):
            renderer = CameraRenderer(scene, index)
            for frame in masks.frames:
                numbers = drone_masks(scene, renderer.cam, renderer.backdrop.depth_m, frame)
                for drone in masks.drones:
                    np.testing.assert_array_equal(masks.mask(camera, drone, frame), numbers == drone)


def test_detections_lie_on_the_drones(sequence_folder):
    recording = read_sequence(sequence_folder)
    assert list(recording.detections) == list(recording.rig.names)
    num_near = num_boxes = 0
    for index, path in enumerate(recording.detections.values()):
        found = read_detections(path)
        for frame in (1, 2):
            pixels, _ = project(recording.rig.cameras[index], recording.truth.position_m[frame])
            for box in found.in_frame(frame).xyxy:
                middle = (box[:2] + box[2:]) / 2 - 0.5
                num_boxes += 1
                # A box's centre differs from the body's origin by less than the box's diagonal.
                num_near += np.linalg.norm(pixels - middle, axis=-1).min() < np.linalg.norm(box[2:] - box[:2])
    # About half of the 64 drones, boxes of about 10 px, are detected; at most two boxes may be false detections.
    assert num_boxes > 15
    assert num_near >= num_boxes - 2


def test_mocap_markers_lie_above_the_drones(sequence_folder):
    truth = read_sequence(sequence_folder).truth
    for drone in range(4):
        markers = read_mocap_markers(sequence_folder / f"dron{drone + 1}_markers_25.csv")
        assert markers.shape == (3, 4, 3)
        # The marker cross is above the body, at most 0.35 m from the body's origin.
        offset = markers[1:] - truth.position_m[1:, drone, None]
        assert np.all(np.linalg.norm(offset, axis=-1) < 0.35)
        assert np.all(offset[..., 2] > 0)


def test_the_record_holds_all_inputs_of_the_simulation(sequence_folder):
    record = json.loads((sequence_folder / "simulation.json").read_text())
    assert {key: record[key] for key in ("frames", "scale", "seed", "masks", "onboard")} == {
        "frames": 3, "scale": 0.1, "seed": 0, "masks": True, "onboard": True,
    }  # fmt: skip
    # Another version starts an unfinished sequence again, because its two halves might differ.
    assert record["version"] == __version__
    assert record["libraries"] == {"numpy": np.__version__, "opencv": cv2.__version__}
    assert msgspec.convert(record["scenario"], type(PAIR)) == scenario(NAME)


def test_the_record_holds_digests_of_the_files_of_the_scenario(tmp_path):
    path = tmp_path / "hover.csv"
    rows = [f"{k},{k / 10},a,0.0,0.0,1.5" for k in range(40)]
    path.write_text("\n".join(["frame,time_s,drone,x_m,y_m,z_m", *rows]) + "\n")
    recipe = change_scenario(
        PAIR, {"drones": [{"flight": {"kind": "recording", "file": str(path)}}], "num_frames": 2}
    )
    folder = simulate(recipe, tmp_path, SimulationSettings(scale=0.04), jobs=1)
    record = json.loads((folder / "simulation.json").read_text())
    assert record["sha256"] == {str(path): hashlib.sha256(path.read_bytes()).hexdigest()}


def test_masks_and_onboard_videos_can_be_left_out(tmp_path):
    folder = simulate(
        PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04, masks=False, onboard=False), jobs=1
    )
    names = set(read_contents(folder))
    assert "cam1i_s.avi" in names
    assert "dl_data/cam1i_s.csv" in names
    assert not any("mask" in name or "_cam" in name or name.startswith("drone") for name in names)


def test_the_frame_rate_stands_in_file_names_and_is_read_back(tmp_path):
    folder = simulate(
        change_scenario(PAIR, {"fps": 12.5}), tmp_path, SimulationSettings(num_frames=2, scale=0.04), jobs=1
    )
    assert {"dron1_pos_12.5.csv", "dron1_markers_12.5.csv", "dron1_cam_12.5.csv"} <= set(
        read_contents(folder)
    )
    recording = read_sequence(folder)
    assert recording.videos["cam1"].fps == 12.5
    assert recording.truth.time_s.tolist() == [0.0, 0.08]
    assert np.isfinite(recording.onboard["dron1"].position_m[1]).all()


def test_fewer_frames_are_the_first_frames_of_the_same_flight(sequence_folder):
    longer = build(scenario(NAME), scale=0.1).positions_m(250)
    truth = read_sequence(sequence_folder).truth
    np.testing.assert_allclose(truth.position_m[1:], longer[1:3], atol=1e-12)


def test_scale_keeps_the_world_and_shrinks_the_images():
    large, small = (build(scenario(NAME), scale=scale) for scale in (1.0, 0.3))
    np.testing.assert_array_equal(large.positions_m(5), small.positions_m(5))
    np.testing.assert_array_equal(large.rig.cameras.T_cam_world, small.rig.cameras.T_cam_world)
    assert large.rig.cameras.K[0].tolist() == [[1156.3, 0, 960], [0, 1156.3, 540], [0, 0, 1]]
    # The image's corner is at -0.5 px, and the distance of a point from that corner shrinks by the scale.
    np.testing.assert_allclose(small.rig.cameras.K[0, :2, 2] + 0.5, 0.3 * np.array([960.5, 540.5]))
    assert np.all(small.rig.cameras.image_size_wh % 2 == 0)


def test_segments_change_only_the_encoded_videos(pair_folder, tmp_path):
    """A video that is encoded in segments differs in bytes; all other files are equal to the byte."""
    unsegmented = read_contents(simulate(PAIR, tmp_path, TINY, jobs=1))
    segmented = read_contents(pair_folder)
    assert unsegmented.keys() == segmented.keys()
    assert {name for name in unsegmented if unsegmented[name] != segmented[name]} == {
        "cam1i_s.avi", "cam2i_s.avi", "dron1_cam_s.avi", "dron2_cam_s.avi",
    }  # fmt: skip


@pytest.mark.usefixtures("short_segments")
@pytest.mark.slow
def test_the_number_of_jobs_changes_no_byte(pair_folder, tmp_path):
    assert read_contents(simulate(PAIR, tmp_path, TINY, jobs=2)) == read_contents(pair_folder)


# --- interruptions


def interrupt_after(after_frames):
    """Return a progress report that raises KeyboardInterrupt (Ctrl-C) after `after_frames` frames."""
    done = 0

    @contextlib.contextmanager
    def report(description, num_boxes):
        def advance(steps):
            nonlocal done
            done += steps
            if done >= after_frames:
                raise KeyboardInterrupt

        yield advance

    return report


@pytest.mark.usefixtures("short_segments")
def test_an_interrupted_simulation_continues_at_its_segment(pair_folder, tmp_path):
    parent = tmp_path / "Simulated_Data"
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, TINY, jobs=1, report=interrupt_after(12))
    assert [path.name for path in parent.iterdir()] == [f".{NAME}.unfinished"]
    # Seven frames of the first camera, and the segments of frames 0-1 and 2-3 of the second camera.
    kept = {path: path.stat().st_mtime_ns for path in parent.rglob("video.avi")}
    assert sorted("/".join(path.parts[-3:-1]) for path in kept) == [
        *(f"cam1i/{start:06d}" for start in (0, 2, 4, 6)), *(f"cam2i/{start:06d}" for start in (0, 2)),
    ]  # fmt: skip
    assert not list(parent.rglob("*.partial*"))
    with pytest.raises(KeyboardInterrupt):
        # The existing frames are reported as done at the start, which raises the interruption.
        simulate(PAIR, tmp_path, TINY, jobs=1, report=interrupt_after(12))
    assert kept == {path: path.stat().st_mtime_ns for path in parent.rglob("video.avi")}
    folder = simulate(PAIR, tmp_path, TINY, jobs=1)
    assert read_contents(folder) == read_contents(pair_folder)
    assert names_in_parent(folder) == [NAME]


@pytest.mark.usefixtures("short_segments")
@pytest.mark.parametrize("step", ["join_videos", "join_archives", "write_onboard_calibration"])
@pytest.mark.slow
def test_an_interruption_after_the_last_frame_renders_no_frame_again(
    pair_folder, tmp_path, monkeypatch, step
):
    """The interruption comes while videos or masks are joined, or tables are written."""
    targets = {
        "join_videos": "psotrack.simulation.segments.join_videos",
        "join_archives": "psotrack.simulation.segments.join_archives",
        "write_onboard_calibration": "psotrack.simulation.generate.write_onboard_calibration",
    }

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(targets[step], interrupt)
        with pytest.raises(KeyboardInterrupt):
            simulate(PAIR, tmp_path, TINY, jobs=1)
    monkeypatch.setattr("psotrack.simulation.segments.CameraRenderer", interrupt)
    folder = simulate(PAIR, tmp_path, TINY, jobs=1)
    assert read_contents(folder) == read_contents(pair_folder)
    assert names_in_parent(folder) == [NAME]


#: Script that simulates into a folder with `jobs` processes and kills itself `delay_s` seconds after `frames` frames,
#: or at the next frame if that comes earlier.
KILLED_SCRIPT = """
    import contextlib
    import os
    import signal
    import sys
    import threading
    from pathlib import Path
    import msgspec
    from psotrack.simulation import Scenario, SimulationSettings, segments, simulate

    def kill():
        os.kill(os.getpid(), signal.SIGKILL)

    @contextlib.contextmanager
    def report(description, total):
        done = 0

        def advance(steps):
            nonlocal done
            if done >= frames:
                kill()
            done += steps
            if done >= frames:
                threading.Timer(delay_s, kill).start()

        yield advance

    if __name__ == "__main__":
        segments.SEGMENT_FRAMES = 2
        folder, jobs, frames, delay_s = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
        recipe = msgspec.json.decode(sys.stdin.buffer.read(), type=Scenario)
        simulate(recipe, Path(folder), SimulationSettings(num_frames=7, scale=0.04), jobs=jobs, report=report)
"""


@pytest.mark.usefixtures("short_segments")
@pytest.mark.slow
def test_a_simulation_killed_at_random_moments_ends_with_the_same_bytes(pair_folder, tmp_path):
    (tmp_path / "run.py").write_text(textwrap.dedent(KILLED_SCRIPT))
    rng = np.random.default_rng(0)
    parent = tmp_path / "Simulated_Data"
    num_segments = [0]
    for jobs in (2, 1):
        # The process is killed a few frames after the frames that existed at its start, plus a random delay.
        moment = 2 * num_segments[-1] + rng.integers(4, 9), rng.uniform(0, 0.04)
        command = [sys.executable, tmp_path / "run.py", tmp_path, *map(str, (jobs, *moment))]
        # `run` waits until stderr is closed, that is until the process and all of its workers have ended.
        killed = subprocess.run(command, input=msgspec.json.encode(PAIR), capture_output=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed
        # The lock file remains, but the lock ended with the process.
        assert sorted(path.name for path in parent.iterdir()) == [f".{NAME}.lock", f".{NAME}.unfinished"]
        num_segments.append(len(list(parent.rglob("[0-9]*/video.avi"))))
    assert num_segments[-1] > 1, "complete segments are kept"
    assert read_contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == read_contents(pair_folder)
    assert [path.name for path in parent.iterdir()] == [NAME]


def test_a_replacement_that_cannot_be_moved_leaves_the_old_sequence(pair_folder, tmp_path, monkeypatch):
    folder = shutil.copytree(pair_folder, tmp_path / "Simulated_Data" / NAME)
    move, moves = os.replace, []

    def refuse(source, target):
        moves.append(target)
        if moves.count(folder) == 1 and target == folder:
            raise OSError(errno.EIO, "Input/output error")
        move(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(
        OutputError, match=r"S02_D4_A: expected a path that can be written, found Input/output error"
    ):
        simulate(PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04), jobs=1, force=True)
    assert read_contents(folder) == read_contents(pair_folder)
    assert names_in_parent(folder) == [f".{NAME}.unfinished", NAME]


@pytest.mark.usefixtures("short_segments")
@pytest.mark.parametrize("other", [{"seed": 5}, {"num_frames": 6}])
def test_segments_of_other_settings_are_not_used(pair_folder, tmp_path, other):
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, replace(TINY, **other), jobs=1, report=interrupt_after(4))
    assert read_contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == read_contents(pair_folder)


def test_different_records_have_different_segment_folders(tmp_path):
    folders = []
    for record in (b"one", b"other"):
        with unfinished(tmp_path / NAME, record) as parts:
            folders.append(parts)
    assert folders[0] != folders[1]


def test_a_second_simulation_of_the_same_sequence_is_refused(tmp_path):
    folder = tmp_path / "Simulated_Data" / NAME
    with unfinished(folder, b"another record") as parts:
        parts.mkdir(parents=True)
        message = r"S02_D4_A: expected no other simulation of this sequence at the same time, found .*; wait"
        with pytest.raises(OutputError, match=message):
            simulate(PAIR, tmp_path, TINY, jobs=1)
        assert parts.exists()
    # The lock ended with the other simulation, so a new simulation can start.
    simulate(PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04), jobs=1)
    assert names_in_parent(folder) == [NAME]


def test_the_simulator_is_imported_where_there_is_no_fcntl():
    """Windows has no module `fcntl`."""
    code = "import sys; sys.modules['fcntl'] = None; from psotrack.simulation import simulate"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EIO])
def test_a_file_system_without_locks_is_accepted_and_a_broken_one_is_an_error(tmp_path, monkeypatch, code):
    def fail(descriptor, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", fail)
    refused = pytest.raises(
        OutputError, match=r"S02_D4_A: expected a path that can be written, found Input/output error"
    )
    allowed = contextlib.nullcontext() if code == errno.ENOLCK else refused
    with allowed, unfinished(tmp_path / NAME, b"record") as parts:
        assert parts.is_relative_to(tmp_path)


def test_a_full_disk_leaves_no_sequence_and_keeps_complete_segments(pair_folder, tmp_path, monkeypatch):
    """A limit on the file size stands for a full disk."""
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import msgspec
        from psotrack.errors import OutputError
        from psotrack.simulation import Scenario, SimulationSettings, segments, simulate
        segments.SEGMENT_FRAMES = 2
        sys.dont_write_bytecode = True  # the limit would truncate the bytecode of other processes too
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
        recipe = msgspec.json.decode(sys.stdin.buffer.read(), type=Scenario)
        try:
            simulate(recipe, Path(sys.argv[1]), SimulationSettings(num_frames=7, scale=0.04), jobs=1)
        except OutputError as error:
            print(error)
        """
    )
    # The limit is above the size of a segment (a few kilobytes) and below the size of a joined video.
    limit = str((pair_folder / "cam1i_s.avi").stat().st_size - 1000)
    command = [sys.executable, "-c", script, tmp_path, limit]
    done = subprocess.run(command, input=msgspec.json.encode(PAIR), capture_output=True)
    assert b"earlier results are unchanged" in done.stdout, done.stderr
    assert done.stdout.count(b"\n") == 1
    assert not (tmp_path / "Simulated_Data" / NAME).exists()
    monkeypatch.setattr(segments, "SEGMENT_FRAMES", 2)
    assert read_contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == read_contents(pair_folder)


# --- refusals


def test_an_existing_sequence_is_replaced_only_by_force(pair_folder, tmp_path):
    folder = shutil.copytree(pair_folder, tmp_path / "Simulated_Data" / NAME)
    before = read_contents(folder)
    with pytest.raises(
        OutputError,
        match=r"S02_D4_A: expected a path that does not exist yet, found an existing folder; pass --force",
    ):
        simulate(PAIR, tmp_path, TINY, jobs=1)
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, replace(TINY, seed=1), jobs=1, force=True, report=interrupt_after(2))
    assert read_contents(folder) == before, "the old sequence stays until the new sequence is complete"
    simulate(PAIR, tmp_path, replace(TINY, seed=1), jobs=1, force=True)
    after = read_contents(folder)
    assert after.keys() == before.keys()
    assert after["dron1_pos_25.csv"] != before["dron1_pos_25.csv"]
    assert after["cam1i_s.avi"] != before["cam1i_s.avi"]
    assert after["cameras_calibration.csv"] == before["cameras_calibration.csv"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "S99"}, r"^scenario: expected one of .*S02_D4_A.*, found S99$"),
        ({"num_frames": 0}, r"^frames: expected 1 to 250, the length of S02_D4_A, found 0$"),
        ({"num_frames": -3}, r"^frames: .* found -3$"),
        ({"num_frames": 251}, r"^frames: .* found 251$"),
        ({"scale": 0.0}, r"^scale: expected a number above 0, found 0$"),
        ({"scale": -1.0}, r"^scale: .* found -1$"),
        ({"scale": float("nan")}, r"^scale: .* found nan$"),
        ({"scale": 0.01}, r"^scale: expected images of at least 32 pixels a side, found 20 x 10$"),
        ({"scale": 5.0}, r"^scale: expected images of at most 8190 pixels a side, found 9600 x 5400$"),
        ({"scale": 1e308}, r"^scale: expected images of at most 8190 pixels a side, found inf x inf$"),
        ({"scenario": change_scenario(PAIR, {"onboard.image_size_wh": [160, 90]})},
         r"^scale: expected images of at least 32 pixels a side, found 16 x 8$"),
        ({"seed": -1}, r"^seed: expected 0 or more, found -1$"),
        ({"jobs": 0}, r"^jobs: expected 1 or more, found 0$"),
    ],
)  # fmt: skip
def test_invalid_settings_are_refused_before_anything_is_written(settings, message, tmp_path):
    recipe, jobs = settings.get("scenario", NAME), settings.get("jobs")
    settings = replace(SMALL, **{name: settings[name] for name in settings.keys() - {"scenario", "jobs"}})
    with pytest.raises(SettingsError, match=message):
        simulate(recipe, tmp_path, settings, jobs=jobs)
    assert not list(tmp_path.iterdir())


def test_the_size_limit_of_images_is_the_limit_of_the_video_writer(tmp_path):
    with VideoWriter(tmp_path / "fits.avi", 25.0, (8190, 32)) as video:
        video.write(np.zeros((32, 8190, 3), np.uint8))
    with pytest.raises(OutputError), VideoWriter(tmp_path / "wide.avi", 25.0, (8192, 32)):
        pass


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "Simulated_Data").write_text("a file where the folder should be")
    with pytest.raises(OutputError, match=r"Simulated_Data"):
        simulate(NAME, tmp_path, SMALL, jobs=1)


def test_a_missing_file_of_the_scenario_is_named(tmp_path):
    recipe = change_scenario(PAIR, {"drones[0].model": {"file": str(tmp_path / "none.ply")}})
    with pytest.raises(InputError, match=r"none\.ply"):
        simulate(recipe, tmp_path, TINY)
    assert not list(tmp_path.iterdir())


def test_progress_counts_every_frame_of_every_video(tmp_path):
    progress = []

    @contextlib.contextmanager
    def report(description, num_boxes):
        progress.append(num_boxes)
        yield lambda steps: progress.append(-steps)

    simulate(PAIR, tmp_path, SimulationSettings(num_frames=2, scale=0.05), jobs=1, report=report)
    assert progress[0] == 2 * (2 + 2)
    assert sum(progress) == 0

"""Simulated sequences on disk: layout, determinism, resuming after any interruption, refusing."""

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
from placed_drones import drone_masks

from psotrack import __version__
from psotrack.datasets.dpjait import (
    DETECTIONS,
    MARKER_CORNERS,
    read_marker_corners,
    read_masks,
    read_mocap_markers,
    read_sequence,
)
from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import project
from psotrack.recordings import VideoWriter, probe, read_detections, read_frames
from psotrack.simulation import (
    CameraRenderer,
    SimulationSettings,
    build,
    replaced,
    scenario,
    segments,
    simulate,
)
from psotrack.simulation.imaging.onboard import OnboardRenderer
from psotrack.simulation.unfinished import unfinished

NAME = "S02_D4_A"
SMALL = SimulationSettings(num_frames=3, scale=0.1)
#: Two cameras and two drones, for tests that interrupt.
PAIR = msgspec.structs.replace(
    replaced(
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
#: An encoder of MPEG-4 at its lowest quality in use is above that; a wrong picture is near 15 dB.
LEAST_PSNR_DB = 28.0


@pytest.fixture(scope="module")
def sequence_folder(tmp_path_factory):
    return simulate(NAME, tmp_path_factory.mktemp("once"), SMALL, jobs=1)


@pytest.fixture(scope="module")
def pair_folder(tmp_path_factory):
    """What the interrupted ones must come to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "SEGMENT_FRAMES", 2)
        return simulate(PAIR, tmp_path_factory.mktemp("pair"), TINY, jobs=1)


@pytest.fixture
def short_segments(monkeypatch):
    monkeypatch.setattr(segments, "SEGMENT_FRAMES", 2)


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def beside(folder):
    return sorted(path.name for path in folder.parent.iterdir())


def test_the_reader_of_the_published_layout_finds_all_of_it(sequence_folder, tmp_path):
    assert sequence_folder.parts[-2:] == ("Simulated_Data", NAME)
    sequence = read_sequence(sequence_folder).usable()
    assert list(sequence.videos) == list(sequence.rig.names)
    assert [video.path.name for video in sequence.videos.values()] == [f"cam{i}i_s.avi" for i in range(1, 9)]
    for video in sequence.videos.values():
        assert (video.num_frames, video.fps, video.image_size_wh) == (3, 25.0, (192, 108))
    scene = build(scenario(NAME), scale=0.1)
    assert {path.name for path in (sequence_folder / DETECTIONS).iterdir()} == {
        f"cam{i}i_s.csv" for i in range(1, 9)
    }
    assert set(sequence.onboard) == {"dron1", "dron2", "dron3", "dron4"}
    for field in ("T_cam_world", "K"):
        np.testing.assert_allclose(
            getattr(sequence.rig.cameras, field), getattr(scene.rig.cameras, field), atol=1e-9
        )
    markers = read_marker_corners(sequence_folder / MARKER_CORNERS)
    assert set(markers) == set(range(1, 42))
    assert [path.name for path in sequence_folder.parent.iterdir()] == [NAME], "nothing is left beside it"


def test_the_truth_on_disk_is_the_flight_and_frame_0_has_none(sequence_folder):
    truth = read_sequence(sequence_folder).truth
    scene = build(scenario(NAME), scale=0.1)
    assert np.isnan(truth.position_m[0]).all()
    time_s = np.array([1, 2]) / 25
    for drone, flight in enumerate(scene.flights):
        # Text holds sixteen digits.
        np.testing.assert_allclose(truth.position_m[1:, drone], flight.position_m(time_s), atol=1e-12)
        np.testing.assert_allclose(
            truth.orientation_wxyz[1:, drone], flight.orientation_wxyz(time_s), atol=1e-9
        )


def test_videos_show_what_the_renderers_draw_at_those_frames(sequence_folder):
    scene = build(scenario(NAME), scale=0.1)
    drawn = {f"cam{i + 1}i_s.avi": CameraRenderer(scene, i) for i in (1, 6)}
    drawn["dron3_cam_s.avi"] = OnboardRenderer(scene, 2)
    for name, renderer in drawn.items():
        frames = list(read_frames(probe(sequence_folder / name)))
        assert len(frames) == 3
        for frame, shown in enumerate(frames):
            assert cv2.PSNR(shown, renderer.frame(frame)) > LEAST_PSNR_DB


def test_masks_are_what_the_renderer_would_draw_for_every_drone_camera_and_frame(sequence_folder):
    scene = build(scenario(NAME), scale=0.1)
    with read_masks(sequence_folder) as masks:
        assert masks.cameras == tuple(f"{name}i" for name in scene.rig.names)  # named as the files
        assert (masks.drones, masks.frames) == ((1, 2, 3, 4), (0, 1, 2))
        for index, camera in enumerate(scene.rig.names):
            one = CameraRenderer(scene, index)
            for frame in masks.frames:
                numbers = drone_masks(scene, one.cam, one.backdrop.depth_m, frame)
                for drone in masks.drones:
                    np.testing.assert_array_equal(masks.mask(camera, drone, frame), numbers == drone)


def test_detections_lie_about_the_drones(sequence_folder):
    sequence = read_sequence(sequence_folder)
    assert list(sequence.detections) == list(sequence.rig.names)
    near = total = 0
    for index, path in enumerate(sequence.detections.values()):
        found = read_detections(path)
        for frame in (1, 2):
            pixels, _ = project(sequence.rig.cameras[index], sequence.truth.position_m[frame])
            for box in found.in_frame(frame).xyxy:
                middle = (box[:2] + box[2:]) / 2 - 0.5
                total += 1
                # A box's middle is off the body's origin by a share of its size, jitter and drawing included.
                near += np.linalg.norm(pixels - middle, axis=-1).min() < np.linalg.norm(box[2:] - box[:2])
    # 64 drones, boxes of about 10 px: some half are found. A false alarm may be among them.
    assert total > 15
    assert near >= total - 2


def test_mocap_markers_go_with_the_poses(sequence_folder):
    truth = read_sequence(sequence_folder).truth
    for drone in range(4):
        markers = read_mocap_markers(sequence_folder / f"dron{drone + 1}_markers_25.csv")
        assert markers.shape == (3, 4, 3)
        # The cross is above the body, some centimetres to a decimetre from its origin.
        offset = markers[1:] - truth.position_m[1:, drone, None]
        assert np.all(np.linalg.norm(offset, axis=-1) < 0.35)
        assert np.all(offset[..., 2] > 0)


def test_the_record_says_how_to_make_it_again(sequence_folder):
    record = json.loads((sequence_folder / "simulation.json").read_text())
    assert {key: record[key] for key in ("frames", "scale", "seed", "masks", "onboard")} == {
        "frames": 3, "scale": 0.1, "seed": 0, "masks": True, "onboard": True,
    }  # fmt: skip
    # With other versions an unfinished sequence is begun anew: its halves might differ.
    assert record["version"] == __version__
    assert record["libraries"] == {"numpy": np.__version__, "opencv": cv2.__version__}
    assert msgspec.convert(record["scenario"], type(PAIR)) == scenario(NAME)


def test_the_record_knows_the_files_that_a_scenario_names(tmp_path):
    path = tmp_path / "hover.csv"
    rows = [f"{k / 10},0.0,0.0,1.5" for k in range(40)]
    path.write_text("\n".join(["time_s,x_m,y_m,z_m", *rows]) + "\n")
    recipe = replaced(
        PAIR, {"drones": [{"flight": {"kind": "recording", "file": str(path)}}], "num_frames": 2}
    )
    folder = simulate(recipe, tmp_path, SimulationSettings(scale=0.04), jobs=1)
    record = json.loads((folder / "simulation.json").read_text())
    assert record["sha256"] == {str(path): hashlib.sha256(path.read_bytes()).hexdigest()}


def test_parts_can_be_left_out(tmp_path):
    folder = simulate(
        PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04, masks=False, onboard=False), jobs=1
    )
    names = set(contents(folder))
    assert "cam1i_s.avi" in names
    assert "dl_data/cam1i_s.csv" in names
    assert not any("mask" in name or "_cam" in name or name.startswith("drone") for name in names)


def test_another_rate_is_in_the_names_and_is_read(tmp_path):
    folder = simulate(
        replaced(PAIR, {"fps": 12.5}), tmp_path, SimulationSettings(num_frames=2, scale=0.04), jobs=1
    )
    assert {"dron1_pos_12.5.csv", "dron1_markers_12.5.csv", "dron1_cam_12.5.csv"} <= set(contents(folder))
    sequence = read_sequence(folder)
    assert sequence.videos["cam1"].fps == 12.5
    assert sequence.truth.time_s.tolist() == [0.0, 0.08]
    assert np.isfinite(sequence.onboard["dron1"].position_m[1]).all()


def test_fewer_frames_are_the_first_of_the_same_flight(sequence_folder):
    longer = build(scenario(NAME), scale=0.1).positions_m(250)
    truth = read_sequence(sequence_folder).truth
    np.testing.assert_allclose(truth.position_m[1:], longer[1:3], atol=1e-12)


def test_scale_keeps_the_world_and_shrinks_the_pictures():
    large, small = (build(scenario(NAME), scale=scale) for scale in (1.0, 0.3))
    np.testing.assert_array_equal(large.positions_m(5), small.positions_m(5))
    np.testing.assert_array_equal(large.rig.cameras.T_cam_world, small.rig.cameras.T_cam_world)
    assert large.rig.cameras.K[0].tolist() == [[1156.3, 0, 960], [0, 1156.3, 540], [0, 0, 1]]
    # A point's distance from the corner of the image, which is at -0.5, shrinks by the scale.
    np.testing.assert_allclose(small.rig.cameras.K[0, :2, 2] + 0.5, 0.3 * np.array([960.5, 540.5]))
    assert np.all(small.rig.cameras.image_size_wh % 2 == 0)


def test_segments_change_no_truth_and_no_picture_before_the_codec(pair_folder, tmp_path):
    """In one piece, the codec sees other neighbours; everything else is the same to the byte."""
    whole = contents(simulate(PAIR, tmp_path, TINY, jobs=1))
    parts = contents(pair_folder)
    assert whole.keys() == parts.keys()
    assert {name for name in whole if whole[name] != parts[name]} == {
        "cam1i_s.avi", "cam2i_s.avi", "dron1_cam_s.avi", "dron2_cam_s.avi",
    }  # fmt: skip


@pytest.mark.usefixtures("short_segments")
def test_the_number_of_jobs_changes_no_byte(pair_folder, tmp_path):
    assert contents(simulate(PAIR, tmp_path, TINY, jobs=2)) == contents(pair_folder)


# --- interruptions


def interrupting(after_frames):
    """A report that is Ctrl-C after so many frames."""
    done = 0

    @contextlib.contextmanager
    def report(description, total):
        def advance(steps):
            nonlocal done
            done += steps
            if done >= after_frames:
                raise KeyboardInterrupt

        yield advance

    return report


@pytest.mark.usefixtures("short_segments")
def test_an_interrupted_call_goes_on_with_the_segment_where_it_stopped(pair_folder, tmp_path):
    place = tmp_path / "Simulated_Data"
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, TINY, jobs=1, report=interrupting(12))
    assert [path.name for path in place.iterdir()] == [f".{NAME}.unfinished"]
    # Seven frames of one camera, and five of the next: its segments of frames 0-1 and 2-3.
    kept = {path: path.stat().st_mtime_ns for path in place.rglob("video.avi")}
    assert sorted("/".join(path.parts[-3:-1]) for path in kept) == [
        *(f"cam1i/{start:06d}" for start in (0, 2, 4, 6)), *(f"cam2i/{start:06d}" for start in (0, 2)),
    ]  # fmt: skip
    assert not list(place.rglob("*.partial*"))
    with pytest.raises(KeyboardInterrupt):
        # What is there is counted at once.
        simulate(PAIR, tmp_path, TINY, jobs=1, report=interrupting(12))
    assert kept == {path: path.stat().st_mtime_ns for path in place.rglob("video.avi")}
    folder = simulate(PAIR, tmp_path, TINY, jobs=1)
    assert contents(folder) == contents(pair_folder)
    assert beside(folder) == [NAME]


@pytest.mark.usefixtures("short_segments")
@pytest.mark.parametrize("step", ["join_videos", "join_archives", "write_onboard_calibration", "rmtree"])
def test_an_interruption_after_the_last_frame_costs_no_frame(pair_folder, tmp_path, monkeypatch, step):
    """While videos or masks are joined, tables written, segments cleared away."""
    places = {
        "join_videos": "psotrack.simulation.segments.join_videos",
        "join_archives": "psotrack.simulation.segments.join_archives",
        "write_onboard_calibration": "psotrack.simulation.generate.write_onboard_calibration",
        "rmtree": "psotrack.simulation.unfinished.shutil.rmtree",
    }

    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(places[step], interrupt)
        with pytest.raises(KeyboardInterrupt):
            simulate(PAIR, tmp_path, TINY, jobs=1)
    # What is joined is not on the disk twice.
    assert bool(list(tmp_path.rglob("video.avi"))) == step.startswith("join")
    monkeypatch.setattr("psotrack.simulation.segments.CameraRenderer", interrupt)
    folder = simulate(PAIR, tmp_path, TINY, jobs=1)
    assert contents(folder) == contents(pair_folder)
    assert beside(folder) == [NAME]


#: Simulates into a folder, with so many jobs; kills itself some time after so many frames, or with the frame after.
KILLED = """
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
def test_killed_at_random_moments_it_comes_to_the_same_bytes(pair_folder, tmp_path):
    (tmp_path / "run.py").write_text(textwrap.dedent(KILLED))
    rng = np.random.default_rng(0)
    place = tmp_path / "Simulated_Data"
    made = [0]
    for jobs in (2, 1):
        # Some frames more than there were at its start, and some fraction of the next.
        moment = 2 * made[-1] + rng.integers(4, 9), rng.uniform(0, 0.04)
        command = [sys.executable, tmp_path / "run.py", tmp_path, *map(str, (jobs, *moment))]
        # It has ended when nobody has its stderr any more, which its workers share.
        killed = subprocess.run(command, input=msgspec.json.encode(PAIR), capture_output=True, check=False)
        assert killed.returncode == -signal.SIGKILL, killed
        # The lock's file stays, but its lock has ended with the process.
        assert sorted(path.name for path in place.iterdir()) == [f".{NAME}.lock", f".{NAME}.unfinished"]
        made.append(len(list(place.rglob("[0-9]*/video.avi"))))
    assert made[-1] > 1, "what was whole has been kept"
    assert contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == contents(pair_folder)
    assert [path.name for path in place.iterdir()] == [NAME]


@pytest.mark.usefixtures("short_segments")
def test_a_death_between_the_two_moves_of_a_replacement_loses_nothing(pair_folder, tmp_path):
    """With --force the old sequence steps aside first: whoever comes next puts it back."""
    folder = tmp_path / "Simulated_Data" / NAME
    aside = folder.with_name(f".{NAME}.old")
    shutil.copytree(pair_folder, aside)
    with pytest.raises(OutputError, match="expected a path that does not exist yet, found an existing"):
        simulate(PAIR, tmp_path, replace(TINY, seed=1), jobs=1)
    assert contents(folder) == contents(pair_folder)
    assert beside(folder) == [NAME]


def test_a_replacement_that_cannot_be_moved_leaves_the_old_sequence(pair_folder, tmp_path, monkeypatch):
    folder = shutil.copytree(pair_folder, tmp_path / "Simulated_Data" / NAME)
    move = os.replace

    def refuse(source, target):
        if str(source).endswith(".unfinished"):
            raise OSError(errno.EIO, "Input/output error")
        move(source, target)

    monkeypatch.setattr("psotrack.simulation.unfinished.os.replace", refuse)
    with pytest.raises(
        OutputError, match=r"S02_D4_A: expected a path that can be written, found Input/output error"
    ):
        simulate(PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04), jobs=1, force=True)
    assert contents(folder) == contents(pair_folder)
    assert beside(folder) == [f".{NAME}.unfinished", NAME]


@pytest.mark.usefixtures("short_segments")
@pytest.mark.parametrize("other", [{"seed": 5}, {"num_frames": 6}])
def test_what_other_settings_left_unfinished_is_not_used(pair_folder, tmp_path, other):
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, replace(TINY, **other), jobs=1, report=interrupting(4))
    assert contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == contents(pair_folder)


def test_a_worker_that_outlives_its_call_leaves_nothing_to_another_record(tmp_path):
    folders = []
    for record in (b"one", b"other"):
        with unfinished(tmp_path / NAME, record, force=False) as growing:
            folders.append(growing.segments)
    assert folders[0] != folders[1]


def test_two_calls_at_once_do_not_meet(tmp_path):
    folder = tmp_path / "Simulated_Data" / NAME
    with unfinished(folder, b"somebody else's", force=False) as growing:
        (growing.folder / "half").write_text("")
        message = r"S02_D4_A: expected to be the only one who writes it, found another simulation at work on it; wait"
        with pytest.raises(OutputError, match=message):
            simulate(PAIR, tmp_path, TINY, jobs=1)
        assert (growing.folder / "half").exists()
    # A lock ends with whoever held it.
    simulate(PAIR, tmp_path, SimulationSettings(num_frames=1, scale=0.04), jobs=1)
    assert beside(folder) == [NAME]


def test_the_simulator_is_imported_where_there_is_no_fcntl():
    """As on Windows."""
    code = "import sys; sys.modules['fcntl'] = None; from psotrack.simulation import simulate"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EIO])
def test_a_file_system_without_locks_keeps_nobody_out_and_a_broken_one_is_named(tmp_path, monkeypatch, code):
    def fail(descriptor, operation):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", fail)
    refused = pytest.raises(
        OutputError, match=r"S02_D4_A: expected a path that can be written, found Input/output error"
    )
    allowed = contextlib.nullcontext() if code == errno.ENOLCK else refused
    with allowed, unfinished(tmp_path / NAME, b"record", force=False) as growing:
        assert growing.folder.is_dir()


def test_a_full_disk_leaves_no_sequence_and_keeps_what_was_whole(pair_folder, tmp_path, monkeypatch):
    """A file size limit stands for the full disk."""
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import msgspec
        from psotrack.errors import OutputError
        from psotrack.simulation import Scenario, SimulationSettings, segments, simulate
        segments.SEGMENT_FRAMES = 2
        sys.dont_write_bytecode = True  # a cached module would be cut off too, for everybody
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
        recipe = msgspec.json.decode(sys.stdin.buffer.read(), type=Scenario)
        try:
            simulate(recipe, Path(sys.argv[1]), SimulationSettings(num_frames=7, scale=0.04), jobs=1)
        except OutputError as error:
            print(error)
        """
    )
    # Segments of a few kilobytes fit, joined videos do not.
    limit = str((pair_folder / "cam1i_s.avi").stat().st_size - 1000)
    command = [sys.executable, "-c", script, tmp_path, limit]
    done = subprocess.run(command, input=msgspec.json.encode(PAIR), capture_output=True)
    assert b"earlier results are unchanged" in done.stdout, done.stderr
    assert done.stdout.count(b"\n") == 1
    assert not (tmp_path / "Simulated_Data" / NAME).exists()
    monkeypatch.setattr(segments, "SEGMENT_FRAMES", 2)
    assert contents(simulate(PAIR, tmp_path, TINY, jobs=1)) == contents(pair_folder)


# --- refusals


def test_a_sequence_that_exists_is_left_alone_unless_forced(pair_folder, tmp_path):
    folder = shutil.copytree(pair_folder, tmp_path / "Simulated_Data" / NAME)
    before = contents(folder)
    with pytest.raises(
        OutputError,
        match=r"S02_D4_A: expected a path that does not exist yet, found an existing folder; pass --force",
    ):
        simulate(PAIR, tmp_path, TINY, jobs=1)
    with pytest.raises(KeyboardInterrupt):
        simulate(PAIR, tmp_path, replace(TINY, seed=1), jobs=1, force=True, report=interrupting(2))
    assert contents(folder) == before, "until the new one is whole, the old one stays"
    simulate(PAIR, tmp_path, replace(TINY, seed=1), jobs=1, force=True)
    after = contents(folder)
    assert after.keys() == before.keys()
    assert after["dron1_pos_25.csv"] != before["dron1_pos_25.csv"]
    assert after["cam1i_s.avi"] != before["cam1i_s.avi"]
    assert after["cameras_calibration.csv"] == before["cameras_calibration.csv"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "S99"}, r"^scenario: expected one of .*S02_D4_A.*, found S99$"),
        ({"num_frames": 0}, r"^frames: expected 1 to 250, as many as S02_D4_A has, found 0$"),
        ({"num_frames": -3}, r"^frames: .* found -3$"),
        ({"num_frames": 251}, r"^frames: .* found 251$"),
        ({"scale": 0.0}, r"^scale: expected a number above 0, found 0$"),
        ({"scale": -1.0}, r"^scale: .* found -1$"),
        ({"scale": float("nan")}, r"^scale: .* found nan$"),
        ({"scale": 0.01}, r"^scale: expected images of at least 32 pixels a side, found 20 x 10$"),
        ({"scale": 5.0}, r"^scale: expected images of at most 8190 pixels a side, found 9600 x 5400$"),
        ({"scale": 1e308}, r"^scale: expected images of at most 8190 pixels a side, found inf x inf$"),
        ({"scenario": replaced(PAIR, {"onboard.image_size_wh": [160, 90]})},
         r"^scale: expected images of at least 32 pixels a side, found 16 x 8$"),
        ({"seed": -1}, r"^seed: expected 0 or more, found -1$"),
        ({"jobs": 0}, r"^jobs: expected 1 or more, found 0$"),
    ],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused_before_anything_is_written(settings, message, tmp_path):
    recipe, jobs = settings.get("scenario", NAME), settings.get("jobs")
    settings = replace(SMALL, **{name: settings[name] for name in settings.keys() - {"scenario", "jobs"}})
    with pytest.raises(SettingsError, match=message):
        simulate(recipe, tmp_path, settings, jobs=jobs)
    assert not list(tmp_path.iterdir())


def test_the_largest_images_are_the_largest_that_a_video_takes(tmp_path):
    with VideoWriter(tmp_path / "fits.avi", 25.0, (8190, 32)) as video:
        video.write(np.zeros((32, 8190, 3), np.uint8))
    with pytest.raises(OutputError), VideoWriter(tmp_path / "wide.avi", 25.0, (8192, 32)):
        pass


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "Simulated_Data").write_text("a file where the folder should be")
    with pytest.raises(OutputError, match=r"Simulated_Data"):
        simulate(NAME, tmp_path, SMALL, jobs=1)


def test_a_file_of_the_scenario_that_is_missing_is_named(tmp_path):
    recipe = replaced(PAIR, {"drones[0].model": {"file": str(tmp_path / "none.ply")}})
    with pytest.raises(InputError, match=r"none\.ply"):
        simulate(recipe, tmp_path, TINY)
    assert not list(tmp_path.iterdir())


def test_progress_counts_every_frame_of_every_video(tmp_path):
    counted = []

    @contextlib.contextmanager
    def report(description, total):
        counted.append(total)
        yield lambda steps: counted.append(-steps)

    simulate(PAIR, tmp_path, SimulationSettings(num_frames=2, scale=0.05), jobs=1, report=report)
    assert counted[0] == 2 * (2 + 2)
    assert sum(counted) == 0

"""Simulated sequences on disk: layout, determinism, resuming, refusing."""

import contextlib
import shutil

import cv2
import numpy as np
import pytest

from psotrack.datasets.dpjait import MARKER_CORNERS, read_marker_corners, read_sequence
from psotrack.errors import OutputError, SettingsError
from psotrack.simulation import build, generate, scenario, simulate
from psotrack.video import probe, read_frames

NAME = "S02_D4_A"
SMALL = {"num_frames": 3, "scale": 0.1}
#: An encoder of MPEG-4 at its lowest quality in use is above that; a wrong picture is near 15 dB.
LEAST_PSNR_DB = 28.0


@pytest.fixture(scope="module")
def sequence_folder(tmp_path_factory):
    return simulate(NAME, tmp_path_factory.mktemp("once"), jobs=1, **SMALL)


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_the_reader_of_the_published_layout_finds_all_of_it(sequence_folder, tmp_path):
    assert sequence_folder.parts[-2:] == ("Simulated_Data", NAME)
    sequence = read_sequence(sequence_folder).usable()
    assert list(sequence.videos) == list(sequence.rig.names)
    assert [video.path.name for video in sequence.videos.values()] == [f"cam{i}i_s.avi" for i in range(1, 9)]
    for video in sequence.videos.values():
        assert (video.num_frames, video.fps, video.image_size_wh) == (3, 25.0, (192, 108))
    scene = build(scenario(NAME), scale=0.1)
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


def test_videos_show_what_the_renderer_draws_at_those_frames(sequence_folder):
    from psotrack.simulation import CameraRenderer

    scene = build(scenario(NAME), scale=0.1)
    for index in (1, 6):
        drawn = CameraRenderer(scene, index)
        video = probe(sequence_folder / generate.video_file(scene.rig.names[index]))
        for frame, shown in enumerate(read_frames(video)):
            assert cv2.PSNR(shown, drawn.frame(frame)) > LEAST_PSNR_DB


def test_the_number_of_jobs_changes_no_byte(sequence_folder, tmp_path):
    assert contents(simulate(NAME, tmp_path, jobs=2, **SMALL)) == contents(sequence_folder)


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


def test_an_interrupted_call_goes_on_where_it_stopped(sequence_folder, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        simulate(NAME, tmp_path, jobs=1, report=interrupting(8), **SMALL)
    place = tmp_path / "Simulated_Data"
    assert not (place / NAME).exists()
    (unfinished,) = place.iterdir()
    kept = {path.name: path.stat().st_mtime_ns for path in unfinished.glob("*.avi")}
    assert set(kept) == {"cam1i_s.avi", "cam2i_s.avi"}
    folder = simulate(NAME, tmp_path, jobs=1, **SMALL)
    assert kept == {name: (folder / name).stat().st_mtime_ns for name in kept}, "they are not drawn again"
    assert contents(folder) == contents(sequence_folder)
    assert [path.name for path in place.iterdir()] == [NAME]


def test_what_other_settings_left_unfinished_is_not_used(sequence_folder, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        simulate(NAME, tmp_path, jobs=1, seed=5, report=interrupting(4), **SMALL)
    assert contents(simulate(NAME, tmp_path, jobs=1, **SMALL)) == contents(sequence_folder)


def test_a_sequence_that_exists_is_left_alone_unless_forced(sequence_folder, tmp_path):
    folder = shutil.copytree(sequence_folder, tmp_path / "Simulated_Data" / NAME)
    before = contents(folder)
    with pytest.raises(OutputError, match=r"S02_D4_A: expected no such file yet, found one; pass --force"):
        simulate(NAME, tmp_path, jobs=1, **SMALL)
    with pytest.raises(KeyboardInterrupt):
        simulate(NAME, tmp_path, jobs=1, seed=1, force=True, report=interrupting(2), **SMALL)
    assert contents(folder) == before, "until the new one is whole, the old one stays"
    simulate(NAME, tmp_path, jobs=1, seed=1, force=True, **SMALL)
    after = contents(folder)
    assert after.keys() == before.keys()
    assert after["dron1_pos_25.csv"] != before["dron1_pos_25.csv"]
    assert after["cam1i_s.avi"] != before["cam1i_s.avi"]
    assert after["cameras_calibration.csv"] == before["cameras_calibration.csv"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"name": "S99"}, r"^scenario: expected one of .*S02_D4_A.*, found S99$"),
        ({"num_frames": 0}, r"^frames: expected 1 to 250, as many as S02_D4_A has, found 0$"),
        ({"num_frames": -3}, r"^frames: .* found -3$"),
        ({"num_frames": 251}, r"^frames: .* found 251$"),
        ({"scale": 0.0}, r"^scale: expected a number above 0, found 0$"),
        ({"scale": -1.0}, r"^scale: .* found -1$"),
        ({"scale": float("nan")}, r"^scale: .* found nan$"),
        ({"scale": 0.01}, r"^scale: expected images of at least 32 pixels a side, found 20 x 10$"),
        ({"seed": -1}, r"^seed: expected 0 or more, found -1$"),
        ({"jobs": 0}, r"^jobs: expected 1 or more, found 0$"),
    ],
)
def test_settings_that_make_no_sense_are_refused_before_anything_is_written(settings, message, tmp_path):
    with pytest.raises(SettingsError, match=message):
        simulate(**{"name": NAME, "root": tmp_path, **SMALL, **settings})
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "Simulated_Data").write_text("a file where the folder should be")
    with pytest.raises(OutputError, match=r"Simulated_Data"):
        simulate(NAME, tmp_path, jobs=1, **SMALL)


def test_progress_counts_every_frame(tmp_path):
    counted = []

    @contextlib.contextmanager
    def report(description, total):
        counted.append(total)
        yield lambda steps: counted.append(-steps)

    simulate(NAME, tmp_path, num_frames=1, scale=0.05, jobs=1, report=report)
    assert counted[0] == 8
    assert sum(counted) == 0

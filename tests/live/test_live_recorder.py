"""What live cameras film is kept: readable after a crash, complete or said to be not, and never waited for."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import cameras_of, ring_rig

from psotrack.errors import OutputError, SettingsError
from psotrack.live import CameraRecorder, recording_folder
from psotrack.recordings import Recording, read_frames
from psotrack.recordings.datasets import open_recording

SIZE_WH = (320, 240)
RIG = ring_rig(3, image_size_wh=SIZE_WH)


@pytest.fixture
def laboratory(tmp_path: Path) -> Recording:
    """Three cameras on the network, with bounds, an image of what is ignored, and a rolling shutter."""
    ignore = tmp_path / "trees.png"
    cv2.imwrite(f"{ignore}", np.zeros(SIZE_WH[::-1], np.uint8))
    return Recording(
        "laboratory",
        tmp_path / "laboratory",
        cameras_of(
            RIG,
            stream={name: f"rtsp://camera/{name}" for name in RIG.names},
            ignore={RIG.names[0]: ignore},
            line_time_s={RIG.names[1]: 1e-5},
        ),
        bounds_m=(-1.0, 1.0, -2.0, 2.0, 0.0, 3.0),
    )


def noise(index: int, size_wh: tuple[int, int] = SIZE_WH) -> np.ndarray:
    return np.random.default_rng(index).integers(0, 255, (size_wh[1], size_wh[0], 3), dtype=np.uint8)


def keep(recorder: CameraRecorder, num_frames: int, first: int = 0) -> None:
    """Record grey frames at 25 Hz, as fast as they are encoded."""
    for index in range(first, first + num_frames):
        recorder.write(np.full((*SIZE_WH[::-1], 3), 2 * index, np.uint8), index / 25)
        wait_for_row(recorder.times, index + 1 - first)


def wait_for_row(times: Path, count: int) -> None:
    """Wait until a frame is being encoded: its row is written just before."""
    for _ in range(1000):
        if times.exists() and times.read_text().count("\n") > count:
            return
        time.sleep(0.01)
    raise AssertionError(f"no row {count} in {times}")


def test_what_was_filmed_is_a_recording(laboratory: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    with recording_folder(folder, laboratory, RIG.names):
        recorders = [CameraRecorder(folder, name, 25.0) for name in RIG.names]
        # A camera that starts later; and one that never films.
        keep(recorders[0], 30)
        keep(recorders[1], 20, first=5)
        assert vars(recorders[0].close()) == {"frames": 30, "left_out": 0}
        assert vars(recorders[1].close()) == {"frames": 20, "left_out": 0}
        assert vars(recorders[2].close()) == {"frames": 0, "left_out": 0}
    found = open_recording(folder / "recording.toml")
    assert found.rig.names == RIG.names[:2]
    assert np.allclose(found.rig.cameras.T_cam_world, RIG.cameras.T_cam_world[:2], atol=1e-6)
    assert found.bounds_m == laboratory.bounds_m
    assert [each.line_time_s for each in found.cameras] == [0.0, 1e-5]
    assert [each.ignore is not None for each in found.cameras] == [True, False]
    for name, first, count in ((RIG.names[0], 0, 30), (RIG.names[1], 5, 20)):
        # Not rounded: what meets live shall meet again.
        assert found.by_name[name].times.time_s.tolist() == [(first + i) / 25 for i in range(count)]
        levels = [frame.mean() for frame in read_frames(found.videos[name])]
        # The codec changes the level of flat frames by up to 3.7 of 255, as tests/test_video.py says.
        assert levels == pytest.approx([2 * (first + index) for index in range(count)], abs=3.7)


def test_a_frame_that_comes_twice_is_kept_once(tmp_path: Path) -> None:
    recorder = CameraRecorder(tmp_path, "cam1", 25.0)
    for time_s in (0.0, 0.04, 0.04, 0.02, 0.08):
        recorder.write(noise(0), time_s)
    assert vars(recorder.close()) == {"frames": 3, "left_out": 0}
    # The times are exact.
    assert recorder.times.read_text() == "frame,time_s\n0,0.0\n1,0.04\n2,0.08\n"


def test_nobody_waits_for_the_codec(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Frames come as fast as they can: most are left out and counted, and this is said once."""
    size_wh = (1920, 1080)
    recorder = CameraRecorder(tmp_path, "cam1", 25.0)
    image = noise(0, size_wh)
    began_s = time.perf_counter()
    for index in range(500):
        recorder.write(image, index / 25)
    # Encoding all of them would take 500 times at least 6 ms of one processor.
    assert time.perf_counter() - began_s < 1.5
    counts = recorder.close()
    assert counts.frames + counts.left_out == 500
    assert counts.left_out > 300
    said = f"{tmp_path}: frames are left out of the recording, because the computer is too slow"
    assert caplog.messages == [said]


def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    head = """
        import os, resource, sys, time
        from pathlib import Path
        import numpy as np
        from psotrack.live import CameraRecorder
        sys.dont_write_bytecode = True  # a limit would truncate the bytecode of other processes too
        folder, rng = Path(sys.argv[1]), np.random.default_rng(0)
        recorders = [CameraRecorder(folder, name, 25.0) for name in sys.argv[2:]]
    """
    text = textwrap.dedent(head) + textwrap.dedent(script)
    return subprocess.run(
        [sys.executable, "-c", text, *map(str, arguments)], capture_output=True, text=True, check=False
    )


def test_a_crash_leaves_what_was_recorded(laboratory: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    script = """
        for index in range(60):
            for recorder in recorders:
                recorder.write(rng.integers(0, 255, (240, 320, 3), dtype=np.uint8), index / 25)
            time.sleep(0.02)
        time.sleep(0.5)
        os.kill(os.getpid(), 9)
    """
    with recording_folder(folder, laboratory, RIG.names):
        assert run(script, folder, *RIG.names).returncode == -9
        found = open_recording(folder)
    for name in RIG.names:
        # 32 KiB and the last frame are lost: these frames of noise take 20 KiB and more.
        assert 55 <= found.videos[name].num_frames < 60
        assert len(list(read_frames(found.videos[name]))) == found.by_name[name].times.num_frames


def test_a_disk_that_is_nearly_full_ends_the_recording_in_time(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = CameraRecorder(tmp_path, "cam1", 25.0, least_free_bytes=10**18)
    for index in range(20):
        recorder.write(noise(index), index / 25)
    assert vars(recorder.close()) == {"frames": 0, "left_out": 20}
    said = [line for line in caplog.messages if "too slow" not in line]
    assert len(said) == 1
    assert "less than 1000000000000 MB of free disk space; what was recorded before stays" in said[0]


class TestFolder:
    def test_a_folder_with_files_is_refused_without_force(
        self, laboratory: Recording, tmp_path: Path
    ) -> None:
        folder = tmp_path / "flight"
        folder.mkdir()
        (folder / "notes.txt").write_text("mine")
        (folder / f"{RIG.names[0]}.avi").write_bytes(b"an earlier video")
        refused = "expected a new or an empty folder, found a folder with files"
        with pytest.raises(OutputError, match=refused), recording_folder(folder, laboratory, RIG.names):
            pass
        with recording_folder(folder, laboratory, RIG.names, force=True):
            assert not (folder / f"{RIG.names[0]}.avi").exists()
        assert (folder / "notes.txt").read_text() == "mine"

    def test_of_cameras_that_never_film_nothing_stays(self, laboratory: Recording, tmp_path: Path) -> None:
        for _ in range(2):  # the second session is not refused
            with recording_folder(tmp_path / "flight", laboratory, RIG.names):
                assert (tmp_path / "flight" / "recording.toml").exists()
        assert not list((tmp_path / "flight").iterdir())

    def test_the_cameras_own_folder_is_refused(self, laboratory: Recording) -> None:
        check_refused(SettingsError, "--record: expected another folder", laboratory, laboratory.folder)

    def test_odd_sizes_are_refused(self, laboratory: Recording, tmp_path: Path) -> None:
        odd = laboratory.with_rig(ring_rig(3, image_size_wh=(321, 240)))
        expected = r"even numbers of pixels, .* found 321 x 240 of camera"
        check_refused(SettingsError, expected, odd, tmp_path / "flight")

    def test_a_folder_that_cannot_be_made_is_one_line(self, laboratory: Recording, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        expected = "expected a folder that can be written"
        check_refused(OutputError, expected, laboratory, tmp_path / "file" / "flight")
        check_refused(OutputError, f"{expected}, found File exists", laboratory, tmp_path / "file")


def check_refused(error: type[Exception], words: str, recording: Recording, folder: Path) -> None:
    with pytest.raises(error, match=words), recording_folder(folder, recording, RIG.names, force=True):
        pass

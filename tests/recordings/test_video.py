"""Videos: exact frame counts and frame rates, broken files, and a writer that never leaves an incomplete file."""

import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.recordings import (
    VideoInfo,
    VideoWriter,
    check_end,
    join_videos,
    probe,
    read_frames,
    read_near,
)

WIDTH, HEIGHT = 96, 64


def grey(level: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def noise(num_frames: int) -> np.ndarray:
    """Make frames of noise, which compress badly, so that a truncated file loses many frames."""
    return np.random.default_rng(0).integers(0, 255, (num_frames, HEIGHT, WIDTH, 3), dtype=np.uint8)


def write(path: Path, frames: Iterable[np.ndarray], fps: float = 25.0) -> Path:
    with VideoWriter(path, fps, (WIDTH, HEIGHT)) as writer:
        for frame in frames:
            writer.write(frame)
    return path


@pytest.mark.parametrize("fps", [25.0, 24000 / 1001, 29.97, 30000 / 1001, 59.94, 100.0, 12.5])
def test_frame_rate_is_not_truncated(tmp_path, fps):
    video = probe(write(tmp_path / "a.avi", noise(2), fps))
    # The container's clock is a multiple of 0.001 per second.
    assert video.fps == pytest.approx(fps, abs=1e-3)


@pytest.mark.parametrize("num_frames", [1, 2, 13, 61])
def test_reading_gives_the_written_frames(tmp_path, num_frames):
    levels = 16 * np.random.default_rng(0).permutation(64)[:num_frames] % 256
    path = write(tmp_path / "a.avi", [grey(level) for level in levels])
    video = probe(path)
    assert video == VideoInfo(path, num_frames, 25.0, (WIDTH, HEIGHT))
    read = [frame.mean() for frame in read_frames(video)]
    # The codec changes the level of flat frames by up to 3.7 of 255 (measured). Levels differ by 16, so a shift by one
    # frame fails.
    np.testing.assert_allclose(read, levels, atol=6)
    assert next(read_frames(video)).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("step", [1, 2, 5, 100])
def test_a_step_reads_every_nth_frame(tmp_path, step):
    video = probe(write(tmp_path / "a.avi", noise(11)))
    all_frames = list(read_frames(video))
    selected = list(read_frames(video, step))
    assert len(selected) == len(range(0, 11, step))
    np.testing.assert_array_equal(selected, all_frames[::step])


def test_frames_that_are_written_over_each_other_are_the_same_frames(tmp_path):
    video = probe(write(tmp_path / "v.avi", noise(9)))
    apart = list(read_frames(video, 2))
    over = [(frame, frame.copy()) for frame in read_frames(video, 2, into_one=True)]
    np.testing.assert_array_equal([then for _, then in over], apart)
    assert len({frame.ctypes.data for frame, _ in over}) == 1


def test_leading_frames_only(tmp_path):
    video = probe(write(tmp_path / "a.avi", noise(11)))
    assert len(list(read_frames(replace(video, num_frames=4)))) == 4


def test_step_of_zero_is_refused(tmp_path):
    video = probe(write(tmp_path / "a.avi", noise(1)))
    with pytest.raises(SettingsError, match="step: expected 1 or more, found 0"):
        next(read_frames(video, 0))


def test_mp4_with_29_97_by_another_writer(tmp_path):
    path = tmp_path / "a.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 29.97, (WIDTH, HEIGHT))
    for frame in noise(7):
        writer.write(frame)
    writer.release()
    video = probe(path)
    assert (video.num_frames, video.image_size_wh) == (7, (WIDTH, HEIGHT))
    assert video.fps == pytest.approx(29.97, abs=1e-3)
    assert len(list(read_frames(video))) == 7


def test_a_name_that_looks_like_a_protocol(tmp_path, monkeypatch):
    """FFmpeg would read `cam:` as a protocol."""
    write(tmp_path / "cam:1 %02d.avi", noise(3))
    monkeypatch.chdir(tmp_path)
    assert probe(Path("cam:1 %02d.avi")).num_frames == 3


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.95])
def test_a_truncated_video_names_file_and_frame(tmp_path, fraction, capfd):
    path = write(tmp_path / "cam1i_s.avi", noise(40))
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    video = probe(path)
    assert video.num_frames == 40  # the header still states 40 frames
    with pytest.raises(InputError) as error_info:
        list(read_frames(video))
    message = str(error_info.value)
    reached = int(re.search(r"only (\d+) can be decoded", message)[1])
    assert message.startswith(f"{path}: expected 40 frames, found that only {reached} can be decoded")
    assert 0 < reached < 40
    assert message.endswith(
        f"`ffmpeg -i cam1i_s.avi -frames:v {reached} -c copy cam1i_s_cut.avi` keeps the frames before"
    )
    with pytest.raises(InputError, match=r"expected 40 frames, found that only \d+ can be decoded"):
        check_end(video)
    # With a step, the error names the same frame.
    with pytest.raises(InputError, match=f"only {reached} can be decoded"):
        list(read_frames(video, 7))
    # The frames before the broken frame can be used.
    assert len(list(read_frames(replace(video, num_frames=reached)))) == reached
    assert capfd.readouterr().err == ""


def test_a_whole_video_has_its_end(tmp_path):
    for count in (1, 2, 40):
        check_end(probe(write(tmp_path / f"{count}.avi", noise(count))))


def test_a_damaged_frame_is_found(tmp_path, capfd):
    path = write(tmp_path / "cam1i_s.avi", noise(40))
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + len(content) // 4] = bytes(len(content) // 4)
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"cam1i_s\.avi: expected 40 frames, found that only \d+"):
        list(read_frames(probe(path)))
    assert capfd.readouterr().err == ""


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match=r"nix\.avi: expected a video, found no such file"):
        probe(tmp_path / "nix.avi")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "an empty file"),
        (b"frame;x;y\n" * 500, "a file that FFmpeg cannot open"),
        (bytes(5000), "a file that FFmpeg cannot open"),
        (b"RIFF\x00\x10\x00\x00AVI ", "a file that FFmpeg cannot open"),
    ],
)
def test_files_that_are_no_videos(tmp_path, content, found, capfd):
    path = tmp_path / "a.avi"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.avi: expected a video, found {found}"):
        probe(path)
    assert capfd.readouterr().err == ""


def test_a_folder_is_no_video(tmp_path):
    with pytest.raises(InputError, match="expected a video, found is a directory"):
        probe(tmp_path)


def test_a_video_without_frames(tmp_path):
    path = tmp_path / "a.avi"
    cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"XVID"), 25, (WIDTH, HEIGHT)).release()
    with pytest.raises(InputError, match="expected a video with frames, found no frames"):
        probe(path)


def test_a_video_whose_writer_was_killed_is_read(tmp_path):
    """What the killed process had written is read, but for the last frame, which may be incomplete."""
    path = tmp_path / "a.avi"
    script = textwrap.dedent(
        """
        import os, sys
        import cv2
        import numpy as np
        writer = cv2.VideoWriter(sys.argv[1], cv2.VideoWriter.fourcc(*"XVID"), 25, (640, 480))
        rng = np.random.default_rng(0)
        for level in range(100):
            writer.write(rng.integers(0, 2 * level + 2, (480, 640, 3), dtype=np.uint8))
        os.kill(os.getpid(), 9)
        """
    )
    subprocess.run([sys.executable, "-c", script, path], check=False)
    video = probe(path)
    # FFmpeg holds back the last 32 KiB, a few frames of this noise.
    assert 80 < video.num_frames < 100
    assert not video.is_finished
    means = [frame.mean() for frame in read_frames(video)]
    assert means == pytest.approx([level + 0.5 for level in range(video.num_frames)], abs=4)
    check_end(video)
    # It has no index, so no frame is reached by seeking.
    assert list(read_near(video, [20, 60])) == []


def test_opening_restores_log_levels(tmp_path, monkeypatch):
    path = write(tmp_path / "a.avi", noise(1))
    level, environment = cv2.utils.logging.getLogLevel(), dict(os.environ)
    probe(path)
    assert (cv2.utils.logging.getLogLevel(), dict(os.environ)) == (level, environment)
    monkeypatch.setenv("OPENCV_FFMPEG_LOGLEVEL", "16")
    probe(path)
    assert os.environ["OPENCV_FFMPEG_LOGLEVEL"] == "16"


def test_writer_makes_the_folder_and_replaces_only_when_complete(tmp_path):
    path = write(tmp_path / "new" / "a.avi", noise(3))
    before = path.read_bytes()

    def interrupted():
        yield grey(0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, interrupted())
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_video_of_no_frames_is_not_written(tmp_path):
    with pytest.raises(OutputError, match="expected at least one frame"):
        write(tmp_path / "a.avi", [])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "fps", "size_wh", "where"),
    [
        ("a.mkv", 25.0, (WIDTH, HEIGHT), "video"),
        ("a.avi", 0.0, (WIDTH, HEIGHT), "fps"),
        ("a.avi", float("nan"), (WIDTH, HEIGHT), "fps"),
        ("a.avi", 25.0, (WIDTH + 1, HEIGHT), "image size"),
        ("a.avi", 25.0, (WIDTH, 0), "image size"),
    ],
)
def test_settings_that_cannot_be_written(tmp_path, name, fps, size_wh, where):
    with pytest.raises(SettingsError, match=f"^{where}: expected"):
        VideoWriter(tmp_path / name, fps, size_wh)


def test_a_frame_of_another_size_is_refused(tmp_path):
    """OpenCV drops such a frame without an error."""
    path = tmp_path / "a.avi"
    with (
        pytest.raises(SettingsError, match=r"frame: expected shape \(64, 96, 3\)"),
        VideoWriter(path, 25.0, (WIDTH, HEIGHT)) as writer,
    ):
        writer.write(np.zeros((HEIGHT, WIDTH + 2, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PsotrackError, match=r"a\.avi: expected a path that can be written"):
        write(tmp_path / "file" / "a.avi", noise(1))


def test_a_full_disk_is_an_error_and_keeps_the_old_file(tmp_path):
    """A limit on the file size stands for a full disk: FFmpeg reports an error in neither case."""
    path = write(tmp_path / "a.avi", noise(2))
    before = path.read_bytes()
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from psotrack.errors import OutputError
        from psotrack.recordings import VideoWriter
        sys.dont_write_bytecode = True  # the limit would truncate the bytecode of other processes too
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        rng = np.random.default_rng(0)
        try:
            with VideoWriter(Path(sys.argv[1]), 25.0, (96, 64)) as writer:
                for _ in range(200):
                    writer.write(rng.integers(0, 255, (64, 96, 3), dtype=np.uint8))
        except OutputError as error:
            print(error)
        """
    )
    done = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True)
    assert "a.avi: expected a file with 200 frames, found" in done.stdout, done.stderr
    assert "is the disk full?" in done.stdout
    assert path.read_bytes() == before
    # OpenCV warns of each frame that is not written.
    assert done.stderr == ""
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("missing_bytes", [1, 100, 200])
def test_an_incomplete_index_is_found(tmp_path, missing_bytes):
    """All frames exist and can be counted, but the index at the end of the file (3200 bytes measured) is incomplete."""
    complete_size = write(tmp_path / "whole.avi", [grey(level) for level in range(200)]).stat().st_size
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from psotrack.errors import OutputError
        from psotrack.recordings import VideoWriter
        sys.dont_write_bytecode = True  # the limit would truncate the bytecode of other processes too
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
        try:
            with VideoWriter(Path(sys.argv[1]), 25.0, (96, 64)) as writer:
                for level in range(200):
                    writer.write(np.full((64, 96, 3), level, np.uint8))
        except OutputError as error:
            print(error)
        """
    )
    command = [sys.executable, "-c", script, tmp_path / "a.avi", str(complete_size - missing_bytes)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (
        "a.avi: expected a file with 200 frames, found an incomplete index of frames; is the disk full?"
        in done.stdout
    )
    assert done.stderr == ""
    assert not (tmp_path / "a.avi").exists()


# --- joining


def key_frames(path: Path) -> list[bool]:
    """Return for each frame whether the index of the container (chunk `idx1`) marks it as a key frame."""
    data = path.read_bytes()
    start = data.rfind(b"idx1")
    entries = np.frombuffer(
        data, "<u4", int.from_bytes(data[start + 4 : start + 8], "little") // 4, start + 8
    )
    return (entries.reshape(-1, 4)[:, 1] & 0x10 > 0).tolist()


def moving_picture(num_frames: int, start: int = 0) -> list[np.ndarray]:
    """Make frames of a moving picture; no two of its frames are equal."""
    large = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (64, 400, 3), np.uint8), (0, 0), 2)
    return [large[:, k : k + WIDTH].copy() for k in range(start, start + num_frames)]


def test_frames_near_some_places_are_the_frames_of_these_numbers(tmp_path):
    path = write(tmp_path / "v.avi", moving_picture(200))
    frames = list(read_frames(probe(path)))
    places = [3, 60, 61, 140, 199]
    found = dict(read_near(probe(path), places))
    for number, frame in found.items():
        np.testing.assert_array_equal(frame, frames[number])
    # The writer makes a key frame every 12 frames; a frame near a place is that long after a key frame.
    for place in places[1:]:
        assert min(abs(np.array(list(found)) - place)) <= 12
    assert len(found) == 4  # 60 and 61 have the same key frame


def test_frames_near_no_place_are_none(tmp_path):
    path = write(tmp_path / "v.avi", moving_picture(20))
    assert list(read_near(probe(path), [])) == []


@pytest.mark.parametrize("lengths", [(5,), (24, 24, 7), (1, 13, 30, 2)])
def test_a_joined_video_decodes_as_its_parts_do(tmp_path, lengths, capfd):
    starts = np.cumsum([0, *lengths])
    parts = [
        write(tmp_path / f"{i}.avi", moving_picture(length, start), 29.97)
        for i, (length, start) in enumerate(zip(lengths, starts, strict=False))
    ]
    join_videos(tmp_path / "joined.avi", parts)
    joined = probe(tmp_path / "joined.avi")
    assert joined == replace(probe(parts[0]), path=joined.path, num_frames=sum(lengths))
    expected = [frame for part in parts for frame in read_frames(probe(part))]
    np.testing.assert_array_equal(list(read_frames(joined)), expected)
    # Joining keeps the key frames that the encoder chose for the parts.
    assert key_frames(joined.path) == [key for part in parts for key in key_frames(part)]
    capture = cv2.VideoCapture(str(joined.path), cv2.CAP_FFMPEG)
    for frame in np.random.default_rng(0).permutation(sum(lengths))[:8].tolist():
        capture.set(cv2.CAP_PROP_POS_FRAMES, frame)
        np.testing.assert_array_equal(capture.read()[1], expected[frame])
    capture.release()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("fps", "size_wh", "expected", "found"),
    [
        (24.0, (WIDTH, HEIGHT), "96 x 64 pixels at 25 Hz as in 0.avi", "96 x 64 pixels at 24 Hz"),
        (25.0, (48, 32), "96 x 64 pixels at 25 Hz as in 0.avi", "48 x 32 pixels at 25 Hz"),
    ],
)
def test_parts_that_differ_are_not_joined(tmp_path, fps, size_wh, expected, found):
    first = write(tmp_path / "0.avi", noise(2))
    with VideoWriter(tmp_path / "1.avi", fps, size_wh) as writer:
        writer.write(np.zeros((size_wh[1], size_wh[0], 3), np.uint8))
    with pytest.raises(InputError, match=rf"1\.avi: expected {expected}, found {found}$"):
        join_videos(tmp_path / "joined.avi", [first, tmp_path / "1.avi"])
    assert not (tmp_path / "joined.avi").exists()


def test_a_part_that_ends_early_is_named(tmp_path):
    parts = [write(tmp_path / f"{i}.avi", noise(20)) for i in range(2)]
    parts[1].write_bytes(parts[1].read_bytes()[:60_000])
    with pytest.raises(InputError, match=r"1\.avi: expected 20 frames, found that only \d+ can be decoded"):
        join_videos(tmp_path / "joined.avi", parts)
    assert sorted(tmp_path.iterdir()) == parts


def test_a_full_disk_while_joining_keeps_the_old_file(tmp_path):
    parts = [write(tmp_path / f"{i}.avi", noise(20)) for i in range(2)]
    size = parts[0].stat().st_size
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        from psotrack.errors import OutputError
        from psotrack.recordings import join_videos
        target, limit, *parts = sys.argv[1:]
        sys.dont_write_bytecode = True  # the limit would truncate the bytecode of other processes too
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), int(limit)))
        try:
            join_videos(Path(target), [Path(part) for part in parts])
        except OutputError as error:
            print(error)
        """
    )
    command = [sys.executable, "-c", script, tmp_path / "joined.avi", str(size * 3 // 2), *parts]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "joined.avi: expected a file with 40 frames, found" in done.stdout, done.stderr
    # OpenCV warns of each frame that is not written.
    assert done.stderr == ""
    assert sorted(tmp_path.iterdir()) == parts

"""Videos and folders of pictures: exact frames, counts and rates, bad files, and a writer that never leaves a part."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import assert_refused, content_of, files_up_to

from psotrack.recordings import (
    VideoInfo,
    VideoWriter,
    frame_times,
    join_videos,
    open_video,
    probe,
    read_frames,
    read_frames_at,
    read_near,
)

WIDTH, HEIGHT = 96, 64


def grey(level):
    return np.full((HEIGHT, WIDTH, 3), level, np.uint8)


def noise(num_frames):
    """Make frames of noise, which compress badly, so that a truncated file loses many frames."""
    return np.random.default_rng(0).integers(0, 255, (num_frames, HEIGHT, WIDTH, 3), dtype=np.uint8)


def write(path, frames, fps=25.0):
    with VideoWriter(path, fps, (WIDTH, HEIGHT)) as writer:
        for frame in frames:
            writer.write(frame)
    return path


# --- reading


@pytest.mark.parametrize(
    ("num_frames", "fps"), [(1, 25.0), (2, 24000 / 1001), (3, 12.5), (13, 59.94), (61, 100.0)]
)
def test_reading_gives_the_written_frames_and_their_rate(tmp_path, num_frames, fps):
    levels = 16 * np.random.default_rng(0).permutation(64)[:num_frames] % 256
    path = write(tmp_path / "a.avi", [grey(level) for level in levels], fps)
    video = probe(path)
    assert video == VideoInfo(path, num_frames, video.fps, (WIDTH, HEIGHT))
    # The container's clock is a multiple of 0.001 per second.
    assert video.fps == pytest.approx(fps, abs=1e-3)
    frames = list(read_frames(video))
    # The codec changes the level of flat frames by up to 3.7 of 255 (measured). Levels differ by 16, so a shift by one
    # frame fails.
    np.testing.assert_allclose([frame.mean() for frame in frames], levels, atol=6)
    assert frames[0].shape == (HEIGHT, WIDTH, 3)


def test_steps_and_leading_frames(tmp_path):
    video = probe(write(tmp_path / "a.avi", noise(11)))
    frames = list(read_frames(video))
    for step in (2, 100):
        np.testing.assert_array_equal(list(read_frames(video, step)), frames[::step])
    np.testing.assert_array_equal(list(read_frames(replace(video, num_frames=4))), frames[:4])


def test_a_name_that_looks_like_a_protocol(tmp_path, monkeypatch):
    """FFmpeg would read `cam:` as a protocol."""
    write(tmp_path / "cam:1 %02d.avi", noise(3))
    monkeypatch.chdir(tmp_path)
    assert probe(Path("cam:1 %02d.avi")).num_frames == 3


def encoded(folder, fourcc, num_frames):
    """Encoded frames of a moving picture, and whether each is a key frame; the first one is."""
    kind = cv2.VideoWriter.fourcc(*fourcc)
    writer = cv2.VideoWriter(str(folder / "source.avi"), kind, 30.0, (WIDTH, HEIGHT))
    for frame in moving_picture(num_frames):
        writer.write(frame)
    writer.release()
    source = cv2.VideoCapture(str(folder / "source.avi"), cv2.CAP_FFMPEG)
    source.set(cv2.CAP_PROP_FORMAT, -1)
    return [(source.read()[1], source.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME)) for _ in range(num_frames)]


def packed(path, frames, ticks, fourcc):
    """A video of encoded frames at whole numbers of intervals of 1 / 30 s."""
    raw = [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]
    writer = cv2.VideoWriter(
        str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*fourcc), 30.0, (WIDTH, HEIGHT), raw
    )
    for tick, (packet, is_key) in zip(ticks, frames, strict=True):
        writer.set(cv2.VIDEOWRITER_PROP_PTS, tick)
        writer.set(cv2.VIDEOWRITER_PROP_KEY_FLAG, is_key)
        writer.write(packet)
    writer.release()
    return path


def with_hidden(path, num_frames):
    """An MP4 whose first frames are hidden, as `ffmpeg -c copy` cuts: its edit list begins in the middle."""
    content = bytearray(path.read_bytes())
    place = content.index(b"elst") + 16
    at = content.index(b"mdhd")
    clock_hz = int.from_bytes(content[at + 16 : at + 20], "big")
    content[place : place + 4] = (num_frames * clock_hz // 30).to_bytes(4, "big")
    path.write_bytes(content)
    return path


DROPPED = [*range(15), *range(24, 60)]


def mp4(folder, ticks, fourcc="MJPG"):
    return packed(folder / "a.mp4", encoded(folder, "MJPG", len(ticks)), ticks, fourcc)


TIMED = {
    "nine frames lost": (
        lambda folder: packed(folder / "a.mkv", encoded(folder, "XVID", 51), DROPPED, "XVID"),
        DROPPED, 30.0, "a.mkv: gap of 0.333 s before frame 15; the times that the file states"),
    "another rate": (lambda folder: mp4(folder, range(0, 120, 2)), range(60), 15.0, ""),
    "hidden frames": (lambda folder: with_hidden(mp4(folder, range(60)), 12), range(48), 30.0,
        "a.mp4: its header says 60 frames until 2.00 s, and the 48 that can be decoded end at 1.60 s"),
    "a damaged frame": (lambda folder: packed(folder / "a.mkv", [*encoded(folder, "VP80", 12)[:9],
        (np.zeros(40, np.uint8), 0.0), *encoded(folder, "VP80", 20)], range(30), "VP80"), range(30), 30.0, ""),
    "no key frame": (
        lambda folder: packed(
            folder / "a.mkv", encoded(folder, "VP80", 12)[5:] + encoded(folder, "VP80", 53), range(60), "VP80"
        ),
        range(7, 60), 30.0, "a.mkv: gap of 0.233 s before frame 0"),
}  # fmt: skip


@pytest.mark.parametrize("case", TIMED)
def test_frames_that_can_be_decoded_and_their_times(case, tmp_path, caplog):
    make, ticks, fps, said = TIMED[case]
    video = probe(make(tmp_path))
    assert video.fps == pytest.approx(fps)
    np.testing.assert_allclose(frame_times(video).time_s, np.array(ticks) / fps, atol=1e-3)
    assert len(list(read_frames(video))) == len(ticks)
    assert [number for number, _ in read_frames_at(video, [3, len(ticks) - 1])] == [3, len(ticks) - 1]
    assert said in caplog.text
    assert bool(said) == bool(caplog.text)
    # What a user states is used instead.
    stated = open_video(video.path, 25.0)
    np.testing.assert_array_equal(frame_times(stated).time_s, np.arange(len(ticks)) / 25.0)


def test_last_frames_that_cannot_be_decoded_show_the_picture_before(tmp_path):
    """No end is decoded when a video is opened."""
    packets = [*encoded(tmp_path, "VP80", 20), *[(np.zeros(40, np.uint8), 0.0)] * 4]
    shown = [
        frame.copy() for frame in read_frames(probe(packed(tmp_path / "a.mkv", packets, range(24), "VP80")))
    ]
    assert len(shown) == 24
    np.testing.assert_array_equal(shown[19], shown[23])


def test_a_codec_that_cannot_be_decoded_is_named(tmp_path):
    path = mp4(tmp_path, range(9), "mp4v")
    words = "a.mp4: expected a video that can be decoded, found 9 frames of the codec FMP4", "-c:v libx264"
    assert_refused(lambda: probe(path), *words, unchanged=tmp_path)


@pytest.mark.parametrize("fraction", [0.2, 0.95])
def test_of_a_video_that_is_cut_short_the_rest_is_used(tmp_path, fraction, capfd, caplog):
    path = write(tmp_path / "cam1i_s.avi", noise(40))
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    video = probe(path)
    assert 0 < video.num_frames < 40
    assert len(list(read_frames(video))) == video.num_frames
    assert f"its header says 40 frames until 1.60 s, and the {video.num_frames} that can be" in caplog.text
    # More than what the last half second may lack.
    longer = replace(video, num_frames=80)
    refused = f"cam1i_s.avi: expected 80 frames, found that only {video.num_frames} can be decoded"
    for step in (1, 7):
        assert_refused(lambda step=step: list(read_frames(longer, step)), refused, unchanged=tmp_path)
    assert capfd.readouterr().err == ""


# --- folders of pictures


def test_grey_pictures_and_pictures_of_16_bits(tmp_path):
    """10 to 16 bits of a camera become 8; a folder has one depth, whatever the single picture shows."""
    values = noise(1)[0, ..., 0]
    for bits in (8, 10, 12, 16):
        folder = tmp_path / f"{bits}"
        folder.mkdir()
        for index, each in enumerate((values, values // 8)):
            image = each if bits == 8 else (each.astype(np.uint16) << (bits - 8))
            cv2.imwrite(str(folder / f"{index}.tif"), image)
        bright, dark = read_frames(open_video(folder, 10.0))
        np.testing.assert_array_equal(bright, np.repeat(values[..., None], 3, axis=2))
        np.testing.assert_array_equal(dark[..., 1], values // 8)


def test_pictures_are_read_as_the_sensor_saw_them(tmp_path):
    """A phone that is held upright notes that its pictures are to be turned; a lens is calibrated for the sensor."""
    data = cv2.imencode(".jpg", noise(1)[0])[1].tobytes()
    # EXIF with one entry: orientation (0x112), a short, one value, 6: turn by 90 degrees.
    tiff = b"MM\0*\0\0\0\x08" + b"\0\x01" + b"\x01\x12\0\x03\0\0\0\x01\0\x06\0\0" + b"\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    for index in range(2):
        (tmp_path / f"{index}.jpg").write_bytes(turned)
    assert cv2.imread(str(tmp_path / "0.jpg")).shape == (WIDTH, HEIGHT, 3)
    video = open_video(tmp_path, 25.0)
    assert video.image_size_wh == (WIDTH, HEIGHT)
    assert next(read_frames(video)).shape == (HEIGHT, WIDTH, 3)


# --- writing


def test_writer_makes_the_folder_and_replaces_only_when_complete(tmp_path):
    path = write(tmp_path / "new" / "a.avi", noise(3))
    before = content_of(tmp_path)

    def interrupted():
        yield grey(0)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, interrupted())
    assert content_of(tmp_path) == before


@pytest.mark.parametrize(
    ("missing_bytes", "found"), [(50_000, ""), (1, "an incomplete index"), (200, "an incomplete index")]
)
def test_a_full_disk_is_an_error_and_keeps_the_old_file(tmp_path, capfd, missing_bytes, found):
    """A limit on the file size stands for a full disk: FFmpeg reports an error in neither case.

    The index of the frames is at the end of the file: without its end, all frames exist and can be counted.
    """
    path = write(tmp_path / "a.avi", noise(60))
    size = path.stat().st_size
    with files_up_to(size - missing_bytes):
        words = ("a.avi: expected a file with 60 frames", found, "is the disk full?")
        assert_refused(lambda: write(path, noise(60)), *words, unchanged=tmp_path)
    # OpenCV warns of each frame that is not written.
    assert capfd.readouterr().err == ""


# --- joining


def key_frames(path):
    """Whether the index of the container (chunk `idx1`) marks each frame as a key frame."""
    data = path.read_bytes()
    start = data.rfind(b"idx1")
    length = int.from_bytes(data[start + 4 : start + 8], "little")
    entries = np.frombuffer(data, "<u4", length // 4, start + 8)
    return (entries.reshape(-1, 4)[:, 1] & 0x10 > 0).tolist()


def moving_picture(num_frames, start=0):
    """Make frames of a moving picture; no two of its frames are equal."""
    noise = np.random.default_rng(1).integers(0, 255, (HEIGHT, 400, 3), np.uint8)
    large = cv2.GaussianBlur(noise, (0, 0), 2)
    return [large[:, left : left + WIDTH].copy() for left in range(start, start + num_frames)]


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
    assert list(read_near(probe(path), [])) == []


@pytest.mark.parametrize("lengths", [(5,), (24, 24, 7), (1, 13, 30, 2)])
def test_a_joined_video_decodes_as_its_parts_do(tmp_path, lengths, capfd):
    parts, start = [], 0
    for length in lengths:
        parts.append(write(tmp_path / f"{start}.avi", moving_picture(length, start), 29.97))
        start += length
    join_videos(tmp_path / "joined.avi", parts)
    joined = probe(tmp_path / "joined.avi")
    assert joined == replace(probe(parts[0]), path=joined.path, num_frames=sum(lengths))
    expected, keys = [], []
    for part in parts:
        expected += read_frames(probe(part))
        keys += key_frames(part)
    np.testing.assert_array_equal(list(read_frames(joined)), expected)
    # Joining keeps the key frames that the encoder chose for the parts.
    assert key_frames(joined.path) == keys
    capture = cv2.VideoCapture(str(joined.path), cv2.CAP_FFMPEG)
    for frame in np.random.default_rng(0).permutation(sum(lengths))[:8].tolist():
        capture.set(cv2.CAP_PROP_POS_FRAMES, frame)
        np.testing.assert_array_equal(capture.read()[1], expected[frame])
    capture.release()
    assert capfd.readouterr().err == ""


def test_parts_that_differ_or_end_early_are_refused(tmp_path, capfd):
    first = write(tmp_path / "0.avi", noise(20))
    write(tmp_path / "slow.avi", noise(2), 24.0)
    (tmp_path / "cut.avi").write_bytes(first.read_bytes()[:60_000])
    for name, words in (
        ("slow.avi", "expected 96 x 64 pixels at 25 Hz as in 0.avi, found 96 x 64 pixels at 24 Hz"),
        ("cut.avi", "expected a whole video, found one that is cut short"),
    ):
        join = partial(join_videos, tmp_path / "joined.avi", [first, tmp_path / name])
        assert_refused(join, f"{name}: {words}", unchanged=tmp_path)
    assert capfd.readouterr().err == ""

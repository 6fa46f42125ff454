"""The first look at a video: what a background is learned from, without decoding the video twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from psotrack.foreground.silhouettes import ForegroundSettings, first_look, look_first, reduce_frame
from psotrack.recordings import VideoWriter, probe, read_frames

SIZE_WH = (64, 48)
SETTINGS = ForegroundSettings(working_reduction=2, num_learning_frames=10)


def _write(path: Path, num_frames: int) -> Path:
    """A video whose brightness tells the number of the frame."""
    with VideoWriter(path, 25.0, SIZE_WH) as writer:
        for index in range(num_frames):
            writer.write(np.full((SIZE_WH[1], SIZE_WH[0], 3), 20 + index, np.uint8))
    return path


def _counted(path: Path, count: list[int]) -> Iterator[np.ndarray]:
    for frame in read_frames(probe(path)):
        count[0] += 1
        yield frame


def test_a_video_that_is_held_is_decoded_once(tmp_path: Path) -> None:
    path, count = _write(tmp_path / "v.avi", 40), [0]
    learning, frames = look_first(probe(path), _counted(path, count), SETTINGS)
    assert count == [40]
    expected = [reduce_frame(frame, SETTINGS) for frame in read_frames(probe(path))]
    for frame, (weight, image) in zip(expected[::4], learning, strict=True):
        assert weight == 1
        np.testing.assert_array_equal(image, frame)
    for frame, image in zip(expected, frames, strict=True):
        np.testing.assert_array_equal(image, frame)
    assert count == [40]


def test_frames_behind_those_that_are_held_stand_for_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held_bytes = 20 * (SIZE_WH[0] // 2) * (SIZE_WH[1] // 2) * 3
    monkeypatch.setattr(first_look, "_HELD_BYTES", held_bytes)
    path, count = _write(tmp_path / "v.avi", 200), [0]
    learning, frames = look_first(probe(path), _counted(path, count), SETTINGS)
    assert count == [20]  # the rest is not read before it is asked for
    number = [round(float(image.mean())) - 20 for _, image in learning]
    weight = np.array([weight for weight, _ in learning])
    # The codec is off by a grey level. The frames 20 to 199 are four places, which are 45 frames apart.
    np.testing.assert_allclose(number, [0, 43, 88, 133, 178], atol=14)
    assert weight.sum() == pytest.approx(200)
    assert weight.max() < 80
    assert len(list(frames)) == 200


def test_a_video_of_one_frame_is_its_own_first_look(tmp_path: Path) -> None:
    path = _write(tmp_path / "v.avi", 1)
    learning, frames = look_first(probe(path), read_frames(probe(path)), SETTINGS)
    assert len(learning) == len(list(frames)) == 1

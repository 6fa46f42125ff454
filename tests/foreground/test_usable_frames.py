"""Frames of a camera in which foreground is everywhere are left out, said, and shown in status and covariance."""

from __future__ import annotations

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import cameras_of
from hypothesis import given
from hypothesis import strategies as st

from psotrack.foreground.silhouettes import Silhouettes, SilhouetteSettings, blob_detections, compute
from psotrack.foreground.silhouettes.usable_frames import (
    LEAST_FRAMES,
    foreground_is_everywhere,
    in_words,
    intervals_of,
)
from psotrack.geometry import look_at, make_camera, make_rig
from psotrack.recordings import Recording, VideoWriter, probe

SIZE_WH = (160, 120)
NUM_FRAMES = 80
#: Frames in which camera "shaken" shows another picture in each frame.
SHAKEN = range(40, 55)
SETTINGS = SilhouetteSettings(background="mog2", reduction=2, working_reduction=1, min_blob_px=9)


def test_foreground_is_everywhere_where_most_parts_of_the_image_have_some() -> None:
    speckle = np.zeros((4, 90, 160), np.uint8)
    speckle[1, 5::10, 5::10] = 255  # a cell in each part
    speckle[2, :60, :50] = 255  # a large object
    speckle[3, 15::20, 5::10] = 255  # less than half of the parts
    assert foreground_is_everywhere(speckle).tolist() == [False, True, False, False]


def test_ten_drones_are_not_everywhere() -> None:
    """Each drone lies where four parts of the image meet."""
    silhouette = np.zeros((1, 90, 160), np.uint8)
    for drone in range(10):
        x, y = 30 * (drone % 5) + 10, 40 * (drone // 5) + 20
        silhouette[0, y - 5 : y + 5, x - 5 : x + 5] = 255
    assert not foreground_is_everywhere(silhouette).any()


@given(st.lists(st.booleans(), max_size=60))
def test_intervals_are_the_chosen_frames(chosen: list[bool]) -> None:
    again = np.zeros(len(chosen), bool)
    intervals = intervals_of(np.array(chosen, bool))
    for start, stop in intervals:
        assert start < stop
        assert not again[max(start - 1, 0) : stop].any()
        again[start:stop] = True
    assert again.tolist() == chosen


def test_a_single_frame_with_speckle_everywhere_is_kept() -> None:
    """Found: key frames of a codec were left out in all cameras at once, and tracks were lost there."""
    unusable = np.array([0, 1, 0, 1, 1, 0, 1, 1, 1], bool)
    assert intervals_of(unusable, LEAST_FRAMES) == [(6, 9)]


def test_intervals_in_words_leave_out_short_gaps() -> None:
    assert in_words([(3, 4), (10, 20), (22, 31), (60, 70)], gap_frames=25) == "3 to 30, 60 to 69"
    assert in_words([(3, 4), (40, 41)], gap_frames=25) == "3, 40"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Two cameras that see a disc; one of them shows noise for 15 frames."""
    folder = tmp_path_factory.mktemp("usable")
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(90, 190, (6, 8, 3)).astype(np.float32), SIZE_WH)
    R, t_m = look_at((0.0, 0.0, 1.0), (5.0, 0.0, 1.0))
    K = np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]])
    for name in ("calm", "shaken"):
        with VideoWriter(folder / f"{name}.avi", 25.0, SIZE_WH) as writer:
            for index in range(NUM_FRAMES):
                image = wall + rng.normal(0, 2, wall.shape)
                if name == "shaken" and index in SHAKEN:
                    image = cv2.resize(rng.uniform(0, 255, (12, 16, 3)), SIZE_WH)
                cv2.circle(image, (20 + index, 60), 8, (20, 20, 20), -1)
                writer.write(np.clip(image, 0, 255).astype(np.uint8))
    videos = {path.stem: probe(path) for path in sorted(folder.glob("*.avi"))}
    rig = make_rig({name: make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH) for name in videos})
    return Recording("usable", folder, cameras_of(rig, video=videos))


@pytest.fixture
def silhouettes(recording: Recording, tmp_path: Path) -> Silhouettes:
    return compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)


def test_a_camera_is_left_out_for_as_long_and_a_line_says_which_and_when(
    recording: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):  # computed, and read from the store
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            made = compute(recording, SETTINGS, cache=tmp_path / "cache", jobs=1)
        (line,) = [each.getMessage() for each in caplog.records]
        assert line.startswith("camera shaken: 15 of 80 frames are left out")
        assert "frames 40 to 54" in line
        assert made.left_out == {"shaken": [(40, 55)]}
    frames = made.read(0, NUM_FRAMES)
    assert not frames[40:55, 1].any()
    assert frames[:, 0].any(axis=(1, 2)).all()


def test_the_camera_has_no_frame_at_these_instants(recording: Recording, silhouettes: Silhouettes) -> None:
    shown = silhouettes.at_instants(recording.timeline())
    assert shown.exposures is not None
    expected = np.ones((NUM_FRAMES, 2), bool)
    expected[40:55, 1] = False
    np.testing.assert_array_equal(shown.exposures.is_there, expected)
    np.testing.assert_array_equal(shown.read(0, NUM_FRAMES), silhouettes.read(0, NUM_FRAMES))


def test_frames_that_are_left_out_have_no_blobs(recording: Recording, silhouettes: Silhouettes) -> None:
    boxes = blob_detections(silhouettes, np.array([SIZE_WH, SIZE_WH], float))
    frames = set(boxes["shaken"].frame.tolist())
    assert frames.isdisjoint(SHAKEN)
    assert set(range(NUM_FRAMES)) - set(SHAKEN) <= frames


def test_some_instants_are_those_of_all(recording: Recording, silhouettes: Silhouettes) -> None:
    timeline = recording.timeline()
    every = silhouettes.at_instants(timeline)
    some = silhouettes.at_instants(timeline.part(np.arange(50, NUM_FRAMES)))
    assert some.exposures is not None
    assert every.exposures is not None
    np.testing.assert_array_equal(some.exposures.is_there, every.exposures.is_there[50:])
    np.testing.assert_array_equal(some.read(0, NUM_FRAMES - 50), every.read(50, NUM_FRAMES))

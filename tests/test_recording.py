"""`Recording.usable` accepts consistent videos; its errors name the inconsistent video and a remedy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import make_camera, make_rig
from psotrack.recordings import Recording, VideoInfo

NAMES = ("a", "b", "c", "d", "e")


def make_test_camera(size_wh=(1920, 1080)):
    K = np.array([[1000, 0, 960], [0, 1000, 540], [0, 0, 1.0]])
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=size_wh)


def make_recording(**changes) -> Recording:
    """Make a recording of five equal cameras.

    Args:
        changes: Camera name -> fields of its `VideoInfo` that differ; None removes the camera's video.
    """
    videos = {name: VideoInfo(Path(f"{name}.avi"), 250, 25.0, (1920, 1080)) for name in NAMES}
    for name, change in changes.items():
        if change is None:
            del videos[name]
        else:
            videos[name] = replace(videos[name], **change)
    rig = make_rig({name: make_test_camera() for name in NAMES})
    return Recording(name="S01", folder=Path("S01"), rig=rig, videos=videos)


def test_consistent_videos_are_kept():
    recording = make_recording().usable()
    assert recording.rig.names == tuple(recording.videos) == NAMES
    assert (recording.num_frames, recording.fps) == (250, 25.0)


def test_cameras_are_chosen_in_the_order_given():
    recording = make_recording().usable(["d", "b"])
    assert recording.rig.names == tuple(recording.videos) == ("d", "b")


def test_an_unknown_camera():
    with pytest.raises(SettingsError, match="cameras: expected some of a, b, c, d, e, found z"):
        make_recording().usable(["a", "z"])


def test_a_camera_without_video():
    with pytest.raises(InputError, match="found none for b, d; pass --cameras a,c,e to leave these out"):
        make_recording(b=None, d=None).usable()
    assert make_recording(b=None).usable(["a", "c"]).rig.names == ("a", "c")


def test_no_videos():
    recording = make_recording(**dict.fromkeys(NAMES))
    assert recording.num_frames == 0
    with pytest.raises(InputError, match="S01: expected at least one video, found none"):
        _ = recording.fps
    with pytest.raises(InputError, match=r"found none for a, b, c, d, e$"):
        recording.usable()


@pytest.mark.parametrize("camera", ["a", "c"], ids=["the first", "a later one"])
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"num_frames": 240}, "250 frames as in .*, found 240 frames; pass --frames 240"),
        ({"num_frames": 260}, "250 frames as in .*, found 260 frames; pass --frames 250"),
        ({"fps": 29.97}, r"25\.000 frames per second as in .*, found 29\.970"),
        ({"fps": 24.98}, r"25\.000 frames per second as in .*, found 24\.980"),
        ({"image_size_wh": (1280, 720)}, "1920 x 1080 pixels as calibrated, found 1280 x 720"),
    ],
)
def test_the_error_names_the_differing_video(camera, change, expected):
    with pytest.raises(InputError, match=rf"^{camera}\.avi: expected {expected}"):
        make_recording(**{camera: change}).usable()
    rest = [name for name in NAMES if name != camera]
    assert make_recording(**{camera: change}).usable(rest).rig.names == tuple(rest)


def test_different_sizes_are_refused_even_if_calibrated():
    recording = make_recording(c={"image_size_wh": (1280, 720)})
    recording.rig.cameras.image_size_wh[2] = (1280, 720)
    with pytest.raises(
        InputError, match=r"^c\.avi: expected 1920 x 1080 pixels as in a\.avi, found 1280 x 720"
    ):
        recording.usable()


def test_rates_that_differ_by_rounding_are_equal():
    assert make_recording(c={"fps": 25.00004}).usable().num_frames == 250


def test_leading_frames():
    recording = make_recording(c={"num_frames": 240}).usable(num_frames=240)
    assert {video.num_frames for video in recording.videos.values()} == {240}


@pytest.mark.parametrize("num_frames", [0, -1, 241])
def test_more_frames_than_exist_are_refused(num_frames):
    with pytest.raises(SettingsError, match=f"frames: expected 1 to 240, .* found {num_frames}"):
        make_recording(c={"num_frames": 240}).usable(num_frames=num_frames)

"""`Recording.usable` accepts what belongs together; its errors name the file that does not, and a remedy."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import cameras_of, with_cameras

from psotrack.errors import InputError, SettingsError
from psotrack.geometry import make_camera, make_rig
from psotrack.recordings import FrameTimes, Recording, VideoInfo

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
    return Recording("S01", Path("S01"), cameras_of(rig, video=videos))


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


def test_a_camera_without_video_is_left_out_with_a_warning(caplog):
    recording = make_recording(b=None, d=None).usable()
    assert recording.rig.names == tuple(recording.videos) == ("a", "c", "e")
    lines = [record.getMessage() for record in caplog.records]
    assert lines == [f"camera {name} is left out: it has no video" for name in "bd"]


def test_a_camera_without_video_that_is_asked_for_is_an_error():
    with pytest.raises(InputError, match=r"^S01: expected a video for each .* a, b, found none for b$"):
        make_recording(b=None).usable(["a", "b"])
    assert make_recording(b=None).usable(["a", "c"]).rig.names == ("a", "c")


def test_a_camera_with_times_alone_counts_where_no_videos_are_needed():
    recording = with_cameras(make_recording(b=None, d=None), times={"b": FrameTimes(30, 25.0)})
    assert recording.usable(videos=False).rig.names == ("a", "b", "c", "e")
    assert recording.usable(videos=False).num_frames == 250
    assert recording.usable(["b"], videos=False).num_frames == 30


def test_no_videos():
    recording = make_recording(**dict.fromkeys(NAMES))
    assert recording.num_frames == 0
    with pytest.raises(InputError, match="S01: expected at least one video, found none"):
        _ = recording.fps
    with pytest.raises(InputError, match=r"found none for a, b, c, d, e$"):
        recording.usable()


@pytest.mark.parametrize("camera", ["a", "c"], ids=["the first", "a later one"])
@pytest.mark.parametrize(
    ("size_wh", "remedy"),
    [
        ((1280, 720), "multiply the first two rows of K by 2/3"),
        ((3840, 2160), "multiply the first two rows of K by 2/1"),
        ((1920, 1200), "is it the video of another camera?"),
    ],
)
def test_a_size_that_differs_from_the_calibration_is_an_error(camera, size_wh, remedy):
    recording = make_recording(**{camera: {"image_size_wh": size_wh}})
    with pytest.raises(InputError) as error:
        recording.usable()
    start = (
        f"{camera}.avi: expected 1920 x 1080 pixels as calibrated, found {size_wh[0]} x {size_wh[1]} pixels"
    )
    assert str(error.value).startswith(start)
    assert str(error.value).endswith(remedy)
    rest = [name for name in NAMES if name != camera]
    assert recording.usable(rest).rig.names == tuple(rest)


def test_cameras_may_differ_in_size_rate_and_length():
    recording = make_recording(
        a={"num_frames": 100},
        b={"fps": 50.0, "num_frames": 400},
        c={"image_size_wh": (1280, 720)},
    )
    recording.cameras[2].camera.image_size_wh[:] = (1280, 720)
    usable = recording.usable()
    assert (usable.rig.names, usable.fps) == (NAMES, 50.0)
    # The cameras at 25 frames per second last 10 s, the fast one 8 s.
    timeline = usable.timeline()
    assert usable.num_frames == timeline.num_instants == 500
    assert timeline.frame[200].tolist() == [-1, 200, 100, 100, 100]


def test_rates_that_differ_by_rounding_are_equal():
    assert make_recording(c={"fps": 25.00004}).usable().num_frames == 250


def test_leading_frames():
    recording = make_recording(c={"num_frames": 240}).usable(num_frames=240)
    assert {video.num_frames for video in recording.videos.values()} == {240}
    assert recording.num_frames == 240


def test_leading_frames_of_a_slow_camera_and_of_one_that_begins_later(caplog):
    recording = with_cameras(
        make_recording(b={"fps": 50.0}),
        times={"c": FrameTimes(250, 25.0, 0.8), "d": FrameTimes(250, 25.0, 3.0)},
    ).usable(num_frames=100)
    # 100 instants at 50 Hz are 2 s.
    counts = {name: video.num_frames for name, video in recording.videos.items()}
    assert counts == {"a": 50, "b": 100, "c": 30, "e": 50}
    assert {each.name: each.times.num_frames for each in recording.cameras} == counts
    assert recording.num_frames == 100
    assert "camera d is left out: it has no frame before instant 100" in caplog.text


@pytest.mark.parametrize("num_frames", [0, -1, 251])
def test_more_frames_than_exist_are_refused(num_frames):
    with pytest.raises(SettingsError, match=f"frames: expected 1 to 250, .* found {num_frames}"):
        make_recording(c={"num_frames": 240}).usable(num_frames=num_frames)


def test_a_single_name_is_one_camera():
    assert make_recording().usable("c").rig.names == ("c",)


@pytest.mark.parametrize("names", [[], [""], [" "]])
def test_empty_names_are_refused(names):
    with pytest.raises(SettingsError, match=r"^cameras: expected some of a, b, c, d, e, found "):
        make_recording().usable(names)

"""`import psotrack as pt`: its names and documentation, wrong calls, and settings."""

import inspect
import pydoc
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_refused, cameras_of, ring_rig

import psotrack as pt
from psotrack.errors import SettingsError
from psotrack.recordings import VideoWriter


def test_every_name_is_there_and_documented():
    assert 30 <= len(dir(pt)) <= 60
    for name in dir(pt):
        value = getattr(pt, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert len(value.__doc__) > 30, name
        assert name in pt.__doc__, name


def test_help_fits_ten_screens():
    """Found: 2,453 lines, the help of every name."""
    lines = pydoc.plain(pydoc.render_doc(pt)).splitlines()
    # Ten screens of 50 lines; prose of 120 characters, indented by pydoc.
    assert 50 < len(lines) < 500
    assert max(map(len, lines)) <= 124


# --- wrong calls

#: Arguments that are right nowhere, but for a text that is the path of no file.
WRONG = (object(), None, 3, 2.5, "nothing", b"nothing", ())
CALLED = [
    name
    for name in dir(pt)
    if callable(getattr(pt, name)) and not getattr(getattr(pt, name), "_is_protocol", False)
]


@pytest.mark.parametrize("name", CALLED)
def test_a_wrong_call_is_answered_like_a_wrong_option(name, tmp_path, monkeypatch):
    """Found: TypeError and AttributeError from the middle of the package."""
    monkeypatch.chdir(tmp_path)
    function = getattr(pt, name)
    many = "(): expected "
    assert_refused(lambda: function(*[1] * 40), name, many, "too many positional", unchanged=tmp_path)
    # Single settings of `track` are named arguments.
    if name != "track":
        assert_refused(lambda: function(unknown=1), name, many, "found unknown", unchanged=tmp_path)
    needed = [each for each in inspect.signature(function).parameters.values() if each.default is each.empty]
    # The name of a camera is any text.
    checks_fields = not inspect.isclass(function) or (
        hasattr(function, "__post_init__") and name != "CameraRecording"
    )
    for wrong in WRONG if checks_fields else ():
        args = [wrong for each in needed if each.kind is each.POSITIONAL_OR_KEYWORD]
        values = {each.name: wrong for each in needed if each.kind is each.KEYWORD_ONLY}
        if args or values:
            call = lambda args=args, values=values: function(*args, **values)  # noqa: E731
            assert_refused(call, "expected ", ", found ", unchanged=tmp_path)


#: Calls, in a folder with videos without frames, and words of the line.
BAD = [
    (lambda: pt.evaluate(1, 2), "evaluate(), traj_est: expected a Trajectories, found 1"),
    (lambda: pt.track("a", particles="many"), 'swarm.particles: expected a whole number, found "many"'),
    (lambda: pt.track("a", particels=3), "found particels; did you mean swarm.particles?"),
    (lambda: pt.track("a", kind="hard"), "expected one of swarm.kind, score.kind, found kind"),
    (lambda: pt.calibrate_rig(), "expected one of --square, --squares, --points"),
    (lambda: pt.calibrate_rig(square_m=0.04), "expected a video, a folder or a pattern"),
    # Found: a line about a folder of images.
    (lambda: pt.calibrate_rig("board", square_m=0.04), "expected a folder with videos or images, found nei"),
    (lambda: pt.calibrate_rig("videos", square_m=0.04), "right.mp4: expected a video, found an empty file"),
    (lambda: pt.overlay("nothing.csv", cameras="left"), "cameras: expected a sequence or None"),
]


def write_video(path, fps=25.0):
    with VideoWriter(path, fps, (64, 48)) as video:
        for _ in range(3):
            video.write(np.zeros((48, 64, 3), np.uint8))


@pytest.mark.parametrize(("call", "words"), BAD)
def test_wrong_calls_are_one_line(call, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("board", "videos"):
        (tmp_path / name).mkdir()
    write_video(tmp_path / "videos" / "left.avi")
    (tmp_path / "videos" / "right.mp4").touch()
    assert_refused(call, words, unchanged=tmp_path)


def test_a_folder_with_a_recording_has_the_times_of_the_recording(tmp_path):
    """Videos of different rates cannot be paired by the numbers of their frames, but by a recording's times."""
    for name, fps in (("left", 25.0), ("right", 50.0)):
        write_video(tmp_path / f"{name}.avi", fps)

    def calibrate():
        pt.calibrate_rig(tmp_path, square_m=0.04)

    assert_refused(calibrate, "expected 25 frames per second", unchanged=tmp_path)
    cameras = "".join(f'[cameras.{name}]\nvideo = "{name}.avi"\n' for name in ("left", "right"))
    (tmp_path / "recording.toml").write_text(f"version = 1\n{cameras}")
    assert_refused(calibrate, "expected a ChArUco board or a chessboard", unchanged=tmp_path)


# --- settings


def test_single_settings_by_the_last_part_of_their_names(monkeypatch):
    taken = {}

    def track_recording(recording, settings, **more):
        taken.update(more, settings=settings)
        raise SettingsError("the test", expected="to stop here", found="an end")

    monkeypatch.setattr("psotrack.api.track_recording", track_recording)
    recording, score = pt.Recording("flight", Path(), cameras_of(ring_rig(2))), object()
    with pytest.raises(SettingsError, match="to stop here"):
        pt.track(recording, {"swarm.kind": "joint"}, particles=50, smooth=True, method="fused", score=score)
    settings = taken["settings"]
    assert (settings.swarm.particles, settings.swarm.kind, settings.smooth) == (50, "joint", True)
    assert (settings.method, taken["score"]) == ("fused", score)
    assert "method" not in taken
    # Settings may be numbers and arrays of NumPy, and paths.
    values = {"swarm.particles": np.int64(50), "bounds_m": np.arange(6.0), "init": Path("tracks.csv")}
    changed = pt.TrackSettings().changed(values)
    assert (changed.swarm.particles, changed.init) == (50, "tracks.csv")
    assert list(changed.bounds_m) == [0, 1, 2, 3, 4, 5]


# --- results


def test_a_repr_fits_a_terminal():
    frames = np.arange(5000)
    trajectories = pt.Trajectories(frames, frames / 25, ("a", "b"), np.zeros((5000, 2, 3)))
    lines = repr(trajectories).splitlines()
    assert len(lines) < 15
    assert max(map(len, lines)) <= 100
    assert "float64 (5000, 2, 3)" in repr(trajectories)

"""`import psotrack as pt`: its names and their documentation, lazy loading, and short output of `repr`."""

import inspect
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import cameras_of, ring_rig

import psotrack as pt
from psotrack.errors import PsotrackError, SettingsError
from psotrack.foreground.silhouettes import ForegroundSettings
from psotrack.geometry import project_boxes
from psotrack.support import short_repr
from psotrack.tracking.swarm import SoftIoU, camera_weights, foreground_and_area, tracker_settings


def test_every_name_is_there_and_documented():
    assert 30 <= len(dir(pt)) <= 60
    for name in dir(pt):
        value = getattr(pt, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert len(value.__doc__) > 30, name
        assert name in pt.__doc__, name


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
    for args, values, words in (
        ([], {"unknown": 1}, r"\(\): expected .*, found unknown"),
        ([1] * 40, {}, r"\(\): expected .*, found too many positional arguments"),
    ):
        if name != "track" or args:
            with pytest.raises(SettingsError, match=rf"^{name}{words}"):
                function(*args, **values)
    needed = [each for each in inspect.signature(function).parameters.values() if each.default is each.empty]
    # The name of a camera is any text.
    checks_fields = not inspect.isclass(function) or (
        hasattr(function, "__post_init__") and name != "CameraRecording"
    )
    for wrong in WRONG if checks_fields else ():
        args = [wrong for each in needed if each.kind is each.POSITIONAL_OR_KEYWORD]
        values = {each.name: wrong for each in needed if each.kind is each.KEYWORD_ONLY}
        if args or values:
            with pytest.raises(PsotrackError, match=r"expected .*, found ") as error:
                function(*args, **values)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: pt.evaluate(1, 2), "evaluate(), traj_est: expected a Trajectories, found 1"),
        (lambda: pt.read_trajectories(None), "path: expected a path or text, found None"),
        (lambda: pt.track("missing"), "missing: expected a recording.toml"),
        (
            lambda: pt.track("missing", particles="many"),
            'swarm.particles: expected a whole number, found "many"',
        ),
        (lambda: pt.track("missing", particels=3), "found particels; did you mean swarm.particles?"),
        (lambda: pt.track("missing", kind="hard"), "expected one of swarm.kind, score.kind, found kind"),
        (lambda: pt.SwarmSettings(particels=3), "found particels; did you mean particles?"),
        (lambda: pt.read_rig("rig.toml", metres=1), "found metres; did you mean metres_per_unit?"),
    ],
)
def test_messages_of_wrong_calls(call, message):
    with pytest.raises(PsotrackError, match=re.escape(message)):
        call()


def test_single_settings_by_the_last_part_of_their_names(monkeypatch):
    taken = {}

    def track_recording(recording, settings, **more):
        taken.update(more, settings=settings)
        raise SettingsError("the test", expected="to stop here", found="an end")

    monkeypatch.setattr("psotrack.api.track_recording", track_recording)
    recording, score = pt.Recording("flight", Path(), cameras_of(ring_rig(2))), Dice()
    with pytest.raises(SettingsError, match="to stop here"):
        pt.track(recording, {"swarm.kind": "joint"}, particles=50, smooth=True, method="fused", score=score)
    settings = taken["settings"]
    assert (settings.swarm.particles, settings.swarm.kind, settings.smooth) == (50, "joint", True)
    assert (settings.method, taken["score"]) == ("fused", score)
    assert "method" not in taken


def test_importing_loads_nothing_heavy():
    code = "import sys, psotrack; print(sorted({'jax', 'cv2', 'pandas', 'zarr', 'scipy', 'numpy'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_markers_in_an_image_in_grey_or_colour():
    image = np.full((400, 400), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image[100:300, 100:300] = cv2.aruco.generateImageMarker(dictionary, 7, 200)
    for one in (image, cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)):
        seen = pt.detect_markers(one, "4x4_50")
        assert seen.ids.tolist() == [7]


def test_the_background_model_finds_a_new_object():
    rng = np.random.default_rng(0)
    empty = [rng.normal(100, 1, (48, 64, 3)).clip(0, 255).astype(np.uint8) for _ in range(20)]
    drone = empty[0].copy()
    drone[10:30, 20:40] = 10
    model = pt.background_model(ForegroundSettings(working_reduction=1, min_blob_px=0))
    assert isinstance(model, pt.BackgroundModel)
    (mask,) = model.foreground(empty, [drone])
    assert (mask[12:28, 22:38] > 0).all()
    assert (mask[35:, :] == 0).all()


def test_a_repr_fits_a_terminal():
    frames = np.arange(5000)
    trajectories = pt.Trajectories(frames, frames / 25, ("a", "b"), np.zeros((5000, 2, 3)))
    lines = repr(trajectories).splitlines()
    assert len(lines) < 15
    assert max(map(len, lines)) <= 100
    assert "float64 (5000, 2, 3)" in repr(trajectories)

    @dataclass(frozen=True, repr=False)
    class Long:
        text: str
        __repr__ = short_repr

    assert len(repr(Long(1000 * "x"))) < 100


@dataclass(frozen=True)
class Dice:
    """A score from outside the package: the Dice coefficient of box and foreground within the ring around the box."""

    ring: float = 1.5
    whole_pixels: bool = False
    min_cameras: int = 2

    def camera_scores(self, inputs, position_m):
        boxes = project_boxes(inputs.extents, position_m)
        foreground, area = foreground_and_area(inputs, boxes, (1.0, self.ring))
        score = 2 * foreground[0] / (area[0] + foreground[1] + 1e-6)
        return score.clip(0, 1), camera_weights(inputs, boxes)


def test_scores_are_interchangeable():
    for score in (Dice(), SoftIoU()):
        assert isinstance(score, pt.Score)
        assert hash(score) == hash(type(score)())


@pytest.mark.parametrize("settings", [{"swarm.search": "annealing"}, {"score.kind": "dice"}])
def test_an_unknown_plugin_is_one_line(settings):
    with pytest.raises(SettingsError, match=r"expected one of .*, found (annealing|dice)"):
        tracker_settings(pt.TrackSettings().changed(settings))


def test_settings_may_be_numbers_and_arrays_of_numpy_and_paths():
    values = {"swarm.particles": np.int64(50), "bounds_m": np.arange(6.0), "init": Path("tracks.csv")}
    changed = pt.TrackSettings().changed(values)
    assert (changed.swarm.particles, changed.init) == (50, "tracks.csv")
    assert list(changed.bounds_m) == [0, 1, 2, 3, 4, 5]
    with pytest.raises(SettingsError, match=re.escape('swarm.particles: expected a whole number, found "a"')):
        pt.SwarmSettings(particles="a")

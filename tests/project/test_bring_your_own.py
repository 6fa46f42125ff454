"""Search, score, method, background model and detector of one's own, from Python and by name on the command line."""

import inspect
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_refused, make_once

import psotrack as pt
from psotrack.foreground.silhouettes import ForegroundSettings, find_background
from psotrack.geometry import project_boxes
from psotrack.recordings import read_frames
from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import identify
from psotrack.tracking.swarm import camera_weights, find_score, find_search, foreground_and_area
from psotrack.trajectories import Status, Tracks

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
#: Few cameras, particles and frames, because compiling takes most of the time.
CAMERAS, NUM_FRAMES = ("cam1", "cam3", "cam6", "cam8"), 8
SETTINGS = {
    "init": "truth",
    "drones.size_m": (0.5, 0.5, 0.2),
    "swarm.particles": 16,
    "swarm.iterations": 6,
    "silhouettes.reduction": 1,
    "silhouettes.working_reduction": 1,
    "silhouettes.min_blob_px": 8,
}
#: A drone is about 0.5 m wide: with a larger mean error the tracks do not follow the drones.
NEAR_M = 0.1


# --8<-- [start:search]
@jax.tree_util.register_dataclass  # the numbers may change without a new compilation
@dataclass(frozen=True)
class RandomSearch:
    """Normal steps about the best position so far, whose standard deviation shrinks."""

    step_m: float = 0.05
    shrink: float = 0.8

    def __call__(self, key, objective, first, region, num_iterations):
        def value_of(position):
            return jnp.nan_to_num(objective(position), nan=-jnp.inf)

        def iterate(number, best):
            noise = jax.random.normal(jax.random.fold_in(key, number), first.shape)
            position = best[0] + self.step_m * self.shrink**number * noise
            return better(best, position.clip(region.low, region.high))

        def better(best, position):
            value = value_of(position)
            winner, groups = value.argmax(axis=0), jnp.arange(value.shape[1])
            improves = value[winner, groups] > best[1]
            return (
                jnp.where(improves[:, None], position[winner, groups], best[0]),
                jnp.where(improves, value[winner, groups], best[1]),
            )

        first = first.clip(region.low, region.high)
        start = first[0], jnp.full(first.shape[1], -jnp.inf)
        return jax.lax.fori_loop(0, num_iterations, iterate, better(start, first))[0]


# --8<-- [end:search]


# --8<-- [start:score]
@dataclass(frozen=True)
class Dice:
    """Dice coefficient: twice the foreground in the box, over the box and the foreground around it."""

    ring: float = 1.5  # the foreground in a box 1.5 times as large belongs to the drone
    whole_pixels: bool = False
    min_cameras: int = 2

    def camera_scores(self, inputs, position_m):
        boxes = project_boxes(inputs.extents, position_m)
        foreground, area = foreground_and_area(inputs, boxes, (1.0, self.ring))
        score = 2 * foreground[0] / (area[0] + foreground[1] + 1e-6)
        return score.clip(0, 1), camera_weights(inputs, boxes)


# --8<-- [end:score]


# --8<-- [start:method]
@dataclass(frozen=True)
class Hover:
    """A method that knows one thing: the drones stay where they are at frame 0."""

    reads_detections: bool = False

    def __call__(self, inputs, report=None):
        start = inputs.initial
        frames, drones = inputs.silhouettes.num_frames, len(start.position_m)
        position_m = np.broadcast_to(start.position_m, (frames, drones, 3))
        covariance_m2 = np.broadcast_to(0.01 * np.eye(3), (frames, drones, 3, 3))
        return Tracks(
            position_m=position_m,
            velocity_m_s=np.zeros((frames, drones, 3)),
            covariance_m2=covariance_m2,
            measured_m=position_m,
            measured_covariance_m2=covariance_m2,
            fitness=np.ones((frames, drones)),
            num_cameras=np.full((frames, drones), len(inputs.rig)),
            status=np.full((frames, drones), Status.TRACKED),
            size_m=start.size_m,
            size_frames=np.zeros((drones, 3), int),
        )


# --8<-- [end:method]


# --8<-- [start:background]
@dataclass(frozen=True)
class MedianBackground:
    """Foreground is what differs from the median of the learning frames."""

    threshold: int = 25
    reduction: int = 1  # silhouettes.working_reduction

    @property
    def key(self):
        return {"threshold": self.threshold, "reduction": self.reduction}

    def foreground(self, learning, frames):
        median = np.median([self.reduced(frame) for frame in learning], axis=0).astype(np.uint8)
        for frame in frames:
            difference = cv2.absdiff(self.reduced(frame), median).max(axis=2)
            yield np.where(difference > self.threshold, 255, 0).astype(np.uint8)

    def reduced(self, frame):
        height, width = frame.shape[:2]
        size_wh = -(-width // self.reduction), -(-height // self.reduction)
        return cv2.resize(frame, size_wh, interpolation=cv2.INTER_AREA)


# --8<-- [end:background]


# --8<-- [start:detector]
@dataclass(frozen=True)
class EmptyHallDetector:
    """Boxes about what differs from a picture of the empty hall; the most similar picture is of the same camera."""

    empty: tuple[np.ndarray, ...]
    threshold: int = 25

    @property
    def key(self):
        return {"empty": [int(image.sum()) for image in self.empty], "threshold": self.threshold}

    def boxes(self, bgr):
        differences = [cv2.absdiff(bgr, image).max(axis=2) for image in self.empty]
        difference = min(differences, key=np.mean)
        _, _, blobs, _ = cv2.connectedComponentsWithStats((difference > self.threshold).astype(np.uint8))
        x, y, width, height, area = blobs[1:].T
        xyxy = np.stack([x, y, x + width, y + height], axis=1)[area > 8]
        return xyxy.astype(float), np.full(len(xyxy), 0.9)


# --8<-- [end:detector]


class HighDice(Dice):
    """Dice between 0.9 and 1, in the same order: a fitness that no other score gives to these drones."""

    def camera_scores(self, inputs, position_m):
        score, weight = super().camera_scores(inputs, position_m)
        return 0.9 + 0.1 * score, weight


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A data folder with a sequence of two drones at a quarter of the image size."""

    def make(folder):
        settings = SimulationSettings(num_frames=NUM_FRAMES, scale=0.25, masks=False, onboard=False)
        simulate("S01_D2_A", folder, settings, jobs=1)

    return make_once(tmp_path_factory, "bring_your_own", make)


@pytest.fixture(scope="module")
def recording(root):
    return pt.read_recording(root / "Simulated_Data" / "S01_D2_A", cameras=CAMERAS)


@pytest.fixture(scope="module")
def track(recording, tmp_path_factory):
    """Tracks the recording with parts of one's own, in this process."""
    cache = tmp_path_factory.mktemp("cache")

    def track(settings=None, **parts):
        return pt.track(recording, SETTINGS | (settings or {}), cache=cache, jobs=1, **parts)

    return track


@pytest.fixture(scope="module")
def empty_hall(recording):
    """A picture of each camera without drones, (height, width, 3) uint8: the median of the frames."""
    return tuple(
        np.median(list(read_frames(video)), axis=0).astype(np.uint8) for video in recording.videos.values()
    )


def mean_error_m(trajectories, recording):
    return pt.evaluate(trajectories, recording.truth).mean_error_m


def test_search_score_and_background_together_find_the_drones(track, recording):
    parts = {"score": HighDice(), "background": MedianBackground()}
    tracked = track(search=RandomSearch(), **parts)
    found = tracked.trajectories
    assert found.seen.all()
    assert mean_error_m(found, recording) < NEAR_M
    names = {kind: part["class"].rpartition(".")[2] for kind, part in tracked.record["parts"].items()}
    assert names == {"search": "RandomSearch", "score": "HighDice", "background": "MedianBackground"}
    assert tracked.record["parts"]["background"]["key"] == {"threshold": 25, "reduction": 1}
    # The score decides the fitness.
    assert (found.fitness >= 0.9).all()
    assert (found.fitness < 1.0).all()
    # The search decides the positions: without steps the best of the first positions remains. The median may take a
    # slow drone as background; this drone coasts, and no search moves it.
    without_steps = track(search=RandomSearch(step_m=0.0), **parts).trajectories
    moved = (found.status == Status.TRACKED).all(axis=0)
    assert moved.any()
    assert (found.position_m != without_steps.position_m)[:, moved].any(axis=2).all()
    # The first positions are so near that the vertices, which the fitness is of, are nearly the same.
    assert found.fitness.mean() > without_steps.fitness.mean() - 1e-4
    # A model that sees no foreground loses the drones; its silhouettes are stored under another key.
    blind = track(search=RandomSearch(), score=HighDice(), background=MedianBackground(threshold=255))
    assert not (blind.trajectories.status == Status.TRACKED).any()
    keys = [set(each.record["input_keys"].values()) for each in (tracked, blind)]
    assert not keys[0] & keys[1]


def test_the_tracks_of_a_method_are_the_result(track):
    tracked = track(method=Hover())
    assert tracked.trajectories.position_m.shape == (NUM_FRAMES, 2, 3)
    assert (tracked.trajectories.position_m == np.asarray(tracked.record["start"]["position_m"])).all()
    assert tracked.record["parts"]["method"]["class"].endswith("Hover")


def test_the_detector_decides_the_detections(track, recording, empty_hall):
    """A method of one's own that reads detections is given those of the detector, and no others."""
    tracked = track({"method": "projection-lines"}, detector=EmptyHallDetector(empty_hall))
    assert tracked.trajectories.seen.all()
    assert mean_error_m(tracked.trajectories, recording) < NEAR_M
    assert tracked.record["parts"]["detector"]["key"]["threshold"] == 25
    given = []

    class Reads(Hover):
        def __call__(self, inputs, report=None):
            given.append(inputs.sightings)
            return super().__call__(inputs, report)

    empty = tuple(next(read_frames(video)) for video in recording.videos.values())
    track(method=Reads(reads_detections=True), detector=EmptyHallDetector(empty))
    # Frame 0 is the picture of the empty hall itself, so nothing differs.
    assert np.isnan(given[0].centre_px[0]).all()
    assert np.isfinite(given[0].centre_px[-1]).any()


class CoarseBackground(MedianBackground):
    """Forgets the reduction that the settings ask for."""

    def foreground(self, learning, frames):
        return (mask[::2] for mask in super().foreground(learning, frames))


def test_parts_that_do_not_fit_are_one_line(track, empty_hall, tmp_path):
    size = "CoarseBackground: expected 8 masks of type uint8 and shape (270, 480)"
    assert_refused(
        lambda: track(background=CoarseBackground()), size, "found uint8 (135, 480)", unchanged=tmp_path
    )
    reads = "detector: expected a method that reads detections"
    assert_refused(lambda: track(detector=EmptyHallDetector(empty_hall)), reads, unchanged=tmp_path)
    # What silhouettes are made of, and so their key, is the class too.
    assert MedianBackground().key == CoarseBackground().key
    assert identify(MedianBackground()) != identify(CoarseBackground())


#: Registers a search and a score by name; in a process of its own, because a plugin stays for the whole process.
REGISTERED_PARTS = """
import psotrack as pt
from own_parts import Dice, RandomSearch
from psotrack.errors import SettingsError
from psotrack.tracking.swarm import tracker_settings

settings = [pt.TrackSettings().changed({name: "own"}) for name in ("swarm.search", "score.kind")]
for each in settings:
    try:
        tracker_settings(each)
    except SettingsError as error:
        print(error)
pt.register_plugin("search", "own", lambda swarm: RandomSearch(step_m=2 * swarm.spread_m))
pt.register_plugin("score", "own", lambda score: Dice(ring=2 * score.windows[-1]))
print(tracker_settings(settings[0]).search)
print(tracker_settings(settings[1]).camera_score)
pt.register_plugin("search", "own", lambda swarm: RandomSearch(shrink=0.5))
print(tracker_settings(settings[0]).search)
"""


def run_python(code, *folders):
    """Run code in a new interpreter that imports from the folders and from this checkout."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (*folders, ROOT)))},
        capture_output=True,
        text=True,
        check=True,
    )


def test_a_registered_plugin_is_found_by_name(tmp_path):
    """The plugin is made from its part of the settings, and a second call replaces the plugin."""
    write_own_parts(tmp_path)
    assert run_python(REGISTERED_PARTS, tmp_path).stdout.splitlines() == [
        "swarm.search: expected one of pso, pso-kernel, found own; no installed package adds more "
        "(entry points psotrack.searches)",
        "score.kind: expected one of soft, hard, found own; no installed package adds more "
        "(entry points psotrack.scores)",
        "RandomSearch(step_m=0.1, shrink=0.8)",
        "Dice(ring=2.0, whole_pixels=False, min_cameras=2)",
        "RandomSearch(step_m=0.05, shrink=0.5)",
    ]


@pytest.mark.parametrize(
    ("part", "value", "face"),
    [
        ("search", 1, "Search, found an object of int"),
        ("score", print, "Score, found an object of builtin_function_or_method"),
        ("method", print, "Method, found an object of builtin_function_or_method"),
        ("background", print, "BackgroundModel, found an object of builtin_function_or_method"),
        ("detector", print, "Detector, found an object of builtin_function_or_method"),
    ],
)
def test_parts_without_the_interface_are_one_line(recording, part, value, face, tmp_path):
    line = f"psotrack: {part}: expected an object with the attributes of psotrack.{face}\n"
    call = partial(pt.track, recording, SETTINGS, cache=tmp_path / "cache", **{part: value})
    assert_refused(call, line, unchanged=tmp_path)


def test_what_cannot_be_registered_is_one_line(tmp_path):
    kinds = "kind: expected one of search, score, method, background, detector, found 'searches'"
    assert_refused(lambda: pt.register_plugin("searches", "own", print), kinds, unchanged=tmp_path)
    makes = "register_plugin(), make: expected a function, found 1"
    assert_refused(lambda: pt.register_plugin("search", "own", 1), makes, unchanged=tmp_path)


#: A package that adds plugins of all kinds; the classes of `OWN_PARTS` follow. Its search returns the tracker's
#: prediction, and its detector reads pictures of the empty hall from a file beside the module.
PACKAGE = """
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from psotrack.geometry import project_boxes
from psotrack.tracking.swarm import camera_weights, foreground_and_area
from psotrack.trajectories import Status, Tracks

@jax.tree_util.register_static
@dataclass(frozen=True)
class Prediction:
    def __call__(self, key, objective, first, region, num_iterations):
        return first[0]

def prediction(settings):
    return Prediction()

def high_dice(settings):
    return HighDice(ring=1.5 * settings.windows[-1])

def hover(settings):
    return Hover(reads_detections=settings.method != "hover")

def median(settings):
    return MedianBackground(reduction=settings.working_reduction)

def empty_hall(settings):
    pictures = np.load(Path(__file__).with_name("empty_hall.npy"))
    return EmptyHallDetector(tuple(pictures), threshold=round(100 * settings.confidence))

def broken(settings):
    return "no detector"
"""
OWN_PARTS = (RandomSearch, Dice, HighDice, Hover, MedianBackground, EmptyHallDetector)
ENTRY_POINTS = """
[psotrack.searches]
prediction = own_parts:prediction
[psotrack.scores]
high-dice = own_parts:high_dice
[psotrack.methods]
hover = own_parts:hover
[psotrack.backgrounds]
median = own_parts:median
absent = own_parts:no_such_function
[psotrack.detectors]
empty-hall = own_parts:empty_hall
broken = own_parts:broken
"""


def write_own_parts(folder):
    """Write the module `own_parts`, which no entry point names yet."""
    (folder / "own_parts.py").write_text("\n\n".join([PACKAGE, *map(inspect.getsource, OWN_PARTS)]))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with an installed package that has entry points."""
    site = tmp_path_factory.mktemp("site")
    write_own_parts(site)
    info = site / "own_parts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-parts\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    return site


@pytest.fixture
def run_track(site, root, run_psotrack, monkeypatch, tmp_path):
    """Runs `psotrack track` with the options where the package of `site` is installed: the tracks and the record."""
    monkeypatch.syspath_prepend(site)
    # A worker may have made this module's folder before: the package would still be imported from there.
    sys.modules.pop("own_parts", None)

    def run_track(*options):
        out = tmp_path / "tracks.csv"
        words = ["track", root / "Simulated_Data" / "S01_D2_A", "--out", out, "--cache", tmp_path / "cache"]
        words += ["--init", "truth", "--drone-size", "0.5,0.5,0.2", "--cameras", ",".join(CAMERAS)]
        ran = run_psotrack(*words, "--particles", 16, "--jobs", 1, "--force", *options)
        assert ran.code == 0, ran
        return pt.read_trajectories(out, fps=25.0), json.loads(out.with_suffix(".json").read_text())

    return run_track


def test_search_background_and_score_by_entry_points(run_track):
    tracks, record = run_track("--search", "prediction", "--background", "median", "--score", "hard")
    assert record["settings"]["swarm"]["search"] == "prediction"
    assert record["parts"] == {
        "background": {"class": "own_parts.MedianBackground", "key": {"threshold": 25, "reduction": 1}}
    }
    # The measured position is always the predicted one, so the drones fly on with the velocity of frame 0.
    steps_m = np.diff(tracks.position_m, axis=0)
    assert np.abs(steps_m).max() > 0.01
    np.testing.assert_allclose(steps_m, np.broadcast_to(steps_m[0], steps_m.shape), atol=1e-3)
    tracks, record = run_track("--search", "prediction", "--score", "high-dice")
    assert record["settings"]["score"]["kind"] == "high-dice"
    # The fitness is that of HighDice, as in Python: 0.9, rounded to float32, or more.
    assert (tracks.fitness >= np.float32(0.9) - 1e-6).all()
    assert (tracks.fitness < 1.0).all()


def test_a_method_and_a_detector_by_entry_points(run_track, site, recording, empty_hall):
    """No method of the package writes such tracks of flying drones: they stay where they are at frame 0."""
    tracks, record = run_track("--method", "hover")
    assert record["settings"]["method"] == "hover"
    start_m = np.asarray(record["start"]["position_m"])
    np.testing.assert_allclose(tracks.position_m, np.broadcast_to(start_m, (NUM_FRAMES, 2, 3)), atol=1e-4)
    np.save(site / "empty_hall.npy", np.stack(empty_hall))
    tracks, record = run_track("--method", "projection-lines", "--detector", "empty-hall")
    detector = record["parts"]["detector"]
    assert detector["class"] == "own_parts.EmptyHallDetector"
    # The threshold is made from the smallest confidence of the detector's settings, 0.25.
    assert detector["key"]["threshold"] == 25
    assert tracks.seen.all()
    assert mean_error_m(tracks, recording) < NEAR_M


#: What asks for a plugin, or the name of a detector for a command, and how the line goes on.
NOT_THERE = [
    (
        lambda: find_search(pt.SwarmSettings(search="predict")),
        "swarm.search: expected one of pso, pso-kernel, prediction, found predict; did you mean prediction?",
    ),
    (
        lambda: find_score(pt.ScoreSettings(kind="iou")),
        "score.kind: expected one of soft, hard, high-dice, found iou",
    ),
    (
        lambda: find_background("mean", ForegroundSettings()),
        "background: expected one of mog2, living, absent, median, found mean",
    ),
    (
        lambda: find_background("absent", ForegroundSettings()),
        "background absent: expected own_parts:no_such_function to be importable, found module 'own_parts' has no "
        "attribute 'no_such_function'",
    ),
    ("yolo", "detector: expected one of MODEL.onnx (a file), broken, empty-hall, found yolo"),
    (
        "broken",
        "detector broken: expected an object with the attributes of psotrack.Detector, found an object of str",
    ),
]


@pytest.mark.parametrize(("find", "message"), NOT_THERE)
def test_the_message_names_what_is_installed(site, root, run_psotrack, monkeypatch, tmp_path, find, message):
    monkeypatch.syspath_prepend(site)
    sequence = root / "Simulated_Data" / "S01_D2_A"

    def detect():
        return run_psotrack("detect", sequence, "--detector", find, "--out", tmp_path / "boxes")

    assert_refused(detect if isinstance(find, str) else find, f"psotrack: {message}\n", unchanged=tmp_path)

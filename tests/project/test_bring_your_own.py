"""Search, score, method, background model and detector of one's own, from Python and by name on the command line."""

import json
from dataclasses import dataclass
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_refused

import psotrack as pt
from psotrack.foreground.silhouettes import ForegroundSettings, find_background
from psotrack.geometry import project_boxes
from psotrack.recordings import read_frames
from psotrack.support import identify
from psotrack.tracking.swarm import camera_weights, find_search, foreground_and_area
from psotrack.trajectories import Status, Tracks

pytestmark = pytest.mark.slow

#: Few particles, because compiling takes most of the time.
SETTINGS = {
    "init": "truth",
    "drones.size_m": (0.3, 0.3, 0.15),
    "swarm.particles": 16,
    "swarm.iterations": 6,
    "silhouettes.reduction": 1,
    "silhouettes.working_reduction": 1,
    "silhouettes.min_blob_px": 8,
}
#: Pictures of the empty hall, whose walls are grey.
EMPTY_HALL = (np.full((240, 320, 3), 125, np.uint8),)


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


class CoarseBackground(MedianBackground):
    """Forgets the reduction that the settings ask for."""

    def foreground(self, learning, frames):
        for mask in super().foreground(learning, frames):
            yield mask[::2]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Prediction:
    """A search that keeps the tracker's prediction."""

    def __call__(self, key, objective, first, region, num_iterations):
        return first[0]


def prediction(settings):
    return Prediction()


def high_dice(settings):
    return HighDice(ring=1.5 * settings.windows[-1])


def hover(settings):
    return Hover(reads_detections=True)


def median(settings):
    return MedianBackground(reduction=settings.working_reduction)


def empty_hall(settings):
    return EmptyHallDetector(EMPTY_HALL, threshold=round(100 * settings.confidence))


#: What an installed package adds; the last function is missing.
ENTRY_POINTS = f"""
[psotrack.searches]
prediction = {__name__}:prediction
[psotrack.scores]
high-dice = {__name__}:high_dice
[psotrack.methods]
hover = {__name__}:hover
[psotrack.detectors]
empty-hall = {__name__}:empty_hall
[psotrack.backgrounds]
median = {__name__}:median
absent = {__name__}:no_such_function
"""


@pytest.fixture(autouse=True)
def installed(tmp_path_factory, monkeypatch):
    """A package is installed whose entry points name functions of this module; nothing is registered."""
    site = tmp_path_factory.mktemp("site")
    info = site / "own_parts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-parts\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr("psotrack.support.plugins._registered", {})


@pytest.fixture(scope="module")
def recording(flight):
    return pt.read_recording(flight)


@pytest.fixture(scope="module")
def track(recording, tmp_path_factory):
    """Tracks the recording with parts of one's own, in this process."""
    return partial(pt.track, recording, SETTINGS, cache=tmp_path_factory.mktemp("cache"), jobs=1)


@pytest.fixture
def run_track(recording, run_psotrack, tmp_path):
    """Runs `psotrack track` with some options: the tracks and the record."""

    def run_track(*options):
        out = tmp_path / "tracks.csv"
        words = ["track", recording.folder, "--out", out, "--cache", tmp_path / "cache", "--jobs", 1]
        words += ["--init", "truth", "--drone-size", "0.3,0.3,0.15", "--particles", 16]
        run_psotrack(*words, *options).ended()
        record = json.loads(out.with_suffix(".json").read_text())
        return pt.read_trajectories(out, fps=25.0), record

    return run_track


def assert_hovering(tracks, record):
    """The drones stay where they are at frame 0, which no method of the package says of flying drones."""
    for position_m in tracks.position_m:
        np.testing.assert_allclose(position_m, record["start"]["position_m"], atol=1e-4)


def test_search_score_and_background_together_find_the_drones(track, recording):
    parts = {"search": RandomSearch(), "score": HighDice()}
    tracked = track(background=MedianBackground(), **parts)
    trajectories = tracked.trajectories
    assert trajectories.seen.all()
    # A drone is 0.3 m wide: with a larger mean error the tracks do not follow the drones.
    assert pt.evaluate(trajectories, recording.truth).mean_error_m < 0.1
    recorded = tracked.record["parts"]
    assert recorded["search"]["class"] == f"{__name__}.RandomSearch"
    assert recorded["score"]["class"] == f"{__name__}.HighDice"
    assert recorded["background"] == identify(MedianBackground())
    # The score decides the fitness, which is unknown where a drone coasts.
    fitness = trajectories.fitness[trajectories.status == Status.TRACKED]
    assert fitness.min() >= 0.9
    assert fitness.max() < 1.0
    # A model that sees no foreground loses the drones; its silhouettes are stored under another key.
    blind = track(background=MedianBackground(threshold=255), **parts)
    assert not (blind.trajectories.status == Status.TRACKED).any()
    stored = set(tracked.record["input_keys"].values())
    assert stored.isdisjoint(blind.record["input_keys"].values())


def test_a_method_is_given_the_boxes_of_the_detector_and_its_tracks_are_the_result(track, recording):
    given = []

    class Reads(Hover):
        def __call__(self, inputs, report=None):
            given.append(inputs.sightings)
            return super().__call__(inputs, report)

    first = tuple(next(read_frames(video)) for video in recording.videos.values())
    tracked = track(method=Reads(reads_detections=True), detector=EmptyHallDetector(first))
    assert_hovering(tracked.trajectories, tracked.record)
    # Frame 0 is the picture of the empty hall itself, so nothing differs.
    assert np.isnan(given[0].centre_px[0]).all()
    assert np.isfinite(given[0].centre_px[-1]).any()


def test_search_background_and_score_by_entry_points(run_track):
    tracks, record = run_track("--search", "prediction", "--background", "median", "--score", "hard")
    # Small images are not reduced.
    assert record["parts"] == {"background": identify(MedianBackground(reduction=1))}
    # The measured position is always the predicted one, so the drones fly on with the velocity of frame 0.
    steps_m = np.diff(tracks.position_m, axis=0)
    assert np.abs(steps_m).max() > 0.01
    np.testing.assert_allclose(steps_m, np.broadcast_to(steps_m[0], steps_m.shape), atol=1e-3)
    tracks, _ = run_track("--score", "high-dice", "--force")
    # The fitness is that of HighDice, as in Python: 0.9, rounded to float32, or more.
    assert (tracks.fitness >= np.float32(0.9) - 1e-6).all()
    assert (tracks.fitness < 1.0).all()


def test_a_method_and_a_detector_by_entry_points(run_track):
    tracks, record = run_track("--method", "hover", "--detector", "empty-hall")
    assert_hovering(tracks, record)
    # The threshold is made from the smallest confidence of the detector's settings, 0.25.
    assert record["parts"]["detector"] == identify(EmptyHallDetector(EMPTY_HALL, threshold=25))


def test_a_registered_plugin_is_made_from_its_part_of_the_settings_and_replaced():
    pt.register_plugin("search", "own", lambda swarm: RandomSearch(step_m=2 * swarm.spread_m))
    assert find_search(pt.SwarmSettings(search="own")) == RandomSearch(step_m=0.1)
    pt.register_plugin("search", "own", lambda swarm: RandomSearch(shrink=0.5))
    assert find_search(pt.SwarmSettings(search="own")) == RandomSearch(shrink=0.5)


def test_what_silhouettes_are_made_of_is_the_class_too():
    assert MedianBackground().key == CoarseBackground().key
    assert identify(MedianBackground()) != identify(CoarseBackground())


#: What an object that is no part lacks.
FACE = "expected an object with the attributes of psotrack."
#: Parts of `track` that do not fit, or calls with names that lead to no plugin, and what the line says.
BAD = [
    ({"search": 1}, f"search: {FACE}Search, found an object of int"),
    ({"background": CoarseBackground()}, "expected 14 masks of type uint8 and shape (240, 320)"),
    ({"detector": EmptyHallDetector(EMPTY_HALL)}, "expected a method that reads detections"),
    (
        partial(find_search, pt.SwarmSettings(search="predict")),
        "swarm.search: expected one of pso, pso-kernel, prediction, found predict; did you mean prediction?",
    ),
    (
        partial(find_background, "absent", ForegroundSettings()),
        "background absent: expected test_bring_your_own:no_such_function to be importable, found module ",
    ),
    (
        partial(pt.register_plugin, "searches", "own", print),
        "kind: expected one of search, score, method, background, detector, found 'searches'",
    ),
]


@pytest.mark.parametrize(("bad", "line"), BAD)
def test_parts_that_do_not_fit_and_names_without_a_plugin_are_one_line(track, bad, line, tmp_path):
    assert_refused(bad if callable(bad) else lambda: track(**bad), line, unchanged=tmp_path)

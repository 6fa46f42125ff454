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
from worlds import NUM_FRAMES, two_flights

import psotrack as pt
from psotrack.foreground.detection import DetectorSettings, find_detector
from psotrack.foreground.silhouettes import ForegroundSettings, find_background
from psotrack.geometry import project_boxes
from psotrack.recordings import read_frames
from psotrack.support import identify
from psotrack.tracking.swarm import camera_weights, find_score, find_search, foreground_and_area
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
#: A drone is 0.3 m wide: with a larger mean error the tracks do not follow the drones.
NEAR_M = 0.1
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
        return (mask[::2] for mask in super().foreground(learning, frames))


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
    return Hover()


def median(settings):
    return MedianBackground(reduction=settings.working_reduction)


def empty_hall(settings):
    return EmptyHallDetector(EMPTY_HALL, threshold=round(100 * settings.confidence))


def broken(settings):
    return "no detector"


#: What an installed package adds: group of entry points -> name of the part and of the function that makes it.
ENTRY_POINTS = {
    "searches": {"prediction": "prediction"},
    "scores": {"high-dice": "high_dice"},
    "methods": {"hover": "hover"},
    "backgrounds": {"median": "median", "absent": "no_such_function"},
    "detectors": {"empty-hall": "empty_hall", "broken": "broken"},
}


@pytest.fixture(autouse=True)
def installed(tmp_path_factory, monkeypatch):
    """A package is installed whose entry points name functions of this module; nothing is registered."""
    site = tmp_path_factory.mktemp("site")
    info = site / "own_parts-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-parts\nVersion: 1.0\n")
    lines = []
    for group, parts in ENTRY_POINTS.items():
        lines += [f"[psotrack.{group}]", *(f"{name} = {__name__}:{made}" for name, made in parts.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(site)
    monkeypatch.setattr("psotrack.support.plugins._registered", {})


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return two_flights(tmp_path_factory) / "flight"


@pytest.fixture(scope="module")
def recording(flight):
    return pt.read_recording(flight)


@pytest.fixture(scope="module")
def track(recording, tmp_path_factory):
    """Tracks the recording with parts of one's own, in this process."""
    return partial(pt.track, recording, SETTINGS, cache=tmp_path_factory.mktemp("cache"), jobs=1)


@pytest.fixture
def run_track(flight, run_psotrack, tmp_path):
    """Runs `psotrack track` with some options: the tracks and the record."""

    def run_track(*options):
        out = tmp_path / "tracks.csv"
        words = ["track", flight, "--out", out, "--cache", tmp_path / "cache", "--jobs", 1, "--force"]
        words += ["--init", "truth", "--drone-size", "0.3,0.3,0.15", "--particles", 16, *options]
        ran = run_psotrack(*words)
        assert ran.code == 0, ran
        return pt.read_trajectories(out, fps=25.0), json.loads(out.with_suffix(".json").read_text())

    return run_track


def mean_error_m(trajectories, recording):
    return pt.evaluate(trajectories, recording.truth).mean_error_m


def test_search_score_and_background_together_find_the_drones(track, recording):
    parts = {"search": RandomSearch(), "score": HighDice()}
    tracked = track(background=MedianBackground(), **parts)
    assert tracked.trajectories.seen.all()
    assert mean_error_m(tracked.trajectories, recording) < NEAR_M
    names = {kind: part["class"].rpartition(".")[2] for kind, part in tracked.record["parts"].items()}
    assert names == {"search": "RandomSearch", "score": "HighDice", "background": "MedianBackground"}
    assert tracked.record["parts"]["background"]["key"] == {"threshold": 25, "reduction": 1}
    # The score decides the fitness, which is unknown where a drone coasts.
    fitness = tracked.trajectories.fitness[tracked.trajectories.status == Status.TRACKED]
    assert len(fitness) > NUM_FRAMES
    assert (fitness >= 0.9).all()
    assert (fitness < 1.0).all()
    # A model that sees no foreground loses the drones; its silhouettes are stored under another key.
    blind = track(background=MedianBackground(threshold=255), **parts)
    assert not (blind.trajectories.status == Status.TRACKED).any()
    assert not {*tracked.record["input_keys"].values()} & {*blind.record["input_keys"].values()}


def test_a_method_is_given_the_boxes_of_the_detector_and_its_tracks_are_the_result(track, recording):
    given = []

    class Reads(Hover):
        def __call__(self, inputs, report=None):
            given.append(inputs.sightings)
            return super().__call__(inputs, report)

    first = tuple(next(read_frames(video)) for video in recording.videos.values())
    tracked = track(method=Reads(reads_detections=True), detector=EmptyHallDetector(first))
    start_m = np.asarray(tracked.record["start"]["position_m"])
    assert (tracked.trajectories.position_m == np.broadcast_to(start_m, (NUM_FRAMES, 2, 3))).all()
    assert tracked.record["parts"]["method"]["class"].endswith("Reads")
    # Frame 0 is the picture of the empty hall itself, so nothing differs.
    assert np.isnan(given[0].centre_px[0]).all()
    assert np.isfinite(given[0].centre_px[-1]).any()


def test_search_background_and_score_by_entry_points(run_track):
    tracks, record = run_track("--search", "prediction", "--background", "median", "--score", "hard")
    assert record["settings"]["swarm"]["search"] == "prediction"
    # Small images are not reduced.
    key = {"threshold": 25, "reduction": 1}
    assert record["parts"] == {"background": {"class": f"{__name__}.MedianBackground", "key": key}}
    # The measured position is always the predicted one, so the drones fly on with the velocity of frame 0.
    steps_m = np.diff(tracks.position_m, axis=0)
    assert np.abs(steps_m).max() > 0.01
    np.testing.assert_allclose(steps_m, np.broadcast_to(steps_m[0], steps_m.shape), atol=1e-3)
    tracks, record = run_track("--search", "prediction", "--score", "high-dice")
    assert record["settings"]["score"]["kind"] == "high-dice"
    # The fitness is that of HighDice, as in Python: 0.9, rounded to float32, or more.
    assert (tracks.fitness >= np.float32(0.9) - 1e-6).all()
    assert (tracks.fitness < 1.0).all()


def test_a_method_and_a_detector_by_entry_points(run_track, recording):
    """No method of the package writes such tracks of flying drones: they stay where they are at frame 0."""
    tracks, record = run_track("--method", "hover")
    assert record["settings"]["method"] == "hover"
    start_m = np.asarray(record["start"]["position_m"])
    np.testing.assert_allclose(tracks.position_m, np.broadcast_to(start_m, (NUM_FRAMES, 2, 3)), atol=1e-4)
    tracks, record = run_track("--method", "projection-lines", "--detector", "empty-hall")
    detector = record["parts"]["detector"]
    assert detector["class"] == f"{__name__}.EmptyHallDetector"
    # The threshold is made from the smallest confidence of the detector's settings, 0.25.
    assert detector["key"]["threshold"] == 25
    assert tracks.seen.all()
    assert mean_error_m(tracks, recording) < NEAR_M


def test_a_registered_plugin_is_made_from_its_part_of_the_settings_and_replaced():
    pt.register_plugin("search", "own", lambda swarm: RandomSearch(step_m=2 * swarm.spread_m))
    pt.register_plugin("score", "own", lambda score: Dice(ring=2 * score.windows[-1]))
    assert find_search(pt.SwarmSettings(search="own")) == RandomSearch(step_m=0.1)
    assert find_score(pt.ScoreSettings(kind="own")) == Dice(ring=2.0)
    pt.register_plugin("search", "own", lambda swarm: RandomSearch(shrink=0.5))
    assert find_search(pt.SwarmSettings(search="own")) == RandomSearch(shrink=0.5)


def test_what_silhouettes_are_made_of_is_the_class_too():
    assert MedianBackground().key == CoarseBackground().key
    assert identify(MedianBackground()) != identify(CoarseBackground())


#: What an object that is no part lacks.
FACE = "expected an object with the attributes of psotrack."
#: The call, with a function that tracks, and what the line says.
BAD = [
    (lambda track: track(search=1), f"search: {FACE}Search, found an object of int"),
    (lambda track: track(score=print), f"score: {FACE}Score, found an object of builtin_function"),
    (lambda track: track(method=print), f"method: {FACE}Method, found an object of builtin_function"),
    (lambda track: track(background=print), f"background: {FACE}BackgroundModel, found an object of builtin"),
    (lambda track: track(detector=print), f"detector: {FACE}Detector, found an object of builtin_function"),
    (
        lambda track: find_detector("broken", DetectorSettings()),
        f"detector broken: {FACE}Detector, found an ",
    ),
    (
        lambda track: track(background=CoarseBackground()),
        "expected 14 masks of type uint8 and shape (240, 320)",
    ),
    (lambda track: track(detector=EmptyHallDetector(EMPTY_HALL)), "expected a method that reads detections"),
    (
        lambda track: pt.register_plugin("searches", "own", print),
        "kind: expected one of search, score, method, background, detector, found 'searches'",
    ),
    (lambda track: pt.register_plugin("search", "own", 1), "make: expected a function, found 1"),
    (
        lambda track: find_search(pt.SwarmSettings(search="predict")),
        "swarm.search: expected one of pso, pso-kernel, prediction, found predict; did you mean prediction?",
    ),
    (
        lambda track: find_detector("yolo", DetectorSettings()),
        "detector: expected one of MODEL.onnx (a file), broken, empty-hall, found yolo",
    ),
    (
        lambda track: find_background("absent", ForegroundSettings()),
        "background absent: expected test_bring_your_own:no_such_function to be importable, found module ",
    ),
]


@pytest.mark.parametrize(("call", "line"), BAD)
def test_parts_that_do_not_fit_are_one_line(track, call, line, tmp_path):
    assert_refused(partial(call, track), line, unchanged=tmp_path)

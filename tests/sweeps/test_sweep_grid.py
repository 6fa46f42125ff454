"""Grids: the cells of a file, errors in one line with the place in the file, keys; and perturbations of a cell's input.

Perturbations are compared with frames by hand, SciPy's angles and moments of the binomial.
"""

import functools
import itertools
import math
import pickle
import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers import assert_refused, cameras_of, ring_rig, silhouettes_in_memory, with_cameras
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.recordings import Recording, VideoInfo
from psotrack.settings import ScoreSettings, SwarmSettings, TrackSettings
from psotrack.sweeps import Perturbation, cell_key, grid, perturb, read_grid
from psotrack.sweeps.cells import choose_cameras

FILE = """
sequences = ["S01_D2_A", "S04_D10"]
runs = 10
[settings]
swarm.spread_m = 1
silhouettes.reduction = 8
silhouettes.background = "mog2"
[methods.paper]
swarm.kind = "joint"
score.kind = "hard"
[methods.ours]
silhouettes.reduction = 2
[grid]
swarm.particles = [20, 50, 100]
"silhouettes.var_threshold" = [8, 9.5]
cameras = ["all", 4, ["cam1i", "cam2i"]]
draws = 3
"""
SMALL = {"sequences": ["S01"], "grid": {"swarm.particles": [20, 50]}}
INPUT = {"cam1": "ab", "cam2": "cd"}
SAME = "expected cells that differ, found the same cell as with"


def cells_of(**changes):
    return grid(SMALL | changes).cells()


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """The cells of the file."""
    path = tmp_path_factory.mktemp("grid") / "grid.toml"
    path.write_text(FILE)
    return read_grid(path).cells()


def test_every_combination_is_a_cell_with_a_key_of_its_own(cells):
    # Three draws where the cameras are a number, and one draw otherwise.
    kept = [("all", 0), ("4", 0), ("4", 1), ("4", 2), ("cam1i+cam2i", 0)]
    sequences, methods = ["S01_D2_A", "S04_D10"], ["paper", "ours"]
    expected = itertools.product(sequences, methods, [20, 50, 100], [8.0, 9.5], kept)
    for cell, (sequence, method, particles, threshold, (cameras, draw)) in zip(cells, expected, strict=True):
        assert cell.sequence == sequence
        assert cell.method == method
        assert list(cell.axes.values()) == [particles, threshold, cameras, draw]
        assert cell.settings.swarm.particles == particles
        assert cell.settings.silhouettes.var_threshold == threshold
        assert cell.perturbation == Perturbation(draw=draw)
    assert list(cells[0].axes) == ["swarm.particles", "silhouettes.var_threshold", "cameras", "draw"]
    assert [cell.cameras for cell in cells[:5]] == [None, 4, 4, 4, ("cam1i", "cam2i")]
    assert len({cell_key(cell, INPUT) for cell in cells}) == len(cells)
    assert pickle.loads(pickle.dumps(cells)) == cells
    # Names lead to inner tables, or are dotted; lists may be tuples.
    nested = {"sequences": ("S01",), "grid": {"swarm": {"particles": (20, 50)}}}
    assert grid(nested).cells() == grid(SMALL).cells()


def test_a_cell_has_the_settings_of_the_file(cells):
    paper = cells[0]
    assert paper.settings == TrackSettings(
        silhouettes=SilhouetteSettings(background="mog2", reduction=8, var_threshold=8.0),
        swarm=SwarmSettings(particles=20, spread_m=1.0, kind="joint"),
        score=ScoreSettings(kind="hard"),
    )
    assert paper.runs == 10
    assert paper.seeds == range(10)
    assert paper.frames is None
    # Each method and sequence has 30 cells.
    ours = cells[30]
    assert ours.method == "ours"
    assert ours.settings.swarm.spread_m == 1.0
    assert ours.settings.silhouettes.reduction == 2
    # A whole number becomes a float where the setting is a float.
    assert isinstance(paper.axes["silhouettes.var_threshold"], float)
    # Without axes and methods there is one cell per sequence.
    (cell,) = grid({"sequences": [Path("data/S01")], "first_seed": 5, "runs": 2}).cells()
    assert cell.sequence == "data/S01"
    assert cell.method == ""
    assert cell.settings == TrackSettings()
    assert list(cell.seeds) == [5, 6]


def test_perturbations_and_frames_can_be_varied():
    varied = {"extrinsics_deg": [0, 0.2], "clock_frames": [1], "flipped": [0.03], "frames": [100]}
    cells = cells_of(grid=varied | {"draws": 2})
    assert len(cells) == 4
    last = cells[-1]
    assert last.perturbation == Perturbation(extrinsics_deg=0.2, clock_frames=1.0, flipped=0.03, draw=1)
    assert last.frames == 100
    assert list(last.axes) == ["extrinsics_deg", "clock_frames", "flipped", "frames", "draw"]
    # Without draws there is one random draw.
    assert [cell.perturbation.draw for cell in cells_of(grid={"cameras": [3, 4]})] == [0, 0]


#: Lines of a grid's file -> words of the error: the place in the file, what is expected and found, and the remedy.
BAD = {
    'sequnces = ["S01"]': ("sequnces: expected an allowed name", "did you mean sequences?"),
    'settings.swarm = "joint"': ("settings.swarm: expected a table with names, found none",),
    "grid.draw = [20]": ("grid.draw: ", "did you mean draws?"),
    # Right names, wrong places.
    "settings.cameras = 4": ("settings.cameras: ", "it belongs in [grid], with a list of values"),
    '"swarm.particles" = 4': ("swarm.particles: ", "it belongs in [settings], or in [grid] with a list of "),
    "grid.seed = [1, 2]": ("grid.seed: ", "every run has a seed of its own: set runs = 10, and first_seed "),
    "methods.a.swarm.particles = 20": (
        "grid.swarm.particles: expected the name in one place, found methods.a.swarm.particles as well",
    ),
    'settings = {"swarm.spread_m" = 4, swarm.spread_m = 8}': (
        "settings.swarm.spread_m: expected the name once, found the name twice",
    ),
    # Kinds of values, and values that are out of range.
    "runs = 2\nfirst_seed = 4294967295": (
        "first_seed, last run, seed: expected a whole number of at most 4294967295, found 4294967296",
    ),
    "runs = 0": ("runs: expected a whole number of at least 1, found 0",),
    "grid.swarm.particles = [20, 1]": (
        "grid.swarm.particles[1]: expected a whole number of at least 2, found 1",
    ),
    "grid.swarm.particles = 20": ("grid.swarm.particles: expected a list of values, found 20; write [20]",),
    "grid.swarm.particles = []": ("grid.swarm.particles: expected a list of values, found []",),
    **dict.fromkeys(
        ("grid.cameras = [0]", "grid.cameras = [true]", 'grid.cameras = [["a", "b", "a"]]'),
        ('grid.cameras[0]: expected "all", a number above 0, or a list of different names, found ',),
    ),
    # What does not fit together.
    "grid.silhouettes.reduction = [4, 6]\nmethods.a.silhouettes.working_reduction = 4": (
        "grid.silhouettes.reduction[1]: expected a multiple of working_reduction, 4, found 6",
    ),
    "grid.swarm.spread_m = [0.1, 1, 1.0]": (f"grid.swarm.spread_m[2]: {SAME} grid.swarm.spread_m[1]",),
    'methods = {a = {}, b = {detections = "yolo"}}': (f"methods.b: {SAME} methods.a",),
    # A perturbation of silhouettes has no effect on detections.
    'settings.method = "projection-lines"\ngrid.flipped = [0.0, 0.03]': (
        "grid.flipped[1]: expected 0 for a method that reads detections, ",
        "found 0.03",
    ),
    'grid = {flipped = [0.0], cameras = [["a"]], draws = 3}': (
        "grid.draws: expected a random choice in [grid]: a number of cameras, ",
        "found none",
    ),
}


@pytest.mark.parametrize("lines", BAD)
def test_an_error_is_one_line_with_the_place_in_the_file(lines, tmp_path):
    words, *more = BAD[lines]
    bad = functools.partial(grid, SMALL | tomllib.loads(lines), where="table5.toml")
    assert_refused(bad, f"table5.toml: {words}", *more, unchanged=tmp_path)


def test_messages_of_a_file_begin_with_its_path(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(FILE.replace("swarm.kind", "swram.kind"))
    assert_refused(lambda: read_grid(path), f"{path}: methods.paper.swram.kind: ", unchanged=tmp_path)


# --- keys


def test_what_decides_the_rows_is_in_the_key_alone():
    """Neither the number of runs nor the place of the sequence is."""
    base = {"sequences": ["S01"], "settings": {"swarm.particles": 20}, "grid": {}}
    (few,) = grid(base | {"runs": 2}).cells()
    elsewhere = {"sequences": ["/data/elsewhere/S01"], "runs": 9, "first_seed": 4}
    (many,) = grid(elsewhere | {"grid": {"swarm.particles": [20]}}).cells()
    assert few != many
    turned = {"cam2": INPUT["cam2"], "cam1": INPUT["cam1"]}
    assert cell_key(few, INPUT) == cell_key(many, turned)
    assert re.fullmatch("[0-9a-f]{20}-[0-9a-f]{20}", cell_key(few, INPUT))
    changes = [
        {},
        {"sequences": ["S02"]},
        {"settings": {"swarm.particles": 21}},
        {"settings": {"swarm.particles": 20, "silhouettes.reduction": 8}},
        {"methods": {"paper": {}}},
        {"grid": {"frames": [100]}},
        {"grid": {"cameras": [["cam1", "cam2"]]}},
        {"grid": {"flipped": [0.1]}},
        {"grid": {"cameras": [2], "draws": 2}},
    ]
    keys = [cell_key(few, INPUT | {"cam2": "ce"})]
    for change in changes:
        keys += [cell_key(cell, INPUT) for cell in grid(base | change).cells()]
    # The last change makes two cells.
    assert len(keys) == len(changes) + 2
    assert len(set(keys)) == len(keys)


# --- perturbations

FRAMES, REDUCTION = 70, 4
EVERYTHING = Perturbation(extrinsics_deg=0.3, clock_frames=1.5, flipped=0.05)


def flown(num_cameras=5, frames=None):
    """A sequence, and silhouettes: all cameras show the frames, or each shows random ones."""
    rig = ring_rig(num_cameras, image_size_wh=(28, 20))
    if frames is None:
        shown = np.random.default_rng(3).integers(0, 256, (FRAMES, num_cameras, 5, 7), np.uint8)
    else:
        shown = frames[:, None].repeat(num_cameras, axis=1)
    videos = {name: VideoInfo(Path(f"{name}.avi"), len(shown), 25.0, (28, 20)) for name in rig.names}
    recording = Recording("S", Path("S"), cameras_of(rig, video=videos))
    return recording, silhouettes_in_memory(rig, shown, REDUCTION)


def frames_of(silhouettes):
    return silhouettes.read(0, silhouettes.num_frames)


def perturbed(perturbation, cameras=None, flight=None):
    """Poses of the cameras, and frames (frames, cameras, height, width), after a perturbation."""
    sequence, silhouettes = perturb(*(flight or flown()), perturbation, cameras)
    return sequence.rig.cameras.T_cam_world, frames_of(silhouettes)


def test_random_numbers_depend_on_the_draw_alone():
    """Not on other perturbations, nor on other cameras; and the input does not change."""
    flight = flown()
    poses, frames = perturbed(EVERYTHING, flight=flight)
    assert perturb(*flight, Perturbation(draw=3), None) == flight
    untouched, _ = flown()
    np.testing.assert_array_equal(flight[0].rig.cameras.T_cam_world, untouched.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(frames_of(flight[1]), frames_of(flown()[1]))
    other_poses, other_frames = perturbed(msgspec.structs.replace(EVERYTHING, draw=1))
    assert not np.allclose(other_poses, poses)
    assert (other_frames != frames).any()
    turned_alone, _ = perturbed(Perturbation(extrinsics_deg=0.3))
    np.testing.assert_array_equal(poses, turned_alone)
    # Clocks are perturbed before pixels, so both perturbations at once are the same as one after the other.
    late = perturb(*flown(), Perturbation(clock_frames=1.5), None)
    _, then_flipped = perturbed(Perturbation(flipped=0.05), flight=late)
    np.testing.assert_array_equal(frames, then_flipped)
    few_poses, few_frames = perturbed(EVERYTHING, ("c3", "c1"))
    np.testing.assert_array_equal(few_poses, poses[[3, 1]])
    np.testing.assert_array_equal(few_frames, frames[:, [3, 1]])


def test_cameras_are_kept_by_name_or_chosen_at_random(tmp_path):
    chosen, _ = perturb(*flown(), Perturbation(draw=2), 3)
    assert chosen.rig.names == choose_cameras(("c0", "c1", "c2", "c3", "c4"), 3, 2)
    sequence, silhouettes = perturb(*flown(), Perturbation(), ("c4", "c2"))
    assert sequence.rig.names == silhouettes.cameras == tuple(silhouettes.keys) == ("c4", "c2")
    assert tuple(sequence.videos) == ("c4", "c2")
    # Not every method needs videos and silhouettes.
    without = with_cameras(sequence, video=dict.fromkeys(sequence.rig.names))
    assert perturb(without, None, Perturbation(), ("c2",))[0].rig.names == ("c2",)
    np.testing.assert_array_equal(frames_of(silhouettes), frames_of(flown()[1])[:, [4, 2]])
    words = "cameras: expected some of c0, ", "found c9"
    assert_refused(lambda: perturbed(Perturbation(), ("c0", "c9")), *words, unchanged=tmp_path)
    words = "cameras: expected 1 to 5, the number of cameras, found 6"
    assert_refused(lambda: perturbed(Perturbation(), 6), words, unchanged=tmp_path)


@given(num_cameras=st.integers(1, 7), data=st.data())
def test_draws_use_every_subset_before_a_subset_is_repeated(num_cameras, data):
    names = tuple("abcdefg"[:num_cameras])
    count = data.draw(st.integers(1, num_cameras))
    every = list(itertools.combinations(names, count))
    drawn = [choose_cameras(names, count, draw) for draw in range(len(every))]
    # `combinations` keeps the order of the names, as subsets must.
    assert sorted(drawn) == every
    assert choose_cameras(names, count, len(every)) == drawn[0]


def test_cameras_turn_about_their_own_centres_by_the_angle():
    sequence, silhouettes = flown(7)
    before = sequence.rig.cameras
    vectors = []
    for angle_deg in (0.2, 0.8):
        turned, same = perturb(sequence, silhouettes, Perturbation(extrinsics_deg=angle_deg, draw=4), None)
        assert same is silhouettes
        after = turned.rig.cameras
        # Metres; rounding of float64 at some metres.
        np.testing.assert_allclose(after.centre_world, before.centre_world, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(after.T_cam_world[:, 3], before.T_cam_world[:, 3])
        R = after.T_cam_world[:, :3, :3] @ before.T_cam_world[:, :3, :3].swapaxes(-1, -2)
        vectors.append(Rotation.from_matrix(R).as_rotvec())
    axes = vectors[0] / np.radians(0.2)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=-1), 1, rtol=1e-9)
    # All cameras turn about different axes, and a wider turn is about the same axis.
    assert np.abs(axes @ axes.T - np.eye(7)).max() < 0.999
    np.testing.assert_allclose(vectors[1], 4 * vectors[0], rtol=1e-6)


@pytest.mark.parametrize("clock_frames", [0.5, 1.0, 3.7])
def test_late_cameras_show_earlier_frames(clock_frames):
    """Brightness 3 f at frame f: a camera that is late by s shows 3 (f - s), and 0 before its first frame."""
    number = np.arange(FRAMES)[:, None, None]
    ramp = np.broadcast_to(3 * number, (FRAMES, 5, 7)).astype(np.uint8)
    _, late = perturbed(Perturbation(clock_frames=clock_frames), flight=flown(40, ramp))
    shown = late[..., 0, 0].astype(float)
    # Only frames without clipped values are used. The mean removes rounding to grey levels, which is at most a half.
    behind = number[4:, 0] - shown[4:] / 3
    lateness = behind.mean(axis=0)
    assert np.abs(behind - lateness).max() < 0.5
    expected = np.maximum(3 * (number[:, 0] - lateness), 0)
    # A half from rounding of the values, and a half from rounding of the delay.
    assert np.abs(shown - expected).max() <= 1.01
    # The smallest of 40 uniform delays is 1/41 of the range on average, and above 0.25 with a probability of 1e-5.
    assert -1 / 6 <= lateness.min() <= 0.25 * clock_frames + 1 / 6
    assert 0.75 * clock_frames - 1 / 6 <= lateness.max() <= clock_frames + 1 / 6


def test_flipped_pixels_have_the_moments_of_the_binomial():
    share, pixels = 0.03, REDUCTION**2
    frames = np.zeros((600, 20, 20), np.uint8)
    # In each quarter of the image, 0, 4, 12 or 16 of 16 pixels are foreground.
    for part, count in enumerate((0, 4, 12, 16)):
        frames[:, 5 * part : 5 * part + 5] = round(255 * count / pixels)
    _, values = perturbed(Perturbation(flipped=share), flight=flown(2, frames))
    counts = np.round(values / 255 * pixels)
    # Every value is a whole number of pixels.
    np.testing.assert_array_equal(np.round(255 * counts / pixels), values)
    num = values[:, :, :5].size
    variance = pixels * share * (1 - share)
    for part, count in enumerate((0, 4, 12, 16)):
        found = counts[:, :, 5 * part : 5 * part + 5]
        mean = count * (1 - share) + (pixels - count) * share
        assert abs(found.mean() - mean) < 5 * math.sqrt(variance / num)
        # The kurtosis of these counts is below 6, so the variance has a relative error of at most sqrt(5 / num).
        assert abs(found.var() / variance - 1) < 5 * math.sqrt(5 / num)
    assert (values[:, 0] != values[:, 1]).any()
    # Flipping all pixels gives the negative: 4 of 16 pixels become 12.
    _, negative = perturbed(Perturbation(flipped=1.0), flight=flown(2, frames))
    assert negative[0, 0, ::5, 0].tolist() == [255, 191, 64, 0]

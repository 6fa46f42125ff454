"""Grids: the cells of a file, errors in one line with the place in the file, keys; and perturbations of a cell's input.

Perturbations are compared with frames by hand, SciPy's angles and moments of the binomial.
"""

import functools
import itertools
import math
import pickle
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from helpers import assert_refused, cameras_of, ring_rig
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.foreground.silhouettes import Silhouettes, SilhouetteSettings
from psotrack.recordings import Recording, VideoInfo
from psotrack.settings import ScoreSettings, SwarmSettings, TrackSettings
from psotrack.sweeps import Perturbation, cell_key, grid, perturb, read_grid
from psotrack.sweeps.grid_files import SETTINGS
from psotrack.sweeps.perturbations import choose_cameras

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
#: The same content.
MAPPING = {
    "sequences": ("S01_D2_A", "S04_D10"),
    "runs": 10,
    "settings": {"swarm.spread_m": 1, "silhouettes.reduction": 8, "silhouettes.background": "mog2"},
    "methods": {
        "paper": {"swarm.kind": "joint", "score.kind": "hard"},
        "ours": {"silhouettes": {"reduction": 2}},
    },
    "grid": {
        "swarm.particles": (20, 50, 100),
        "silhouettes": {"var_threshold": [8, 9.5]},
        "cameras": ["all", 4, ("cam1i", "cam2i")],
        "draws": 3,
    },
}
SMALL = {"sequences": ["S01"], "grid": {"swarm.particles": [20, 50]}}
INPUT = {"cam1": "ab", "cam2": "cd"}


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
    cameras = [(None, 0), (4, 0), (4, 1), (4, 2), (("cam1i", "cam2i"), 0)]
    expected = [
        (sequence, method, particles, threshold, *kept)
        for sequence, method, particles, threshold, kept in itertools.product(
            ["S01_D2_A", "S04_D10"], ["paper", "ours"], [20, 50, 100], [8.0, 9.5], cameras
        )
    ]
    found = [
        (
            cell.sequence,
            cell.method,
            cell.settings.swarm.particles,
            cell.settings.silhouettes.var_threshold,
            cell.cameras,
            cell.perturbation.draw,
        )
        for cell in cells
    ]
    assert found == expected
    assert len({cell_key(cell, INPUT) for cell in cells}) == len(cells)
    assert grid(MAPPING).cells() == pickle.loads(pickle.dumps(cells)) == cells


def test_a_cell_has_the_settings_of_the_file_and_axes_as_numbers_and_words(cells):
    paper = cells[0]
    assert paper.settings == TrackSettings(
        silhouettes=SilhouetteSettings(background="mog2", reduction=8, var_threshold=8.0),
        swarm=SwarmSettings(particles=20, spread_m=1.0, kind="joint"),
        score=ScoreSettings(kind="hard"),
    )
    assert (paper.runs, paper.seeds, paper.frames) == (10, range(10), None)
    assert paper.perturbation == Perturbation()
    ours = next(cell for cell in cells if cell.method == "ours")
    assert (ours.settings.swarm.spread_m, ours.settings.silhouettes.reduction) == (1.0, 2)
    kept = [("all", 0), ("4", 0), ("4", 1), ("4", 2), ("cam1i+cam2i", 0)]
    assert [dict(cell.axes) for cell in cells[:5]] == [
        {"swarm.particles": 20, "silhouettes.var_threshold": 8.0, "cameras": cameras, "draw": draw}
        for cameras, draw in kept
    ]
    # A whole number becomes a float where the setting is a float.
    assert isinstance(paper.axes["silhouettes.var_threshold"], float)


def test_without_axes_and_methods_there_is_one_cell_per_sequence():
    (cell,) = grid({"sequences": [Path("data/S01")], "first_seed": 5, "runs": 2}).cells()
    assert (cell.sequence, cell.method, cell.settings, dict(cell.axes)) == (
        "data/S01",
        "",
        TrackSettings(),
        {},
    )
    assert list(cell.seeds) == [5, 6]


def test_perturbations_and_frames_can_be_varied():
    varied = {"extrinsics_deg": [0, 0.2], "clock_frames": [1], "flipped": [0.03], "frames": [100]}
    cells = cells_of(grid=varied | {"draws": 2})
    assert [cell.perturbation for cell in cells] == [
        Perturbation(extrinsics_deg=angle, clock_frames=1.0, flipped=0.03, draw=draw)
        for angle in (0.0, 0.2)
        for draw in (0, 1)
    ]
    assert {cell.frames for cell in cells} == {100}
    last = {"extrinsics_deg": 0.2, "clock_frames": 1.0, "flipped": 0.03, "frames": 100, "draw": 1}
    assert cells[-1].axes == last
    # Without draws there is one random draw.
    assert [cell.perturbation.draw for cell in cells_of(grid={"cameras": [3, 4]})] == [0, 0]


def test_every_setting_can_be_set():
    def names(content, prefix=""):
        for name, value in content.items():
            yield from names(value, f"{prefix}{name}.") if isinstance(value, dict) else [f"{prefix}{name}"]

    assert set(SETTINGS) == set(names(msgspec.to_builtins(TrackSettings()))) - {"seed"}


def of_settings(**values):
    return {"settings": {name.replace("__", "."): value for name, value in values.items()}}


def of_grid(**values):
    return {"grid": {name.replace("__", "."): value for name, value in values.items()}}


SAME = "expected cells that differ, found the same cell as with"
TWICE = "grid.swarm.particles: expected the name in one place, found"
#: Name of the case -> what is wrong in the grid, and words of the line; the first begins with the place.
BAD = {
    # Names.
    "no table": ({"sequnces": ["S01"]}, "sequnces: expected an allowed name", "did you mean sequences?"),
    "no method": ({"methods": {"paper": {"swram": 1}}}, "methods.paper.swram: expected an allowed name"),
    "a part": (of_settings(reduction=4), "settings.reduction: ", "did you mean silhouettes.reduction?"),
    "no axis": (of_grid(draw=[20]), "grid.draw: ", "did you mean draws?"),
    "no inner table": (of_settings(swarm="joint"), "settings.swarm: expected a table with names, found none"),
    "a far name": (of_settings(zzz=4), "settings.zzz: ", "allowed names are method, detections, "),
    # Right names, wrong places.
    "an axis as setting": (
        of_settings(cameras=4),
        "settings.cameras: ",
        "it belongs in [grid], with a list of values",
    ),
    "a setting at the top": (
        {"swarm.particles": 4},
        "swarm.particles: ",
        "it belongs in [settings], or in [grid] with a list of values",
    ),
    "seeds": (
        of_grid(seed=[1, 2]),
        "grid.seed: ",
        "every run has a seed of its own: set runs = 10, and first_seed ",
    ),
    "set twice": (of_settings(swarm__particles=20), f"{TWICE} settings.swarm.particles as well"),
    "set by a method": (
        {"methods": {"a": {"swarm.particles": 20}}},
        f"{TWICE} methods.a.swarm.particles as well",
    ),
    "the name twice": (
        of_settings(silhouettes__reduction=4, silhouettes={"reduction": 8}),
        "settings.silhouettes.reduction: expected the name once, found the name twice",
    ),
    # Kinds of values.
    "a truth": (
        of_grid(swarm__particles=[20, True]),
        "grid.swarm.particles[1]: expected a whole number, found true",
    ),
    "a word in a list": (
        of_grid(score__windows=[[1.0], [0.5, "a"]]),
        'grid.score.windows[1][1]: expected a number, found "a"',
    ),
    "not a number": (
        of_settings(swarm__spread_m=math.nan),
        "settings.swarm.spread_m: expected a finite number, found nan",
    ),
    "no kind": (
        {"methods": {"paper": {"swarm.kind": "jont"}}},
        "methods.paper.swarm.kind: expected one of joint, per-drone, found jont; did you mean joint?",
    ),
    "no list": (
        of_grid(swarm__particles=20),
        "grid.swarm.particles: expected a list of values, found 20; write [20]",
    ),
    "an empty list": (
        of_grid(swarm__particles=[]),
        "grid.swarm.particles: expected a list of values, found []",
    ),
    **{
        f"cameras {value}": (
            of_grid(cameras=[value]),
            'grid.cameras[0]: expected "all", a number above 0, or a list of ',
            f"found {value!r}",
        )
        for value in (0, True, ["a", "b", "a"], [])
    },
    "no frames": (of_grid(frames=[0]), "grid.frames[0]: expected a whole number of at least 1, found 0"),
    "no draws": (of_grid(cameras=[4], draws=0), "grid.draws: expected a whole number of at least 1, found 0"),
    "no runs": ({"runs": 0}, "runs: expected a whole number of at least 1, found 0"),
    "a sequence": ({"sequences": "S01"}, 'sequences: expected a list, found "S01"'),
    "no table of a method": ({"methods": {"paper": 3}}, "methods.paper: expected a table, found 3"),
    # Values that are out of range.
    "one particle": (
        of_grid(swarm__particles=[20, 1]),
        "grid.swarm.particles[1]: expected a whole number of at least 2",
    ),
    "too many": (of_grid(flipped=[0.5, 2]), "grid.flipped[1]: expected a number of at most 1, found 2"),
    "no multiple": (
        of_grid(silhouettes__reduction=[4, 6]) | {"methods": {"a": {"silhouettes.working_reduction": 4}}},
        "grid.silhouettes.reduction[1]: expected a multiple of working_reduction, 4, found 6",
    ),
    "unused": (
        of_settings(silhouettes__shadows="drop"),
        "settings.silhouettes.shadows: expected keep, because the background model living does not use this setting",
        "found drop; or choose the background model mog2",
    ),
    # Cells.
    "equal values": (
        of_grid(swarm__spread_m=[0.1, 1, 1.0]),
        f"grid.swarm.spread_m[2]: {SAME} grid.swarm.spread_m[1]",
    ),
    "equal sequences": ({"sequences": ["a", "a"]}, f"sequences[1]: {SAME} sequences[0]"),
    "equal methods": (
        {"methods": {"a": {}, "b": {"swarm.iterations": TrackSettings().swarm.iterations}}},
        f"methods.b: {SAME} methods.a",
    ),
    # A perturbation of silhouettes has no effect on detections.
    "no effect": (
        of_settings(method="projection-lines") | of_grid(flipped=[0.0, 0.03]),
        "grid.flipped[1]: expected 0 for a method that reads detections, ",
        "found 0.03",
    ),
    "nothing random": (
        of_grid(flipped=[0.0], cameras=[["a"]], draws=3),
        "grid.draws: expected a random choice in [grid]: a number of cameras, ",
        "found none",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_an_error_is_one_line_with_the_place_in_the_file(case, tmp_path):
    changes, words, *more = BAD[case]
    bad = functools.partial(grid, SMALL | changes, where="table5.toml")
    assert_refused(bad, f"table5.toml: {words}", *more, unchanged=tmp_path)


def test_sequences_must_be_given_and_messages_of_a_file_begin_with_its_path(tmp_path):
    assert_refused(
        lambda: grid({"runs": 2}), "grid: sequences: expected a value, found none", unchanged=tmp_path
    )
    path = tmp_path / "grid.toml"
    for text, words in (
        (FILE.replace("swarm.kind", "swram.kind"), ": methods.paper.swram.kind: "),
        ("sequences = [\n", ": expected valid TOML"),
    ):
        path.write_text(text)
        assert_refused(lambda: read_grid(path), f"psotrack: {path}", words, unchanged=tmp_path)
    missing = tmp_path / "none.toml"
    assert_refused(lambda: read_grid(missing), f"{missing}: expected a file to read", unchanged=tmp_path)
    unknown = functools.partial(Perturbation, extrinsics_deg=math.nan)
    assert_refused(unknown, "extrinsics_deg: expected a number of at least 0, found NaN", unchanged=tmp_path)


# --- keys


def test_neither_the_number_of_runs_nor_the_place_of_the_sequence_is_in_the_key():
    (few,) = grid({"sequences": ["S01"], "runs": 2, "settings": {"swarm.particles": 20}}).cells()
    elsewhere = {"sequences": ["/data/elsewhere/S01"], "runs": 9, "first_seed": 4}
    many = grid(elsewhere | {"grid": {"swarm.particles": [20, 50]}}).cells()[0]
    assert few != many
    assert cell_key(few, INPUT) == cell_key(many, dict(reversed(INPUT.items())))
    assert re.fullmatch("[0-9a-f]{20}-[0-9a-f]{20}", cell_key(few, INPUT))


def test_everything_that_decides_the_rows_is_in_the_key():
    base = {"sequences": ["S01"], "settings": {"swarm.particles": 20}, "grid": {}}
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
    keys = [cell_key(cell, INPUT) for change in changes for cell in grid(base | change).cells()]
    keys.append(cell_key(grid(base).cells()[0], INPUT | {"cam2": "ce"}))
    assert len(set(keys)) == len(keys) == len(changes) + 2


# --- perturbations

FRAMES, REDUCTION = 70, 4
EVERYTHING = Perturbation(extrinsics_deg=0.3, clock_frames=1.5, flipped=0.05)
ANOTHER_DRAW = Perturbation(extrinsics_deg=0.3, clock_frames=1.5, flipped=0.05, draw=1)


def flown(num_cameras=5, frames=None):
    """A sequence, and silhouettes; camera i has the frames, or random ones, plus i grey levels."""
    rig = ring_rig(num_cameras, image_size_wh=(28, 20))
    if frames is None:
        frames = np.random.default_rng(3).integers(0, 256, (FRAMES, 5, 7), np.uint8)
    videos = {name: VideoInfo(Path(f"{name}.avi"), len(frames), 25.0, (28, 20)) for name in rig.names}
    silhouettes = Silhouettes(
        cameras=rig.names,
        keys={name: f"key of {name}" for name in rig.names},
        reduction=REDUCTION,
        num_frames=len(frames),
        shape=frames.shape[1:],
        seconds={},
        arrays=tuple(frames + np.uint8(camera) for camera in range(num_cameras)),
    )
    return Recording("S", Path("S"), cameras_of(rig, video=videos)), silhouettes


def perturbed(perturbation, cameras=None):
    """Poses of the cameras, and frames (frames, cameras, height, width), after a perturbation."""
    sequence, silhouettes = perturb(*flown(), perturbation, cameras)
    return sequence.rig.cameras.T_cam_world, frames_of(silhouettes)


def frames_of(silhouettes):
    return silhouettes.read(0, silhouettes.num_frames)


def test_equal_draws_give_equal_results_and_the_input_does_not_change():
    sequence, silhouettes = flown()
    assert perturb(sequence, silhouettes, Perturbation(draw=3), None) == (sequence, silhouettes)
    once = perturb(sequence, silhouettes, EVERYTHING, ("c0", "c1"))
    untouched, unflipped = flown()
    np.testing.assert_array_equal(sequence.rig.cameras.T_cam_world, untouched.rig.cameras.T_cam_world)
    np.testing.assert_array_equal(frames_of(silhouettes), frames_of(unflipped))
    poses, frames = perturbed(EVERYTHING, ("c0", "c1"))
    np.testing.assert_array_equal(once[0].rig.cameras.T_cam_world, poses)
    np.testing.assert_array_equal(frames_of(once[1]), frames)
    other_poses, other_frames = perturbed(ANOTHER_DRAW, ("c0", "c1"))
    assert not np.allclose(other_poses, poses)
    assert (other_frames != frames).any()


def test_random_numbers_depend_neither_on_other_perturbations_nor_on_other_cameras():
    poses, frames = perturbed(EVERYTHING)
    np.testing.assert_array_equal(poses, perturbed(Perturbation(extrinsics_deg=0.3))[0])
    # Clocks are perturbed before pixels, so both perturbations at once are the same as one after the other.
    sequence, silhouettes = flown()
    _, late = perturb(sequence, silhouettes, Perturbation(clock_frames=1.5), None)
    _, flipped = perturb(sequence, late, Perturbation(flipped=0.05), None)
    np.testing.assert_array_equal(frames, frames_of(flipped))
    few_poses, few_frames = perturbed(EVERYTHING, ("c3", "c1"))
    np.testing.assert_array_equal(few_poses, poses[[3, 1]])
    np.testing.assert_array_equal(few_frames, frames[:, [3, 1]])


def test_cameras_are_kept_by_name_or_chosen_at_random(tmp_path):
    chosen, _ = perturb(*flown(), Perturbation(draw=2), 3)
    assert chosen.rig.names == choose_cameras(("c0", "c1", "c2", "c3", "c4"), 3, 2)
    sequence, silhouettes = perturb(*flown(), Perturbation(), ("c4", "c2"))
    assert sequence.rig.names == silhouettes.cameras == tuple(silhouettes.keys) == ("c4", "c2")
    assert tuple(sequence.videos) == ("c4", "c2")
    np.testing.assert_array_equal(frames_of(silhouettes), frames_of(flown()[1])[:, [4, 2]])
    for cameras, words in (
        (("c0", "c9"), ("cameras: expected some of c0, ", "found c9")),
        (6, ("cameras: expected 1 to 5, the number of cameras, found 6",)),
    ):
        assert_refused(functools.partial(perturbed, Perturbation(), cameras), *words, unchanged=tmp_path)


@given(num_cameras=st.integers(1, 7), data=st.data())
def test_draws_use_every_subset_before_a_subset_is_repeated(num_cameras, data):
    names = tuple("abcdefg"[:num_cameras])
    count = data.draw(st.integers(1, num_cameras))
    every = list(itertools.combinations(names, count))
    drawn = [choose_cameras(names, count, draw) for draw in range(len(every))]
    # `combinations` keeps the order of the names, as subsets must.
    assert sorted(drawn) == every
    assert choose_cameras(names, count, len(every)) == drawn[0]


def test_every_camera_is_chosen_equally_often():
    names = tuple(map(str, range(20)))
    drawn = [int(name) for draw in range(400) for name in choose_cameras(names, 3, draw)]
    # 400 of 1140 subsets: 60 +- 5.8 of each camera (hypergeometric); 5 standard deviations.
    assert np.abs(np.bincount(drawn, minlength=20) - 60).max() < 29


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
    ramp = np.tile((3 * np.arange(FRAMES)).astype(np.uint8)[:, None, None], (1, 5, 7))
    sequence, silhouettes = flown(40, ramp)
    silhouettes = replace(silhouettes, arrays=(ramp,) * 40)
    same, late = perturb(sequence, silhouettes, Perturbation(clock_frames=clock_frames), None)
    assert same is sequence
    shown = frames_of(late)[..., 0, 0].astype(float)
    # Only frames without clipped values are used. The mean removes rounding to grey levels, which is at most a half.
    behind = np.arange(FRAMES)[4:, None] - shown[4:] / 3
    lateness = behind.mean(axis=0)
    assert np.abs(behind - lateness).max() < 0.5
    expected = np.maximum(3 * (np.arange(FRAMES)[:, None] - lateness), 0)
    # A half from rounding of the values, and a half from rounding of the delay.
    assert np.abs(shown - expected).max() <= 1.01
    # The smallest of 40 uniform delays is 1/41 of the range on average, and above 0.25 with a probability of 1e-5.
    assert -1 / 6 <= lateness.min() <= 0.25 * clock_frames + 1 / 6
    assert 0.75 * clock_frames - 1 / 6 <= lateness.max() <= clock_frames + 1 / 6


def flipped_of(frames, share):
    """Frames of two cameras that showed the same, (frames, 2, height, width), after pixels were flipped."""
    sequence, silhouettes = flown(2, frames)
    silhouettes = replace(silhouettes, arrays=(frames, frames))
    same, noisy = perturb(sequence, silhouettes, Perturbation(flipped=share), None)
    assert same is sequence
    return frames_of(noisy)


def test_flipped_pixels_have_the_moments_of_the_binomial():
    share, pixels = 0.03, REDUCTION**2
    frames = np.zeros((600, 20, 20), np.uint8)
    # In each quarter of the image, 0, 4, 12 or 16 of 16 pixels are foreground.
    for part, count in enumerate((0, 4, 12, 16)):
        frames[:, 5 * part : 5 * part + 5] = round(255 * count / pixels)
    values = flipped_of(frames, share)
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
    negative = flipped_of(frames, 1.0)[0, 0, ::5, 0]
    assert negative.tolist() == [255, 191, 64, 0]

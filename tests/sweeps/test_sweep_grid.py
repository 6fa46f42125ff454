"""Grids: the cells of a file, errors in one line with the place in the file, and the content of keys."""

import itertools
import pickle
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.errors import InputError, SettingsError
from psotrack.foreground.silhouettes import SilhouetteSettings
from psotrack.settings import ScoreSettings, SwarmSettings, TrackSettings
from psotrack.sweeps import Perturbation, cell_key, grid, read_grid
from psotrack.sweeps.grid_files import SETTINGS

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


def cells_of(**changes):
    return grid(SMALL | changes).cells()


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "grid.toml"
    path.write_text(FILE)
    return path


def test_every_combination_is_a_cell(path):
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
        for cell in read_grid(path).cells()
    ]
    assert found == expected


def test_a_cell_has_the_settings_of_the_file(path):
    paper = read_grid(path).cells()[0]
    assert paper.settings == TrackSettings(
        silhouettes=SilhouetteSettings(background="mog2", reduction=8, var_threshold=8.0),
        swarm=SwarmSettings(particles=20, spread_m=1.0, kind="joint"),
        score=ScoreSettings(kind="hard"),
    )
    assert (paper.runs, paper.seeds, paper.frames) == (10, range(10), None)
    assert paper.perturbation == Perturbation()
    ours = next(cell for cell in read_grid(path).cells() if cell.method == "ours")
    assert (ours.settings.swarm.spread_m, ours.settings.silhouettes.reduction) == (1.0, 2)


def test_axes_are_the_varied_values_as_numbers_and_words(path):
    axes = [dict(cell.axes) for cell in read_grid(path).cells()[:5]]
    kept = [("all", 0), ("4", 0), ("4", 1), ("4", 2), ("cam1i+cam2i", 0)]
    assert axes == [
        {"swarm.particles": 20, "silhouettes.var_threshold": 8.0, "cameras": cameras, "draw": draw}
        for cameras, draw in kept
    ]
    # A whole number becomes a float where the setting is a float.
    assert isinstance(axes[0]["silhouettes.var_threshold"], float)


def test_a_mapping_gives_the_same_cells_as_toml(path):
    mapping = {
        "sequences": ("S01_D2_A", "S04_D10"),
        "runs": 10,
        "settings": {
            "swarm.spread_m": 1,
            "silhouettes.reduction": 8,
            "silhouettes.background": "mog2",
        },
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
    assert grid(mapping).cells() == read_grid(path).cells()


def test_sequences_may_be_path_objects(tmp_path):
    assert cells_of(sequences=[tmp_path])[0].sequence == str(tmp_path)


def test_without_axes_and_methods_there_is_one_cell_per_sequence():
    (cell,) = grid({"sequences": ["S01"], "first_seed": 5, "runs": 2}).cells()
    assert (cell.method, cell.settings, dict(cell.axes)) == ("", TrackSettings(), {})
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
    assert cells[-1].axes == {
        "extrinsics_deg": 0.2,
        "clock_frames": 1.0,
        "flipped": 0.03,
        "frames": 100,
        "draw": 1,
    }


def test_without_draws_there_is_one_random_draw():
    assert [cell.perturbation.draw for cell in cells_of(grid={"cameras": [3, 4]})] == [0, 0]


def test_every_setting_can_be_set():
    def names(content, prefix=""):
        for name, value in content.items():
            yield from names(value, f"{prefix}{name}.") if isinstance(value, dict) else [f"{prefix}{name}"]

    assert set(SETTINGS) == set(names(msgspec.to_builtins(TrackSettings()))) - {"seed"}


@given(
    particles=st.lists(st.integers(2, 500), min_size=1, max_size=4, unique=True),
    spread_m=st.lists(st.floats(0.01, 1.0), min_size=1, max_size=4, unique=True),
    cameras=st.lists(st.one_of(st.just("all"), st.integers(1, 9)), min_size=1, max_size=4, unique=True),
    draws=st.integers(1, 3),
)
def test_there_is_one_cell_per_combination_and_every_cell_has_its_own_key(
    particles, spread_m, cameras, draws
):
    varied = {"swarm.particles": particles, "swarm.spread_m": spread_m, "cameras": cameras}
    num_drawn = len(set(cameras) - {"all"})
    cells = cells_of(grid=varied | ({"draws": draws} if num_drawn else {}))
    expected = len(particles) * len(spread_m) * (num_drawn * draws + ("all" in cameras))
    keys = {cell_key(cell, {"cam1": "ab"}) for cell in cells}
    assert len(keys) == len(cells) == expected


WRONG = [
    # Names.
    (
        {"sequnces": ["S01"]},
        "sequnces: expected an allowed name, found sequnces; did you mean sequences?",
    ),
    (
        {"methods": {"paper": {"swram": "joint"}}},
        "methods.paper.swram: expected an allowed name, found swram; .*",
    ),
    ({"settings": {"reduction": 4}}, "settings.reduction: .*; did you mean silhouettes.reduction?"),
    ({"grid": {"draw": [20]}}, "grid.draw: .*; did you mean draws?"),
    ({"settings": {"swarm": "joint"}}, "settings.swarm: expected a table with names, found none"),
    (
        {"settings": {"zzz": 4}},
        "settings.zzz: .*; allowed names are method, detections, .*, swarm.particles, .* ...",
    ),
    # Right names, wrong places.
    ({"settings": {"cameras": 4}}, "settings.cameras: .*; it belongs in [grid], with a list of values"),
    (
        {"swarm.particles": 4},
        "swarm.particles: .*; it belongs in [settings], or in [grid] with a list of values",
    ),
    (
        {"grid": {"seed": [1, 2]}},
        "grid.seed: .*; every run has a seed of its own: set runs = 10, and first_seed .*",
    ),
    (
        {"settings": {"swarm.particles": 20}},
        "grid.swarm.particles: expected the name in one place, found settings.swarm.particles as well",
    ),
    (
        {"methods": {"a": {"swarm.particles": 20}}},
        "grid.swarm.particles: expected the name in one place, found methods.a.swarm.particles as well",
    ),
    (
        {"settings": {"silhouettes.reduction": 4, "silhouettes": {"reduction": 8}}},
        "settings.silhouettes.reduction: expected the name once, found the name twice",
    ),
    # Kinds of values.
    (
        {"grid": {"swarm.particles": [20, True]}},
        "grid.swarm.particles[1]: expected a whole number, found true",
    ),
    (
        {"grid": {"score.windows": [[1.0], [0.5, "a"]]}},
        'grid.score.windows[1][1]: expected a number, found "a"',
    ),
    (
        {"settings": {"swarm.spread_m": float("nan")}},
        "settings.swarm.spread_m: expected a finite number, found nan",
    ),
    (
        {"methods": {"paper": {"swarm.kind": "jont"}}},
        "methods.paper.swarm.kind: expected one of joint, per-drone, found jont; did you mean joint?",
    ),
    (
        {"grid": {"swarm.particles": 20}},
        "grid.swarm.particles: expected a list of values, found 20; write [20]",
    ),
    ({"grid": {"swarm.particles": []}}, "grid.swarm.particles: expected a list of values, found []"),
    (
        {"grid": {"cameras": [0]}},
        'grid.cameras[0]: expected "all", a number above 0, or a list of .*, found 0',
    ),
    ({"grid": {"cameras": [True]}}, "grid.cameras[0]: .*, found True"),
    ({"grid": {"cameras": [["a", "b", "a"]]}}, "grid.cameras[0]: .*, found ['a', 'b', 'a']"),
    ({"grid": {"cameras": [[]]}}, "grid.cameras[0]: .*, found []"),
    ({"grid": {"frames": [0]}}, "grid.frames[0]: expected a whole number of at least 1, found 0"),
    ({"grid": {"cameras": [4], "draws": 0}}, "grid.draws: expected a whole number of at least 1, found 0"),
    ({"runs": 0}, "runs: expected a whole number of at least 1, found 0"),
    ({"sequences": []}, "sequences: expected a list of length at least 1, found []"),
    ({"sequences": "S01"}, 'sequences: expected a list, found "S01"'),
    ({"sequences": ["S01", 2]}, "sequences[1]: expected text, found 2"),
    ({"methods": {"paper": 3}}, "methods.paper: expected a table, found 3"),
    # Values that are out of range.
    (
        {"grid": {"swarm.particles": [20, 1]}},
        "grid.swarm.particles[1]: expected a whole number of at least 2, found 1",
    ),
    ({"grid": {"flipped": [0.5, 2]}}, "grid.flipped[1]: expected a number of at most 1, found 2"),
    ({"grid": {"clock_frames": [-1]}}, "grid.clock_frames[0]: expected a number of at least 0, found -1"),
    (
        {"methods": {"a": {"silhouettes.working_reduction": 4}}, "grid": {"silhouettes.reduction": [4, 6]}},
        "grid.silhouettes.reduction[1]: expected a multiple of working_reduction, 4, found 6",
    ),
    (
        {"settings": {"silhouettes.shadows": "drop"}},
        "settings.silhouettes.shadows: expected keep, because the background model living does not use this setting, "
        "found drop; or choose the background model mog2",
    ),
    # Cells.
    (
        {"grid": {"swarm.spread_m": [0.1, 1, 1.0]}},
        "grid.swarm.spread_m[2]: expected cells that differ, found the same cell as with grid.swarm.spread_m[1]",
    ),
    (
        {"sequences": ["a", "a"]},
        "sequences[1]: expected cells that differ, found the same cell as with sequences[0]",
    ),
    (
        {"methods": {"a": {}, "b": {"swarm.iterations": TrackSettings().swarm.iterations}}},
        "methods.b: expected cells that differ, found the same cell as with methods.a",
    ),
    # A perturbation of silhouettes has no effect on detections.
    (
        {"settings": {"method": "projection-lines"}, "grid": {"flipped": [0.0, 0.03]}},
        "grid.flipped[1]: expected 0 for a method that reads detections, .*, found 0.03",
    ),
    (
        {"grid": {"flipped": [0.0], "cameras": [["a"]], "draws": 3}},
        "grid.draws: expected a random choice in [grid]: a number of cameras, .*, found none",
    ),
]


@pytest.mark.parametrize(("changes", "sentence"), WRONG)
def test_an_error_is_one_line_with_the_place_in_the_file(changes, sentence):
    with pytest.raises(SettingsError) as caught:
        grid(SMALL | changes, where="table5.toml")
    pattern = re.escape(f"table5.toml: {sentence}").replace(re.escape(".*"), ".*")
    assert re.fullmatch(pattern, str(caught.value)), str(caught.value)
    assert "\n" not in str(caught.value)


def test_sequences_must_be_given():
    with pytest.raises(SettingsError, match=r"^grid: sequences: expected a value, found none$"):
        grid({"runs": 2})


def test_messages_of_a_file_begin_with_its_path(path):
    path.write_text(FILE.replace("swarm.kind", "swram.kind"))
    with pytest.raises(SettingsError, match=f"^{re.escape(str(path))}: methods.paper.swram.kind: "):
        read_grid(path)
    path.write_text("sequences = [\n")
    with pytest.raises(InputError, match=r"grid.toml.*: expected valid TOML"):
        read_grid(path)
    with pytest.raises(InputError, match=r"none.toml: expected a file to read"):
        read_grid(path.with_name("none.toml"))


def test_a_perturbation_made_in_python_is_checked():
    with pytest.raises(SettingsError, match="extrinsics_deg: expected a number of at least 0, found NaN"):
        Perturbation(extrinsics_deg=float("nan"))
    with pytest.raises(
        SettingsError, match="clock_frames: expected a number of at most 1000000, found Infinity"
    ):
        Perturbation(clock_frames=float("inf"))


# --- keys

INPUT = {"cam1": "ab", "cam2": "cd"}


def test_the_number_of_runs_is_not_in_the_key():
    (few,) = grid({"sequences": ["S01"], "runs": 2, "settings": {"swarm.particles": 20}}).cells()
    many = grid(
        {"sequences": ["S01"], "runs": 9, "first_seed": 4, "grid": {"swarm.particles": [20, 50]}}
    ).cells()[0]
    assert few != many
    assert cell_key(few, INPUT) == cell_key(many, INPUT)
    assert re.fullmatch("[0-9a-f]{20}-[0-9a-f]{20}", cell_key(few, INPUT))


def test_the_place_of_a_sequence_is_not_in_the_key():
    (one,) = grid({"sequences": ["S01"]}).cells()
    (other,) = grid({"sequences": ["/data/elsewhere/S01"]}).cells()
    assert cell_key(one, INPUT) == cell_key(other, dict(reversed(INPUT.items())))


def test_everything_that_decides_the_rows_is_in_the_key():
    base = {"sequences": ["S01"], "settings": {"swarm.particles": 20}, "grid": {}}
    changes = [
        {},
        {"sequences": ["S02"]},
        {"settings": {"swarm.particles": 21}},
        {"settings": {"swarm.particles": 20, "silhouettes.reduction": 8}},
        {"methods": {"paper": {}}},
        {"grid": {"frames": [100]}},
        {"grid": {"cameras": [2]}},
        {"grid": {"cameras": [["cam1", "cam2"]]}},
        {"grid": {"flipped": [0.1]}},
    ]
    keys = [cell_key(grid(base | change).cells()[0], INPUT) for change in changes]
    keys.append(cell_key(grid(base).cells()[0], INPUT | {"cam2": "ce"}))
    keys += [
        cell_key(cell, INPUT) for cell in grid(base | {"grid": {"cameras": [2], "draws": 2}}).cells()[1:]
    ]
    assert len(set(keys)) == len(keys)


def test_cells_can_be_pickled(path):
    cells = read_grid(path).cells()
    assert pickle.loads(pickle.dumps(cells)) == cells

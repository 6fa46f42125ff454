"""Scenarios: the thirteen presets of the dataset, scenario files, changed fields, and errors before rendering."""

import json
import math
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from psotrack.errors import InputError, SettingsError
from psotrack.simulation import build, change_scenario, load, preset_names, preset_text, scenario
from psotrack.simulation.flights.planning import frame_times_s, plan
from psotrack.simulation.scenarios import FlightFromFile, Mesh, NearPass
from psotrack.simulation.world.halls import RIGS

S02 = scenario("S02_D4_A")

#: Name -> drones (the published S05 ships ten pose files), cameras, frames.
DATASET = {
    "S01_D2_A": (2, 8, 500),
    "S02_D4_A": (4, 8, 250),
    "S03_D10_A": (10, 8, 400),
    "S04_D10": (10, 8, 250),
    "S05_D8": (10, 8, 246),
    "S06_D6": (6, 8, 500),
    "S07_D8": (8, 8, 500),
    "S08_D8": (8, 8, 3000),
    "S09_D6": (6, 8, 3000),
    "S10_D6": (6, 8, 3000),
    "S11_D4": (4, 4, 3878),
    "S12_D3": (3, 4, 5600),
    "S13_D3": (3, 4, 8951),
}


# --- the thirteen presets


def test_the_presets_are_the_sequences_of_the_dataset():
    assert preset_names() == tuple(DATASET)
    for name, (drones, cameras, frames) in DATASET.items():
        recipe = scenario(name)
        assert (recipe.name, len(recipe.drones), recipe.num_frames) == (name, drones, frames)
        assert len(RIGS[recipe.cameras]) == cameras
        assert (recipe.fps, recipe.image_size_wh) == (25.0, (1920, 1080))
        assert recipe.markers == (recipe.onboard is not None) == name.endswith("_A")
        assert recipe.hall == ("large_hall" if 3 <= int(name[1:3]) <= 10 else "laboratory")
        assert recipe.description


def test_the_total_duration_is_that_of_the_paper():
    """The paper states 20 min 3 s in total, and 91 min 25 s when each sequence is counted once per drone."""
    recipes = [scenario(name) for name in preset_names()]
    assert sum(recipe.num_frames for recipe in recipes) / 25 == 20 * 60 + 3
    assert sum(recipe.num_frames * len(recipe.drones) for recipe in recipes) / 25 == 91 * 60 + 25


@pytest.mark.parametrize("name", DATASET)
def test_mean_speeds_are_those_measured_on_the_dataset(name):
    recipe = scenario(name)
    time_s = frame_times_s(recipe, recipe.num_frames)[::5]
    for seed in (0, 5):
        speed = [np.linalg.norm(flight.velocity_m_s(time_s), axis=-1).mean() for flight in plan(recipe, seed)]
        if name[:3] in {"S08", "S09", "S10"}:
            assert 3.4 <= np.mean(speed) <= 4.0
        elif name[:3] in {"S11", "S12", "S13"}:
            assert 0.25 <= np.mean(speed) <= 0.43
        else:
            assert 0.5 <= np.mean(speed) <= 3.0


def test_drones_of_a_preset_differ_and_all_five_models_are_used():
    models = set()
    for name in preset_names():
        drones = scenario(name).drones
        assert len({(drone.model, drone.paint_bgr) for drone in drones}) == len(drones)
        models |= {drone.model for drone in drones}
    assert models == {"x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross"}


def test_the_two_drones_of_s01_pass_each_other_at_30_cm():
    recipe = scenario("S01_D2_A")
    time_s = frame_times_s(recipe, recipe.num_frames)
    for seed in (0, 1, 2):
        first, second = (flight.position_m(time_s) for flight in plan(recipe, seed))
        gap_m = np.linalg.norm(first - second, axis=-1)
        meetings = (gap_m[1:-1] < gap_m[:-2]) & (gap_m[1:-1] < gap_m[2:])
        assert np.count_nonzero(meetings) >= 5
        # At up to 1.1 m/s, a frame is at most half a frame time from the closest approach: sqrt(0.3^2 + 0.022^2) m.
        np.testing.assert_allclose(gap_m[1:-1][meetings], 0.3, atol=1e-3)


@pytest.mark.parametrize("name", DATASET)
def test_all_cameras_see_the_drones_of_every_preset_most_of_the_time(name):
    scene = build(scenario(name), scale=0.1)
    position_m = scene.positions_m(scene.scenario.num_frames)[::25].reshape(-1, 3)
    for cam in (scene.rig.cameras[index] for index in range(len(scene.rig))):
        points = position_m @ cam.T_cam_world[:3, :3].T + cam.T_cam_world[:3, 3]
        pixel = (points / points[:, 2:]) @ cam.K.T
        seen = (points[:, 2] > 0) & np.all((pixel[:, :2] > 0) & (pixel[:, :2] < cam.image_size_wh), axis=-1)
        assert seen.mean() > 0.5


# --- files


def write_scenario(tmp_path, text, name="mine.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["S02_D4_A", "S06_D6", "S13_D3"])
def test_a_file_with_the_text_of_a_preset_is_that_preset(name, tmp_path):
    assert load(write_scenario(tmp_path, preset_text(name))) == scenario(name)


def test_an_unknown_scenario_is_refused_and_the_presets_are_named():
    for function in (scenario, preset_text):
        with pytest.raises(SettingsError, match=r"^scenario: expected one of S01_D2_A, .*S13_D3, found S99$"):
            function("S99")


def test_paths_in_a_scenario_file_are_relative_to_its_folder(tmp_path, monkeypatch):
    (tmp_path / "mine").mkdir()
    head, _, _, third = preset_text("S12_D3").split("[[drones]]")
    path = write_scenario(
        tmp_path / "mine",
        head
        + '[[drones]]\nmodel = { file = "shapes/a.obj", scale = 0.01 }\n'
        + 'flight = { kind = "recording", file = "r.csv" }\n'
        + '[[drones]]\nflight = { kind = "recording", file = "/elsewhere/r.csv", start_s = 2.5 }\n'
        + f"[[drones]]{third}",
    )
    monkeypatch.chdir(tmp_path)
    for given_path in (path, Path("mine/mine.toml")):
        first, second, third_drone = load(given_path).drones
        folder = tmp_path / "mine"
        assert first.model == Mesh(file=str(folder / "shapes/a.obj"), scale=0.01)
        assert first.flight == FlightFromFile(file=str(folder / "r.csv"))
        assert second.flight == FlightFromFile(file="/elsewhere/r.csv", start_s=2.5)
        assert third_drone == scenario("S12_D3").drones[2]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("period_s = 7.4", "period_s = -7.4",
         "drones[0].flight.terms[0].period_s: expected a number of at least 0.001, found -7.4"),
        ("period_s = 7.4", "periods = 7.4",
         "drones[0].flight.terms[0].periods: expected one of amplitude_m, period_s, phase_deg, found periods; "
         "did you mean period_s?"),
        ("period_s = 7.4, ", "", "drones[0].flight.terms[0].period_s: expected a value, found none"),
        ('kind = "harmonics"', 'kind = "harmonic"',
         "drones[0].flight.kind: expected one of harmonics, orbit, crossing, formation, following, near_pass, "
         "waypoints, recording, found harmonic; did you mean harmonics?"),
        ('kind = "harmonics"\n', "", "drones[0].flight.kind: expected a value, found none"),
        ('kind = "harmonics"\n', 'kind = "orbit"\n',
         "drones[0].flight.terms: expected one of centre_m, radius_m, period_s, phase_deg, clockwise, rise_m, "
         "rise_period_s, rise_phase_deg, found terms"),
        ("centre_m = [0.0, 0.0, 1.85]", "centre_m = [0.0, 1.85]",
         "drones[0].flight.centre_m: expected a list of length 3, found [0.0, 1.85]"),
        ("centre_m = [0.0, 0.0, 1.85]", "centre_m = [0.0, nan, 1.85]",
         "drones[0].flight.centre_m[1]: expected a finite number, found nan"),
        ("paint_bgr = [0.028,", "paint_bgr = [1.5,",
         "drones[0].paint_bgr[0]: expected a number of at most 1, found 1.5"),
        ('model = "x_frame"', "model = 7", "drones[0].model: expected text or a table, found 7"),
        ('model = "x_frame"', 'model = { files = "a.obj" }',
         "drones[0].model.files: expected one of file, scale, origin_m, rotors, found files; did you mean file?"),
        ("num_frames = 250", "num_frames = 25.5", "num_frames: expected a whole number, found 25.5"),
        ("num_frames = 250", "num_frames = 0", "num_frames: expected a whole number of at least 1, found 0"),
        ("num_frames = 250", "num_frames = 2500000000",
         "num_frames: expected a whole number of at most 1000000, found 2500000000"),
        ("num_frames = 250", "num_frames = 2026-01-01", 'num_frames: expected a whole number, found "2026-01-01"'),
        ("num_frames = 250", f"num_frames = 250\nfps = 1{'0' * 400}",
         f"fps: expected a value in the allowed range, found 1{'0' * 59}..."),
        ("markers = true", 'markers = "yes"', 'markers: expected true or false, found "yes"'),
        ("[onboard]", "onboard = 3", "onboard: expected a table, found 3"),
        ("max_tilt_deg = 20.0", "max_tilt_deg = 90", "limits.max_tilt_deg: expected a number below 90, found 90"),
        ('cameras = "laboratory"', "cameras = []", "cameras: expected a list of length at least 1, found []"),
        ('name = "S02_D4_A"', 'name = "../up"',
         'name: expected a name of letters, digits, dots, dashes and underscores, the first a letter or digit, '
         'found "../up"'),
    ],
)  # fmt: skip
def test_a_wrong_field_of_a_file_is_named_in_one_line(old, new, sentence, tmp_path):
    text = preset_text("S02_D4_A")
    assert old in text
    path = write_scenario(tmp_path, text.replace(old, new, 1))
    with pytest.raises(InputError) as error_info:
        load(path)
    assert str(error_info.value) == f"{path}: {sentence}"


def test_an_unknown_field_is_refused_and_the_nearest_field_is_suggested(tmp_path):
    path = write_scenario(tmp_path, preset_text("S02_D4_A").replace("markers", "marker"))
    with pytest.raises(
        InputError, match=r"toml: marker: expected one of name, .*, found marker; did you mean markers\?$"
    ):
        load(path)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ('name = "x"\nfps = \n', ", line 2: expected valid TOML, found an error (invalid value)"),
        (
            'name = "x"\nname = "y"\n',
            ", line 2: expected valid TOML, found an error (cannot overwrite a value)",
        ),
        ("drones = [", ", end of document: expected valid TOML, found an error (invalid value)"),
        (f"fps = {'1' * 5000}", ": expected valid TOML, found an error (exceeds the limit"),
        ("", ": name: expected a value, found none"),
    ],
)
def test_invalid_toml_is_named_with_its_line(text, where, tmp_path):
    path = write_scenario(tmp_path, text)
    with pytest.raises(InputError) as error_info:
        load(path)
    assert str(error_info.value).startswith(f"{path}{where}")


def test_files_that_cannot_be_read_are_named(tmp_path):
    (tmp_path / "bytes.toml").write_bytes(b'name = "\xff"')
    for name, found in (("none.toml", "no such file or directory"), ("", "is a directory")):
        with pytest.raises(InputError, match=f": expected a file to read, found {found}$"):
            load(tmp_path / name)
    with pytest.raises(
        InputError, match=r"bytes.toml: expected UTF-8 text, found an invalid byte at offset 8$"
    ):
        load(tmp_path / "bytes.toml")


def field_paths(value, path=""):
    """Yield the dotted path of every field of nested dictionaries and lists."""
    if path:
        yield path
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from field_paths(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from field_paths(inner, f"{path}[{index}]")


def to_plain_data(recipe):
    return msgspec.json.decode(msgspec.json.encode(recipe))


EVERY_PATH = [
    path for name in ("S02_D4_A", "S06_D6", "S12_D3") for path in field_paths(to_plain_data(scenario(name)))
]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["kind", "file", "x"]), inner)
    ),
    max_leaves=4,
)


@given(name=st.sampled_from(["S02_D4_A", "S06_D6", "S12_D3"]), path=st.sampled_from(EVERY_PATH), value=VALUES)
def test_any_value_of_a_field_is_accepted_or_refused_in_one_line(name, path, value):
    try:
        recipe = change_scenario(scenario(name), {path: value})
    except SettingsError as error:
        refusal = str(error)
    else:
        assert all(math.isfinite(number) for number in numbers(to_plain_data(recipe)))
        return
    # The message begins with the field, with its parent, or with a field inside the given value.
    assert refusal.startswith(path.rpartition(".")[0])
    assert ": expected " in refusal
    assert not {"\n", "`", "$"} & set(refusal.replace(json.dumps(value, default=str)[:60], ""))


def numbers(value):
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from numbers(inner)
    elif isinstance(value, float):
        yield value


# --- changed fields


def test_change_scenario_changes_only_the_given_fields():
    changed = change_scenario(
        S02,
        {
            "imaging.reflections": 0,
            "surroundings.screen": 0.02,
            "drones[1].flight.terms[0].period_s": 8.0,
            "drones[2].model": {"file": "a.obj"},
            "onboard": None,
        },
    )
    assert changed.imaging == msgspec.structs.replace(S02.imaging, reflections=0.0)
    assert changed.surroundings.screen == 0.02
    assert changed.drones[1].flight.terms[0].period_s == 8.0
    assert changed.drones[2].model == Mesh(file="a.obj")
    assert changed.onboard is None
    back = change_scenario(
        changed,
        {
            "imaging.reflections": S02.imaging.reflections,
            "surroundings": {},
            "drones[1].flight.terms[0].period_s": S02.drones[1].flight.terms[0].period_s,
            "drones[2].model": S02.drones[2].model,
            "onboard": {},
        },
    )
    assert back == S02
    assert change_scenario(S02, {}) == S02


def test_a_missing_part_starts_from_its_defaults():
    assert change_scenario(
        scenario("S04_D10"), {"onboard.pitch_deg": -20}
    ).onboard == msgspec.structs.replace(S02.onboard, pitch_deg=-20.0)


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        (
            "imaging.reflection",
            0,
            "imaging.reflection: expected one of antialiasing, .*; did you mean reflections?",
        ),
        ("imaging.reflections", -1, "imaging.reflections: expected a number of at least 0, found -1"),
        ("imaging.reflections", "no", 'imaging.reflections: expected a number, found "no"'),
        ("imaging.reflections.x", 0, "imaging.reflections.x: expected a field of the scenario, found none"),
        ("imaging[0]", 0, "imaging[0]: expected a field of the scenario, found none"),
        ("drones[4].yaw_deg", 0, "drones[4].yaw_deg: expected a field of the scenario, found none"),
        ("drones.yaw_deg", 0, "drones.yaw_deg: expected a field of the scenario, found none"),
        (
            "cameras[0].position_m",
            [0, 0, 1],
            "cameras[0].position_m: expected a field of the scenario, found none",
        ),
        ("tracker.inertia", 0.5, "tracker: expected one of name, .*, found tracker"),
        ("fps", math.inf, "fps: expected a finite number, found inf"),
        # Values beyond the limits of codecs, memory or computing time.
        ("fps", 0.01, "fps: expected a number of at least 0.1, found 0.01"),
        ("fps", 1e5, "fps: expected a number of at most 1000, found 100000.0"),
        (
            "imaging.lens_blur_px",
            1e6,
            "imaging.lens_blur_px: expected a number of at most 50, found 1000000.0",
        ),
        ("imaging.shot_noise", 300, "imaging.shot_noise: expected a number of at most 255, found 300"),
        (
            "detector.false_alarms_per_frame",
            1e6,
            "detector.false_alarms_per_frame: expected a number of at most 1000, found 1000000.0",
        ),
        (
            "cameras",
            [{"position_m": [0, 0, 1], "target_m": [1, 0, 1], "focal_length_px": 1e9}],
            "cameras[0].focal_length_px: expected a number of at most 100000, found 1000000000.0",
        ),
    ],
)
def test_an_invalid_change_is_refused_and_its_path_is_named(path, value, sentence):
    with pytest.raises(SettingsError) as error_info:
        change_scenario(S02, {path: value})
    start, _, end = sentence.partition(".*")
    assert str(error_info.value).startswith(start)
    assert str(error_info.value).endswith(end)


# --- refused before anything is drawn


CAMERA = {"position_m": [-4.0, -3.0, 2.5], "target_m": [0.0, 0.0, 1.2]}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"hall": "lab"}, "hall: expected one of laboratory, large_hall, found lab"),
        ({"cameras": "rig"},
         "cameras: expected one of laboratory, laboratory_corners, large_hall, or a list, found rig"),
        ({"cameras": "large_hall"},
         "cameras: expected a place in the hall, x within 5 m of 0, y within 4 m, z from 0 to 4 m, found ["),
        ({"drones[3].model": "quad"},
         "drones[3].model: expected one of x_frame, x_frame_racer, camera_drone, hexacopter, tall_cross, or a mesh, "
         "found quad"),
        ({"cameras": [CAMERA, {**CAMERA, "position_m": [5.0, 0.0, 2.0]}]},
         "cameras[1].position_m: expected a place in the hall, x within 5 m of 0, y within 4 m, z from 0 to 4 m, "
         "found [5.0, 0.0, 2.0]"),
        ({"cameras": [{**CAMERA, "position_m": [0.0, 0.0, -0.1]}]},
         "cameras[0].position_m: expected a place in the hall"),
        ({"cameras": [{**CAMERA, "position_m": [-2.0, 2.9, 2.0]}]},
         "cameras[0].position_m: expected a place outside of the furniture, found [-2.0, 2.9, 2.0]"),
        ({"cameras": [CAMERA, {**CAMERA, "target_m": CAMERA["position_m"]}]},
         "cameras[1].target_m: expected a point that is not straight above or below the camera, nor at "
         "its place, found ["),
        ({"cameras": [{**CAMERA, "target_m": [-4.0, -3.0, 0.0]}]},
         "cameras[0].target_m: expected a point that is not straight above"),
        ({"limits.lower_m": [-6.0, -1.9, 0.7]},
         "limits.lower_m: expected a point in the hall, x within 5 m of 0, y within 4 m, z from 0 to 4 m, "
         "found [-6.0, -1.9, 0.7]"),
        ({"limits.upper_m": [2.7, 1.9, 4.5]}, "limits.upper_m: expected a point in the hall"),
        ({"limits.lower_m": [-2.7, 2.0, 0.7]},
         "limits.lower_m: expected less than limits.upper_m, [2.7, 1.9, 2.4], along each axis, found [-2.7, 2.0, 0.7]"),
        ({"drones[2].flight.centre_m": [30.0, 0.0, 1.0]},
         "drones[2].flight: expected positions from [-2.7, -1.9, 0.7] (limits.lower_m) to [2.7, 1.9, 2.4] "
         "(limits.upper_m), found [30."),
        ({"drones[2].flight.terms[0].period_s": 0.5},
         "drones[2].flight: expected at most 2.6 m/s (limits.max_speed_m_s), found "),
        ({"limits.lower_m": [-4.9, -3.9, 0.1], "limits.max_speed_m_s": 20, "limits.max_acceleration_m_s2": 50,
          "limits.max_tilt_deg": 80, "limits.min_distance_m": 0,
          "drones[0].flight": {"kind": "crossing", "start_m": [-4.8, -1, 0.5], "end_m": [1, -1, 0.5], "period_s": 9}},
         "drones[0].flight: expected a way around the furniture, found [-4."),
        ({"onboard.fov_deg": [180.0, 60.0]}, "onboard.fov_deg: expected angles below 180 degrees, found [180.0, 60.0]"),
        ({"onboard.fov_deg": [90.0, 90.0]},
         "onboard.fov_deg: expected angles that fit 1920 x 1080 square pixels, 90 and 58.72, found [90.0, 90.0]"),
        ({"imaging.shutter_s": 0.05},
         "imaging.shutter_s: expected at most 0.04 s, the time between two frames, found 0.05"),
        ({"onboard.shutter_s": 0.05},
         "onboard.shutter_s: expected at most 0.04 s, the time between two frames, found 0.05"),
    ],
)  # fmt: skip
def test_values_that_do_not_fit_the_hall_are_refused_and_the_field_is_named(changes, sentence):
    with pytest.raises(SettingsError) as error_info:
        build(change_scenario(S02, changes), scale=0.1)
    assert str(error_info.value).startswith(f"scenario S02_D4_A: {sentence}")


def test_a_square_onboard_image_with_equal_angles_is_accepted():
    build(
        change_scenario(S02, {"onboard.fov_deg": [90.0, 90.0], "onboard.image_size_wh": [800, 800]}),
        scale=0.1,
    )


def test_missing_files_of_a_scenario_are_named_before_rendering(tmp_path):
    missing = str(tmp_path / "none")
    for path, value in (
        ("model", {"file": f"{missing}.obj"}),
        ("flight", {"kind": "recording", "file": f"{missing}.csv"}),
    ):
        with pytest.raises(InputError, match=rf"^{missing}\."):
            build(change_scenario(S02, {f"drones[0].{path}": value}), scale=0.1)


def test_only_near_passes_of_the_presets_are_below_the_minimum_distance():
    for name in preset_names():
        near = [d.flight.distance_m for d in scenario(name).drones if isinstance(d.flight, NearPass)]
        raw = tomllib.loads(preset_text(name))
        assert [
            d["flight"]["distance_m"] for d in raw["drones"] if d["flight"]["kind"] == "near_pass"
        ] == near
        assert scenario(name).limits.min_distance_m >= 0.8
        assert bool(near) == (name in {"S01_D2_A", "S04_D10", "S06_D6"})

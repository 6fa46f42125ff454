"""What the simulator refuses: each bad input is one line with the field, and nothing is written."""

import json

import msgspec
import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import given
from hypothesis import strategies as st
from made_flights import CROSSINGS, NEAR, NO_VARIATION, ORBIT, POINTS, WIDE, make_scenario, write_tracks
from msgspec.structs import replace
from placed_drones import S02

from psotrack.errors import SettingsError
from psotrack.simulation import (
    SimulationSettings,
    build,
    change_scenario,
    flight_space,
    load,
    preset_text,
    scenario,
    simulate,
    simulate_own_cameras,
    write_recorded_flight,
)
from psotrack.simulation.flights.motion import read_recorded_flight
from psotrack.simulation.flights.piloting import Sample, Sticks, fly, open_device, read_sticks, write_sticks
from psotrack.simulation.flights.planning import plan
from psotrack.simulation.scenarios import (
    FlightFromFile,
    FollowingFlight,
    Formation,
    Mesh,
    Rotor,
    Variation,
    Waypoints,
)
from psotrack.simulation.world import drones

LABORATORY = flight_space("laboratory")
CAMERA = {"position_m": [-4.0, -3.0, 2.5], "target_m": [0.0, 0.0, 1.2]}
SCRIPT = (Sample(0.0, Sticks(1.0, -0.5, 0.1, 0.0)), Sample(1 / 3, Sticks(turn=-1.0)), Sample(2.5, Sticks()))


# Each function below makes one bad input of a kind. It gives a function of the test's folder and of the function that
# runs commands, which writes the files that are needed and gives the call that must be refused.


def bad_file(folder, run):
    """The file of a preset with a negative period."""
    path = folder / "mine.toml"
    path.write_text(preset_text("S02_D4_A").replace("period_s = 7.4", "period_s = -7.4", 1))
    return lambda: load(path)


def scene(**changes):
    """A scenario with changed fields; `__` stands for a dot."""
    named = {name.replace("__", "."): value for name, value in changes.items()}
    return lambda folder, run: lambda: build(change_scenario(S02, named), scale=0.1)


def flights(*records, num_frames=250, variation=NO_VARIATION, **limits):
    """Flights with wide limits, except for those given."""
    recipe = make_scenario(
        *records, limits=replace(WIDE, **limits), num_frames=num_frames, variation=variation
    )

    def call():
        with np.errstate(all="ignore"):
            plan(recipe, 0)

    return lambda folder, run: call


def replayed(tail=(), num_frames=250, **fields):
    """A recorded flight of 11.99 seconds."""

    def make(folder, run):
        time_s = np.arange(1200) / 100
        position_m = np.stack([0.1 * time_s, 0 * time_s, 1 + 0 * time_s], axis=-1)
        write_recorded_flight(folder / "r.csv", time_s, position_m, None)
        record = FlightFromFile(file=str(folder / "r.csv"), **fields)
        return lambda: plan(make_scenario(record, *tail, num_frames=num_frames), 0)

    return make


def tracks(**options):
    """A file of tracks that is no flight."""

    def make(folder, run):
        path = write_tracks(folder / "loop.csv", **options)
        return lambda: read_recorded_flight(path)

    return make


def mesh(content, name="a.obj", **fields):
    """A file of a mesh."""

    def make(folder, run):
        (folder / name).write_text(content)
        return lambda: drones.model(Mesh(file=str(folder / name), **fields))

    return make


def flown(*samples, start_m=(0.0, 0.0, 1.0), **options):
    """A flight by hand."""
    return lambda folder, run: lambda: fly(samples, np.array(start_m), LABORATORY, **options)


def sticks(old, new):
    """A file of sticks with one change."""

    def make(folder, run):
        write_sticks(folder / "s.csv", SCRIPT)
        (folder / "s.csv").write_text((folder / "s.csv").read_text().replace(old, new, 1))
        return lambda: read_sticks(folder / "s.csv")

    return make


def simulated(jobs=1, **settings):
    settings = SimulationSettings(**{"num_frames": 3, "scale": 0.1} | settings)
    return lambda folder, run: lambda: simulate("S02_D4_A", folder, settings, jobs=jobs)


def command(*words):
    """`psotrack simulate` in a folder with a file of sticks; nothing may be written."""

    def make(folder, run):
        write_sticks(folder / "script.csv", SCRIPT)
        return lambda: run("simulate", *words)

    return make


#: PLY file with the three corners of a triangle; the face and the corners follow.
_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
)
_TRIANGLE = "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\n"
_IN_HALL = "in the hall, x within 5 m of 0, y within 4 m, z from 0 to 4 m, found ["

#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Scenario files.
    "a negative period": (bad_file,
        "mine.toml: drones[0].flight.terms[0].period_s: expected a number of at least 0.001, found -7.4"),
    "more frames than a disk holds": (scene(num_frames=2500000000),
        "num_frames: expected a whole number of at most 1000000, found 2500000000"),
    "a name that is a path": (scene(name="../up"),
        "name: expected a name of letters, digits, dots, dashes and underscores", 'found "../up"'),
    # Changed fields.
    "a drone that is not there": (scene(**{"drones[4].yaw_deg": 0}),
        "drones[4].yaw_deg: expected a field of the scenario, found none"),
    # What does not fit the hall.
    "no hall": (scene(hall="lab"), "scenario S02_D4_A: hall: expected one of laboratory, large_hall, found lab"),
    "a camera in the wall": (scene(cameras=[CAMERA, CAMERA | {"position_m": [5.0, 0.0, 2.0]}]),
        f"cameras[1].position_m: expected a place {_IN_HALL}5.0, 0.0, 2.0]"),
    "a camera in a pillar": (scene(cameras=[CAMERA | {"position_m": [-2.0, 2.9, 2.0]}]),
        "cameras[0].position_m: expected a place outside of the furniture, found [-2.0, 2.9, 2.0]"),
    "a camera that looks down": (scene(cameras=[CAMERA | {"target_m": [-4.0, -3.0, 0.0]}]),
        "cameras[0].target_m: expected a point that is not straight above"),
    "limits in the wrong order": (scene(limits__lower_m=[-2.7, 2.0, 0.7]),
        "limits.lower_m: expected less than limits.upper_m, [2.7, 1.9, 2.4], along each axis, found [-2.7, 2.0, 0.7]"),
    "a flight through furniture": (scene(limits__lower_m=[-4.9, -3.9, 0.1], limits__max_speed_m_s=20,
        limits__max_acceleration_m_s2=50, limits__max_tilt_deg=80, limits__min_distance_m=0,
        drones=[{"flight": {"kind": "crossing", "start_m": [-4.8, -1, 0.5], "end_m": [1, -1, 0.5], "period_s": 9}}]),
        "drones[0].flight: expected a way around the furniture, found [-4."),
    "an angle of view of 180 degrees": (scene(onboard__fov_deg=[180.0, 60.0]),
        "onboard.fov_deg: expected angles below 180 degrees, found [180.0, 60.0]"),
    "angles of view of other pixels": (scene(onboard__fov_deg=[90.0, 90.0]),
        "onboard.fov_deg: expected angles that fit 1920 x 1080 square pixels, 90 and 58.72, found [90.0, 90.0]"),
    "an exposure longer than a frame": (scene(imaging__shutter_s=0.05),
        "imaging.shutter_s: expected at most 0.04 s, the time between two frames, found 0.05"),
    "a slow shutter": (scene(onboard__line_time_s=1e-3),
        "onboard.line_time_s: expected at most 3.7e-05 s: 1080 rows in 0.04 s"),
    # Flights.
    "a leader that is not there": (flights(ORBIT, Formation(leader=3, offset_m=(0, 0, 1))),
        "scenario T: drones[1].flight.leader: expected", "1 to 2, found 3"),
    "a cycle": (flights(Formation(leader=2, offset_m=(0, 0, 1)), FollowingFlight(leader=3, delay_s=1.0), NEAR, ORBIT),
        "drones[2].flight.other: expected relative flights without a cycle, found drones 1 -> 2 -> 3 -> 1"),
    "a side that is not perpendicular": (flights(ORBIT, replace(NEAR, side=(1.0, 0.0, 1.0))),
        "flight.side: expected a direction perpendicular to swing_m, found one at 45 degrees to it; "),
    "the first point again": (flights(replace(POINTS, points_m=(*POINTS.points_m, (0.0, 0.0, 1.0)))),
        "drones[0].flight.points_m[0]: expected a point that differs", "found [0.0, 0.0, 1.0] again; "),
    # Limits, with value and time.
    "too near": (flights(*CROSSINGS, min_distance_m=1.0),
        "drones[1].flight: expected at least 1 m from drones[0] (limits.min_distance_m), found 0.5 m at 2.00 s"),
    "too fast": (flights(*CROSSINGS, max_speed_m_s=1.2),
        "drones[0].flight: expected at most 1.2 m/s (limits.max_speed_m_s), found 1.571 m/s at 2.00 s"),
    "too much acceleration": (flights(*CROSSINGS, max_acceleration_m_s2=0.5),
        "expected at most 0.5 m/s2 (limits.max_acceleration_m_s2), found 1.234 m/s2 at 0.00 s"),
    "too much tilt": (flights(*CROSSINGS, max_tilt_deg=3.0),
        "at most 3 degrees of tilt (limits.max_tilt_deg), found 7.168 degrees of tilt at 0.00 s"),
    "too far": (flights(*CROSSINGS, upper_m=(3.0, 1.9, 2.0)),
        "drones[1].flight: expected positions from [-9.0, -9.0, -9.0] (limits.lower_m) to [3.0, 1.9, 2.0] "
        "(limits.upper_m), found [0.000, 2.000, 1.500] at 4.00 s"),
    # x = 0.3 + 1.5 cos(2 pi t / 6.28 s - 2 pi / 6.28 * 1 frame): frame 1 is at 1.8 m, frames 0 and 6 are lower.
    "too far in one frame": (flights(replace(ORBIT, phase_deg=-360.0 / (25 * 6.28), period_s=6.28, rise_m=0.0),
        upper_m=(1.79999, 9.0, 9.0), num_frames=100), "found [1.800, -0.200, 1.400] at 0.04 s"),
    # 1 m in 10 ms between two frames; the drone hovers at every frame.
    "too fast between frames": (
        flights(Waypoints(points_m=((0.0, 0.0, 1.0), (1.0, 0.0, 1.0)), speed_m_s=100.0, hover_s=0.99)),
        "drones[0].flight.speed_m_s: expected at most 9 m/s (limits.max_speed_m_s), found 100"),
    "numbers that overflow": (flights(Waypoints(points_m=((0.0, 0.0, 1.0), (1e300, 0.0, 1.0)), speed_m_s=1.0)),
        "expected positions from ", "found [nan, "),
    "every variation too far": (flights(CROSSINGS[0], variation=Variation(),
        lower_m=(-2.5, -2.5, 1.0), upper_m=(2.5, 2.5, 1.0)), "; 400 of 400 variations broke this limit: "),
    # The minimum distance applies between a drone that passes another one and a third drone.
    "a third drone too near": (flights(ORBIT, replace(NEAR, distance_m=0.3, swing_m=(1.5, 0.0, 0.0)),
        Formation(leader=2, offset_m=(0.0, 0.0, 0.5)), min_distance_m=0.8),
        "drones[2].flight: expected at least 0.8 m from drones[1]"),
    # Recorded flights.
    "more frames than the recording": (replayed(num_frames=301),
        "r.csv: expected a recording of at least 12 s, found 11.99 s; 300 of the 301 frames would fit"),
    "a start after the end": (replayed(start_s=12.0), "r.csv: expected a recording of at least 21.96 s, found 11.99 s"),
    "a follower before the start": (replayed([FollowingFlight(leader=1, delay_s=1.5)], start_s=1.0),
        "r.csv: expected a start_s of at least 1.5 s, found 1 s; the drone that foll"),
    "the flights of two drones": (tracks(num_drones=2),
        "loop.csv: expected the flight of one drone, found a, b; keep one drone's rows"),
    "five positions": (tracks(count=5), "loop.csv: expected at least 6 positions, found 5"),
    # Meshes.
    "another suffix": (mesh("solid", "a.stl"), "a.stl: expected a mesh, .obj or .ply, found .stl; export"),
    "an empty PLY file": (mesh("", "a.ply"), "a.ply: expected a mesh, found a file that cannot be read", "; export"),
    "corners without faces": (mesh(_TRIANGLE), "expected faces with an area, found no faces; export a surface"),
    "no number": (mesh("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n"), "expected numbers as vertices, found NaN"),
    "vertex 7 of 3": (mesh(_PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "a.ply"),
        "expected faces of its 3 vertices, found vertex 7"),
    "millimetres": (mesh("v 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3\n"),
        "expected a drone of 0.02 to 3 m over all, found 300 m; set scale"),
    "a far origin": (mesh("v 9 0 0\nv 9.5 0 0\nv 9 0.5 0\nf 1 2 3\n"),
        "expected the body origin in or near the drone, found ", "(9.25, 0.25, 0) m; set origin_m"),
    "a rotor far away": (mesh(_TRIANGLE + "f 1 2 3\n",
        rotors=(Rotor(centre_m=(0, 0, 0), radius_m=0.05), Rotor(centre_m=(120, 80, 0), radius_m=0.05))),
        "expected rotors within 3 m of the body origin, found rotors[1] that reaches 144 m; "),
    # Flights by hand.
    "a start above the ceiling": (flown(Sample(0.0, Sticks()), start_m=(0.0, 0.0, 4.0)),
        "start: expected a point from (-4.6, -3.6, 0.15) to (4.6, 3.6, 3.6), found (0, 0, 4)"),
    "a flight of four samples": (flown(Sample(0.0, Sticks(1.0)), Sample(0.13, Sticks())),
        "flight: expected at least 6 samples, found 4"),
    "a stick beyond its end": (sticks("-0.5", "-1.5"),
        "s.csv, line 2, column left: expected a number from -1 to 1, found -1.5"),
    "times that go back": (sticks("2.5", "0.2"), "line 4, column time_s: expected a time above 0.333333, found 0.2"),
    "an unknown device": (lambda folder, run: lambda: open_device("joystick", LABORATORY).__enter__(),
        "device: expected gamepad, keyboard, or a file ", "found joystick"),
    # Sequences.
    "tiny images": (simulated(scale=0.01), "scale: expected images of at least 32 pixels a side, found 20 x 10"),
    "a negative seed": (simulated(seed=-1), "seed: expected 0 or more, found -1"),
    "no jobs": (simulated(jobs=0), "jobs: expected 1 or more, found 0"),
    "a laboratory's recording elsewhere": (lambda folder, run: lambda: simulate_own_cameras(
        "S03_D10_A", folder / "lab", SimulationSettings(1, 0.1)), "hall: expected laboratory, found large_hall"),
    # Commands.
    "neither a name nor a file": (command("--seed", "1"),
        "simulate: expected the NAME of a scenario or --scenario FILE.toml, found neither"),
    "a change without a value": (command("S01_D2_A", "--out", "x", "--set", "imaging"),
        "--set: expected FIELD=VALUE"),
    "changes of what is shown": (command("S01_D2_A", "--show", "--set", "fps=50"),
        "whose file is shown as it is, found fps=50"),
    "an output of another kind": (command("fly", "--device", "script.csv", "--out", "loop"),
        "--out: expected a file that ends in .csv, found loop"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_in_one_line(name, tmp_path, monkeypatch, run_psotrack, capfd):
    make, *words = BAD[name]
    monkeypatch.chdir(tmp_path)
    assert_refused(make(tmp_path, run_psotrack), *words, unchanged=tmp_path)
    assert capfd.readouterr() == ("", "")


# --- any value of any field


def field_paths(value, path=""):
    """Yield the dotted path of every field of nested dictionaries and lists."""
    yield path
    items = value.items() if isinstance(value, dict) else ()
    for name, inner in items:
        yield from field_paths(inner, f"{path}.{name}".lstrip("."))
    for index, inner in enumerate(value if isinstance(value, list | tuple) else ()):
        yield from field_paths(inner, f"{path}[{index}]")


#: Name of a scenario -> paths of all its fields.
PATHS = {
    name: [path for path in field_paths(msgspec.to_builtins(scenario(name))) if path]
    for name in ("S02_D4_A", "S06_D6", "S12_D3")
}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["kind", "file", "x"]), inner)
    ),
    max_leaves=4,
)


@given(name=st.sampled_from(sorted(PATHS)), data=st.data(), value=VALUES)
def test_any_value_of_a_field_is_accepted_or_refused_in_one_line(name, data, value):
    path = data.draw(st.sampled_from(PATHS[name]))
    try:
        recipe = change_scenario(scenario(name), {path: value})
    except SettingsError as error:
        refusal = str(error)
        # The message begins with the field, with its parent, or with a field inside the given value.
        assert refusal.startswith(path.rpartition(".")[0])
        assert ": expected " in refusal
        assert not {"\n", "`", "$"} & set(refusal.replace(json.dumps(value, default=str)[:60], ""))
    else:
        json.dumps(msgspec.to_builtins(recipe), allow_nan=False)

"""Scenarios: the thirteen presets of the dataset, scenario files, and changed fields."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from placed_drones import S02

from psotrack.simulation import build, catalogue, change_scenario, load, preset_names, preset_text, scenario
from psotrack.simulation.scenarios import FlightFromFile, Mesh, NearPass

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


def test_the_presets_are_the_sequences_of_the_dataset(run_psotrack):
    """The paper states 20 min 3 s in total, and 91 min 25 s when each sequence is counted once per drone."""
    rows, models = catalogue(), set()
    assert preset_names() == tuple(DATASET) == tuple(row["name"] for row in rows)
    assert sum(row["frames"] for row in rows) / 25 == 20 * 60 + 3
    assert sum(row["frames"] * row["drones"] for row in rows) / 25 == 91 * 60 + 25
    shown = run_psotrack("simulate", "--list").out
    # Speeds measured on the dataset: the fast sequences, the sequences flown by hand, and all others.
    fast = dict.fromkeys(("S08_D8", "S09_D6", "S10_D6"), (3.4, 4.0))
    by_hand = dict.fromkeys(("S11_D4", "S12_D3", "S13_D3"), (0.25, 0.43))
    for row in rows:
        name, recipe = row["name"], scenario(row["name"])
        drones, cameras, frames = DATASET[name]
        assert (row["drones"], row["cameras"], row["frames"]) == (drones, cameras, frames)
        assert (recipe.name, recipe.fps, recipe.image_size_wh) == (name, 25.0, (1920, 1080))
        assert row["markers"] == row["onboard"] == name.endswith("_A")
        assert row["hall"] == ("large_hall" if 3 <= int(name[1:3]) <= 10 else "laboratory")
        assert f"{name}: {drones} drones, {cameras} cameras, {frames} frames, {row['hall']}" in shown
        assert row["description"] in shown
        least, most = (fast | by_hand).get(name, (0.5, 3.0))
        assert least <= row["mean_speed_m_s"] <= most
        assert len({(drone.model, drone.paint_bgr) for drone in recipe.drones}) == drones
        models |= {drone.model for drone in recipe.drones}
        assert recipe.limits.min_distance_m >= 0.8
        near_m = [drone.flight.distance_m for drone in recipe.drones if isinstance(drone.flight, NearPass)]
        assert bool(near_m) == (name in {"S01_D2_A", "S04_D10", "S06_D6"})
        if name == "S01_D2_A":
            assert near_m == [0.3], "its two drones pass each other at 30 cm"
    assert models == {"x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross"}


@pytest.mark.parametrize("name", DATASET)
def test_all_cameras_see_the_drones_of_every_preset_most_of_the_time(name):
    scene = build(scenario(name), scale=0.1)
    position_m = scene.positions_m(scene.scenario.num_frames)[::25].reshape(-1, 3)
    for cam in (scene.rig.cameras[index] for index in range(len(scene.rig))):
        points = position_m @ cam.T_cam_world[:3, :3].T + cam.T_cam_world[:3, 3]
        pixel = (points / points[:, 2:]) @ cam.K.T
        seen = (points[:, 2] > 0) & np.all((pixel[:, :2] > 0) & (pixel[:, :2] < cam.image_size_wh), axis=-1)
        assert seen.mean() > 0.5


def test_a_file_is_read_and_its_paths_are_relative_to_its_folder(tmp_path, monkeypatch, run_psotrack):
    path = tmp_path / "mine" / "mine.toml"
    path.parent.mkdir()
    for name in DATASET:
        path.write_text(preset_text(name), encoding="utf-8")
        assert load(path) == scenario(name)
    assert run_psotrack("simulate", "S01_D2_A", "--show").out == preset_text("S01_D2_A")
    head, _, _, third = preset_text("S12_D3").split("[[drones]]")
    path.write_text(
        head
        + '[[drones]]\nmodel = { file = "shapes/a.obj", scale = 0.01 }\n'
        + 'flight = { kind = "recording", file = "r.csv" }\n'
        + '[[drones]]\nflight = { kind = "recording", file = "/elsewhere/r.csv", start_s = 2.5 }\n'
        + f"[[drones]]{third}"
    )
    monkeypatch.chdir(tmp_path)
    for given_path in (path, Path("mine/mine.toml")):
        first, second, third_drone = load(given_path).drones
        assert first.model == Mesh(file=str(tmp_path / "mine/shapes/a.obj"), scale=0.01)
        assert first.flight == FlightFromFile(file=str(tmp_path / "mine/r.csv"))
        assert second.flight == FlightFromFile(file="/elsewhere/r.csv", start_s=2.5)
        assert third_drone == scenario("S12_D3").drones[2]


def test_change_scenario_changes_only_the_given_fields():
    changes = {
        "imaging.reflections": 0,
        "surroundings.screen": 0.02,
        "drones[1].flight.terms[0].period_s": 8.0,
        "drones[2].model": {"file": "a.obj"},
        "onboard": None,
    }
    changed = change_scenario(S02, changes)
    assert changed.imaging == msgspec.structs.replace(S02.imaging, reflections=0.0)
    assert changed.surroundings.screen == 0.02
    assert changed.drones[1].flight.terms[0].period_s == 8.0
    assert changed.drones[2].model == Mesh(file="a.obj")
    assert changed.onboard is None
    old = {
        "imaging.reflections": S02.imaging.reflections,
        "surroundings": {},
        "drones[1].flight.terms[0].period_s": S02.drones[1].flight.terms[0].period_s,
        "drones[2].model": S02.drones[2].model,
        "onboard": {},
    }
    assert change_scenario(changed, old) == change_scenario(S02, {}) == S02
    # A part that is missing starts from its defaults.
    with_camera = change_scenario(scenario("S04_D10"), {"onboard.pitch_deg": -20})
    assert with_camera.onboard == msgspec.structs.replace(S02.onboard, pitch_deg=-20.0)
    # Angles that are equal fit a square image.
    build(
        change_scenario(S02, {"onboard.fov_deg": [90.0, 90.0], "onboard.image_size_wh": [800, 800]}),
        scale=0.1,
    )

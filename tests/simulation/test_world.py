"""Scenarios and their world: the presets of the dataset, scenario files, drones, meshes, halls, markers and light.

The oracles are trimesh, files that trimesh writes, and points along rays.
"""

import itertools
from collections import defaultdict
from pathlib import Path

import msgspec
import numpy as np
import pytest
import trimesh
from placed_drones import S02

from psotrack.geometry import project
from psotrack.simulation import build, catalogue, change_scenario, load, preset_names, preset_text, scenario
from psotrack.simulation.scenarios import FlightFromFile, Mesh, NearPass, Rotor
from psotrack.simulation.world import drones, rooms
from psotrack.simulation.world.rooms import HALLS

MODELS = {name: drones.model(name) for name in drones.MODELS}


def distances_m(points_m):
    """Distances of all pairs of points, in ascending order, metres."""
    return np.sort([np.linalg.norm(a - b) for a, b in itertools.combinations(points_m, 2)])


# --- the five models


#: Name -> rotors, distance of the outermost motors, length over all, metres, and volume of the solid parts, cm3.
SIZES = {
    "x_frame": (4, 0.34, 0.39, 660.9),
    "x_frame_racer": (4, 0.25, 0.34, 287.9),
    "camera_drone": (4, 0.40, 0.46, 1260.6),
    "hexacopter": (6, 0.55, 0.80, 3120.8),
    "tall_cross": (4, 0.40, 0.58, 1430.5),
}


@pytest.mark.parametrize("name", SIZES)
def test_a_model_is_closed_and_has_its_stated_sizes(name):
    """The oracle is trimesh, which computes the edges and the volume of each part."""
    assert list(drones.MODELS) == list(SIZES)
    model = MODELS[name]
    rotors, motor_to_motor_m, over_all_m, volume_cm3 = SIZES[name]
    corners_m = model.triangles_m.reshape(-1, 3)
    faces = np.arange(len(corners_m)).reshape(-1, 3)
    parts = trimesh.Trimesh(corners_m, faces, process=True).split(only_watertight=False)
    assert len(parts) > 10
    for part in parts:
        assert part.is_watertight
        assert part.is_winding_consistent
        assert part.volume > 0
    # A change of a shape changes every figure that is made with it.
    assert 1e6 * sum(part.volume for part in parts) == pytest.approx(volume_cm3, rel=1e-3)
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=-1), 1.0)
    assert np.all((model.paint >= 0) & (model.paint <= 1))
    assert len(model.rotor_centres_m) == rotors
    # Stated sizes are rounded to 0.01 m.
    assert distances_m(model.rotor_centres_m)[-1] == pytest.approx(motor_to_motor_m, abs=0.005)
    points = np.concatenate([model.triangles_m, drones.disc_fans(model)]).reshape(-1, 3)
    assert np.ptp(points, axis=0).max() == pytest.approx(over_all_m, abs=0.006)
    assert np.linalg.norm(points, axis=-1).max() <= model.radius_m + 1e-12


@pytest.mark.parametrize("name", MODELS)
def test_marker_crosses_stand_on_top_are_asymmetric_and_differ_between_ten_drones(name):
    model = MODELS[name]
    crosses = [drones.marker_cross(model, number) for number in range(1, 11)]
    # A is in front, C behind, B to the left, D to the right; the arms cross at right angles above the origin.
    a, b, c, d = crosses[2]
    assert a[0] > 0 > c[0]
    assert b[1] > 0 > d[1]
    np.testing.assert_array_equal([a[1], c[1], b[0], d[0]], 0.0)
    sides_m = []
    for cross in crosses:
        assert cross[:, 2].min() > model.triangles_m[..., 2].max()
        sides_m.append(distances_m(cross))
    # The table of crosses states 12 mm, and 20 mm, rounded. Rotating, moving or mirroring a cross keeps its six
    # distances, so at least one distance must differ.
    assert np.diff(sides_m).min() > 0.012
    for first, second in itertools.combinations(sides_m, 2):
        assert np.abs(first - second).max() > 0.019


# --- meshes


MESH_FORMATS = {
    "obj": (".obj", {}),
    "ply": (".ply", {}),
    "ply ascii": (".ply", {"encoding": "ascii"}),
    "capitals": (".PLY", {"file_type": "ply"}),
}


@pytest.mark.parametrize("mesh_format", MESH_FORMATS)
def test_a_mesh_is_read_exactly_with_its_scale_origin_and_rotors(mesh_format, tmp_path):
    suffix, options = MESH_FORMATS[mesh_format]
    path = tmp_path / f"cube{suffix}"
    shape = trimesh.creation.box((256, 256, 256))  # exact in every format
    shape.export(path, **options)
    small = Rotor(centre_m=(0.1, 0.2, 0.3), radius_m=0.05)
    large = Rotor(centre_m=(-0.1, 0.2, 0.3), radius_m=0.07)
    origin_m = (0.125, 0.0, -0.0625)
    model = drones.model(Mesh(file=str(path), scale=1 / 1024, origin_m=origin_m, rotors=(small, large)))
    np.testing.assert_array_equal(model.triangles_m, shape.triangles / 1024 - origin_m)
    np.testing.assert_array_equal(model.rotor_centres_m, [small.centre_m, large.centre_m])
    np.testing.assert_array_equal(model.rotor_radii_m, [0.05, 0.07])
    np.testing.assert_array_equal(model.paint, 1.0)
    # The rim of each rotor's disc has the rotor's radius, and the farther rotor's rim is the farthest point.
    fans = drones.disc_fans(model).reshape(2, -1, 3, 3)
    for fan, rotor in zip(fans, (small, large), strict=True):
        rim_m = np.linalg.norm(fan[:, 1:] - rotor.centre_m, axis=-1)
        np.testing.assert_allclose(rim_m, rotor.radius_m)
    assert model.radius_m == pytest.approx(np.sqrt(0.14) + 0.07)


def test_polygons_materials_parts_and_latin_1_are_read(tmp_path, capfd):
    path = tmp_path / "drone.obj"
    text = """# Fl\xfcgel
mtllib missing.mtl
v 0 0 0
v 0.5 0 0
v 0.5 0.5 0
v 0 0.5 0
vn 0 0 1
o Fl\xfcgel
usemtl red
f 1//1 2//1 3//1 4//1
f -4 -3 -2
f 1 1 2
"""
    path.write_bytes(text.encode("latin-1"))
    model = drones.model(Mesh(file=str(path)))
    a, b, c = model.triangles_m.swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
    # The square is two triangles, the triangle is half of the square, and the face without area is dropped.
    np.testing.assert_allclose(area, [0.125] * 3)
    assert capfd.readouterr() == ("", "")


# --- halls and rigs


#: Hall -> lower and upper corner of the flight volume, (x, y, z), metres.
VOLUMES = {
    "laboratory": ((-2.7, -1.9, 0.7), (2.7, 1.9, 2.4)),
    "large_hall": ((-5.0, -3.8, 0.8), (5.0, 3.8, 4.6)),
}


@pytest.fixture(scope="module", params=HALLS)
def hall_name(request):
    return request.param


def are_hidden(points_m, eye_m, boxes, step_m):
    """Return whether a box is between the eye and each point, (points,) bool, by testing points along the ray."""
    length = np.linalg.norm(points_m - eye_m, axis=-1).max()
    shares = np.linspace(0, 1, int(length / step_m))
    path = eye_m + shares[:, None, None] * (points_m - eye_m)
    hidden = np.zeros(len(points_m), bool)
    for box in boxes:
        inside = (path >= box.lower_m) & (path <= box.upper_m)
        hidden |= inside.all(axis=-1).any(axis=0)
    return hidden


def test_furniture_stands_inside_the_hall_and_outside_the_flight_volume(hall_name):
    hall = HALLS[hall_name]
    length, width, height = hall.size_m
    low, high = VOLUMES[hall_name]
    below = [surface for surface in rooms.room(hall_name, True, 0.1).surfaces if surface.normal[2] == -1]
    for box in hall.boxes:
        lower, upper = np.array(box.lower_m), np.array(box.upper_m)
        assert np.all(lower < upper)
        assert np.all(lower >= [-length / 2, -width / 2, 0.0])
        assert np.all(upper <= [length / 2, width / 2, height])
        assert np.any((upper < low) | (lower > high)), f"{box} stands in the flight volume"
        if lower[2] == 0:
            continue
        # A box above the floor is closed from below.
        bottom = [lower, [*upper[:2], lower[2]]]
        corners_m = [(face.corners_m.min(axis=0), face.corners_m.max(axis=0)) for face in below]
        assert any(np.allclose(found, bottom) for found in corners_m)


# --- markers, light and textures


def test_41_markers_are_on_the_walls_and_face_inwards(hall_name):
    hall = HALLS[hall_name]
    side = hall.marker_size_m
    corners_m = rooms.room(hall_name, True, 0.1).marker_corners_m
    assert sorted(corners_m) == list(range(1, 42))
    half = np.array(hall.size_m) / 2
    #: Wall -> centres of its markers along the wall and upwards.
    centres_m = defaultdict(list)
    for a, b, c, d in corners_m.values():
        along, down = b - a, d - a
        np.testing.assert_allclose(np.linalg.norm([along, down], axis=1), side, rtol=1e-9)
        np.testing.assert_allclose(a + c, b + d)
        np.testing.assert_array_equal(down[:2], 0.0)
        assert down[2] < 0, "the second row is below the first"
        # The marker is 0.01 m in front of one wall and faces inwards: (along x down) points into the wall.
        (wall,) = np.nonzero(np.isclose(half[:2] - np.abs(a[:2]), 0.01))[0]
        assert along[wall] == 0
        outwards = np.sign(a[wall])
        assert np.sign(np.cross(along, down)[wall]) == outwards
        # The marker with its margin stays inside the wall.
        middle = (a + c) / 2
        assert abs(middle[1 - wall]) < half[1 - wall] - 0.7 * side
        assert 0.7 * side < middle[2] < hall.size_m[2] - 0.7 * side
        centres_m[wall, outwards].append((middle[1 - wall], middle[2]))
    for of_one_wall in centres_m.values():
        for one, other in itertools.combinations(of_one_wall, 2):
            assert np.abs(np.subtract(one, other)).max() > 1.4 * side, "sheets overlap"


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)], ids=["floor", "wall"])
def test_baked_light_agrees_with_the_visibility_of_the_lamp(normal):
    """The oracle tests points along the ray from each floor or wall point to each part of the lamp."""
    panels = rooms.lamps(np.array([[0.3, -0.2, 4.0]]), (0.6, 0.4))
    boxes = [
        rooms.Box((0.5, 0.5, 0.0), (0.9, 1.4, 1.1), (0.5,) * 3),
        rooms.Box((-1.3, -0.9, 0.8), (-0.4, -0.5, 0.9), (0.5,) * 3),  # a table's top
        rooms.Box((1.2, -1.0, 0.0), (1.4, -0.8, 4.0), (0.5,) * 3),  # as high as the lamp
        rooms.Box((-3.0, 1.0, -1.0), (-2.5, 2.0, -0.5), (0.5,) * 3),  # below the floor: no shadow
    ]
    boxes_m = np.array([(box.lower_m, box.upper_m) for box in boxes])
    u, v = np.meshgrid(np.linspace(-1.9, 1.9, 41), np.linspace(-1.9, 1.9, 37))
    nothing = np.zeros_like(u)
    points_m = np.stack([u, v, nothing] if normal[2] else [nothing + 2.0, u, v + 2.0], axis=-1)
    baked = rooms.bake(points_m, np.array(normal), panels, boxes_m)
    raised_m = points_m.reshape(-1, 3) + 2e-3 * np.array(normal)
    normals = np.broadcast_to(normal, raised_m.shape)
    expected = np.full(len(raised_m), rooms.AMBIENT * (0.85 + 0.15 * normal[2]))
    for source_m in panels.samples_m()[0]:
        clear = ~are_hidden(raised_m, source_m, boxes, 0.01)
        expected += clear * panels.direct(raised_m, normals, source_m) / 4
    wrong = np.abs(baked.ravel() - expected) > 1e-9
    # Steps of 1 cm miss the box on rays that cut only a corner of the box.
    assert wrong.mean() < 0.02
    assert baked.min() < baked.max() - 0.05, "there are shadows"


def test_light_on_the_floor_is_even_and_textures_are_valid(hall_name):
    room = rooms.room(hall_name, True, 0.1)
    for surface in room.surfaces:
        assert np.isfinite(surface.texture).all()
        assert surface.texture.min() >= 0
    low, high = VOLUMES[hall_name]
    up = np.array([[0.0, 0.0, 1.0]])
    # White in the middle of the floor is 1, so no part of the floor is overexposed or dark.
    for x in np.linspace(low[0], high[0], 7):
        for y in np.linspace(low[1], high[1], 7):
            (light,) = room.panels.on_faces(np.array([x, y, 0.0]), up)
            assert 0.8 < light < 1.1


# --- scenarios


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
    rows = catalogue()
    assert preset_names() == tuple(DATASET) == tuple(row["name"] for row in rows)
    assert sum(row["frames"] for row in rows) / 25 == 20 * 60 + 3
    assert sum(row["frames"] * row["drones"] for row in rows) / 25 == 91 * 60 + 25
    shown = run_psotrack("simulate", "--list").out
    # Speeds measured on the dataset: the fast sequences, the sequences flown by hand, and all others.
    fast = dict.fromkeys(("S08_D8", "S09_D6", "S10_D6"), (3.4, 4.0))
    by_hand = dict.fromkeys(("S11_D4", "S12_D3", "S13_D3"), (0.25, 0.43))
    models = set()
    for row in rows:
        name = row["name"]
        recipe = scenario(name)
        drones, cameras, frames = DATASET[name]
        assert (row["drones"], row["cameras"], row["frames"]) == (drones, cameras, frames)
        assert (recipe.name, recipe.fps, recipe.image_size_wh) == (name, 25.0, (1920, 1080))
        assert row["markers"] == row["onboard"] == name.endswith("_A")
        assert row["hall"] == ("large_hall" if 3 <= int(name[1:3]) <= 10 else "laboratory")
        assert f"{name}: {drones} drones, {cameras} cameras, {frames} frames, {row['hall']}" in shown
        assert row["description"] in shown
        least, most = (fast | by_hand).get(name, (0.5, 3.0))
        assert least <= row["mean_speed_m_s"] <= most
        models |= {drone.model for drone in recipe.drones}
        assert len({(drone.model, drone.paint_bgr) for drone in recipe.drones}) == drones
        assert recipe.limits.min_distance_m >= 0.8
        near = [drone.flight for drone in recipe.drones if isinstance(drone.flight, NearPass)]
        assert bool(near) == (name in {"S01_D2_A", "S04_D10", "S06_D6"})
    (passing,) = [drone.flight for drone in scenario("S01_D2_A").drones if isinstance(drone.flight, NearPass)]
    assert passing.distance_m == 0.3
    assert models == {"x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross"}


@pytest.mark.parametrize("name", DATASET)
def test_all_cameras_see_the_drones_of_every_preset_most_of_the_time(name):
    scene = build(scenario(name), scale=0.1)
    position_m = scene.positions_m(scene.scenario.num_frames)[::25].reshape(-1, 3)
    pixels, depth_m = project(scene.rig.cameras, position_m[:, None])
    inside = (pixels > 0) & (pixels < scene.rig.cameras.image_size_wh)
    seen = inside.all(axis=-1) & (depth_m > 0)
    assert seen.mean(axis=0).min() > 0.5


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
        "drones[1].flight.terms[0].period_s": 8.0,
        "drones[2].model": {"file": "a.obj"},
        "onboard": None,
    }
    changed = change_scenario(S02, changes)
    assert changed.imaging.reflections == 0.0
    assert changed.drones[1].flight.terms[0].period_s == 8.0
    assert changed.drones[2].model == Mesh(file="a.obj")
    assert changed.onboard is None
    assert changed.drones[3:] == S02.drones[3:]
    assert change_scenario(S02, {}) == S02
    # A part that is missing starts from its defaults.
    with_camera = change_scenario(scenario("S04_D10"), {"onboard.pitch_deg": -20})
    assert with_camera.onboard == msgspec.structs.replace(S02.onboard, pitch_deg=-20.0)
    # Angles that are equal fit a square image.
    square = {"onboard.fov_deg": [90.0, 90.0], "onboard.image_size_wh": [800, 800]}
    build(change_scenario(S02, square), scale=0.1)

"""Drones, meshes, halls, markers and light, compared with trimesh, files that trimesh writes, and points along rays."""

import itertools

import numpy as np
import pytest
import trimesh

from psotrack.simulation.scenarios import Mesh, Rotor
from psotrack.simulation.world import drones, lighting, rooms
from psotrack.simulation.world.halls import HALLS

MODELS = {name: drones.model(name) for name in drones.MODELS}


def as_trimesh(triangles):
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=True)


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
    model, (rotors, motor_to_motor_m, over_all_m, volume_cm3) = MODELS[name], SIZES[name]
    parts = as_trimesh(model.triangles_m).split(only_watertight=False)
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
    widest = max(np.linalg.norm(a - b) for a, b in itertools.combinations(model.rotor_centres_m, 2))
    assert widest == pytest.approx(motor_to_motor_m, abs=0.005)  # stated sizes are rounded to 0.01 m
    points = np.concatenate([model.triangles_m, drones.disc_fans(model)]).reshape(-1, 3)
    assert np.ptp(points, axis=0).max() == pytest.approx(over_all_m, abs=0.006)
    assert np.linalg.norm(points, axis=-1).max() <= model.radius_m + 1e-12


@pytest.mark.parametrize("name", MODELS)
def test_marker_crosses_stand_on_top_are_asymmetric_and_differ_between_ten_drones(name):
    model = MODELS[name]
    crosses = [drones.marker_cross(model, number) for number in range(1, 11)]
    a, b, c, d = crosses[2]
    assert np.all(np.array(crosses)[..., 2] > model.triangles_m[..., 2].max())
    # A is in front, C behind, B to the left, D to the right; the arms cross at right angles above the origin.
    assert a[0] > 0 > c[0]
    assert b[1] > 0 > d[1]
    np.testing.assert_array_equal([a[1], c[1], b[0], d[0]], 0.0)
    sides_m = [
        np.sort([np.linalg.norm(a - b) for a, b in itertools.combinations(cross, 2)]) for cross in crosses
    ]
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
    shape = trimesh.creation.box((256, 256, 256))  # exact in every format
    shape.export(tmp_path / f"cube{suffix}", **options)
    rotors = (
        Rotor(centre_m=(0.1, 0.2, 0.3), radius_m=0.05),
        Rotor(centre_m=(-0.1, 0.2, 0.3), radius_m=0.07),
    )
    mesh = Mesh(
        file=f"{tmp_path / 'cube'}{suffix}", scale=1 / 1024, origin_m=(0.125, 0.0, -0.0625), rotors=rotors
    )
    model = drones.model(mesh)
    np.testing.assert_array_equal(model.triangles_m, shape.triangles / 1024 - [0.125, 0.0, -0.0625])
    np.testing.assert_array_equal(model.rotor_centres_m, [(0.1, 0.2, 0.3), (-0.1, 0.2, 0.3)])
    np.testing.assert_array_equal(model.rotor_radii_m, [0.05, 0.07])
    np.testing.assert_array_equal(model.paint, 1.0)
    # The rim of each rotor's disc has the rotor's radius, and the farther rotor's rim is the farthest point.
    fans = drones.disc_fans(model).reshape(2, -1, 3, 3)
    rims = np.linalg.norm(fans[:, :, 1:] - model.rotor_centres_m[:, None, None], axis=-1)
    np.testing.assert_allclose(rims, np.broadcast_to([[[0.05]], [[0.07]]], rims.shape))
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


def lie_in_boxes(points_m, boxes):
    """Return whether each point lies in one of the boxes, (points,) bool."""
    return np.any(
        [np.all((points_m >= box.lower_m) & (points_m <= box.upper_m), axis=-1) for box in boxes], axis=0
    )


def are_hidden(points_m, eye_m, boxes, step_m=0.02):
    """Return whether a box is between the eye and each point, (points,) bool, by testing points along the ray."""
    length = np.linalg.norm(points_m - eye_m, axis=-1).max()
    shares = np.linspace(0, 1, int(length / step_m))
    path = eye_m + shares[:, None, None] * (points_m - eye_m)
    return lie_in_boxes(path, boxes).any(axis=0)


def test_furniture_stands_inside_the_hall_and_outside_the_flight_volume(hall_name):
    hall = HALLS[hall_name]
    np.testing.assert_array_equal(HALLS["large_hall"].size_m, 2 * np.array(HALLS["laboratory"].size_m))
    length, width, height = hall.size_m
    low, high = VOLUMES[hall_name]
    surfaces = rooms.room(hall_name, True, 0.1).surfaces
    for box in hall.boxes:
        lower, upper = np.array(box.lower_m), np.array(box.upper_m)
        assert np.all(lower < upper)
        assert np.all(lower >= [-length / 2, -width / 2, 0.0])
        assert np.all(upper <= [length / 2, width / 2, height])
        assert np.any((upper < low) | (lower > high)), f"{box} stands in the flight volume"
        if lower[2] == 0:
            continue
        # A box above the floor lies on another box, such as a table, a crate, a pole or a stage.
        beneath = [second for second in hall.boxes if 0 <= lower[2] - second.upper_m[2] <= 0.07]
        supports = [np.all((lower <= each.upper_m)[:2] & (upper >= each.lower_m)[:2]) for each in beneath]
        assert any(supports), f"{box} has no support"
        # It is closed from below.
        spans = [
            (each.corners_m.min(axis=0), each.corners_m.max(axis=0), each.normal[2]) for each in surfaces
        ]
        bottom = [*upper[:2], lower[2]]
        assert any(np.allclose(a, lower) and np.allclose(b, bottom) and z == -1 for a, b, z in spans)


# --- markers, light and textures


def test_41_markers_are_on_the_walls_and_face_inwards(hall_name):
    hall = HALLS[hall_name]
    corners_m = rooms.room(hall_name, True, 0.1).marker_corners_m
    assert sorted(corners_m) == list(range(1, 42))
    half = np.array(hall.size_m) / 2
    quads = []
    for corners in corners_m.values():
        a, b, c, d = corners
        side = hall.marker_size_m
        np.testing.assert_allclose([np.linalg.norm(b - a), np.linalg.norm(d - a)], side, rtol=1e-9)
        np.testing.assert_allclose(a + c, b + d)
        assert np.all(d - a == [0.0, 0.0, (d - a)[2]])
        assert (d - a)[2] < 0, "the second row is below the first"
        # The marker is 0.01 m in front of one wall and faces inwards: (along x down) points into the wall.
        (wall,) = np.nonzero(np.isclose(half[:2] - np.abs(a[:2]), 0.01))[0]
        np.testing.assert_allclose(corners[:, wall], a[wall])
        assert np.sign(np.cross(b - a, d - a)[wall]) == np.sign(a[wall])
        quads.append((wall, np.sign(a[wall]), corners.min(axis=0), corners.max(axis=0)))
        # The marker with its margin stays inside the wall.
        assert np.all(np.abs(corners[:, 1 - wall]) < half[1 - wall] - 0.2 * side)
        assert 0.2 * side < corners[:, 2].min() < corners[:, 2].max() < hall.size_m[2] - 0.2 * side
    for (wall, sign, low, high), (other_wall, other_sign, other_low, other_high) in itertools.combinations(
        quads, 2
    ):
        if (wall, sign) == (other_wall, other_sign):
            gap_m = np.maximum(low - other_high, other_low - high).max()
            assert gap_m > 0.4 * hall.marker_size_m, "sheets overlap"


def test_markers_change_no_wall():
    plain, marked = (rooms.room("laboratory", markers, 0.1) for markers in (False, True))
    assert plain.marker_corners_m == {}
    assert len(marked.surfaces) == len(plain.surfaces) + 41
    for first, second in zip(plain.surfaces[:6], marked.surfaces[:6], strict=True):
        np.testing.assert_array_equal(first.texture, second.texture)


def test_baked_light_agrees_with_the_visibility_of_the_lamp():
    """The oracle tests points along the ray from each floor or wall point to each part of the lamp."""
    panels = lighting.lamps(np.array([[0.3, -0.2, 4.0]]), (0.6, 0.4))
    boxes = [
        rooms.Box((0.5, 0.5, 0.0), (0.9, 1.4, 1.1), (0.5,) * 3),
        rooms.Box((-1.3, -0.9, 0.8), (-0.4, -0.5, 0.9), (0.5,) * 3),  # a table's top
        rooms.Box((1.2, -1.0, 0.0), (1.4, -0.8, 4.0), (0.5,) * 3),  # as high as the lamp
        rooms.Box((-3.0, 1.0, -1.0), (-2.5, 2.0, -0.5), (0.5,) * 3),  # below the floor: no shadow
    ]
    boxes_m = np.array([(box.lower_m, box.upper_m) for box in boxes])
    for normal, grid in (
        ((0.0, 0.0, 1.0), lambda u, v: (u, v, 0 * u)),
        ((-1.0, 0.0, 0.0), lambda u, v: (0 * u + 2.0, u, v + 2.0)),
    ):
        u, v = np.meshgrid(np.linspace(-1.9, 1.9, 41), np.linspace(-1.9, 1.9, 37))
        points = np.stack(grid(u, v), axis=-1)
        baked = lighting.bake(points, np.array(normal), panels, boxes_m)
        flat = points.reshape(-1, 3) + 2e-3 * np.array(normal)
        normals = np.broadcast_to(normal, flat.shape)
        expected = np.full(len(flat), lighting.AMBIENT * (0.85 + 0.15 * normal[2]))
        for source in panels.samples_m()[0]:
            clear = ~are_hidden(flat, source, boxes, 0.01)
            expected += clear * panels.direct(flat, normals, source) / 4
        wrong = np.abs(baked.ravel() - expected) > 1e-9
        # Steps of 1 cm miss the box on rays that cut only a corner of the box.
        assert wrong.mean() < 0.02
        assert (baked < baked.max() - 0.05).any(), "there are shadows"


def test_light_on_the_floor_is_even_and_textures_are_valid(hall_name):
    room = rooms.room(hall_name, True, 0.1)
    for surface in room.surfaces:
        assert np.isfinite(surface.texture).all()
        assert surface.texture.min() >= 0
    (x0, y0, _), (x1, y1, _) = VOLUMES[hall_name]
    places = itertools.product(np.linspace(x0, x1, 7), np.linspace(y0, y1, 7))
    up = np.array([[0.0, 0.0, 1.0]])
    floor = [room.panels.on_faces(np.array([x, y, 0.0]), up)[0] for x, y in places]
    # White in the middle of the floor is 1, so no part of the floor is overexposed or dark.
    assert min(floor) > 0.8
    assert max(floor) < 1.1

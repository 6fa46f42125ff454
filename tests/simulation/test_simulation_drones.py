"""Drone models and meshes, compared with trimesh, OpenCV's polygons, and files that trimesh writes."""

import itertools
import subprocess
import sys

import cv2
import msgspec
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.geometry import project
from psotrack.simulation import CameraRenderer, build, scenario
from psotrack.simulation.scenarios import Mesh, Rotor
from psotrack.simulation.world import drones, models

MODELS = {name: drones.model(name) for name in drones.MODELS}


def as_trimesh(triangles):
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    return trimesh.Trimesh(triangles.reshape(-1, 3), faces, process=True)


# --- the five models


def test_there_are_five_models():
    assert list(drones.MODELS) == ["x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross"]


@pytest.mark.parametrize("name", MODELS)
def test_every_part_is_a_closed_surface_that_faces_outwards(name):
    """The oracle is trimesh, which computes the edges and the volume of each part."""
    parts = as_trimesh(MODELS[name].triangles_m).split(only_watertight=False)
    assert len(parts) > 10
    for part in parts:
        assert part.is_watertight
        assert part.is_winding_consistent
        assert part.volume > 0
    np.testing.assert_allclose(np.linalg.norm(MODELS[name].normals, axis=-1), 1.0)
    assert np.all((MODELS[name].paint >= 0) & (MODELS[name].paint <= 1))


@pytest.mark.parametrize(
    ("name", "rotors", "motor_to_motor_m", "over_all_m"),
    [
        ("x_frame", 4, 0.34, 0.39),
        ("x_frame_racer", 4, 0.25, 0.34),
        ("camera_drone", 4, 0.40, 0.46),
        ("hexacopter", 6, 0.55, 0.80),
        ("tall_cross", 4, 0.40, 0.58),
    ],
)
def test_models_have_their_stated_sizes(name, rotors, motor_to_motor_m, over_all_m):
    model = MODELS[name]
    rotor_centres_m = model.rotor_centres_m
    assert len(rotor_centres_m) == rotors
    widest = max(np.linalg.norm(a - b) for a, b in itertools.combinations(rotor_centres_m, 2))
    assert widest == pytest.approx(motor_to_motor_m, abs=0.005)  # stated sizes are rounded to 0.01 m
    points = np.concatenate([model.triangles_m, drones.disc_fans(model)]).reshape(-1, 3)
    assert np.ptp(points, axis=0).max() == pytest.approx(over_all_m, abs=0.006)
    assert np.linalg.norm(points, axis=-1).max() <= model.radius_m + 1e-12


@pytest.mark.parametrize("name", MODELS)
def test_rotors_turn_above_their_motors_without_touching_each_other(name):
    model = MODELS[name]
    vertices = model.triangles_m.reshape(-1, 3)
    for hub, radius in zip(model.rotor_centres_m, model.rotor_radii_m, strict=True):
        # The rotor's cap is a cylinder with a radius of 6 mm around the rotor's centre.
        assert np.linalg.norm(vertices - hub, axis=-1).min() < 0.008
        swept = np.linalg.norm(vertices[:, :2] - hub[:2], axis=-1) < radius
        own_motor = np.linalg.norm(vertices[:, :2] - hub[:2], axis=-1) < 0.02
        assert np.abs(vertices[swept & ~own_motor][:, 2] - hub[2]).min(initial=np.inf) > 0.003
    for (a, r), (b, s) in itertools.combinations(
        zip(model.rotor_centres_m, model.rotor_radii_m, strict=True), 2
    ):
        apart = np.linalg.norm(a - b) > r + s
        assert apart or abs(a[2] - b[2]) > 0.01


def test_each_rotor_disc_has_the_radius_of_its_rotor():
    model = drones.DroneModel(
        models.box((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)),
        np.ones(12),
        np.array([[0.2, 0.0, 0.1], [-0.3, 0.1, 0.2]]),
        np.array([0.05, 0.4]),
    )
    fans = drones.disc_fans(model).reshape(2, -1, 3, 3)
    np.testing.assert_array_equal(
        fans[:, :, 0], np.repeat(model.rotor_centres_m[:, None], fans.shape[1], axis=1)
    )
    rims = np.linalg.norm(fans[:, :, 1:] - fans[:, :, :1], axis=-1)
    np.testing.assert_allclose(rims, np.broadcast_to(model.rotor_radii_m[:, None, None], rims.shape))
    assert model.radius_m == pytest.approx(np.hypot(0.3, np.hypot(0.1, 0.2)) + 0.4)


def draw_outline(model, azimuth_deg, elevation_deg, size_px=64):
    """Draw the parallel projection of a model, scaled to a fixed size and centred in a square image."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.array(
        [-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)]
    )
    triangles = np.concatenate([model.triangles_m, drones.disc_fans(model)]) @ np.stack([right, -up], axis=1)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    pixels = (triangles - (low + high) / 2) * (size_px - 2) / (high - low).max() + size_px / 2
    image = np.zeros((size_px, size_px), np.uint8)
    for triangle in pixels.round().astype(np.int32):
        cv2.fillConvexPoly(image, triangle, 1)
    return image.astype(bool)


@pytest.mark.parametrize(("elevation_deg", "limit"), [(0.0, 0.62), (25.0, 0.78)])
@pytest.mark.parametrize("pair", list(itertools.combinations(MODELS, 2)), ids=" ".join)
def test_silhouettes_differ_in_shape_not_only_in_size(pair, elevation_deg, limit):
    """The largest overlap (IoU) of two models over all headings is limited, from the side and from above."""
    first, second = (MODELS[name] for name in pair)
    overlaps = []
    for azimuth, other_azimuth in itertools.product((0.0, 20.0, 40.0), range(0, 360, 15)):
        first_outline, second_outline = (
            draw_outline(first, azimuth, elevation_deg),
            draw_outline(second, float(other_azimuth), elevation_deg),
        )
        overlaps.append((first_outline & second_outline).sum() / (first_outline | second_outline).sum())
    # Largest measured overlaps: 0.57 from the side (hexacopter, tall_cross), 0.74 from above (x_frame, tall_cross).
    assert max(overlaps) < limit


# --- markers


def pairwise_distances_m(cross):
    return np.sort([np.linalg.norm(a - b) for a, b in itertools.combinations(cross, 2)])


@pytest.mark.parametrize("name", MODELS)
def test_marker_crosses_are_asymmetric_and_differ_between_ten_drones(name):
    crosses = [drones.marker_cross(MODELS[name], number) for number in range(1, 11)]
    for cross in crosses:
        assert (
            np.diff(pairwise_distances_m(cross)).min() > 0.012
        )  # the value that the table of crosses states
    # Rotating, moving or mirroring a cross keeps its six distances, so at least one distance must differ.
    for a, b in itertools.combinations(crosses, 2):
        assert np.abs(pairwise_distances_m(a) - pairwise_distances_m(b)).max() > 0.019  # 20 mm, rounded


@pytest.mark.parametrize("name", MODELS)
def test_markers_form_a_cross_on_top_of_the_drone(name):
    model = MODELS[name]
    a, b, c, d = drones.marker_cross(model, 3)
    top = model.triangles_m[..., 2].max()
    assert np.all(np.array([a, b, c, d])[:, 2] > top)
    # A is in front, C behind, B to the left, D to the right; the arms cross at right angles above the origin.
    assert a[0] > 0 > c[0]
    assert b[1] > 0 > d[1]
    np.testing.assert_array_equal([a[1], c[1], b[0], d[0]], 0.0)


# --- meshes


@pytest.fixture
def cube(tmp_path):
    """Return a function that lets trimesh export a cube of 0.2 m and returns the file's path and the triangles."""

    def write(suffix, scale=1.0, **options):
        shape = trimesh.creation.box((0.2 * scale, 0.2 * scale, 0.2 * scale))
        path = tmp_path / f"cube{suffix}"
        shape.export(path, **options)
        return path, shape.triangles

    return write


MESH_FORMATS = {
    "obj": (".obj", {}),
    "ply": (".ply", {}),
    "ply ascii": (".ply", {"encoding": "ascii"}),
    "capitals": (".PLY", {"file_type": "ply"}),
}


@pytest.mark.parametrize("mesh_format", MESH_FORMATS)
def test_an_exported_mesh_is_read_with_the_same_triangles(mesh_format, tmp_path):
    suffix, options = MESH_FORMATS[mesh_format]
    written = as_trimesh(MODELS["hexacopter"].triangles_m)
    written.export(tmp_path / f"drone{suffix}", **options)
    model = drones.model(Mesh(file=str(tmp_path / f"drone{suffix}")))
    # PLY holds float32 and OBJ eight decimals, so coordinates are exact to about 1e-8 m.
    np.testing.assert_allclose(model.triangles_m, written.triangles, atol=4e-8)
    np.testing.assert_array_equal(model.paint, 1.0)
    assert model.rotor_centres_m.shape == (0, 3)
    assert drones.disc_fans(model).shape == (0, 3, 3)
    assert model.radius_m == pytest.approx(np.linalg.norm(written.vertices, axis=-1).max(), abs=1e-7)


@pytest.mark.parametrize("mesh_format", MESH_FORMATS)
def test_scale_origin_and_rotors_are_exact(mesh_format, cube):
    suffix, options = MESH_FORMATS[mesh_format]
    path, triangles = cube(suffix, scale=1280.0, **options)  # 256 units: exact in every format
    rotors = (
        Rotor(centre_m=(0.1, 0.2, 0.3), radius_m=0.05),
        Rotor(centre_m=(-0.1, 0.2, 0.3), radius_m=0.07),
    )
    model = drones.model(Mesh(file=str(path), scale=1 / 1024, origin_m=(0.125, 0.0, -0.0625), rotors=rotors))
    np.testing.assert_array_equal(model.triangles_m, triangles / 1024 - [0.125, 0.0, -0.0625])
    np.testing.assert_array_equal(model.rotor_centres_m, [(0.1, 0.2, 0.3), (-0.1, 0.2, 0.3)])
    np.testing.assert_array_equal(model.rotor_radii_m, [0.05, 0.07])


def test_polygons_materials_parts_and_latin_1_are_read(tmp_path, capfd):
    path = tmp_path / "drone.obj"
    text = """# Fl\xfcgel
mtllib missing.mtl
v 0 0 0
v 0.5 0 0
v 0.5 0.5 0
v 0.25 0.75 0
v 0 0.5 0
vn 0 0 1
o Fl\xfcgel
usemtl red
f 1//1 2//1 3//1 4//1 5//1
usemtl blue
f -5 -4 -3
f 1 1 2
"""
    path.write_bytes(text.encode("latin-1"))
    model = drones.model(Mesh(file=str(path)))
    a, b, c = model.triangles_m.swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
    # The pentagon is a square and a roof, the triangle is half of the square, and the face without area is dropped.
    assert len(area) == 4
    assert area.sum() == pytest.approx(0.25 + 0.0625 + 0.125)
    assert capfd.readouterr() == ("", "")


_PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""
_TRIANGLE = "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.stl", "solid", "expected a mesh, .obj or .ply, found .stl; export"),
        ("a", "", "expected a mesh, .obj or .ply, found no suffix; export"),
        ("a.ply", "", "expected a mesh, found a file that cannot be read .*; export"),
        ("a.ply", "\x00\x01\x02" * 99, "expected a mesh, found a file that cannot be read .*; export"),
        ("a.ply", _PLY[:60], "expected a mesh, found a file that cannot be read .*; export"),
        ("a.obj", "", "expected faces with an area, found no faces; export a surface"),
        ("a.obj", "a letter to a friend\n", "expected faces with an area, found no faces; export"),
        ("a.obj", _TRIANGLE, "expected faces with an area, found no faces; export a surface"),
        ("a.obj", _TRIANGLE + "l 1 2\n", "expected faces with an area, found no faces; export"),
        ("a.obj", _TRIANGLE + "f 1 2 2\nf 3 3 3\n", "expected faces with an area, found 2 without; export"),
        ("a.obj", _TRIANGLE + "f 1 2 7\n", "expected a mesh, found a file that cannot be read"),
        ("a.obj", "v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "expected numbers as vertices, found NaN"),
        ("a.ply", _PLY + "0 0 0\ninf 0 0\n0 1 0\n3 0 1 2\n", "expected numbers as vertices, found NaN"),
        (
            "a.ply",
            _PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "expected faces of its 3 vertices, found vertex 7",
        ),
        (
            "a.ply",
            _PLY + "0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n",
            "expected faces of its 3 vertices, found vertex -1",
        ),
        (
            "a.obj",
            "v 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3\n",
            "expected a drone of 0.02 to 3 m over all, found 300 m; set scale",
        ),
        (
            "a.obj",
            "v 0 0 0\nv 0.0003 0 0\nv 0 0.0003 0\nf 1 2 3\n",
            "expected a drone of 0.02 to 3 m over all, found 0.0003 m; set scale",
        ),
        (
            "a.obj",
            "v 9 0 0\nv 9.5 0 0\nv 9 0.5 0\nf 1 2 3\n",
            r"expected the body origin in or near the drone, found .* \(9.25, 0.25, 0\) m; set origin_m",
        ),
    ],
)
def test_files_that_hold_no_drone_are_refused_in_one_line(name, content, message, tmp_path, capfd):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as error_info:
        drones.model(Mesh(file=str(path)))
    assert str(error_info.value).startswith(f"{path}: ")
    assert "\n" not in str(error_info.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("rotor", "reach"),
    [(Rotor(centre_m=(120.0, 80.0, 0.0), radius_m=0.05), 144), (Rotor(centre_m=(0, 0, 0), radius_m=76), 76)],
)
def test_rotors_in_the_units_of_the_mesh_are_refused(rotor, reach, cube):
    path, _ = cube(".obj", 1024)
    fits = Rotor(centre_m=(0.1, 0.1, 0.0), radius_m=0.05)
    message = (
        rf"^{path}: expected rotors within 3 m of the body origin, found rotors\[1\] that reaches {reach} m; "
    )
    with pytest.raises(InputError, match=message):
        drones.model(Mesh(file=str(path), scale=1 / 1024, rotors=(fits, rotor)))


def test_a_missing_file_is_named(tmp_path):
    for path in (tmp_path / "none.obj", tmp_path):
        expected = "No such file" if path.suffix else "no suffix"
        with pytest.raises(InputError, match=f"{path}: expected .*{expected}"):
            drones.model(Mesh(file=str(path)))


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    suffix=st.sampled_from([".obj", ".ply"]),
    cut=st.integers(0, 1000),
    at=st.integers(0, 1000),
    noise=st.binary(max_size=12),
)
def test_damaged_files_are_either_read_or_refused(suffix, cut, at, noise, tmp_path):
    path = tmp_path / f"damaged{suffix}"
    content = trimesh.creation.box((0.2, 0.2, 0.2)).export(file_type=suffix[1:])
    content = content.encode() if isinstance(content, str) else content
    path.write_bytes(content[:at] + noise + content[at + len(noise) : len(content) - cut])
    try:
        model = drones.model(Mesh(file=str(path)))
    except InputError:
        return
    assert len(model.triangles_m) > 0
    assert np.isfinite(model.normals).all()


def test_a_mesh_of_the_user_is_rendered_in_a_scene(tmp_path):
    trimesh.creation.icosphere(subdivisions=2, radius=0.3).export(tmp_path / "ball.obj")
    recipe = scenario("S02_D4_A")
    ball = msgspec.structs.replace(
        recipe.drones[0], model=Mesh(file=str(tmp_path / "ball.obj")), paint_bgr=(0.0, 0.0, 0.0)
    )
    scene = build(msgspec.structs.replace(recipe, drones=(ball,)), scale=0.2)
    renderer = CameraRenderer(scene, 0)
    pixel, depth_m = project(scene.rig.cameras[0], scene.positions_m(21)[20])
    x, y = np.asarray(pixel)[0].round().astype(int)
    shown = renderer.clean_frame(20)
    radius_px = int(0.3 * 1156.3 * 0.2 / float(depth_m[0]))
    inside, outside = (np.s_[y, x + share * radius_px // 10] for share in (8, 14))
    assert shown[inside].max() < 20, "the ball is black"
    assert shown[outside].min() > 50, "the wall behind the ball is brighter"


def test_trimesh_is_not_imported_without_a_mesh():
    code = "import sys, psotrack.simulation.world.drones; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0

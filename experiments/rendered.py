"""A sequence by another renderer than the simulator's: Cycles, the path tracer of Blender.

    pip install bpy==4.2.0                            # Blender as a package, for Python 3.11
    python experiments/rendered.py --data data        # DATA/rendered/Simulated_Data/R01_D4, 20 minutes on two cores
    python experiments/accuracy/accuracy.py foreground --data data --only rendered \
        --rendered data/rendered/Simulated_Data/R01_D4

The drones, their flights and the cameras are the simulator's; the room, its materials and lights are Blender's, with
shadows, reflections and indirect light. Rotors are discs that let most light through. The masks are those that Cycles
renders of each drone. Nothing of it is in the training of the package's network.
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from psotrack.recordings.datasets import open_recording
from psotrack.simulation import Scenario, SimulationSettings, change_scenario, scenario, simulate
from psotrack.simulation.world.drones import disc_fans, model
from psotrack.support import progress_bar

FPS = 2.5
#: Corners of the room from which the cameras look at its middle, metres.
CORNERS_M = ((4.2, 3.2, 2.9), (-4.2, 3.2, 2.2), (-4.2, -3.2, 3.0))
#: Samples of light per pixel of a picture and of a mask, and share of the light that rotors let through.
SAMPLES, MASK_SAMPLES, THROUGH = 10, 16, 0.8


def recipe() -> Scenario:
    """Four drones in the laboratory before cameras without distortion."""
    usual = scenario("S02_D4_A")
    cameras = [{"position_m": place, "target_m": (0.0, 0.0, 1.2)} for place in CORNERS_M]
    changes = {"name": "R01_D4", "cameras": cameras, "fps": FPS, "markers": False}
    return change_scenario(usual, {**changes, "num_frames": round(usual.num_frames * FPS / usual.fps)})


def main() -> None:
    """Simulate, and render again."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--frames", type=int, default=12, help="number of frames")
    options = parser.parse_args()
    out, drawn = options.data / "rendered", recipe()
    folder = out / "Simulated_Data" / drawn.name
    if folder.exists():
        raise SystemExit(f"rendered: {folder}: expected no such folder; delete it to render it again")
    options.data.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.data) as temporary:
        settings = SimulationSettings(num_frames=options.frames, scale=0.5, seed=3, onboard=False)
        simulate(drawn, Path(temporary), settings, report=progress_bar)
        made = Path(temporary) / "Simulated_Data" / drawn.name
        render(drawn, made)
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(made, folder)
    print(folder)


def render(drawn: Scenario, folder: Path) -> None:
    """Replace the videos and masks of a sequence by those of Cycles."""
    import bpy

    recording = open_recording(folder)
    truth = recording.truth
    assert truth is not None
    assert truth.orientation_wxyz is not None
    scene = _room(bpy)
    drones = [_drone(bpy, drone) for drone in drawn.drones]
    picture = str(folder / "picture.png")
    scene.render.filepath = picture
    with (
        zipfile.ZipFile(folder / "drone_masks.zip", "w") as masks,
        progress_bar("render", len(recording.videos) * len(truth.frame)) as advance,
    ):
        for number, (name, video) in enumerate(recording.videos.items()):
            _look(bpy, scene, recording.rig.cameras[recording.rig.names.index(name)])
            code = cv2.VideoWriter.fourcc(*"MJPG")
            writer = cv2.VideoWriter(str(video.path), code, video.fps, video.image_size_wh)
            writer.set(cv2.VIDEOWRITER_PROP_QUALITY, 95)
            noise = np.random.default_rng(number)
            for index in range(len(truth.frame)):
                # The reference begins at frame 1.
                known = max(index, 1)
                for drone, place_m, turn in zip(
                    drones, truth.position_m[known], truth.orientation_wxyz[known], strict=True
                ):
                    drone.location, drone.rotation_quaternion = place_m, turn
                bpy.ops.render.render(write_still=True)
                clean = cv2.imread(picture)
                writer.write(np.clip(clean + noise.normal(0, 2, clean.shape), 0, 255).astype(np.uint8))
                for order, mask in enumerate(_masks(bpy, scene, drones, picture), start=1):
                    content = cv2.imencode(".png", mask)[1].tobytes()
                    stem = video.path.stem.removesuffix("_s")
                    masks.writestr(f"{stem}/dron{order}/{truth.frame[index]:06d}.png", content)
                advance(1)
            writer.release()
    Path(picture).unlink()


def _masks(bpy: Any, scene: Any, drones: list[Any], picture: str) -> list[np.ndarray]:
    """The mask of each drone: what hides the drone cuts it out."""
    scene.render.film_transparent = True
    scene.cycles.samples, scene.cycles.use_denoising = MASK_SAMPLES, False
    through = bpy.data.materials["rotor"].node_tree.nodes["Mix Shader"].inputs[0]
    through.default_value = 1.0
    found = []
    for drone in drones:
        for each in scene.objects:
            each.is_holdout = each not in (drone, *drone.children)
        bpy.ops.render.render(write_still=True)
        opacity = cv2.imread(picture, cv2.IMREAD_UNCHANGED)[..., 3]
        # A drone's pixels are those of which it covers a half at least.
        found.append(np.where(opacity >= 128, 255, 0).astype(np.uint8))
    for each in scene.objects:
        each.is_holdout = False
    through.default_value = 1 - THROUGH
    scene.render.film_transparent = False
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, True
    return found


def _look(bpy: Any, scene: Any, camera: Any) -> None:
    """Put Blender's camera where a camera of the rig is."""
    K, pose = np.asarray(camera.K), np.asarray(camera.T_cam_world)
    width, height = np.asarray(camera.image_size_wh).astype(int).tolist()
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
    lens.lens = float(K[0, 0]) / width * lens.sensor_width
    lens.shift_x, lens.shift_y = (width / 2 - K[0, 2]) / width, (K[1, 2] - height / 2) / width
    seen = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(seen)
    # Blender's cameras look along -z, and y is up.
    world = np.eye(4)
    world[:3, :3] = pose[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
    world[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    seen.matrix_world = world.T.tolist()
    scene.camera = seen
    scene.render.resolution_x, scene.render.resolution_y = width, height


def _room(bpy: Any) -> Any:
    """A room of eleven by nine metres with furniture, a window and lamps."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene, choice = bpy.context.scene, random.Random(5)
    scene.render.engine, scene.cycles.samples, scene.cycles.max_bounces = "CYCLES", SAMPLES, 2
    # A pixel is the mean of the light in it, and a mask tells whether half of a pixel is covered.
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("sky")
    walls = [
        _material(bpy, f"wall{number}", colour, 3.0)
        for number, colour in enumerate(
            [
                (0.35, 0.22, 0.14),
                (0.5, 0.5, 0.45),
                (0.2, 0.3, 0.35),
                (0.6, 0.58, 0.5),
                (0.45, 0.4, 0.3),
                (0.7, 0.7, 0.7),
            ]
        )
    ]
    for material, (middle, size) in zip(
        walls,
        [
            ((0, 0, -0.05), (11, 9, 0.1)),
            ((5.5, 0, 2), (0.1, 9, 4)),
            ((-5.5, 0, 2), (0.1, 9, 4)),
            ((0, 4.5, 2), (11, 0.1, 4)),
            ((0, -4.5, 2), (11, 0.1, 4)),
            ((0, 0, 4), (11, 9, 0.1)),
        ],
        strict=True,
    ):
        _put(bpy, bpy.ops.mesh.primitive_cube_add, middle, size, material)
    for number in range(40):
        colour = tuple(choice.uniform(0.02, 0.8) for _ in range(3))
        material = _material(bpy, f"thing{number}", colour, choice.uniform(1, 20))
        along, size = choice.uniform(0, 1), [choice.uniform(0.1, 1.0) for _ in range(3)]
        middle = [choice.uniform(-4.8, 4.8), choice.choice([-4.1, 4.1]) * along, size[2] / 2]
        if abs(middle[0]) < 3.4 and abs(middle[1]) < 2.6:
            middle[0] = choice.choice([-4.7, 4.7])
        middle[2] += choice.choice([0, 0, 1.5])
        shape = choice.choice([bpy.ops.mesh.primitive_cube_add, bpy.ops.mesh.primitive_cylinder_add])
        _put(bpy, shape, middle, size, material)
    for place, power, size in (
        ((2.5, 1, 3.8), 120, 1.5),
        ((-2.5, -1, 3.8), 90, 1.0),
        ((0, 4.3, 2), 150, 2.0),
    ):
        bpy.ops.object.light_add(type="AREA", location=place)
        lamp = bpy.context.object
        lamp.data.energy, lamp.data.size = power, size
        lamp.rotation_euler = (-1.57, 0, 0) if place[1] > 4 else (0, 0, 0)
    return scene


def _put(bpy: Any, shape: Any, middle: Any, size: Any, material: Any) -> None:
    shape(location=middle)
    put = bpy.context.object
    put.scale = [length / 2 for length in size]
    put.data.materials.append(material)


def _material(bpy: Any, name: str, colour: tuple[float, ...], scale: float) -> Any:
    """A material whose colour changes with place."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    noise, ramp, place = (nodes.new(f"ShaderNode{each}") for each in ("TexNoise", "ValToRGB", "TexCoord"))
    noise.inputs["Scale"].default_value = scale
    for element, share in zip(ramp.color_ramp.elements, (0.4, 1.2), strict=True):
        element.color = (*(min(1.0, share * each) for each in colour), 1.0)
    links.new(place.outputs["Object"], noise.inputs["Vector"])
    links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.5
    return material


def _drone(bpy: Any, drone: Any) -> Any:
    """A drone with its rotors, which let most light through."""
    shape = model(drone.model)
    body = _mesh(bpy, shape.triangles_m, _material(bpy, "drone", tuple(drone.paint_bgr[::-1]), 5.0))
    rotor = bpy.data.materials.get("rotor")
    if rotor is None:
        rotor = bpy.data.materials.new("rotor")
        rotor.use_nodes = True
        nodes, links = rotor.node_tree.nodes, rotor.node_tree.links
        mix, clear = nodes.new("ShaderNodeMixShader"), nodes.new("ShaderNodeBsdfTransparent")
        mix.inputs[0].default_value = 1 - THROUGH
        nodes["Principled BSDF"].inputs["Base Color"].default_value = (0.02, 0.02, 0.02, 1.0)
        links.new(clear.outputs[0], mix.inputs[1])
        links.new(nodes["Principled BSDF"].outputs[0], mix.inputs[2])
        links.new(mix.outputs[0], nodes["Material Output"].inputs["Surface"])
    discs = _mesh(bpy, disc_fans(shape), rotor)
    discs.parent = body
    body.rotation_mode = "QUATERNION"
    return body


def _mesh(bpy: Any, triangles_m: np.ndarray, material: Any) -> Any:
    mesh = bpy.data.meshes.new("mesh")
    faces = np.arange(3 * len(triangles_m)).reshape(-1, 3)
    mesh.from_pydata(triangles_m.reshape(-1, 3).tolist(), [], faces.tolist())
    mesh.materials.append(material)
    made = bpy.data.objects.new("part", mesh)
    bpy.context.scene.collection.objects.link(made)
    return made


if __name__ == "__main__":
    main()

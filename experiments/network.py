"""Train the network that comes with the package, on sequences of random drones, rooms, lights and surroundings.

    python experiments/network.py --data data      # `make network`, 75 minutes on two cores

The sequences are simulated if missing, half as large as usual, in DATA/network. Each has the cameras and paths of a
preset, and random exposure, noise, compression, plants, screens, people and lamps. Drones for training have random
shapes. Sequences for validation have the package's drones, and cameras and paths of presets that are not in training.
Writes DATA/network/drones.model, and a picture of what it finds. Further options are those of `psotrack train`.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import trimesh

from psotrack.simulation import Scenario, SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import progress_bar

PRESETS = ("S01_D2_A", "S02_D4_A", "S03_D10_A", "S04_D10", "S06_D6", "S11_D4")
#: Presets whose cameras and paths are not in training; the package's drones fly there.
VALIDATION = ("S07_D8", "S12_D3")
MODELS = ("x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross")
UP = np.array([0.0, 0.0, 1.0])
#: Frames per second: a few frames show much of a flight.
FPS = 5.0


def main() -> None:
    """Simulate what is missing, and train."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--sequences", type=int, default=72, help="number of sequences")
    parser.add_argument("--frames", type=int, default=24, help="frames of each sequence")
    parser.add_argument("--only-simulate", action="store_true", help="simulate what is missing, and end")
    options, words = parser.parse_known_args()
    out = options.data / "network"
    recipes = [random_scenario(seed, out / "drones") for seed in range(options.sequences)]
    for seed, recipe in enumerate(recipes):
        if not (out / "Simulated_Data" / recipe.name).exists():
            settings = SimulationSettings(num_frames=options.frames, scale=0.5, seed=seed, onboard=False)
            simulate(recipe, out, settings, report=progress_bar)
    if options.only_simulate:
        return
    names = [recipe.name for recipe in recipes]
    held = ",".join(name for name in names if name.split("_", 1)[1] in VALIDATION)
    folders = [str(out / "Simulated_Data" / name) for name in names]
    command = ["train", *folders, "--out", str(out / "drones.model"), "--validation", held, "--force", *words]
    raise SystemExit(subprocess.run([sys.executable, "-m", "psotrack", *command], check=False).returncode)


def random_scenario(seed: int, meshes: Path) -> Scenario:
    """A preset with random drones, light, camera and surroundings; one of six is for validation.

    Args:
        seed: seed.
        meshes: folder for the shapes of drones.
    """
    choice = random.Random(seed)
    validates = seed % 6 == 5
    preset = choice.choice(VALIDATION if validates else PRESETS)
    recipe, exposure = scenario(preset), choice.choice([1.0, choice.uniform(1.0, 1.5)])
    changes: dict[str, Any] = {
        "fps": FPS,
        "num_frames": round(recipe.num_frames * FPS / recipe.fps),
        "imaging.shutter_s": choice.choice([1 / 500, 1 / 125, 1 / 60]),
        "imaging.lens_blur_px": choice.uniform(0.0, 1.2),
        "imaging.read_noise": choice.uniform(0.0, 4.0),
        "imaging.shot_noise": choice.uniform(1.0, 7.0),
        "imaging.jpeg_quality": choice.choice([0, 0, 30, 60, 90]),
        "imaging.flicker": choice.uniform(0.0, 0.3),
        "imaging.exposure": [1 / exposure, exposure],
        "surroundings.foliage": choice.choice([0.0, 0.0, 0.03, 0.1, 0.3]),
        "surroundings.screen": choice.choice([0.0, 0.03]),
        "surroundings.person": choice.choice([0.0, choice.uniform(0.2, 0.8)]),
        "surroundings.lamp_drop": choice.choice([0.0, 0.25]),
    }
    for number in range(len(recipe.drones)):
        grey = choice.choice([0.02, 0.05, 0.1, 0.3, 0.6, 0.8])
        changes[f"drones[{number}].paint_bgr"] = [min(1.0, grey * choice.uniform(0.3, 1.7)) for _ in range(3)]
        if validates:
            shape: Any = choice.choice(MODELS)
        else:
            shape = random_drone(choice, meshes / f"{seed:03d}_{number}.ply")
        changes[f"drones[{number}].model"] = shape
    changed = change_scenario(recipe, changes)
    return msgspec.structs.replace(changed, name=f"N{seed:03d}_{preset}")


def random_drone(choice: random.Random, path: Path) -> dict[str, Any]:
    """A drone of random shape: body, arms, motors, and often legs, a payload or guards about its rotors.

    Args:
        choice: random numbers.
        path: file for the mesh.

    Returns:
        The record of the mesh for a scenario.
    """
    arms = choice.choice([3, 4, 4, 4, 4, 6, 8])
    reach = choice.uniform(0.09, 0.3)
    rotor = reach * np.sin(np.pi / arms) * choice.uniform(0.6, 0.95)
    long, wide, high = (reach * choice.uniform(*limits) for limits in ((0.4, 1.3), (0.25, 0.7), (0.1, 0.5)))
    thick = reach * choice.uniform(0.05, 0.15)
    parts = [_body(choice, (long, wide, high), (0.0, 0.0, 0.0))]
    if choice.random() < 0.6:
        above = 0.7 * high
        parts.append(
            _body(choice, (0.6 * long, 0.7 * wide, 0.7 * high), (choice.uniform(-0.1, 0.1) * long, 0, above))
        )
    if choice.random() < 0.5:
        size = reach * choice.uniform(0.15, 0.4)
        parts.append(
            _body(choice, (size, size, size), (choice.uniform(-0.3, 0.4) * long, 0, -0.5 * high - 0.5 * size))
        )
    angles = 2 * np.pi * (np.arange(arms) + choice.choice([0.0, 0.5])) / arms
    squeeze, lift = choice.uniform(0.7, 1.0), choice.uniform(-0.1, 0.3) * reach
    hubs = np.column_stack([reach * np.cos(angles), squeeze * reach * np.sin(angles), np.full(arms, lift)])
    legs, guards = choice.choice(["none", "none", "stubs", "skids"]), choice.random() < 0.15
    for hub in hubs:
        parts.append(trimesh.creation.cylinder(thick / 2, segment=[[0, 0, 0], hub], sections=6))
        parts.append(
            trimesh.creation.cylinder(0.8 * thick, segment=[hub, hub + 1.2 * thick * UP], sections=8)
        )
        if legs == "stubs":
            foot = hub * [0.8, 0.8, 0] - (high + 0.3 * reach) * UP
            parts.append(trimesh.creation.cylinder(thick / 3, segment=[0.7 * hub, foot], sections=6))
        if guards:
            ring = trimesh.creation.annulus(rotor, 1.06 * rotor, 0.15 * rotor, sections=16)
            parts.append(ring.apply_translation(hub + 1.4 * thick * UP))
    if legs == "skids":
        low, half = -0.5 * high - choice.uniform(0.2, 0.6) * reach, 0.5 * reach
        for side in (-1, 1):
            y = side * choice.uniform(0.3, 0.6) * reach
            ends = [[-half, y, low], [half, y, low]]
            parts.append(trimesh.creation.cylinder(thick / 3, segment=ends, sections=6))
            for end in ends:
                parts.append(
                    trimesh.creation.cylinder(thick / 3, segment=[[end[0] / 2, 0, 0], end], sections=6)
                )
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.util.concatenate(parts).export(path)
    rotors = [{"centre_m": (hub + 1.4 * thick * UP).tolist(), "radius_m": float(rotor)} for hub in hubs]
    return {"file": str(path.resolve()), "rotors": rotors}


def _body(
    choice: random.Random, size: tuple[float, float, float], middle: tuple[float, float, float]
) -> trimesh.Trimesh:
    """A box, a round box or an upright cylinder."""
    kind = choice.choice(["box", "round", "cylinder"])
    if kind == "box":
        body = trimesh.creation.box((1, 1, 1))
    elif kind == "round":
        body = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    else:
        body = trimesh.creation.cylinder(0.5, 1.0, sections=12)
    return body.apply_scale(size).apply_translation(middle)


if __name__ == "__main__":
    main()

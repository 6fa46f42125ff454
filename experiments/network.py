"""Train the network that finds drones on sequences of random rooms, lights, drones and surroundings.

    python experiments/network.py --data data      # `make network`, two hours on two cores

The sequences are simulated if missing, half as large as usual, in DATA/network. Each has the flights and cameras of a
preset, and random drones, paint, exposure, noise, compression, plants, screens, people and lamps. The sequences of the
presets in VALIDATION are for validation. Writes DATA/network/drones.model, and a picture of what it finds.
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec

from psotrack.simulation import Scenario, SimulationSettings, change_scenario, scenario, simulate
from psotrack.support import progress_bar

PRESETS = ("S01_D2_A", "S02_D4_A", "S03_D10_A", "S04_D10", "S06_D6", "S11_D4")
#: Presets whose cameras and flights are not in training.
VALIDATION = ("S07_D8", "S12_D3")
MODELS = ("x_frame", "x_frame_racer", "camera_drone", "hexacopter", "tall_cross")


def main() -> None:
    """Simulate what is missing, and train."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the recordings")
    parser.add_argument("--sequences", type=int, default=60, help="number of sequences")
    parser.add_argument("--frames", type=int, default=80, help="frames of each sequence")
    options = parser.parse_args()
    out = options.data / "network"
    recipes = [random_scenario(seed) for seed in range(options.sequences)]
    for seed, recipe in enumerate(recipes):
        if not (out / "Simulated_Data" / recipe.name).exists():
            settings = SimulationSettings(num_frames=options.frames, scale=0.5, seed=seed, onboard=False)
            simulate(recipe, out, settings, report=progress_bar)
    names = [recipe.name for recipe in recipes]
    held = ",".join(name for name in names if name.split("_", 1)[1] in VALIDATION)
    folders = [str(out / "Simulated_Data" / name) for name in names]
    words = ["train", *folders, "--out", str(out / "drones.model"), "--validation", held, "--force"]
    raise SystemExit(subprocess.run([sys.executable, "-m", "psotrack", *words], check=False).returncode)


def random_scenario(seed: int) -> Scenario:
    """A preset with random drones, light, camera and surroundings; one of six is for validation."""
    choice = random.Random(seed)
    preset = choice.choice(VALIDATION if seed % 6 == 5 else PRESETS)
    recipe, exposure = scenario(preset), choice.choice([1.0, choice.uniform(1.0, 1.5)])
    changes: dict[str, Any] = {
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
        changes[f"drones[{number}].model"] = choice.choice(MODELS)
        changes[f"drones[{number}].paint_bgr"] = [min(1.0, grey * choice.uniform(0.3, 1.7)) for _ in range(3)]
    changed = change_scenario(recipe, changes)
    return msgspec.structs.replace(changed, name=f"N{seed:03d}_{preset}")


if __name__ == "__main__":
    main()

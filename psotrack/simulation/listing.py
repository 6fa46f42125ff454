"""List of the package's scenarios."""

from __future__ import annotations

from typing import Any

import numpy as np

from psotrack.simulation.scenarios import preset_names, scenario
from psotrack.simulation.scene import build


def catalogue() -> list[dict[str, Any]]:
    """One record per scenario of the package; the speed is the mean over drones and frames for seed 0."""
    rows = []
    for name in preset_names():
        recipe = scenario(name)
        scene = build(recipe)
        position_m = scene.positions_m(recipe.num_frames)
        speed = np.linalg.norm(np.diff(position_m, axis=0), axis=-1).mean() * recipe.fps
        rows.append(
            {
                "name": name,
                "drones": len(recipe.drones),
                "cameras": len(scene.rig.names),
                "frames": recipe.num_frames,
                "seconds": recipe.num_frames / recipe.fps,
                "hall": recipe.hall,
                "mean_speed_m_s": round(float(speed), 3),
                "markers": recipe.markers,
                "onboard": recipe.onboard is not None,
                "description": recipe.description,
            }
        )
    return rows

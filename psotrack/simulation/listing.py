"""List of the package's scenarios, as records and as a table for the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.simulation.scenarios import preset_names, scenario
from psotrack.simulation.scene import build

if TYPE_CHECKING:
    from rich.table import Table


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


def render(rows: list[dict[str, Any]]) -> Table:
    """Table of the records of `catalogue`, one row per scenario."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    headings = ("name", "drones", "cameras", "frames", "hall", "m/s", "flights")
    for heading in headings:
        numeric = heading in {"drones", "cameras", "frames", "m/s"}
        table.add_column(heading, justify="right" if numeric else "left", no_wrap=heading != "flights")
    for row in rows:
        hall = row["hall"].removesuffix("_hall").replace("_", " ")
        told = row | {"hall": hall, "m/s": f"{row['mean_speed_m_s']:.1f}", "flights": row["description"]}
        table.add_row(*(f"{told[heading]}" for heading in headings))
    return table

"""What gradient steps after the swarm, and the paraboloid, do at different sizes of the swarm.

    python experiments/accuracy/refinement.py --data data

Tracks S02_D4_A with one swarm per drone, writes one row per run, and prints the rows. Rows with two particles and no
iterations show gradient steps alone, which begin at the prediction and at the last position.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import _runs

from psotrack.settings import TrackSettings

NAME = "S02_D4_A"
SWARMS = ((30, 20), (10, 5), (2, 0))
STEPS = (0, 10, 30)


def run(particles: int, iterations: int, steps: int, vertex: bool, opened: tuple) -> dict[str, Any]:
    """One row."""
    settings = TrackSettings(particles=particles, iterations=iterations, refinements=steps, vertex=vertex)
    row = {"particles": particles, "iterations": iterations, "gradient_steps": steps, "paraboloid": vertex}
    return row | _runs.figures(*opened, settings)


def main() -> None:
    """Track, write, print."""
    parser = _runs.parser(__doc__)
    options = parser.parse_args()
    opened = _runs.opened(NAME, options.data)
    started = _runs.start("refinement")
    rows = (
        (
            f"{particles} {iterations} {steps} {vertex}",
            partial(run, particles, iterations, steps, vertex, opened),
        )
        for particles, iterations in SWARMS
        for steps in STEPS
        for vertex in (False, True)
    )
    table = _runs.save_rows(started, rows, options.data, options.out)
    print(table.to_string(float_format="{:.4f}".format, index=False))


if __name__ == "__main__":
    main()

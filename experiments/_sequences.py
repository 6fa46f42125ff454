"""Simulate the sequences that experiments use, unless they exist already.

    python experiments/_sequences.py S01_D2_A S02_D4_A --data data --seeds 2

Writes DATA/seed0/Simulated_Data/NAME and so on. With --onboard it writes DATA/onboard0/Simulated_Data/NAME and so on,
with the videos of the drones' own cameras.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from psotrack.simulation import SimulationSettings, simulate
from psotrack.support import progress_bar


def simulated(name: str, data: Path, seed: int, *, onboard: bool = False) -> Path:
    """The folder of a simulated sequence, which is made if it is missing."""
    folder = data / f"{'onboard' if onboard else 'seed'}{seed}" / "Simulated_Data" / name
    if not folder.exists():
        print(f"simulating {folder}", flush=True)
        settings = SimulationSettings(seed=seed, masks=False, onboard=onboard)
        simulate(name, folder.parents[1], settings, report=progress_bar)
    return folder


def simulated_root(names: Iterable[str], data: Path) -> Path:
    """The root folder of the first flight of each of these sequences, which are made if they are missing."""
    folders = [simulated(name, data, 0) for name in names]
    return folders[0].parents[1]


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="+", metavar="NAME", help="sequences of the dataset's simulated half")
    parser.add_argument("--data", type=Path, default=Path("data"), help="root folder of the data")
    parser.add_argument("--seeds", type=int, default=1, help="number of flights: seeds 0, 1, ...")
    parser.add_argument("--onboard", action="store_true", help="with the videos of the drones' own cameras")
    options = parser.parse_args()
    for seed in range(options.seeds):
        for name in options.names:
            simulated(name, options.data, seed, onboard=options.onboard)


if __name__ == "__main__":
    main()

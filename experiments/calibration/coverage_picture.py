"""The picture of `calibrate rig --plot`: a board that is simulated before three cameras.

    python experiments/calibration/coverage_picture.py

Writes experiments/pictures/rig_coverage.png.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE.parent), str(HERE.parents[1] / "tests")]
import _results
from board_rigs import BOARD, Errors, Scene, row_of_cameras

from psotrack.calibration import calibrate_rig, save_coverage


def main() -> None:
    """Simulate the views, calibrate, and save the picture."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE.parent / "pictures", help="folder of the picture")
    options = parser.parse_args()
    run = _results.Run("rig_coverage")
    scene = Scene(row_of_cameras(3), errors=Errors(0.2, slip_m=0.0005), instants=60)
    calibrated = calibrate_rig(BOARD, scene.views(np.random.default_rng(0)))
    picture = options.out / "rig_coverage.png"
    save_coverage(picture, calibrated, force=True)
    run.save(options.out, files=[picture])


if __name__ == "__main__":
    main()

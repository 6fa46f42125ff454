"""Recordings that other people published: where tests find them, and what each is used for.

They lie below the folder that the environment variable PSOTRACK_REAL_DATA names, as OWNER/NAME, and none is part of
this repository. `make real` runs the tests that need them, which have the marker `real`.

    python tests/real_data.py      # says which recordings are not there
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

VARIABLE = "PSOTRACK_REAL_DATA"
#: Owner and name of each repository, and what the tests and the experiments use it for.
RECORDINGS = {
    "AprilRobotics/apriltag": "markers in photographs: corners that are marked by hand",
    "Ashrafhij/TelloAI-V.0.1": "markers before a telephone in a hand: photographs, a map, a path",
    "Biomechanical-ToolKit/BTKData": "C3D files of many makers, beside ezc3d",
    "DroneDetectionThesis/Drone-detection-dataset": "foreground: drones before sky and trees, with boxes",
    "MichaelGrupp/evo": "paths beside evo's errors",
    "QAlexBall/opencv_contrib": "photographs in which no marker may be found",
    "TemugeB/handpose3d": "rig files; a recording without drones",
    "UbiquityRobotics/fiducials": "markers in photographs: known identities",
    "abakisita/camera_calibration": "markers in photographs: a board of markers",
    "cadop/pyCGM": "C3D files, beside ezc3d",
    "christofhapp/batflight3D_publication": "flights of a drone before two cameras, with false alarms and GPS",
    "cvlab-epfl/multiview_calib": "a flight before five cameras: rational lenses, covariances",
    "duckietown/lib-dt-apriltags": "markers in photographs: a tag at known angles",
    "e-sha/Background-subtraction": "foreground: an office, with masks",
    "felixchenier/kineticstoolkit": "C3D files, beside ezc3d",
    "kyamagu/mexopencv": "a rig of two cameras from a chessboard",
    "mprib/caliscope": "rigs of four webcams from a board; rig files; inverted boards",
    "perfanalytics/pose2sim": "rig files of Qualisys",
    "talmolab/sleap-anipose": "a rig of three cameras from a board; rig files; a recording without drones",
    "wordbomb/PoseFree-GeoLocator": "a flight before three cameras: covariances, clocks",
    "zhu-lebin/trackmesh_gui": "rig files of EasyMocap",
}


def folder() -> Path | None:
    """The folder of all recordings; None where the variable names none."""
    named = os.environ.get(VARIABLE)
    return Path(named) if named else None


def missing() -> list[str]:
    """Names of the recordings that are not there."""
    root = folder()
    return [name for name in RECORDINGS if root is None or not (root / name).is_dir()]


def published(name: str) -> Path:
    """Folder of a recording of the table, OWNER/NAME; the test is skipped where the recording is absent."""
    import pytest

    assert name in RECORDINGS, f"expected a recording of tests/real_data.py, found {name}"
    root = folder()
    if root is None:
        pytest.skip(f"{name}: expected the folder of the recordings in {VARIABLE}, found none")
    if name in missing():
        pytest.skip(f"{name}: expected in {root}, found no such folder")
    return root / name


def main() -> None:
    """Say in one line each which recordings are not there."""
    root = folder()
    if root is None or not root.is_dir():
        sys.exit(
            f"real: expected the folder of the recordings in {VARIABLE}, found {root or 'none'}; name it"
        )
    lines = [f"not found in {root}: {name} ({RECORDINGS[name]})" for name in missing()]
    lines.append(f"found in {root}: {len(RECORDINGS) - len(missing())} of {len(RECORDINGS)} recordings")
    sys.stdout.write("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()

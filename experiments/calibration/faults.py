"""Findings of the doctor for a correct rig with one planted fault, fault by fault.

    python experiments/calibration/faults.py data/Simulated_Data/S02_D4_A --out experiments/pictures

Reads a sequence with its detections, plants each fault in the calibration or in the detections, and calls the function
of `psotrack doctor`. Writes results/faults.json beside this file, and doctor_faults.png, which shows the disagreement
of each pair of cameras for some faults.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from psotrack.calibration.doctor import Diagnosis, examine
from psotrack.geometry import Rig
from psotrack.pipeline import detection_files_of
from psotrack.recordings import Detections, read_detections
from psotrack.recordings.datasets import read_sequence
from psotrack.settings import YOLO
from psotrack.support import save_figure
from psotrack.tracking.matching import from_detections

sys.path.append(str(Path(__file__).resolve().parents[1]))
import _results

HERE = Path(__file__).parent
#: Index of the camera that gets the fault, and of the camera that it is exchanged with.
FAULTY, OTHER = 2, 5
#: Faults in the picture.
SHOWN = ("nothing", "a camera turned by 1 degree", "a camera moved by 0.2 m", "a camera late by 3 frames")

#: Largest distance on the colour scale, pixels.
MOST_PX = 30

Boxes = Mapping[str, Detections]
Fault = Callable[[Rig, Boxes], tuple[Rig, Boxes]]


def turned(degrees: float) -> Fault:
    """Turn one camera about its vertical axis."""

    def fault(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
        R, centre = rig.cameras.T_cam_world[:, :3, :3].copy(), rig.cameras.centre_world
        R[FAULTY] = Rotation.from_rotvec([0.0, degrees, 0.0], degrees=True).as_matrix() @ R[FAULTY]
        return _posed(rig, R, -np.matvec(R, centre)), boxes

    return fault


def moved(shift_m: float) -> Fault:
    """Move one camera sideways."""

    def fault(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
        t_m = rig.cameras.T_cam_world[:, :3, 3].copy()
        t_m[FAULTY, 0] += shift_m
        return _posed(rig, rig.cameras.T_cam_world[:, :3, :3], t_m), boxes

    return fault


def late(frames: int) -> Fault:
    """Let the video of one camera lag: its frame i shows what the other cameras show in frame i - frames."""

    def fault(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
        name = rig.names[FAULTY]
        seen = boxes[name]
        shifted = Detections(seen.frame + frames, seen.xyxy, seen.confidence)
        return rig, {**boxes, name: shifted}

    return fault


def centres(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
    """Write the cameras' centres in place of the translations."""
    return _posed(rig, rig.cameras.T_cam_world[:, :3, :3], rig.cameras.centre_world), boxes


def millimetres(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
    """Read millimetres as metres."""
    T = rig.cameras.T_cam_world
    return _posed(rig, T[:, :3, :3], 1e3 * T[:, :3, 3]), boxes


def opengl(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
    """Use the camera axes of OpenGL."""
    flip, T = np.array([1.0, -1.0, -1.0]), rig.cameras.T_cam_world
    return _posed(rig, flip[:, None] * T[:, :3, :3], flip * T[:, :3, 3]), boxes


def exchanged(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
    """Exchange the names of two cameras' videos."""
    one, other = rig.names[FAULTY], rig.names[OTHER]
    return rig, {**boxes, one: boxes[other], other: boxes[one]}


def longer(share: float, cameras: int | slice) -> Fault:
    """Make focal lengths too long by a share."""

    def fault(rig: Rig, boxes: Boxes) -> tuple[Rig, Boxes]:
        K = rig.cameras.K.copy()
        K[cameras, :2, :2] *= 1 + share
        return Rig(rig.names, replace(rig.cameras, K=K)), boxes

    return fault


FAULTS: dict[str, Fault] = {
    "nothing": lambda rig, boxes: (rig, boxes),
    "a camera turned by 1 degree": turned(1.0),
    "a camera turned by 0.3 degrees": turned(0.3),
    "a camera moved by 0.2 m": moved(0.2),
    "a camera late by 3 frames": late(3),
    "a camera late by 1 frame": late(1),
    "two cameras exchanged": exchanged,
    "centres read as translations": centres,
    "millimetres read as metres": millimetres,
    "camera axes as in OpenGL": opengl,
    "a focal length 6 % too long": longer(0.06, FAULTY),
    "all focal lengths 10 % too long": longer(0.1, slice(None)),
    "all focal lengths 4 % too long": longer(0.04, slice(None)),
}


def main() -> None:
    """Plant the faults, examine each rig, and write the findings."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--out", type=Path, default=HERE.parent / "pictures", help="folder of the picture")
    parser.add_argument("--results", type=Path, default=HERE / "results", help="folder of the record")
    options = parser.parse_args()
    run = _results.Run("faults")
    recording = read_sequence(options.sequence)
    boxes = {name: read_detections(path) for name, path in detection_files_of(recording, YOLO).items()}
    diagnoses = {}
    for name, fault in FAULTS.items():
        rig, tampered = fault(recording.rig, boxes)
        sightings = from_detections(tampered, rig, recording.num_frames)
        diagnoses[name] = examine(rig, sightings, fps=recording.fps, reference=recording.truth)
        print(f"{name}: {words(diagnoses[name])}", flush=True)
    names = recording.rig.names
    save_figure(
        options.out / "doctor_faults.png",
        (13.0, 3.9),
        lambda figure: draw(figure, diagnoses, names),
        force=True,
    )
    found = {name: words(diagnosis) for name, diagnosis in diagnoses.items()}
    run.save(options.results, figures={"found": found}, files=[options.out / "doctor_faults.png"])


def words(diagnosis: Diagnosis) -> str:
    """The findings in one line."""
    return "; ".join(finding.message for finding in diagnosis.findings) or "nothing disagrees"


def draw(figure: Figure, diagnoses: Mapping[str, Diagnosis], names: tuple[str, ...]) -> None:
    """Draw a matrix of all pairs of cameras for each fault in `SHOWN`."""
    axes = figure.subplots(1, len(SHOWN), sharey=True)
    for axis, name in zip(axes, SHOWN, strict=True):
        picture = axis.imshow(
            np.log10(diagnoses[name].epipolar_px), cmap="viridis", vmin=0, vmax=np.log10(MOST_PX)
        )
        axis.set_title("a sound rig" if name == "nothing" else name, fontsize=10)
        axis.set_xticks(range(len(names)), names, rotation=90, fontsize=8)
        axis.set_yticks(range(len(names)), names, fontsize=8)
    bar = figure.colorbar(picture, ax=list(axes), shrink=0.85, ticks=np.log10([1, 3, 10, MOST_PX]))
    bar.ax.set_yticklabels(["1", "3", "10", f"{MOST_PX}"])
    bar.set_label("median distance from the other's\nepipolar lines (px)", fontsize=9)


def _posed(rig: Rig, R: np.ndarray, t_m: np.ndarray) -> Rig:
    T = rig.cameras.T_cam_world.copy()
    T[:, :3, :3], T[:, :3, 3] = R, t_m
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


if __name__ == "__main__":
    main()

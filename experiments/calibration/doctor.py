"""The doctor judged: sound rigs and planted faults, on boxes by formula.

    python experiments/calibration/doctor.py            # 36 sound rigs, and 12 rigs with each fault
    python experiments/calibration/doctor.py --quick    # 6 sound rigs, and 2 rigs with each fault

Each recording has its own rig, bodies and detector (`_boxes`). Faults that move the boxes by less than 3 px at the
median are left out. A fault is found if the doctor's first finding has the right kind and camera, and for a clock the
right sign; it is wrong if a finding names another camera, or another kind of fault.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from psotrack.correspondence import from_detections
from psotrack.doctor import Diagnosis, examine
from psotrack.geometry import Rig
from psotrack.recordings import Detections

sys.path += [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
import _boxes
from _boxes import FPS, Flight, Scene

#: Smallest shift of the boxes by a fault that is counted, pixels.
LEAST_PX = 3.0
#: Scenes, in turn, before the number of cameras is set.
SCENES = (
    Scene(drones=2, size=0.7),
    Scene(drones=4, size=0.5, frames=500),
    Scene(outdoors=True, drones=3, size=1.2),
    Scene(drones=1, lopsided=True, turning=False),
    Scene(drones=3, size=0.8, frames=60, missed=0.15),
    Scene(outdoors=True, drones=1, size=0.8, frames=400),
    Scene(drones=1, lopsided=True),
    Scene(drones=4, size=0.9, noise_share=0.06, lasting=0.6, missed=0.15, false_alarms=0.4),
    Scene(drones=1, size=0.7, frames=40),
    Scene(outdoors=True, drones=4, size=2.0, noise_px=1.5, missed=0.2, false_alarms=0.5),
    Scene(drones=2, size=0.6, calibration_deg=0.03),
    Scene(drones=5, size=1.0, missed=0.1),
)
FAULTS = (
    "turned 0.5",
    "turned 1",
    "moved 5 cm",
    "late 0.5",
    "late 2",
    "early 2",
    "focal length 2 %",
    "exchanged",
    "millimetres",
)


@dataclass(frozen=True)
class Case:
    """A rig as it is read, its detections, and what is wrong with it.

    Attributes:
        rig: the rig as it is read.
        seen: detections by camera.
        frames: number of frames.
        kind: kind of the planted fault; empty for a sound rig.
        cameras: names of the faulty cameras.
        lag: frames by which the faulty camera's video shows the scene late.
        shift_px: median shift of the boxes by the fault, pixels.
        truth: the true rig.
        flight: the bodies.
    """

    rig: Rig
    seen: dict[str, Detections]
    frames: int
    kind: str
    cameras: tuple[str, ...]
    lag: float
    shift_px: float
    truth: Rig
    flight: Flight


def make_case(number: int, fault: str = "") -> Case:
    """The case of a number, always the same; cameras 3 to 8 in turn, for faults 4 to 8."""
    rng = np.random.default_rng((number, 7))
    fewest = 3 if not fault else 4
    scene = replace(SCENES[number % len(SCENES)], cameras=fewest + (number + number // 12) % (9 - fewest))
    truth, flight = _boxes.make_true_rig(scene, rng), _boxes.make_flight(scene, rng)
    index = int(rng.integers(len(truth)))
    rig, lag, kind, cameras = truth, 0.0, fault.split()[0] if fault else "", (truth.names[index],)
    if scene.calibration_deg:
        for each in range(len(rig)):
            rig = _boxes.turned(rig, each, scene.calibration_deg * np.sqrt(3), rng)
    if kind == "turned":
        rig = _boxes.turned(rig, index, float(fault.split()[1]), rng)
    elif kind == "moved":
        rig = _boxes.moved(rig, index, 0.05, rng)
    elif kind in ("late", "early"):
        kind, lag = "clock", float(fault.split()[1]) * (1 if kind == "late" else -1)
    elif kind == "focal":
        kind, rig = "focal length", _boxes.refocused(rig, index, float(rng.choice([0.98, 1.02])))
    elif kind == "millimetres":
        T = rig.cameras.T_cam_world.copy()
        T[:, :3, 3] *= 1e3
        kind, cameras, rig = "unit", (), Rig(rig.names, replace(rig.cameras, T_cam_world=T))
    seen = _boxes.record(truth, flight, scene, rng, {truth.names[index]: lag})
    shift_px = _boxes.shift_px(truth, rig, flight, scene, index, lag)
    if kind == "exchanged":
        other = truth.names[(index + 1 + int(rng.integers(len(truth) - 1))) % len(truth)]
        (one,) = cameras
        seen, cameras = {**seen, one: seen[other], other: seen[one]}, tuple(sorted((one, other)))
    if kind in ("exchanged", "unit"):
        shift_px = np.inf
    return Case(rig, seen, scene.frames, kind, cameras, lag, shift_px, truth, flight)


def judge(case: Case, diagnosis: Diagnosis) -> dict[str, object]:
    """Whether the right fault is named first, and whether a wrong one is named."""
    right = [_is_right(case, finding) for finding in diagnosis.findings]
    named = [finding.kind not in ("unclear", "too little seen") for finding in diagnosis.findings]
    return {
        "first": bool(right) and right[0],
        "camera": bool(right) and tuple(sorted(diagnosis.findings[0].cameras)) == case.cameras,
        "wrong": any(there and not good for good, there in zip(right, named, strict=True)),
        "findings": "; ".join(finding.message for finding in diagnosis.findings),
    }


def _is_right(case: Case, finding: object) -> bool:
    same = finding.kind == case.kind and tuple(sorted(finding.cameras)) == case.cameras
    if case.kind == "clock":
        return same and ("late" in finding.message) == (case.lag > 0)
    return same


def run(fault: str, numbers: range, verbose: bool) -> Iterator[dict[str, object]]:
    """Judge one kind of fault, or sound rigs."""
    for number in numbers:
        case = make_case(number, fault)
        if fault and case.shift_px < LEAST_PX:
            continue
        start = time.perf_counter()
        diagnosis = examine(case.rig, from_detections(case.seen, case.rig, case.frames), fps=FPS)
        row = {
            "fault": fault or "nothing",
            "number": number,
            "cameras": len(case.rig),
            "planted": f"{case.kind} {' '.join(case.cameras)}" if fault else "",
            "shift_px": case.shift_px,
            "seconds": time.perf_counter() - start,
            **judge(case, diagnosis),
        }
        if verbose:
            state = "right" if row["first"] else "WRONG" if row["wrong"] else "silent"
            print(
                f"{row['fault']:17s} {number:3d} {row['cameras']} {SCENES[number % len(SCENES)].drones}"
                f"{'L' if SCENES[number % len(SCENES)].lopsided else ' '} {row['shift_px']:6.1f} px "
                f"{row['seconds']:5.1f} s {state:6s} {row['planted']} | {row['findings']}",
                flush=True,
            )
        yield row


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per fault."""
    table = []
    for fault, of in rows.groupby("fault", sort=False):
        table.append(
            {
                "planted": fault,
                "rigs": len(of),
                "named first": "" if fault == "nothing" else f"{of['first'].mean():.0%}",
                "right camera first": "" if fault == "nothing" else f"{of['camera'].mean():.0%}",
                "a wrong one named": f"{int(of['wrong'].sum())} of {len(of)}",
                "seconds, at most": round(float(of["seconds"].max()), 1),
            }
        )
    return pd.DataFrame(table)


def main() -> None:
    """Judge the doctor, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sound", type=int, default=36, help="number of sound rigs")
    parser.add_argument("--rigs", type=int, default=12, help="number of rigs with each fault")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--fault", action="append", choices=["nothing", *FAULTS], help="only this one")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    sound, rigs = (6, 2) if options.quick else (options.sound, options.rigs)
    rows: list[dict[str, object]] = []
    for fault in options.fault or ["nothing", *FAULTS]:
        count = sound if fault == "nothing" else rigs
        numbers = range(options.first, options.first + count)
        rows += run("" if fault == "nothing" else fault, numbers, options.verbose)
    print(summary(pd.DataFrame(rows)).to_string(index=False))


if __name__ == "__main__":
    main()

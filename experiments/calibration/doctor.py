"""The doctor judged: sound rigs and planted faults, on boxes by formula.

    python experiments/calibration/doctor.py            # 36 sound rigs, and 12 + 5 rigs with each fault
    python experiments/calibration/doctor.py --quick    # 6 sound rigs, and 2 + 1 rigs with each fault

Each recording has its own rig, bodies and detector (`_boxes`). Sound rigs have 3 to 8 cameras, and so have rigs with
faults: four to eight cameras and small drones, three cameras and small drones, and one large lopsided body, each in
rows of its own. Faults that move the boxes by less than 3 px at the median are left out.

The right fault is "named first" if the first finding has its kind and camera, and for a clock its sign. It is "named
second" if the finding calls it nearly as likely as another kind of fault of the same camera. The camera is "among
several" if the finding calls faults of several cameras equally likely, and one of them is right. A finding is wrong
otherwise. Writes OUT/doctor.csv, a row per rig and fault, and OUT/doctor.json with the table.
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

from psotrack.calibration.doctor import Diagnosis, Finding, examine
from psotrack.geometry import Rig
from psotrack.recordings import Detections
from psotrack.tracking.matching import from_detections

sys.path += [str(Path(__file__).resolve().parent), str(Path(__file__).resolve().parents[1])]
import _boxes
import _results
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
SMALL, LOPSIDED, THREE = "small drones", "one large lopsided body", "three cameras"


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


def make_case(number: int, fault: str = "", cameras: int | None = None) -> Case:
    """The case of a number, always the same.

    Args:
        number: number of the case.
        fault: the planted fault; empty for a sound rig.
        cameras: number of cameras; None: 3 to 8 in turn, for faults 4 to 8.
    """
    rng = np.random.default_rng((number, 7))
    fewest = 3 if not fault else 4
    cameras = fewest + (number + number // 12) % (9 - fewest) if cameras is None else cameras
    scene = replace(SCENES[number % len(SCENES)], cameras=cameras)
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
    """Whether the right fault is named first or second, or its camera among several, and whether a wrong one is."""
    findings = [finding for finding in diagnosis.findings if finding.kind != "too little seen"]
    right = [_is_right(case, finding, (finding.kind,)) for finding in findings]
    second = [_is_right(case, finding, finding.nearly_as_likely) for finding in findings]
    several = [
        finding.kind == "unclear" and set(case.cameras) <= set(finding.cameras) and bool(case.cameras)
        for finding in findings
    ]
    return {
        "named first": bool(right) and right[0],
        "named second": bool(second) and not right[0] and second[0],
        "among several": bool(several) and several[0],
        "wrong": not all(np.any([right, second, several], axis=0)) if findings else False,
        "findings": "; ".join(finding.message for finding in diagnosis.findings),
    }


def _is_right(case: Case, finding: Finding, kinds: tuple[str, ...]) -> bool:
    same = case.kind in kinds and tuple(sorted(finding.cameras)) == case.cameras
    if case.kind == "clock":
        return same and ("late" in finding.message) == (case.lag > 0)
    return same


def run(fault: str, numbers: range, cameras: int | None, verbose: bool) -> Iterator[dict[str, object]]:
    """Judge one kind of fault, or sound rigs."""
    for number in numbers:
        case = make_case(number, fault, cameras)
        if fault and case.shift_px < LEAST_PX:
            continue
        start = time.process_time()
        diagnosis = examine(case.rig, from_detections(case.seen, case.rig, case.frames), fps=FPS)
        lopsided = SCENES[number % len(SCENES)].lopsided
        row = {
            "planted": fault or "nothing",
            "group": "all" if not fault else LOPSIDED if lopsided else THREE if cameras == 3 else SMALL,
            "number": number,
            "cameras": len(case.rig),
            "truth": f"{case.kind} {' '.join(case.cameras)}" if fault else "",
            "shift_px": case.shift_px,
            "seconds": time.process_time() - start,
            **judge(case, diagnosis),
        }
        if verbose:
            verdicts = ("wrong", "named first", "named second", "among several")
            verdict = next((one for one in verdicts if row[one]), "silent")
            print(
                f"{row['planted']:17s} {row['group']:13.13s} {number:3d} {row['cameras']} {row['shift_px']:6.1f} px "
                f"{row['seconds']:5.1f} s {verdict:13s} {row['truth']} | {row['findings']}",
                flush=True,
            )
        yield row


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """One row per group and fault."""
    table = []
    for group in ("all", SMALL, LOPSIDED, THREE):
        for planted, of in rows[rows["group"] == group].groupby("planted", sort=False):
            counts = {
                key: int(of[key].sum()) for key in ("named first", "named second", "among several", "wrong")
            }
            first = "" if planted == "nothing" else f"{of['named first'].mean():.0%}"
            table.append({"rigs with": group, "planted": planted, "rigs": len(of), "first": first} | counts)
    return pd.DataFrame(table)


def main() -> None:
    """Judge the doctor, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sound", type=int, default=36, help="number of sound rigs")
    parser.add_argument(
        "--rigs", type=int, default=12, help="number of rigs of 4 to 8 cameras with each fault"
    )
    parser.add_argument("--three", type=int, default=5, help="number of rigs of 3 cameras with each fault")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--fault", action="append", choices=["nothing", *FAULTS], help="only this one")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--out", type=Path, default=_results.FOLDER, help="folder of the table")
    options = parser.parse_args()
    record = _results.Run("doctor")
    sound, rigs, three = (6, 2, 1) if options.quick else (options.sound, options.rigs, options.three)
    rows: list[dict[str, object]] = []
    for fault in options.fault or ["nothing", *FAULTS]:
        if fault == "nothing":
            rows += run("", range(options.first, options.first + sound), None, options.verbose)
        else:
            rows += run(fault, range(options.first, options.first + rigs), None, options.verbose)
            rows += run(fault, range(options.first, options.first + three), 3, options.verbose)
    judged = pd.DataFrame(rows)
    table = summary(judged)
    print(table.to_string(index=False))
    if not (options.quick or options.fault or options.first):
        record.save(options.out, rows=judged.round(2), figures={"table": table.to_dict("records")})


if __name__ == "__main__":
    main()

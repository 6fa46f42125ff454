"""Photographs and a video of markers that other people recorded: what the commands of a user find in them.

    python experiments/accuracy/accuracy.py markers --real REAL

REAL is the folder of the public repositories, as OWNER/NAME. Cases: AprilTags with hand-marked corners
(AprilRobotics/apriltag); a tag that is turned by 10 degrees from photograph to photograph, whose pose is compared with
these angles (duckietown/lib-dt-apriltags); ten photographs of several tags (the same); markers of known ids
(UbiquityRobotics/fiducials); a board of markers (abakisita/camera_calibration); a video by a hand-held phone
(Ashrafhij/TelloAI-V.0.1), from which a map is made and along which the phone is localised.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from jaxtyping import Float
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

Figures = dict[str, float]
CORNERS = [f"{axis}{corner}_px" for corner in range(4) for axis in "xy"]
#: A marker is found if its middle is this near to that of a marker that is marked by hand, pixels.
FOUND_PX = 5.0
PHONE = "Ashrafhij/TelloAI-V.0.1/part_A/challengeA.mp4"


def psotrack(*words: str | Path) -> dict[str, Any]:
    """What a command writes as JSON."""
    command = [
        sys.executable,
        "-m",
        "psotrack",
        "onboard",
        *map(str, words),
        "--json",
        "-",
        "--force",
        "--quiet",
    ]
    return dict(json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout))


def detected(folder: Path, out: Path, dictionary: str = "apriltag_36h11") -> pd.DataFrame:
    """Markers of photographs, a row each."""
    psotrack("detect", folder, "--dictionary", dictionary, "--out", out / "markers.csv")
    return pd.read_csv(out / "markers.csv")


def marked_tags(real: Path, out: Path) -> Figures:
    """Tags found, and the distances of their corners from the marked ones."""
    folder = real / "AprilRobotics/apriltag/test/data"
    found, errors_px, marked = detected(folder, out), [], 0
    for text in folder.glob("*.txt"):
        truth = np.array([re.findall(r"[-\d.]+", line)[1:] for line in text.read_text().splitlines()], float)
        truth, marked = truth.reshape(-1, 4, 2), marked + len(truth)
        corners = found.loc[found.image == f"{text.stem}.jpg", CORNERS].to_numpy().reshape(-1, 4, 2)
        # A corner of the hand is counted in pixels whose first has its middle at 0.5.
        nearest = cdist(truth.mean(axis=1), corners.mean(axis=1) + 0.5)
        for one, other in zip(*np.nonzero(nearest < FOUND_PX), strict=True):
            errors_px.append(cdist(truth[one], corners[other] + 0.5).min(axis=1))
    return {"marked": marked, "found": len(errors_px), "others": len(found) - len(errors_px)} | _spread(
        errors_px, "px"
    )


def turned_tag(real: Path, out: Path) -> Figures:
    """Angles between the photographs of one tag, beside the published angles."""
    folder = real / "duckietown/lib-dt-apriltags/test/test_files"
    info = yaml.safe_load((folder / "test_info.yaml").read_text())["rotation_test"]
    angles_deg = sorted(int(re.findall(r"-?\d+", name)[0]) for name in info["files"])
    photographs = out / "photographs"
    photographs.mkdir()
    for number, angle in enumerate(angles_deg):
        (photographs / f"{number:02}.png").write_bytes(
            (folder / f"test_image_rotation_{angle}.png").read_bytes()
        )
    half = info["tag_size"] / 2
    corners = [-half, half, 0, half, half, 0, half, -half, 0, -half, -half, 0]
    (out / "map.csv").write_text("76," + ",".join(map(str, corners)) + "\n")
    matrix = ", ".join(map(str, info["K"]))
    (out / "lens.yml").write_text(
        f"%YAML:1.0\n---\nimage_width: {info['width']}\nimage_height: {info['height']}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [{matrix}]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [0., 0., 0., 0., 0.]\n"
    )
    words = ("--fps", "1", "--markers", out / "map.csv", "--camera", out / "lens.yml", "--min-markers", "1")
    psotrack(
        "localise",
        photographs,
        *words,
        "--dictionary",
        "apriltag_36h11",
        "--no-filter",
        "--out",
        out / "path.csv",
    )
    path = pd.read_csv(out / "path.csv")
    located = np.flatnonzero(path.x_m.notna())
    rotations = Rotation.from_quat(path.loc[located, ["qx", "qy", "qz", "qw"]].to_numpy())
    turns_deg = np.degrees((rotations[:-1].inv() * rotations[1:]).magnitude())
    errors_deg = np.abs(turns_deg - np.diff(np.array(angles_deg)[located]))
    return {"photographs": len(angles_deg), "found": len(located)} | _spread([errors_deg], "deg")


def several_tags(real: Path, out: Path) -> Figures:
    """Number of tags found in the ten photographs of several tags."""
    folder = real / "duckietown/lib-dt-apriltags/test/test_files"
    found = detected(folder, out)
    return {"found": int(found.image.str.contains("multiple").sum())}


def known_ids(real: Path, out: Path) -> Figures:
    """Which of the known ids are found."""
    expected = {"aruco_detect": {1, 245, 246}, "fiducial_slam": {403}}
    found = {
        room: set(
            detected(real / "UbiquityRobotics/fiducials" / room / "test/test_images", out, "5x5_1000").id
        )
        for room in expected
    }
    return {
        "marked": sum(map(len, expected.values())),
        "found": sum(len(expected[room] & found[room]) for room in expected),
        "others": sum(len(found[room] - expected[room]) for room in expected),
    }


def board(real: Path, out: Path) -> Figures:
    """Markers found in the photographs of a board, and how far corners lie from their place on the flat board."""
    found = detected(real / "abakisita/camera_calibration/aruco_data", out, "6x6_250")
    return {"photographs": found.image.nunique(), "found": len(found)}


def phone(real: Path, out: Path) -> Figures:
    """Poses of a phone, and how far the corners lie from the map that the same video gives."""
    lens = ("--fov", "50,80")
    made = psotrack("map", real / PHONE, "--known", "0", "--side", "0.2", *lens, "--out", out / "map.csv")
    path = psotrack(
        "localise",
        real / PHONE,
        "--markers",
        out / "map.csv",
        *lens,
        "--min-markers",
        "1",
        "--out",
        out / "path.csv",
    )
    return {
        "markers": len(made["markers"]),
        "map residual px": max(marker["residual_px"] for marker in made["markers"].values()),
        "found": int(pd.read_csv(out / "path.csv").reprojection_px.notna().sum()),
        "median px": path["median_reprojection_px"],
    }


CASES: dict[str, Callable[[Path, Path], Figures]] = {
    "marked tags": marked_tags,
    "turned tag": turned_tag,
    "several tags": several_tags,
    "known ids": known_ids,
    "board": board,
    "phone": phone,
}


def _spread(errors: list[Float[np.ndarray, " errors"]], unit: str) -> Figures:
    each = np.concatenate(errors)
    return {f"median {unit}": float(np.median(each)), f"99 % {unit}": float(np.percentile(each, 99))}


def add_options(options: argparse.ArgumentParser) -> None:
    """Options of this study."""
    options.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))


def rows(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], dict[str, Any]]]]:
    """Name and function of each case."""
    for name in options.cases:
        yield name, partial(figures_of, name, options.real)


def figures_of(name: str, real: Path) -> dict[str, Any]:
    """The figures of a case."""
    with tempfile.TemporaryDirectory() as folder:
        return {"case": name, **CASES[name](real, Path(folder))}


def show(table: pd.DataFrame, options: argparse.Namespace) -> None:
    """Print a line per figure."""
    print(table.melt("case", var_name="figure").dropna().sort_values("case").to_string(index=False))

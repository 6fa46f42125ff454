"""Plain text files of handpose3d: blocks `intrinsic:`, `distortion:`, `R:` and `T:`, each followed by lines of numbers.

`c0.dat` has the lens of the first camera, `rot_trans_c0.dat` beside it the pose, x_cam = R X + T; the unit is open. All
cameras of the folder are read. A second `R:` and `T:`, from the first camera to this one, is left alone.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from psotrack.errors import InputError
from psotrack.geometry.rig_files.fields import CameraFields
from psotrack.support import read_text

_POSE = "rot_trans_"
_KEYS = {"intrinsic": "K", "distortion": "D", "R": "R", "T": "t"}


def recognises(text: str) -> bool:
    """Whether a text has such blocks."""
    return bool(re.match(r"\s*(intrinsic|R):", text)) and bool(re.search(r"^(distortion|T):", text, re.M))


def read(path: Path, text: str) -> Iterator[CameraFields]:
    """Read the cameras of a folder; the unit of length is open."""
    folder, suffix = path.parent, path.suffix
    numbered = re.compile(rf"(?:{_POSE})?(\w*?\d+){re.escape(suffix)}")
    stems = {match[1] for each in folder.iterdir() if (match := numbered.fullmatch(each.name))}
    stems |= {path.stem.removeprefix(_POSE)}
    for stem in sorted(stems, key=lambda stem: (len(stem), stem)):
        paths = [folder / f"{prefix}{stem}{suffix}" for prefix in ("", _POSE)]
        values: dict[str, object] = {}
        for each in paths:
            values |= _blocks(each) if each.exists() else {}
        if values:
            # Videos of handpose3d are named cam0, its calibrations c0.
            name = f"cam{stem[1:]}" if re.fullmatch(r"c\d+", stem) else stem
            yield CameraFields(paths[0], "", values, name)


def _blocks(path: Path) -> dict[str, object]:
    found: dict[str, list[list[float]]] = {}
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        if words[0].endswith(":"):
            rows = []
            found.setdefault(_KEYS.get(words[0].rstrip(":"), ""), rows)
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            where = f"{path}, line {number}"
            raise InputError(where, expected="numbers", found=repr(line[:60])) from None
    found.pop("", None)
    return {key: value[0] if key == "D" and value else value for key, value in found.items()}

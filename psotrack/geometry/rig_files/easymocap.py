"""Calibrations of EasyMocap: intri.yml with the lenses and extri.yml with the poses, side by side.

intri.yml has `names` and for each name `K_NAME` and `dist_NAME`, in newer versions `H_NAME` and `W_NAME` too; extri.yml
has `R_NAME` (a Rodrigues vector), `Rot_NAME` (a matrix) and `T_NAME`: x_cam = R X + T in metres. Either file may be
named. Where a camera has both `R_NAME` and `Rot_NAME`, `R_NAME` counts, as for EasyMocap. A width or height that is not
above 0 is not known.

The format: `easymocap/mytools/camera_utils.py` of https://github.com/zju3dv/EasyMocap (`read_camera`, `write_camera`);
its `apps/calibration/Readme.md` states the board's squares in metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from psotrack.errors import InputError
from psotrack.geometry.rig_files.fields import CameraFields
from psotrack.geometry.rig_files.opencv_storage import parse, with_partner

#: Field of a camera -> the same field in this package's reader.
_FIELDS = {"K": "K", "dist": "D", "D": "D", "Rot": "R", "R": "rvec", "T": "t"}


def recognises(text: str) -> bool:
    """Whether a text is one of EasyMocap's two files."""
    return bool(
        re.search(r"^names:", text, re.M) and re.search(r"^(K|Rot|R|T)_[^\s:]+: *!!opencv", text, re.M)
    )


def read(path: Path, text: str) -> Iterator[CameraFields]:
    """Read intri.yml and extri.yml; lengths are metres."""
    content = with_partner(path, parse(path, text))
    # Names of all cameras, of lenses and of poses, in the file's order.
    names = dict.fromkeys(match[1] for key in content if (match := re.fullmatch(r"(?:K|Rot|R|T)_(.+)", key)))
    if not any(f"K_{name}" in content for name in names):
        expected = "intri.yml with the lenses beside it"
        raise InputError(path, expected=expected, found="a file of poses alone")
    for name in names:
        yield CameraFields(path, f"camera {name}", _values(content, name), name, unit_m=1.0)


def _values(content: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The fields of a camera; none for a camera whose place is known, but not its lens."""
    values = {
        ours: content[f"{theirs}_{name}"]
        for theirs, ours in _FIELDS.items()
        if content.get(f"{theirs}_{name}") is not None
    }
    width, height = content.get(f"W_{name}"), content.get(f"H_{name}")
    if isinstance(width, int | float) and isinstance(height, int | float) and min(width, height) > 0:
        values["size"] = [width, height]
    if "rvec" in values:
        values.pop("R", None)
    return values if "K" in values else {}

"""Argus's profile of lenses: a line `camera fx w h cx cy AR k1 k2 t1 t2 k3` per camera.

AR is fy / fx; k1, k2, t1, t2, k3 are OpenCV's k1, k2, p1, p2, k3. The file has no poses: those are DLT coefficients in
a file of their own, for undistorted pixels; see `dlt`.

The format: `docs/user-guide.md` of https://github.com/backyardbiomech/argus_gui (there k1, k2, k3 are r2, r4, r6).
Argus takes cy and t1 for pixels counted upwards where it undistorts clicked points (`tools.undistort_pts`), but
estimates them on images, downwards (`patterns`). Here they are those of images; the two differ only if cy is not in the
middle or t1 is not 0. Argus undistorts with fx alone; AR is 1 in its profiles.
"""

from __future__ import annotations

import numpy as np

from psotrack.errors import InputError
from psotrack.geometry import make_camera
from psotrack.geometry.rig_files.entries import Entry, FileRig, Source, collect
from psotrack.geometry.rig_files.fields import CameraFields, image_size
from psotrack.geometry.rig_files.number_table import parse_numbers
from psotrack.support import LARGEST

_NAMES = ("camera", "fx", "w", "h", "cx", "cy", "AR", "k1", "k2", "t1", "t2", "k3")


def recognises(text: str) -> bool:
    """Whether a text is a table of 12 numbers per line, with an image size where Argus has it."""
    table = parse_numbers(text)
    if table is None or table.values.shape[1] != len(_NAMES):
        return False
    sizes = table.values[:, 2:4]
    return bool((sizes >= 1).all() and (sizes == np.round(sizes)).all())


def read(source: Source) -> FileRig:
    """Read the lenses; no camera is placed."""
    table = parse_numbers(source.text)
    if table is None or table.values.shape[1] != len(_NAMES):
        raise InputError(source.path, expected=f"lines of {' '.join(_NAMES)}", found="other text")
    entries = []
    for row in table.values:
        values = dict(zip(_NAMES, row.tolist(), strict=True))
        name = f"cam{values['camera']:.9g}"
        fields = CameraFields(source.path, name, {"size": [values["w"], values["h"]]})
        if not (values["fx"] > 0 and values["AR"] > 0 and (np.abs(row) <= LARGEST).all()):
            raise fields.error(
                "fx", "finite numbers, fx and AR above 0", f"{values['fx']:g}, {values['AR']:g}"
            )
        K = np.array(
            [[values["fx"], 0, values["cx"]], [0, values["fx"] * values["AR"], values["cy"]], [0, 0, 1.0]]
        )
        camera = make_camera(
            R=np.eye(3),
            t_m=np.zeros(3),
            K=K,
            dist=[values[key] for key in ("k1", "k2", "t1", "t2", "k3")],
            image_size_wh=image_size(fields, None),
        )
        entries.append((name, name, Entry(camera, placed=False)))
    return FileRig(collect(source.path, entries), metres_per_unit=None)

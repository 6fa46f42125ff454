"""Direct linear transformation (DLT): 11 coefficients per camera, as DLTdv, easyWand and Argus write them.

    u = (L1 X + L2 Y + L3 Z + L4) / (L9 X + L10 Y + L11 Z + 1)
    v = (L5 X + L6 Y + L7 Z + L8) / (L9 X + L10 Y + L11 Z + 1)

A file has 11 lines of numbers, one column per camera; 11 numbers per line and one line per camera are read too. The
unit of X, Y, Z is open. Argus and DLTdv before version 8 measure v upwards from the lower edge of the image, DLTdv8 and
other programs downwards; the sign of the determinant of the 3 x 3 part says which, if the world's origin is in front of
the cameras, as a calibration object or a wand at the origin is. A camera alone with the other sign has the origin
behind it.

Upwards, v is the image's height less the row, where the first row is 0; u is 0 in the first column. That is Argus's
count (`DLCclicker.py` and `frameFinderPyglet.py` of https://github.com/backyardbiomech/argus_gui). DLTdv, in MATLAB,
counts columns from 1 (and DLTdv8 rows, too; `dlt_invert.m` of https://github.com/tlhedrick/dltdv changes from one
origin to the other). Places from its files are therefore shown 1 pixel too far to the right (and below): a file does
not say which program wrote it.

There is no lens distortion: pixels must be undistorted ones. Argus's profile of the lenses is read by `argus`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import rq

from psotrack.errors import InputError
from psotrack.geometry import Camera, make_camera
from psotrack.geometry.rig_files.entries import Entry, FileRig, Source
from psotrack.geometry.rig_files.number_table import NumberTable, parse_numbers
from psotrack.support import LARGEST

_COEFFICIENTS = 11
#: Largest condition number of the 3 x 3 part. That of a camera is below the square of its focal length in pixels.
_LARGEST_CONDITION = 1e12


def recognises(text: str) -> bool:
    """Whether a text is a table of 11 numbers per camera."""
    table = parse_numbers(text)
    return table is not None and _COEFFICIENTS in table.values.shape


def read(source: Source) -> FileRig:
    """Read DLT coefficients; the unit of length is open."""
    table = parse_numbers(source.text)
    if table is None or _COEFFICIENTS not in table.values.shape:
        found = "other text" if table is None else f"{' x '.join(map(str, table.values.shape))}"
        raise InputError(source.path, expected="11 lines of numbers, one column per camera", found=found)
    if source.image_size_wh is None:
        raise source.missing_size()
    names, columns = _columns(table)
    for name, column in zip(names, columns, strict=True):
        if not (np.abs(column) <= LARGEST).all():
            raise InputError(
                f"{source.path}, camera {name}", expected="finite numbers", found="NaN or infinity"
            )
    matrices = [np.append(column, 1.0).reshape(3, 4) for column in columns]
    for name, matrix in zip(names, matrices, strict=True):
        if np.linalg.cond(matrix[:, :3]) > _LARGEST_CONDITION:
            raise InputError(
                f"{source.path}, camera {name}",
                expected="the coefficients of a camera",
                found="a determinant of 0",
            )
    signs = np.sign([np.linalg.det(matrix[:, :3]) for matrix in matrices])
    if not signs.sum():
        raise InputError(
            source.path,
            expected="cameras most of which have the world's origin in front of them",
            found="as many with it behind, so that the direction of v is not known",
        )
    upwards = signs.sum() < 0
    entries = {}
    for name, matrix in zip(names, matrices, strict=True):
        image = np.array([[1.0, 0, 0], [0, -1, source.image_size_wh[1]], [0, 0, 1]]) @ matrix
        entries[name] = Entry(camera_of_projection(image if upwards else matrix, source.image_size_wh))
    return FileRig(entries, metres_per_unit=None)


def camera_of_projection(P: Float[np.ndarray, "3 4"], image_size_wh: tuple[int, int]) -> Camera:
    """The camera with this projection matrix, which may have any scale and sign.

    Args:
        P: 3 x 4 matrix that maps homogeneous world points to homogeneous pixels, with v downwards.
        image_size_wh: width and height in pixels.
    """
    P = P * np.sign(np.linalg.det(P[:, :3])) / np.linalg.norm(P[2, :3])
    K, R = rq(P[:, :3])
    flip = np.sign(np.diag(K))
    K, R = K * flip, flip[:, None] * R
    t = np.linalg.solve(K, P[:, 3])
    return make_camera(R=R, t_m=t, K=K / K[2, 2], image_size_wh=image_size_wh)


def _columns(table: NumberTable) -> tuple[Sequence[str], Float[np.ndarray, "cameras 11"]]:
    by_column = table.values.shape[0] == _COEFFICIENTS
    columns = table.values.T if by_column else table.values
    named = by_column and table.header is not None and len(table.header) == len(columns)
    return (
        table.header if named and table.header else [f"cam{index + 1}" for index in range(len(columns))]
    ), columns

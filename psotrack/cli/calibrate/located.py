"""Poses of cameras from points of known positions, for `calibrate extrinsics` and `calibrate rig --pairs`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from psotrack.cli.calibrate.shown import row_of

if TYPE_CHECKING:
    from psotrack.calibration import ImagePoints
    from psotrack.geometry import Camera, Rig


def locate_cameras(
    marks: Mapping[str, ImagePoints], lenses: Mapping[str, Camera], noise_px: float
) -> tuple[Rig, dict[str, dict[str, Any]]]:
    """Rig of the cameras whose images show points of known positions, and a row of each camera."""
    from psotrack.calibration import locate_camera
    from psotrack.geometry import make_rig

    cameras, rows = {}, {}
    for name, of_camera in marks.items():
        one = lenses[name]
        located = locate_camera(
            of_camera.points_m,
            of_camera.points_px,
            np.asarray(one.K),
            np.asarray(one.dist),
            noise_px,
            fisheye=bool(one.fisheye),
            name=f"camera {name}",
        )
        cameras[name] = replace(one, T_cam_world=located.T_cam_world)
        rows[name] = row_of(
            np.asarray(cameras[name].centre_world),
            located.centre_covariance_m2,
            located.residual_px,
            located.used,
            of_camera.points,
        )
    return make_rig(cameras), rows

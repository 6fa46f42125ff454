"""Rigs and silhouettes for tests, made without the code that they test (`boxes`, `fitness`)."""

import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filelock import FileLock

from psotrack.geometry import Camera, Rig, look_at, make_camera, make_rig, project, undistort
from psotrack.settings import RENAMED, TrackSettings

#: Lenses as strong as those of action cameras, in OpenCV's order.
LENSES = {
    0: (),
    4: (-0.12, 0.03, 0.0008, -0.0005),
    5: (-0.12, 0.03, 0.0008, -0.0005, 0.004),
    8: (-0.12, 0.03, 0.0008, -0.0005, 0.004, 0.01, -0.006, 0.001),
}

ROOM_M = np.array([[-3.0, -3.0, 0.0], [3.0, 3.0, 3.0]])


def ring_rig(num_cameras, *, coefficients=0, image_size_wh=(320, 240), radius_m=4.0, height_m=2.4):
    """Cameras on a circle that look at the middle of the room, no two alike (each has its own focal length)."""
    cameras = {}
    for i in range(num_cameras):
        angle = 2 * np.pi * i / num_cameras + 0.2
        centre = (radius_m * np.cos(angle), radius_m * np.sin(angle), height_m + 0.1 * i)
        R, t_m = look_at(centre, (0.1, -0.1, 1.2))
        focal = image_size_wh[0] * (0.8 + 0.02 * i)
        K = np.array(
            [[focal, 0, image_size_wh[0] / 2 + 1.5], [0, 1.01 * focal, image_size_wh[1] / 2 - 2], [0, 0, 1]]
        )
        cameras[f"c{i}"] = make_camera(
            R=R, t_m=t_m, K=K, image_size_wh=image_size_wh, dist=LENSES[coefficients]
        )
    return make_rig(cameras)


def far_camera(*, image_size_wh, pixels_per_m, distance_m=1000.0):
    """A camera so far away on the y axis that metres are pixels: x is to the right, z is up.

    The origin projects to the middle of the image, which is between pixels where the sides are even.
    """
    R, t_m = look_at((0.0, -distance_m, 0.0), (0.0, 0.0, 0.0))
    width, height = image_size_wh
    focal = pixels_per_m * distance_m
    K = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    return make_camera(R=R, t_m=t_m, K=K, image_size_wh=image_size_wh)


def rig_of(*cameras):
    """A rig of unnamed cameras."""
    return make_rig({str(i): one for i, one in enumerate(cameras)})


def environment_without_jax_settings() -> dict[str, str]:
    """Environment variables for a command that must not use the suite's folder of compiled programs."""
    return {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}


def make_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder `name` with what `make` writes into it; made by the first worker of a run that asks for it.

    Tests must not change the folder: the tests of all workers read it.
    """
    base = tmp_path_factory.getbasetemp()
    # Each worker has a folder of its own within the folder of the run.
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, finished = shared / name, shared / f"{name}.finished"
    with FileLock(shared / f"{name}.lock"):
        if not finished.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            finished.touch()
    return folder


def float32(tree):
    """A pytree of JAX float32 arrays: what the tracker computes in."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def moved(rig: Rig, R, shift_m) -> Rig:
    """The rig after the whole world was turned by R and then shifted."""
    T_old_new = np.eye(4)
    T_old_new[:3, :3], T_old_new[:3, 3] = R.T, -R.T @ np.asarray(shift_m)
    cams = rig.cameras
    return Rig(rig.names, Camera(cams.T_cam_world @ T_old_new, cams.K, cams.dist, cams.image_size_wh))


def assert_same(actual, desired, atol=0.0):
    """Every array of one pytree equals that of the other; exactly, where no tolerance is given."""
    assert jax.tree.structure(actual) == jax.tree.structure(desired)
    for one, other in zip(jax.tree.leaves(actual), jax.tree.leaves(desired), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=atol)


def sphere_points(count):
    """Points spread evenly over the unit sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=-1)


def draw_coverage(rig: Rig, position_m, size_m, reduction):
    """(cameras, height, width) uint8 coverage of ellipsoids, by casting a ray through the centre of every pixel.

    Independent of `boxes`: a pixel is foreground where its ray meets an ellipsoid.
    """
    position_m, size_m = np.atleast_2d(position_m), np.atleast_2d(size_m)
    width, height = rig.cameras.image_size_wh[0].astype(int)
    foreground = np.zeros((len(rig), height, width))
    for index in range(len(rig)):
        one = rig.cameras[index]
        R = one.T_cam_world[:3, :3]
        for centre, size in zip(position_m, np.broadcast_to(size_m, position_m.shape), strict=True):
            pixel, depth = project(one, centre)
            reach = 2.0 * one.K[1, 1] * size.max() / max(depth, 0.1)
            (x0, y0), (x1, y1) = (
                np.clip(np.floor(pixel + sign * reach), 0, (width, height)).astype(int) for sign in (-1, 1)
            )
            if depth < size.max() or x0 >= x1 or y0 >= y1:
                continue
            grid = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), axis=-1).astype(float)
            ray = np.concatenate([undistort(one, grid), np.ones((*grid.shape[:2], 1))], axis=-1) @ R
            # In units of the semi-axes the ellipsoid is the unit sphere.
            ray, start = ray / (size / 2), (one.centre_world - centre) / (size / 2)
            hit = (ray @ start) ** 2 >= (ray * ray).sum(axis=-1) * (start @ start - 1)
            foreground[index, y0:y1, x0:x1] = np.maximum(foreground[index, y0:y1, x0:x1], hit)
    cells = foreground.reshape(len(rig), height // reduction, reduction, width // reduction, reduction)
    return np.round(255 * cells.mean(axis=(2, 4))).astype(np.uint8)


def track_settings(**options):
    """Settings by the names of the command line's options, such as `particles`; dotted names are not needed."""
    return TrackSettings().changed({RENAMED.get(name, name): value for name, value in options.items()})

"""Rigs and silhouettes for tests, made without the code under test (`boxes`, `fitness`)."""

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from filelock import FileLock

from psotrack.errors import LONGEST_MESSAGE, PsotrackError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.geometry import Rig, look_at, make_camera, make_rig, project, undistort
from psotrack.recordings import CameraRecording, Recording
from psotrack.settings import TrackSettings, full_name

#: Number of distortion coefficients -> coefficients in OpenCV's order, as strong as the distortion of action cameras.
LENSES = {
    0: (),
    4: (-0.12, 0.03, 0.0008, -0.0005),
    5: (-0.12, 0.03, 0.0008, -0.0005, 0.004),
    8: (-0.12, 0.03, 0.0008, -0.0005, 0.004, 0.01, -0.006, 0.001),
}

ROOM_M = np.array([[-3.0, -3.0, 0.0], [3.0, 3.0, 3.0]])


def ring_rig(num_cameras, *, coefficients=0, image_size_wh=(320, 240), radius_m=4.0, height_m=2.4):
    """Rig of cameras on a circle that look at the middle of the room; each camera has its own focal length."""
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
    """Camera so far away on the y axis that its image is a parallel projection: x is to the right, z is up.

    A metre has `pixels_per_m` pixels. The origin projects to the middle of the image, which lies between two pixels if
    the side is even.
    """
    lens = simple_lens(pixels_per_m * distance_m, image_size_wh)
    return posed(lens, (0.0, -distance_m, 0.0), (0.0, 0.0, 0.0))


def simple_lens(focal_px, image_size_wh, dist=(), *, fisheye=False):
    """A camera at the origin, whose axis meets the middle of the image."""
    width, height = image_size_wh
    K = np.array([[focal_px, 0, width / 2 - 0.5], [0, focal_px, height / 2 - 0.5], [0, 0, 1]])
    pose = {"R": np.eye(3), "t_m": np.zeros(3)}
    return make_camera(**pose, K=K, image_size_wh=image_size_wh, dist=dist, fisheye=fisheye)


def posed(lens, centre_m, target_m, up=(0.0, 0.0, 1.0)):
    """The camera at a place, looking at a point."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = look_at(tuple(centre_m), tuple(target_m), up=up)
    return replace(lens, T_cam_world=T)


def opencv_pixels(camera, points_m):
    """(..., 2), the pixels in which OpenCV projects points (..., 3); it leaves out a skew."""
    function = cv2.projectPoints if camera.fisheye is None else cv2.fisheye.projectPoints
    T = camera.T_cam_world
    turn, _ = cv2.Rodrigues(T[:3, :3])
    flat = np.ascontiguousarray(points_m, float).reshape(-1, 1, 3)
    pixels, _ = function(flat, turn, T[:3, 3], camera.K, np.array(camera.dist))
    return pixels.reshape(*np.shape(points_m)[:-1], 2)


def cameras_of(rig, **fields):
    """What a recording has of the cameras of a rig; a field of `CameraRecording` has values by camera name."""
    return tuple(
        CameraRecording(name, rig.cameras[index], **_of_camera(name, fields))
        for index, name in enumerate(rig.names)
    )


def with_cameras(recording, **fields) -> Recording:
    """The recording with other values of fields of its cameras, by camera name."""
    cameras = tuple(replace(each, **_of_camera(each.name, fields)) for each in recording.cameras)
    return replace(recording, cameras=cameras)


def _of_camera(name, fields):
    return {field: values[name] for field, values in fields.items() if name in values}


def read_mocap_markers(path):
    """The positions (frames, 4, 3) in a file of `write_mocap_markers`, metres."""
    return np.loadtxt(path, delimiter=";", skiprows=1)[:, 1:].reshape(-1, 4, 3)


def make_unnamed_rig(*cameras):
    """Rig of the given cameras, which are named "0", "1" and so on."""
    return make_rig({str(i): camera for i, camera in enumerate(cameras)})


class Output(NamedTuple):
    """What a command gave: exit code, stdout and stderr."""

    code: int
    out: str
    err: str

    def ended(self, code: int = 0) -> Self:
        """What a command gave that must end with this exit code."""
        assert self.code == code, self
        return self


#: What runs a command, given its words.
Run = Callable[..., Output]


def assert_refused(bad: Callable[[], object], *words: object, unchanged: Path) -> None:
    """Assert that bad input is refused: one short line with the words, exit code 2, and a folder as it was before.

    Args:
        bad: calls a function of the package, which must raise one of its errors, or runs a command and returns its
            `Output`.
        words: parts of the line: what was expected, what was found, where, and the remedy.
        unchanged: folder in which no file may appear, change or go, hidden files included.
    """
    before = content_of(unchanged)
    try:
        result = bad()
    except PsotrackError as error:
        line = f"psotrack: {error}\n"
    else:
        assert isinstance(result, Output), f"expected an error, found {result!r}"
        assert (result.code, result.out) == (2, ""), result
        line = result.err
    assert line.startswith("psotrack: "), line
    assert line.count("\n") == 1, line
    # A long place, such as the folder of the tests, is not cut.
    assert len(line.replace(str(unchanged), "")) <= len("psotrack: \n") + LONGEST_MESSAGE, line
    for word in words:
        assert str(word) in line, line
    assert content_of(unchanged) == before


def calls(function: Callable[..., object], *arguments: Any, **options: Any) -> Callable[..., Callable]:
    """What prepares a bad call that needs neither the folder of a test nor a command."""
    return lambda folder, run: lambda: function(*arguments, **options)


def content_of(folder: Path) -> dict[str, bytes | None]:
    """Path of each file below a folder, hidden files included, -> its bytes; path of each folder -> None."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }


@contextlib.contextmanager
def files_up_to(num_bytes: int) -> Iterator[None]:
    """No file gets longer than a number of bytes, which needs no rights, and stands for a full disk.

    Python ignores the signal that else ends the process.
    """
    resource = pytest.importorskip("resource", reason="limits on the size of files are a matter of Unix")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def environment_without_jax_settings() -> dict[str, str]:
    """Environment variables for a command that must not use the suite's folder of compiled programs."""
    return {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}


#: `psotrack` as at a terminal: shells start programs in the background with Ctrl-C ignored.
AT_A_TERMINAL = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from psotrack.__main__ import main
main()
"""


def listening_at(process: int) -> set[str]:
    """The addresses of this computer at which a process and its children listen."""
    psutil = pytest.importorskip("psutil", reason="comes with Dask")
    one = psutil.Process(process)
    return {
        connection.laddr.ip
        for each in (one, *one.children(recursive=True))
        for connection in each.net_connections()
        if connection.status == psutil.CONN_LISTEN
    }


def make_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """The folder `name`, which `make` fills once per test run: the first worker that needs the folder calls `make`.

    Tests must not change the folder, because the tests of all workers read it. A name belongs to one maker.
    """
    maker = f"{make.__module__}.{make.__qualname__}"
    base = tmp_path_factory.getbasetemp()
    # Each worker has a folder of its own within the folder of the run.
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, finished = shared / name, shared / f"{name}.finished"
    with FileLock(shared / f"{name}.lock"):
        if not finished.exists():
            folder.mkdir(exist_ok=True)
            make(folder)
            finished.write_text(maker)
        assert finished.read_text() == maker, f"two worlds of the tests have the name {name}"
    return folder


def made_once(name: str, make: Callable[[Path], object], inside: str = "") -> Any:
    """A fixture: the folder of `make_once`, or what is inside of it."""

    @pytest.fixture(scope="session")
    def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
        return make_once(tmp_path_factory, name, make) / inside

    return folder


def float32(tree):
    """Convert a pytree to JAX float32 arrays, the type in which the tracker computes."""

    def convert(leaf):
        is_bool = np.asarray(leaf).dtype == bool
        return jnp.asarray(leaf, bool if is_bool else jnp.float32)

    return jax.tree.map(convert, tree)


def move_world(rig: Rig, R, shift_m) -> Rig:
    """Rig after the whole world was turned by R, (3, 3), and then shifted by `shift_m`, (3,)."""
    T_old_new = np.eye(4)
    T_old_new[:3, :3], T_old_new[:3, 3] = R.T, -R.T @ np.asarray(shift_m)
    cams = rig.cameras
    return Rig(rig.names, replace(cams, T_cam_world=cams.T_cam_world @ T_old_new))


def assert_same(actual, desired, atol=0.0):
    """Assert that two pytrees have the same structure and equal arrays; exactly equal, unless `atol` is given."""
    assert jax.tree.structure(actual) == jax.tree.structure(desired)
    for actual_leaf, desired_leaf in zip(jax.tree.leaves(actual), jax.tree.leaves(desired), strict=True):
        np.testing.assert_allclose(actual_leaf, desired_leaf, rtol=0, atol=atol)


def fading(noise, persistence):
    """Noise of variance 1, as a stationary first-order autoregression along the first axis."""
    noise = noise.copy()
    for row in range(1, len(noise)):
        noise[row] = persistence * noise[row - 1] + np.sqrt(1 - persistence**2) * noise[row]
    return noise


def sphere_points(count):
    """(count, 3), points spread evenly over the unit sphere (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=-1)


#: Bytes of a lens -> (height, width, 3) directions of the rays through the centres of its pixels, in its axes.
_RAYS: dict[tuple[bytes, ...], np.ndarray] = {}


def _rays(camera, size_wh):
    """Directions of the rays through the pixels; they are computed once per lens."""
    parts = (camera.K, camera.dist, camera.fisheye, size_wh)
    key = tuple(np.asarray(part).tobytes() for part in parts)
    if key not in _RAYS:
        x, y = np.meshgrid(np.arange(size_wh[0]), np.arange(size_wh[1]))
        points = undistort(camera, np.stack([x, y], axis=-1).astype(float))
        ahead = np.ones((*points.shape[:2], 1))
        _RAYS[key] = np.concatenate([points, ahead], axis=-1)
    return _RAYS[key]


def draw_coverage(rig: Rig, position_m, size_m, reduction):
    """(cameras, height, width) uint8, coverage by ellipsoids, from a ray through the centre of every pixel.

    A pixel is foreground if its ray meets an ellipsoid. The function does not use `boxes`, so it can test that module.
    """
    position_m = np.atleast_2d(position_m)
    size_m = np.broadcast_to(size_m, position_m.shape)
    width, height = rig.cameras.image_size_wh[0].astype(int)
    foreground = np.zeros((len(rig), height, width), bool)
    for index in range(len(rig)):
        camera = rig.cameras[index]
        rays = _rays(camera, (width, height)) @ camera.T_cam_world[:3, :3]
        for centre, size in zip(position_m, size_m, strict=True):
            _, depth = project(camera, centre)
            if depth < size.max():
                continue
            # In units of the semi-axes the ellipsoid is the unit sphere.
            scaled = rays / (size / 2)
            start = (camera.centre_world - centre) / (size / 2)
            squared = (scaled * scaled).sum(axis=-1)
            foreground[index] |= (scaled @ start) ** 2 >= squared * (start @ start - 1)
    cells = foreground.reshape(len(rig), height // reduction, reduction, width // reduction, reduction)
    return np.round(255 * cells.mean(axis=(2, 4))).astype(np.uint8)


def drawn_silhouettes(rig: Rig, position_m, size_m, reduction) -> Silhouettes:
    """Silhouettes of ellipsoids at positions (frames, drones, 3), NaN where a drone is not there; sizes (drones, 3)."""
    there = np.isfinite(position_m).all(axis=-1)
    images = [
        draw_coverage(rig, places[visible], size_m[visible], reduction)
        for places, visible in zip(position_m, there, strict=True)
    ]
    return silhouettes_in_memory(rig, np.array(images), reduction)


def silhouettes_in_memory(rig: Rig, coverage, reduction) -> Silhouettes:
    """Silhouettes from their coverage, (frames, cameras, height, width)."""
    arrays = tuple(np.moveaxis(coverage, 1, 0))
    drawn = dict.fromkeys(rig.names, "drawn")
    return Silhouettes(rig.names, drawn, reduction, len(coverage), coverage.shape[2:], {}, arrays)


#: Short names of settings whose last name is not theirs alone.
SHORT_NAMES = {
    "swarm": "swarm.kind",
    "score": "score.kind",
    "drones": "drones.count",
    "drone_size_m": "drones.size_m",
}


def track_settings(**options):
    """Tracking settings by their last names, such as `particles`, by `SHORT_NAMES`, or by dotted names."""
    named = {SHORT_NAMES.get(name, name): value for name, value in options.items()}
    return TrackSettings().changed({full_name(name): value for name, value in named.items()})


def points_in_room(*shape, seed=0):
    """(*shape, 3), points in the middle of the room of `ring_rig`, metres."""
    return np.random.default_rng(seed).uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (*shape, 3))


def project_points(rig, points):
    """(..., cameras, 2), pixels of points in all cameras."""
    return project(rig.cameras, points[..., None, :])[0]

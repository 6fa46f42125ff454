"""A simulated sequence in the form of the real half of DPJAIT, which a Vicon system recorded, for tests of its readers.

The real half differs from the simulated half: four cameras of one type with lens distortion, 1924 x 1082 pixels, named
by serial number, calibration in millimetres. The reference is one C3D file of marker crosses at 100 Hz. It begins at
another time than the videos, and has noise. There are no poses and no masks. The middle of a cross is not the drone's
body origin: evaluation finds the lever arm.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from helpers import read_mocap_markers
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from psotrack.geometry import Camera, Rig, to_pixels, undistort
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import (
    Detections,
    VideoInfo,
    VideoWriter,
    read_detections,
    read_frames,
    write_detections,
)
from psotrack.recordings.datasets import (
    CALIBRATION,
    DETECTIONS,
    read_sequence,
)
from psotrack.recordings.mocap import Markers, write_c3d

#: Serial numbers of the dataset's cameras, without the fifth camera, which was a spare.
SERIALS = ("55260362", "56339527", "60881257", "61016180")
#: Focal length, principal point and image size in the real half's calibration; scaled for images of other sizes.
_FOCAL_LENGTH_PX, _CENTRE_PX, _SIZE_WH = 1158.7, (962.0, 541.0), (1924, 1082)
#: Width of the simulated images at full size.
_SIMULATED_WIDTH_PX = 1920
#: Distortion k1, k2, p1, p2: a weak barrel distortion, usual for this field of view. The distortion of the dataset's
#: lenses is not known.
_LENS = np.array([-0.08, 0.02, 0.0004, -0.0003])
#: Standard deviation of a marker's position along each axis.
_NOISE_M = 0.0002
#: Position of an unlabelled reflection on the floor.
_REFLECTION_M = (1.3, -1.1, 0.02)


def write_as_real(sequence: Path, root: Path, *, offset_s: float) -> Path:
    """Write a simulated sequence in the folder ROOT/Real_Data/RXX_Dn, where XX is the number in the sequence's name.

    The lens shows more than the simulated image: 8 % of the pixels, at the edges, repeat its border. Marker positions
    between the frames of the simulation are cubic splines; before frame 0 the drones stand still.

    Args:
        sequence: folder of the simulated sequence, of four cameras.
        root: root folder of the data.
        offset_s: time in the C3D file at frame 0 of the videos, seconds; positive if the C3D file begins first.
    """
    simulated = read_sequence(sequence)
    rig = _real_rig(simulated.rig)
    paths = sorted(Path(sequence).glob("dron*_markers_*.csv"))
    markers_m = np.stack([read_mocap_markers(path) for path in paths], axis=1)
    number = re.match(r"[A-Za-z]*(\d+)", simulated.name)[1]
    folder = Path(root) / "Real_Data" / f"R{int(number):02d}_D{len(paths)}"
    folder.mkdir(parents=True)
    write_calibration(folder / CALIBRATION, rig, unit="mm")
    rng = np.random.default_rng(0)
    write_c3d(folder / f"{folder.name}.c3d", _recording(markers_m, simulated.fps, 100.0, offset_s, rng))
    for index, (name, serial) in enumerate(zip(simulated.rig.names, SERIALS, strict=True)):
        before, lens = simulated.rig.cameras[index], rig.cameras[index]
        _write_video(folder / f"{serial}.avi", simulated.videos[name], before, lens)
        boxes = _distort_boxes(read_detections(simulated.detections[name]), before, lens)
        write_detections(folder / DETECTIONS / f"{serial}.csv", boxes)
    return folder


# --- cameras, videos and boxes


def _real_rig(rig: Rig) -> Rig:
    """Cameras with the simulated poses, and with the real half's intrinsics, distortion and names."""
    cameras = rig.cameras
    scale = float(cameras.image_size_wh[0, 0]) / _SIMULATED_WIDTH_PX
    # Pixel centres have integer coordinates, so the image's corner, which the scale does not move, is at -0.5.
    cx, cy = ((centre + 0.5) * scale - 0.5 for centre in _CENTRE_PX)
    focal_px = _FOCAL_LENGTH_PX * scale
    K = np.array([[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]])
    size_wh = np.array([2.0 * round(side * scale / 2) for side in _SIZE_WH])
    return Rig(
        SERIALS,
        replace(
            cameras,
            K=np.tile(K, (len(rig), 1, 1)),
            dist=np.tile(_LENS, (len(rig), 1)),
            image_size_wh=np.tile(size_wh, (len(rig), 1)),
        ),
    )


def _write_video(path: Path, video: VideoInfo, before: Camera, lens: Camera) -> None:
    width, height = (int(side) for side in lens.image_size_wh)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    xs, ys = np.moveaxis(_convert_pixels(lens, before, pixels).astype(np.float32), -1, 0)
    with VideoWriter(path, video.fps, (width, height)) as writer:
        for frame in read_frames(video):
            writer.write(cv2.remap(frame, xs, ys, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def _distort_boxes(detections: Detections, before: Camera, lens: Camera) -> Detections:
    """Boxes around the distorted corners and distorted middles of the sides of the given boxes."""
    x0, y0, x1, y1 = detections.xyxy.T
    xs, ys = (np.stack([low, (low + high) / 2, high], axis=-1) for low, high in ((x0, x1), (y0, y1)))
    grid = np.stack(np.broadcast_arrays(xs[:, None, :], ys[:, :, None]), axis=-1).reshape(-1, 9, 2)
    seen = _convert_pixels(before, lens, grid)
    return replace(detections, xyxy=np.hstack([seen.min(axis=1), seen.max(axis=1)]))


def _convert_pixels(
    camera: Camera, other: Camera, pixels: Float[np.ndarray, "*points 2"]
) -> Float[np.ndarray, "*points 2"]:
    """Pixels of a second camera with the same pose that show the same points as the given pixels of a camera."""
    rays = undistort(camera, pixels)
    return np.asarray(to_pixels(other, np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)))


# --- the C3D file


def _recording(
    markers_m: Float[np.ndarray, "frames drones markers 3"],
    fps: float,
    rate_hz: float,
    offset_s: float,
    rng: np.random.Generator,
) -> Markers:
    """Markers as a mocap system would record them, until the end of the videos."""
    num_frames, num_drones, per_drone, _ = markers_m.shape
    last_s = (num_frames - 1) / fps
    time_s = np.arange(int((last_s + offset_s) * rate_hz + 1e-6) + 1) / rate_hz - offset_s
    spline = CubicSpline(np.arange(num_frames) / fps, markers_m.reshape(num_frames, -1))
    shown_m = spline(np.maximum(time_s, 0.0)).reshape(len(time_s), -1, 3)
    shown_m += rng.normal(0.0, _NOISE_M, shown_m.shape)
    names = [f"Dron{number}" for number in range(1, num_drones + 1)]
    labels = [f"{name}:{name}{marker}" for name in names for marker in range(1, per_drone + 1)]
    strays_m = np.tile(_REFLECTION_M, (len(time_s), 1, 1))
    return Markers((*labels, "*1"), np.concatenate([shown_m, strays_m], axis=1), rate_hz)

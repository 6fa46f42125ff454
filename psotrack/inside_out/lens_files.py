"""The lens of a camera that is carried, from any file of cameras or its fields of view, for images of one size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.calibration import lens_of_view
from psotrack.datasets.dpjait import read_onboard_calibration
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, CameraRig, camera, read_lenses, stack
from psotrack.support import read_table

#: Of the image, that the optical axis may be off its middle, where a file does not say the size of its images.
_OFF_MIDDLE = 0.2
#: Share by which two aspect ratios may differ and be the same, because sizes are whole pixels.
_ASPECT = 2e-3

Size = tuple[int, int]


def chosen_lens(
    image_size_wh: Size,
    *,
    path: Path | None,
    fov_deg: tuple[float, float] | None,
    name: str | None = None,
    scale: bool = False,
) -> Camera:
    """The lens of a file as `read_lens` has it, or that of fields of view, whichever is given.

    Args:
        image_size_wh: width and height of the images in pixels.
        path: of a calibration.
        fov_deg: fields of view, horizontal and vertical, in degrees.
        name: of the camera in the file.
        scale: as of `read_lens`.

    Raises:
        InputError: as of `read_lens`.
        SettingsError: both are given, or neither, or angles that no lens has.
    """
    if (path is None) == (fov_deg is None):
        found = "neither" if path is None else "both"
        raise SettingsError("lens", expected="--camera FILE or --fov H,V", found=found)
    if fov_deg is not None:
        return lens_of_view(*fov_deg, image_size_wh)
    return read_lens(Path(str(path)), image_size_wh, name=name, scale=scale)


def lens_of_matrix(K: Float[np.ndarray, "3 3"], image_size_wh: Size) -> Camera:
    """A lens without distortion, at the world's origin."""
    return camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)


def read_lens(path: Path, image_size_wh: Size, *, name: str | None = None, scale: bool = False) -> Camera:
    """The lens of one camera, for images of this size.

    Args:
        path: of a calibration: those that `rig_files` reads, or the dataset's `drone_cameras_calibration.csv`.
        image_size_wh: width and height of the images in pixels.
        name: of the camera; needed where the file has several.
        scale: whether a lens for a larger or smaller form of the same images is scaled to these.

    Raises:
        InputError: the file cannot be read, has no such camera, or its lens is for images of another size.
    """
    rig = _cameras(path, image_size_wh)
    if name is None and len(rig) > 1:
        names = ", ".join(rig.names)
        raise InputError(path, expected="one camera", found=names, remedy="name it by --camera-name")
    if name is not None and name not in rig.names:
        raise InputError(path, expected=f"a camera {name}", found=", ".join(rig.names))
    lens = rig.cameras[0 if name is None else rig.names.index(name)]
    size_wh = (int(lens.image_size_wh[0]), int(lens.image_size_wh[1]))
    off_middle = np.abs(lens.K[:2, 2] / lens.image_size_wh - 0.5).max()
    if size_wh == image_size_wh and off_middle <= _OFF_MIDDLE:
        return lens
    width, height = image_size_wh
    expected = f"intrinsics for {width} x {height} pixels, as the images have"
    if size_wh == image_size_wh:
        found = f"an optical axis at ({lens.K[0, 2]:.0f}, {lens.K[1, 2]:.0f}), far off their middle"
        raise InputError(path, expected=expected, found=found, remedy="is it for images of this size?")
    found = f"{size_wh[0]} x {size_wh[1]}"
    if abs(size_wh[0] * height / (size_wh[1] * width) - 1) > _ASPECT:
        raise InputError(
            path, expected=expected, found=found, remedy="calibrate at this size: the shape differs"
        )
    if not scale:
        remedy = "pass --scale-camera if the whole image is there, only larger or smaller"
        raise InputError(path, expected=expected, found=found, remedy=remedy)
    return scaled(lens, image_size_wh)


def scaled(lens: Camera, image_size_wh: Size) -> Camera:
    """The same lens where its images are enlarged or reduced to another size."""
    factors = np.array(image_size_wh) / lens.image_size_wh
    # Pixel centres are at whole numbers, so it is edges, at -1/2, that stay where they are.
    shift = (factors - 1) / 2
    K = np.array([[factors[0], 0.0, shift[0]], [0.0, factors[1], shift[1]], [0.0, 0.0, 1.0]]) @ lens.K
    return replace(lens, K=K, image_size_wh=np.array(image_size_wh, np.float64))


def _cameras(path: Path, image_size_wh: Size) -> CameraRig:
    if path.suffix.lower() == ".csv" and read_table(path).find("focal_length_x") is not None:
        return stack(
            {
                name: lens_of_matrix(K, size_wh)
                for name, (K, size_wh) in read_onboard_calibration(path).items()
            }
        )
    return read_lenses(path, image_size_wh)

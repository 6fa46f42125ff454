"""The lens of an on-board camera, from a calibration file or from fields of view, for images of a given size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.calibration import lens_of_view
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Camera, Rig, make_camera, make_rig, scale_lens
from psotrack.geometry.rig_files import read_lenses
from psotrack.recordings.datasets import read_onboard_calibration
from psotrack.support import read_table

#: Largest distance of the optical axis from the middle of the image, as a fraction of its size, for files that do not
#: state the size of the images.
_OFF_MIDDLE = 0.2
#: Largest relative difference of two equal aspect ratios; sizes are whole pixels.
_ASPECT_TOLERANCE = 2e-3

Size = tuple[int, int]


def choose_lens(
    image_size_wh: Size,
    *,
    path: Path | str | None,
    fov_deg: tuple[float, float] | None,
    name: str | None = None,
    scale: bool = False,
) -> Camera:
    """The lens of one camera, for images of a given size, from a calibration file or from fields of view.

    Args:
        image_size_wh: width and height of the images in pixels.
        path: calibration file: any that `read_lenses` reads, or the dataset's `drone_cameras_calibration.csv`; None if
            fields of view are given.
        fov_deg: horizontal and vertical field of view, degrees; None if a file is given.
        name: name of the camera; needed where the file has several cameras.
        scale: scale a lens that is for a larger or smaller form of the same images.

    Raises:
        InputError: the file cannot be read, has no camera of this name, or its lens is for images of another size.
        SettingsError: a file and fields of view are given, or neither, or angles that no lens has.
    """
    if fov_deg is not None and path is None:
        return lens_of_view(*fov_deg, image_size_wh)
    if path is None or fov_deg is not None:
        found = "neither" if path is None else "both"
        raise SettingsError("lens", expected="--camera FILE or --fov H,V", found=found)
    path = Path(path)
    rig = _read_cameras(path, image_size_wh)
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
    if abs(size_wh[0] * height / (size_wh[1] * width) - 1) > _ASPECT_TOLERANCE:
        raise InputError(
            path, expected=expected, found=found, remedy="calibrate at this size: the shape differs"
        )
    if not scale:
        remedy = (
            "pass --scale-camera if these images show all of the calibrated image, only larger or smaller"
        )
        raise InputError(path, expected=expected, found=found, remedy=remedy)
    return scale_lens(lens, image_size_wh)


def lens_from_matrix(K: Float[np.ndarray, "3 3"], image_size_wh: Size) -> Camera:
    """A lens without distortion, with intrinsics K, at the world's origin."""
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=image_size_wh)


def check_size(where: Path | str, lens: Camera, image_size_wh: Size) -> None:
    """Raise `InputError` if images, which `where` names, are of another size than the lens is for."""
    width, height = (int(side) for side in lens.image_size_wh)
    if (width, height) != image_size_wh:
        raise InputError(
            where,
            expected=f"{width} x {height} pixels as the lens is for",
            found="{} x {}".format(*image_size_wh),
        )


def _read_cameras(path: Path, image_size_wh: Size) -> Rig:
    if path.suffix.lower() == ".csv" and read_table(path).find("focal_length_x") is not None:
        return make_rig(
            {
                name: lens_from_matrix(K, size_wh)
                for name, (K, size_wh) in read_onboard_calibration(path).items()
            }
        )
    return read_lenses(path, image_size_wh)

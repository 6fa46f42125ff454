"""Camera names: which camera does a file's name, or a name that a user typed, belong to?

In the simulated half of the DPJAIT dataset the calibration says `cam1` and the files are `cam1i_s.avi`; sequences that
psotrack simulated until version 0.1.0 say `cam1i` in the calibration. In the real half files and calibration bear the
serial number of the camera's body, with or without `cam_` before the number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from psotrack.errors import InputError

#: Fewer digits in a row are the number of a camera, not the serial number of its body.
_SERIAL_DIGITS = 6


def camera_key(name: str) -> str:
    """The part of a name that two spellings of one camera share.

    >>> camera_key("cam1i_s"), camera_key("cam_60881257")
    ('cam1i', '60881257')
    """
    key = name.lower().removesuffix("_s")
    digits = "".join(character for character in key if character.isdigit())
    return digits if len(digits) >= _SERIAL_DIGITS else key


def camera_of(name: str, cameras: Sequence[str]) -> str | None:
    """The camera to which a file of this name belongs; None where there is no such camera.

    A file belongs to the camera whose name the file's name begins with, where no digit follows: `cam1i_s` belongs to
    `cam1` and not to `cam10`. Of several such cameras the one with the longest name is meant.

    Args:
        name: name of the file, without its suffix.
        cameras: names of the cameras in the calibration.
    """
    key = camera_key(name)
    keys = {camera: camera_key(camera) for camera in cameras}
    same = [camera for camera in cameras if keys[camera] == key]
    begun = [camera for camera in cameras if _continues(key, keys[camera])]
    return max(same or begun, key=lambda camera: len(keys[camera]), default=None)


def chosen_camera(name: str, cameras: Sequence[str]) -> str | None:
    """The camera that a user means by a name: as `camera_of`, and `cam1` also means a camera called `cam1i`.

    None where no camera fits, or where several cameras fit equally well.
    """
    if name in cameras:
        return name
    found = camera_of(name, cameras)
    if found is None:
        longer = [camera for camera in cameras if _continues(camera_key(camera), camera_key(name))]
        found = longer[0] if len(longer) == 1 else None
    return found


def files_by_camera(paths: Iterable[Path], cameras: Sequence[str]) -> dict[str, Path]:
    """The file of each camera, in the order of `cameras`; a camera without a file is absent.

    A file that has exactly the camera's name comes before files whose names only begin with the camera's name.

    Raises:
        InputError: two files fit one camera equally well.
    """
    found: dict[str, Path] = {}
    for path in sorted(paths):
        camera = camera_of(path.stem, cameras)
        if camera is None:
            continue
        if camera in found and _exact(found[camera], camera) == _exact(path, camera):
            raise InputError(path, expected="one such file per camera", found=f"{found[camera].name} as well")
        if camera not in found or _exact(path, camera):
            found[camera] = path
    return {camera: found[camera] for camera in cameras if camera in found}


def _exact(path: Path, camera: str) -> bool:
    return camera_key(path.stem) == camera_key(camera)


def _continues(longer: str, shorter: str) -> bool:
    """Whether `longer` begins with `shorter` and goes on with no digit."""
    return bool(shorter) and longer.startswith(shorter) and not longer[len(shorter) :][:1].isdigit()

"""Camera names: which camera does a file's name, or a name that a user typed, belong to?

Names are compared without regard to case, spaces, underscores, dashes, dots, brackets and zeros before a number:
`GoPro 3`, `gopro3_clip` and `gopro[3]` are of one camera. Numbers are compared as a whole: `cam1` is not `cam10`, and
`cam1_0` is not `cam10`.

In the simulated half of the DPJAIT dataset the calibration says `cam1` and the files are `cam1i_s.avi`; sequences that
psotrack simulated until version 0.1.0 say `cam1i` in the calibration. In the real half files and calibration bear the
serial number of the camera's body, with or without `cam_` before the number.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

from psotrack.errors import InputError, SettingsError

#: Fewer digits in a row are the number of a camera, not the serial number of its body.
_SERIAL_DIGITS = 6


def camera_key(name: str) -> str:
    """The part of a name that all spellings of one camera share.

    >>> camera_key("cam1i_s"), camera_key("cam_60881257"), camera_key("GoPro 03")
    ('cam1i', '60881257', 'gopro3')
    """
    folded = name.casefold().removesuffix("_s")
    numbers = re.findall(r"\d+", folded)
    if len(numbers) == 1 and len(numbers[0]) >= _SERIAL_DIGITS:
        folded = numbers[0]
    # A separator counts between two numbers only.
    return re.sub(r"(?<!\d)-|-(?!\d)", "", _words(folded))


def camera_of(name: str, cameras: Sequence[str]) -> str | None:
    """The camera to which a file of this name belongs; None where there is no such camera, or no single one.

    Args:
        name: name of the file, without its suffix.
        cameras: names of the cameras in the calibration.
    """
    found = cameras_of(name, cameras)
    return found[0] if len(found) == 1 else None


def cameras_of(name: str, cameras: Sequence[str]) -> list[str]:
    """The cameras to which a file of this name may belong, the best ones only.

    A file belongs to the camera with the same name; else to the camera whose name the file's name begins with; else to
    the camera whose name it contains. No digit may follow: `cam1i_s` belongs to `cam1` and not to `cam10`. Of several
    such cameras the one with the longest name is meant. Two cameras remain where a name contains both equally well.
    """
    ranked = {camera: _rank(name, camera) for camera in cameras}
    fitting = {camera: rank for camera, rank in ranked.items() if rank is not None}
    best = min(fitting.values(), default=None)
    return [camera for camera, rank in fitting.items() if rank == best]


def chosen_camera(name: str, cameras: Sequence[str]) -> str | None:
    """The camera that a user means by a name: as `camera_of`, and `cam1` also means a camera called `cam1i`.

    None where no camera fits, or where several cameras fit equally well.
    """
    if name in cameras:
        return name
    found = [camera for camera in cameras_of(name, cameras) if (_rank(name, camera) or (9,))[0] <= _BEGINS]
    longer = [camera for camera in cameras if _rank(camera, name) is not None]
    fitting = found or longer
    return fitting[0] if len(fitting) == 1 else None


def chosen_cameras(names: Sequence[str], cameras: Sequence[str]) -> tuple[str, ...]:
    """The cameras that a user means by several names, in the order of `names`.

    Raises:
        SettingsError: a name fits no camera, a camera is named twice, or no name is given.
    """
    found = {name: chosen_camera(name, cameras) for name in names}
    unknown = [name for name in names if found[name] is None]
    expected = f"some of {', '.join(cameras)}"
    if unknown or not names:
        shown = ", ".join(name if name.strip() else repr(name) for name in unknown)
        raise SettingsError("cameras", expected=expected, found=shown or "none")
    kept = [camera for camera in (found[name] for name in names) if camera is not None]
    if len(set(kept)) < len(kept):
        twice = ", ".join(name for name in names if kept.count(found[name] or "") > 1)
        raise SettingsError("cameras", expected=f"{expected}, each once", found=twice)
    return tuple(kept)


def files_by_camera(paths: Iterable[Path], cameras: Sequence[str]) -> dict[str, Path]:
    """The file of each camera, in the order of `cameras`; a camera without a file is absent.

    A file that has exactly the camera's name comes before files whose names begin with the camera's name, and these
    before files whose names contain it.

    Raises:
        InputError: two files fit one camera equally well.
    """
    found: dict[str, Path] = {}
    for path in sorted(paths):
        camera = camera_of(path.stem, cameras)
        if camera is None:
            continue
        before = found.get(camera)
        ranks = [(_rank(one.stem, camera) or (9,))[0] for one in (path, before or path)]
        if before is not None and ranks[0] == ranks[1]:
            raise InputError(path, expected="one such file per camera", found=f"{before.name} as well")
        if before is None or ranks[0] < ranks[1]:
            found[camera] = path
    return {camera: found[camera] for camera in cameras if camera in found}


#: How well a file's name fits a camera's: the same name; the camera's name, then another word; the camera's name
#: between other words; the camera's name, then more letters of the same word.
_SAME, _BEGINS, _CONTAINS, _LONGER_WORD = range(4)


def _words(name: str) -> str:
    """A name in lower case, with a dash for each separator, and without zeros before numbers."""
    # Some systems store an accented letter as a letter and an accent.
    folded = unicodedata.normalize("NFC", name).casefold()
    parted = re.sub(r"[\s_.\-()\[\]]+", "-", folded).strip("-")
    return re.sub(r"\d+", lambda number: number[0].lstrip("0") or "0", parted)


def _rank(name: str, camera: str) -> tuple[int, int] | None:
    """How well a file's name fits a camera's, and minus the length of the latter; smaller is better, None is not."""
    key, text = camera_key(camera), _words(name)
    if not key:
        return None
    if key == camera_key(name):
        return _SAME, -len(key)
    pattern = re.escape(key[0])
    for before, after in pairwise(key):
        # A separator between two digits makes two numbers of them.
        between = "" if f"{before}{after}".isdecimal() or "-" in (before, after) else "-?"
        pattern += f"{between}{re.escape(after)}"
    # The name is whole words of the text. A word ends before and after a number, but `cam` is not `cam1`.
    begin = r"(?<!\d)" if key[0].isdecimal() else r"(?<![^\d-])"
    end = r"(?!\d)" if key[-1].isdecimal() else r"(?![^-])"
    if re.match(f"{pattern}{end}", text):
        return _BEGINS, -len(key)
    if re.search(f"{begin}{pattern}{end}", text):
        return _CONTAINS, -len(key)
    return (_LONGER_WORD, -len(key)) if re.match(rf"{pattern}(?!\d)", text) else None

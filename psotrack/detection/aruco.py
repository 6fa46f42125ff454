"""OpenCV's ArUco dictionaries by their names."""

from __future__ import annotations

import cv2

from psotrack.errors import SettingsError


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's ArUco dictionary with a name such as 4x4_50 or DICT_4X4_50.

    Raises:
        SettingsError: OpenCV has no dictionary with this name.
    """
    known = {key.lower(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    key = known.get(f"dict_{name.lower().removeprefix('dict_')}")
    if key is None:
        names = ", ".join(name.removeprefix("dict_") for name in known)
        raise SettingsError("dictionary", expected=f"one of {names}", found=name)
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, key))

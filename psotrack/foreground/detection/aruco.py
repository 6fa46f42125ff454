"""OpenCV's ArUco dictionaries by their names."""

from __future__ import annotations

import cv2

from psotrack.errors import SettingsError


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's ArUco dictionary with a name such as 4x4_50 or DICT_4X4_50.

    Raises:
        SettingsError: OpenCV has no dictionary with this name.
    """
    known = {key[5:].lower(): number for key, number in vars(cv2.aruco).items() if key.startswith("DICT_")}
    short = name.lower().removeprefix("dict_")
    if short not in known:
        raise SettingsError("dictionary", expected=f"one of {', '.join(sorted(known))}", found=name)
    return cv2.aruco.getPredefinedDictionary(known[short])

from .camera_clocks import camera_offsets
from .synchronisation import Offset, find_offset, own_reference, save_curve, shifted

__all__ = [
    "Offset",
    "camera_offsets",
    "find_offset",
    "own_reference",
    "save_curve",
    "shifted",
]

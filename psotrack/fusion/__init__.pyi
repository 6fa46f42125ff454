from .errors import fused_errors
from .fusion import Fusion, fuse_tracks

__all__ = [
    "Fusion",
    "fuse_tracks",
    "fused_errors",
]

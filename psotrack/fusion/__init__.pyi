from .fusion import COMMON_CORRELATION, Fusion, fuse_tracks

__all__ = [
    "COMMON_CORRELATION",
    "Fusion",
    "fuse_tracks",
]

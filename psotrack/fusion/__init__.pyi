from .fusion import fuse_tracks

__all__ = [
    "fuse_tracks",
]

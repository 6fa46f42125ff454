from .fusion import Fusion, fuse_tracks, fused_errors

__all__ = [
    "Fusion",
    "fuse_tracks",
    "fused_errors",
]

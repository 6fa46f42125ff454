from .blobs import LEAST_RADIUS_CELLS, ViewBlobs, find_blobs, stack_blobs
from .computation import Silhouettes, compute
from .foreground import BackgroundModel, Mog2, find_background
from .settings import ForegroundSettings, Shadows, SilhouetteSettings, check_whole
from .store import key_of, open_stored, reduced_shape
from .summed_area import box_sum, of_packed_box_sums, pack, summed_area_table

__all__ = [
    "LEAST_RADIUS_CELLS",
    "BackgroundModel",
    "ForegroundSettings",
    "Mog2",
    "Shadows",
    "SilhouetteSettings",
    "Silhouettes",
    "ViewBlobs",
    "box_sum",
    "check_whole",
    "compute",
    "find_background",
    "find_blobs",
    "key_of",
    "of_packed_box_sums",
    "open_stored",
    "pack",
    "reduced_shape",
    "stack_blobs",
    "summed_area_table",
]

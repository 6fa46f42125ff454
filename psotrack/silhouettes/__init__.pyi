from .blobs import LEAST_RADIUS_CELLS, ViewBlobs, border_cells, find_blobs, stack_blobs
from .computation import Silhouettes, compute, exposures_of
from .exposures import Exposures, moved_by
from .foreground import BackgroundModel, Mog2, find_background
from .settings import ForegroundSettings, Shadows, SilhouetteSettings, check_whole
from .store import key_of, open_stored, reduced_shape
from .summed_area import box_sum, of_packed_box_sums, pack, summed_area_table

__all__ = [
    "LEAST_RADIUS_CELLS",
    "BackgroundModel",
    "Exposures",
    "ForegroundSettings",
    "Mog2",
    "Shadows",
    "SilhouetteSettings",
    "Silhouettes",
    "ViewBlobs",
    "border_cells",
    "box_sum",
    "check_whole",
    "compute",
    "exposures_of",
    "find_background",
    "find_blobs",
    "key_of",
    "moved_by",
    "of_packed_box_sums",
    "open_stored",
    "pack",
    "reduced_shape",
    "stack_blobs",
    "summed_area_table",
]

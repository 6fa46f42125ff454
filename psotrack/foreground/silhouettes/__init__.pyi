from .blobs import blob_detections, border_cells, find_blobs
from .cache import CacheEntry, choose_to_prune, list_entries, remove_entry
from .computation import (
    compute,
    find_background,
    num_processes,
    scaled_settings,
    stored_silhouettes,
    usual_drone_px,
)
from .exposures import Exposures, moved_by
from .first_look import look_first
from .foreground import BackgroundModel, Mog2, coverage, learned_mog2, learning_step, reduce_frame
from .frames import Silhouettes, exposures_of
from .living_background import Living, LivingBackground
from .masks import masks_out, write_masks
from .repeated_frames import FrameChanges, repeated_frames
from .settings import ForegroundSettings, Shadows, SilhouetteSettings, check_whole
from .store import SEAL_FILE, Task, ignored_pixels, is_whole, reduced_shape
from .summed_area import LOW_BITS, box_sum, pack, packed_box_sums, summed_area_table
from .usable_frames import foreground_is_everywhere

__all__ = [
    "LOW_BITS",
    "SEAL_FILE",
    "BackgroundModel",
    "CacheEntry",
    "Exposures",
    "ForegroundSettings",
    "FrameChanges",
    "Living",
    "LivingBackground",
    "Mog2",
    "Shadows",
    "SilhouetteSettings",
    "Silhouettes",
    "Task",
    "blob_detections",
    "border_cells",
    "box_sum",
    "check_whole",
    "choose_to_prune",
    "compute",
    "coverage",
    "exposures_of",
    "find_background",
    "find_blobs",
    "foreground_is_everywhere",
    "ignored_pixels",
    "is_whole",
    "learned_mog2",
    "learning_step",
    "list_entries",
    "look_first",
    "masks_out",
    "moved_by",
    "num_processes",
    "pack",
    "packed_box_sums",
    "reduce_frame",
    "reduced_shape",
    "remove_entry",
    "repeated_frames",
    "scaled_settings",
    "stored_silhouettes",
    "summed_area_table",
    "usual_drone_px",
    "write_masks",
]

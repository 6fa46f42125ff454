from .background_models import find_background
from .blob_boxes import blob_detections
from .blobs import border_cells, find_blobs
from .cache import CacheEntry, choose_to_prune, is_damaged, list_entries, remove_entry
from .computation import (
    Silhouettes,
    compute,
    exposures_of,
    scaled_settings,
    silhouette_keys,
    stored_silhouettes,
    tasks_of,
    usual_drone_px,
)
from .exposures import Exposures, moved_by
from .foreground import BackgroundModel, Mog2, coverage, learning_step, reduce_frame
from .living_background import Living, LivingBackground
from .masks import MaskTask, masks_out, write_masks
from .seals import SEAL_FILE, is_whole, removable
from .settings import ForegroundSettings, ScaledSettings, Shadows, SilhouetteSettings, check_whole
from .store import Task, frames_to_decode, ignored_pixels, key_of, made_of, open_stored, reduced_shape
from .summed_area import box_sum, pack, packed_box_sums, summed_area_table
from .usable_frames import foreground_is_everywhere

__all__ = [
    "SEAL_FILE",
    "BackgroundModel",
    "CacheEntry",
    "Exposures",
    "ForegroundSettings",
    "Living",
    "LivingBackground",
    "MaskTask",
    "Mog2",
    "ScaledSettings",
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
    "frames_to_decode",
    "ignored_pixels",
    "is_damaged",
    "is_whole",
    "key_of",
    "learning_step",
    "list_entries",
    "made_of",
    "masks_out",
    "moved_by",
    "open_stored",
    "pack",
    "packed_box_sums",
    "reduce_frame",
    "reduced_shape",
    "removable",
    "remove_entry",
    "scaled_settings",
    "silhouette_keys",
    "stored_silhouettes",
    "summed_area_table",
    "tasks_of",
    "usual_drone_px",
    "write_masks",
]

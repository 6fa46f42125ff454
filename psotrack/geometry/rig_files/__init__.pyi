from .fields import UNITS_M, CameraFields, Entry, camera_values
from .formats import (
    RIG_FORMATS,
    WRITTEN_RIG_FORMATS,
    entries_of,
    read_cameras,
    read_lenses,
    read_rig,
    rescale_lenses,
    write_rig,
)
from .text_files import write_calibration
from .toml_files import KEYS, fields_of_table

__all__ = [
    "KEYS",
    "RIG_FORMATS",
    "UNITS_M",
    "WRITTEN_RIG_FORMATS",
    "CameraFields",
    "Entry",
    "camera_values",
    "entries_of",
    "fields_of_table",
    "read_cameras",
    "read_lenses",
    "read_rig",
    "rescale_lenses",
    "write_calibration",
    "write_rig",
]

from .dpjait_calibration import METRES_PER_UNIT, read_calibration, read_camera_names, write_calibration
from .entries import UNITS_M, Entry
from .fields import lens_model
from .formats import (
    RIG_FORMATS,
    WRITTEN_RIG_FORMATS,
    read_entries,
    read_lenses,
    read_rig,
    write_lenses,
    write_rig,
)
from .rig_toml import camera_of_table

__all__ = [
    "METRES_PER_UNIT",
    "RIG_FORMATS",
    "UNITS_M",
    "WRITTEN_RIG_FORMATS",
    "Entry",
    "camera_of_table",
    "lens_model",
    "read_calibration",
    "read_camera_names",
    "read_entries",
    "read_lenses",
    "read_rig",
    "write_calibration",
    "write_lenses",
    "write_rig",
]

from .any_report import WrittenPage, write_report
from .calibration_report import is_calibration_record, write_calibration_report
from .flight_report import write_flight_report
from .page import MOST_BYTES, write_page
from .scene import MOST_ROWS, PointCloud, Scene3D, scene_of_flight, view_3d
from .sweep_report import write_sweep_report

__all__ = [
    "MOST_BYTES",
    "MOST_ROWS",
    "PointCloud",
    "Scene3D",
    "WrittenPage",
    "is_calibration_record",
    "scene_of_flight",
    "view_3d",
    "write_calibration_report",
    "write_flight_report",
    "write_page",
    "write_report",
    "write_sweep_report",
]

from .calibration_report import is_calibration_record, write_calibration_report
from .flight_report import write_flight_report
from .notebook_view import view_3d
from .scene import PointCloud, Scene3D, SceneDrones, scene_of_flight, scene_of_tracks
from .sweep_report import write_sweep_report

__all__ = [
    "PointCloud",
    "Scene3D",
    "SceneDrones",
    "is_calibration_record",
    "scene_of_flight",
    "scene_of_tracks",
    "view_3d",
    "write_calibration_report",
    "write_flight_report",
    "write_sweep_report",
]

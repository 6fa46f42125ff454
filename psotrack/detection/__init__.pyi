from .aruco import marker_dictionary
from .detector import DetectorSettings, OnnxDetector, detect
from .labels import LabelSettings
from .store import stored_detections
from .training_data import DATA_SET, write_data_set

__all__ = [
    "DATA_SET",
    "DetectorSettings",
    "LabelSettings",
    "OnnxDetector",
    "detect",
    "marker_dictionary",
    "stored_detections",
    "write_data_set",
]

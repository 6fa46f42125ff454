from .aruco import marker_dictionary
from .detector import Detector, DetectorSettings, OnnxDetector, detect_drones, find_detector
from .labels import LabelSettings
from .store import stored_detections
from .training_data import DATA_SET, FrameSelection, write_data_set

__all__ = [
    "DATA_SET",
    "Detector",
    "DetectorSettings",
    "FrameSelection",
    "LabelSettings",
    "OnnxDetector",
    "detect_drones",
    "find_detector",
    "marker_dictionary",
    "stored_detections",
    "write_data_set",
]

from .aruco import marker_dictionary
from .detector import Detector, DetectorSettings, OnnxDetector, detect_drones, find_detector
from .labels import LabelSettings, box_corners, label_boxes
from .store import stored_detections
from .training_data import DATA_SET, write_data_set

__all__ = [
    "DATA_SET",
    "Detector",
    "DetectorSettings",
    "LabelSettings",
    "OnnxDetector",
    "box_corners",
    "detect_drones",
    "find_detector",
    "label_boxes",
    "marker_dictionary",
    "stored_detections",
    "write_data_set",
]

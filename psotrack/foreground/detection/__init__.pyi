from .detector import (
    Detector,
    OnnxDetector,
    detect_drones,
    find_detector,
    stored_detections,
)
from .settings import DetectorSettings, LabelSettings, Layout
from .training_data import DATA_SET, box_corners, label_boxes, parts_of, write_data_set

__all__ = [
    "DATA_SET",
    "Detector",
    "DetectorSettings",
    "LabelSettings",
    "Layout",
    "OnnxDetector",
    "box_corners",
    "detect_drones",
    "find_detector",
    "label_boxes",
    "parts_of",
    "stored_detections",
    "write_data_set",
]

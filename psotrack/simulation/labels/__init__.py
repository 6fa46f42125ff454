"""Labels of the frames: masks and detections."""

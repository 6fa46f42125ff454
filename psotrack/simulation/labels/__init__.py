"""Labels of the simulated videos: masks, detections and mocap markers."""

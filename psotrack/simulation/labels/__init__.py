"""What comes with the videos: masks, detections, markers."""

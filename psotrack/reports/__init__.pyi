from .scene import PointCloud, Scene3D, SceneDrones, scene_of_flight, scene_of_tracks

__all__ = [
    "PointCloud",
    "Scene3D",
    "SceneDrones",
    "scene_of_flight",
    "scene_of_tracks",
]

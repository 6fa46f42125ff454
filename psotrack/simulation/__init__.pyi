from .flights.piloting import flight_space
from .flights.recordings import write_recorded_flight
from .generate import SimulationSettings, simulate
from .imaging.renderer import CameraRenderer
from .listing import catalogue, render
from .own_cameras import OWN_CAMERAS, simulate_own_cameras
from .preview import save_preview
from .scenarios import RESTLESS, Scenario, change_scenario, load, preset_names, preset_text, scenario
from .scene import Scene, build

__all__ = [
    "OWN_CAMERAS",
    "RESTLESS",
    "CameraRenderer",
    "Scenario",
    "Scene",
    "SimulationSettings",
    "build",
    "catalogue",
    "change_scenario",
    "flight_space",
    "load",
    "preset_names",
    "preset_text",
    "render",
    "save_preview",
    "scenario",
    "simulate",
    "simulate_own_cameras",
    "write_recorded_flight",
]

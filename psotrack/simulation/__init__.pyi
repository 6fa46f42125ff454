from .flights.piloting import flight_space
from .flights.recordings import write_recorded_flight
from .generate import simulate
from .imaging.renderer import CameraRenderer
from .listing import catalogue
from .own_cameras import OWN_CAMERAS, simulate_own_cameras
from .scenarios import (
    RESTLESS,
    Scenario,
    SimulationSettings,
    change_scenario,
    load,
    preset_names,
    preset_text,
    scenario,
)
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
    "scenario",
    "simulate",
    "simulate_own_cameras",
    "write_recorded_flight",
]

from .flights.motion import read_recorded_flight, write_recorded_flight
from .flights.piloting import flight_space, read_sticks
from .generate import simulate
from .imaging.renderer import CameraRenderer
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
from .scene import Scene, build, catalogue

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
    "read_recorded_flight",
    "read_sticks",
    "scenario",
    "simulate",
    "simulate_own_cameras",
    "write_recorded_flight",
]

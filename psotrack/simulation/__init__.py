"""Simulated sequences: a scenario's name and a seed -> videos, calibration and truth on disk, as if recorded."""

from psotrack.simulation.generate import simulate
from psotrack.simulation.imaging.renderer import CameraRenderer
from psotrack.simulation.scenarios import Scenario, load, preset_names, preset_text, replaced, scenario
from psotrack.simulation.scene import Scene, build

__all__ = [
    "CameraRenderer",
    "Scenario",
    "Scene",
    "build",
    "load",
    "preset_names",
    "preset_text",
    "replaced",
    "scenario",
    "simulate",
]

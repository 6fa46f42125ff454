"""Simulated sequences: a scenario's name and a seed -> videos, calibration and truth on disk, as if recorded."""

from psotrack.simulation.generate import simulate
from psotrack.simulation.renderer import CameraRenderer
from psotrack.simulation.scenarios import SCENARIOS, Scenario, scenario
from psotrack.simulation.scene import Scene, build

__all__ = ["SCENARIOS", "CameraRenderer", "Scenario", "Scene", "build", "scenario", "simulate"]

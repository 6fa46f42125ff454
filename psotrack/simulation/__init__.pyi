from .flights.dynamics import space_in
from .flights.recordings import write_recording
from .generate import SimulationSettings, simulate
from .imaging.renderer import CameraRenderer
from .listing import catalogue, render
from .preview import save_preview
from .real_form import RealFormSettings, write_as_real
from .scenarios import Scenario, load, preset_names, preset_text, replaced, scenario
from .scene import Scene, build

__all__ = [
    "CameraRenderer",
    "RealFormSettings",
    "Scenario",
    "Scene",
    "SimulationSettings",
    "build",
    "catalogue",
    "load",
    "preset_names",
    "preset_text",
    "render",
    "replaced",
    "save_preview",
    "scenario",
    "simulate",
    "space_in",
    "write_as_real",
    "write_recording",
]

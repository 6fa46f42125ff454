from .cluster import Cluster, run_on_cluster
from .estimates import estimate
from .frames import sweep
from .grid_files import Cell, Grid, Perturbation, cameras_label, grid, key_of, load
from .inputs import Inputs
from .machine import Device, share_processors, use_device
from .perturbations import perturb
from .printing import render
from .runner import SweepOutcome, run
from .store import Store
from .tables import pivot

__all__ = [
    "Cell",
    "Cluster",
    "Device",
    "Grid",
    "Inputs",
    "Perturbation",
    "Store",
    "SweepOutcome",
    "cameras_label",
    "estimate",
    "grid",
    "key_of",
    "load",
    "perturb",
    "pivot",
    "render",
    "run",
    "run_on_cluster",
    "share_processors",
    "sweep",
    "use_device",
]

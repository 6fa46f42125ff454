from .cells import Cell, Perturbation, cameras_label, cell_key, delays_frames, perturb
from .grid_files import Grid, grid, read_grid
from .grid_runs import SweepOutcome, SweepPlan, plan, sweep
from .inputs import Inputs
from .runner import Cluster
from .store import Store
from .tables import pivot, render_table

__all__ = [
    "Cell",
    "Cluster",
    "Grid",
    "Inputs",
    "Perturbation",
    "Store",
    "SweepOutcome",
    "SweepPlan",
    "cameras_label",
    "cell_key",
    "delays_frames",
    "grid",
    "perturb",
    "pivot",
    "plan",
    "read_grid",
    "render_table",
    "sweep",
]

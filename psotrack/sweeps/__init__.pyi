from .cells import Cell, Perturbation, cameras_label, cell_key
from .cluster import Cluster
from .grid_files import Grid, grid, read_grid
from .grid_runs import Estimate, SweepOutcome, SweepPlan, estimate, plan, sweep
from .inputs import Inputs
from .perturbations import delays_frames, perturb
from .store import Store, is_results_folder
from .tables import pivot, render_table

__all__ = [
    "Cell",
    "Cluster",
    "Estimate",
    "Grid",
    "Inputs",
    "Perturbation",
    "Store",
    "SweepOutcome",
    "SweepPlan",
    "cameras_label",
    "cell_key",
    "delays_frames",
    "estimate",
    "grid",
    "is_results_folder",
    "perturb",
    "pivot",
    "plan",
    "read_grid",
    "render_table",
    "sweep",
]

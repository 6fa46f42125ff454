from .association import GATE_M, UNASSIGNED, fixed_partner_values
from .files import check_cells, read_trajectories, write_ambiguity, write_trajectories
from .resampling import resample
from .row_streams import RowStream
from .status import Status
from .summaries import DroneSummary, drones_html, summarise, summary_columns
from .tracks import ARRAYS, Arrival, Tracks, padded
from .trajectories import Trajectories

__all__ = [
    "ARRAYS",
    "GATE_M",
    "UNASSIGNED",
    "Arrival",
    "DroneSummary",
    "RowStream",
    "Status",
    "Tracks",
    "Trajectories",
    "check_cells",
    "drones_html",
    "fixed_partner_values",
    "padded",
    "read_trajectories",
    "resample",
    "summarise",
    "summary_columns",
    "write_ambiguity",
    "write_trajectories",
]

from .association import GATE_M, UNASSIGNED, fixed_partner_values
from .columns import drones_html, summary_columns
from .files import DroneRows, check_cells, from_rows, read_trajectories, write_ambiguity, write_trajectories
from .resampling import merged, resample, roll_pitch_yaw_deg, rotation_matrices
from .row_streams import RowStream
from .tracks import ARRAYS, Arrival, Status, Tracks, padded
from .trajectories import QUANTITIES, Trajectories, timed_path

__all__ = [
    "ARRAYS",
    "GATE_M",
    "QUANTITIES",
    "UNASSIGNED",
    "Arrival",
    "DroneRows",
    "RowStream",
    "Status",
    "Tracks",
    "Trajectories",
    "check_cells",
    "drones_html",
    "fixed_partner_values",
    "from_rows",
    "merged",
    "padded",
    "read_trajectories",
    "resample",
    "roll_pitch_yaw_deg",
    "rotation_matrices",
    "summary_columns",
    "timed_path",
    "write_ambiguity",
    "write_trajectories",
]

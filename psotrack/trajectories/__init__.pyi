from .association import GATE_M, UNASSIGNED, fixed_partner_values
from .files import read_trajectories, write_ambiguity, write_trajectories
from .trajectories import Status, Trajectories

__all__ = [
    "GATE_M",
    "UNASSIGNED",
    "Status",
    "Trajectories",
    "fixed_partner_values",
    "read_trajectories",
    "write_ambiguity",
    "write_trajectories",
]

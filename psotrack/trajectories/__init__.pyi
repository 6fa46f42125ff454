from .association import GATE_M, UNASSIGNED, of_partners
from .files import read_trajectories, write_ambiguity, write_trajectories
from .trajectories import Status, Trajectories

__all__ = [
    "GATE_M",
    "UNASSIGNED",
    "Status",
    "Trajectories",
    "of_partners",
    "read_trajectories",
    "write_ambiguity",
    "write_trajectories",
]

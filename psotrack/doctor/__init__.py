"""The doctor: a rig against its own data, before anybody tracks; what disagrees, by how much, and what to do."""

from psotrack.doctor.agreement import Agreement
from psotrack.doctor.examination import Diagnosis, examine, sampled_frames

__all__ = ["Agreement", "Diagnosis", "examine", "sampled_frames"]

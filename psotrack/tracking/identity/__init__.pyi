from .postprocessing import postprocess
from .records import Encounter, Identities, LabelOutcome, relabelled
from .resolving import resolve

__all__ = [
    "Encounter",
    "Identities",
    "LabelOutcome",
    "postprocess",
    "relabelled",
    "resolve",
]

from .encounters import Encounter, Identities, LabelOutcome, relabelled
from .postprocessing import postprocess
from .resolving import resolve

__all__ = [
    "Encounter",
    "Identities",
    "LabelOutcome",
    "postprocess",
    "relabelled",
    "resolve",
]

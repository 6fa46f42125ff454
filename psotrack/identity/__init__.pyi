from .postprocessing import postprocess
from .records import Encounter, Identities, IdentityParams, LabelOutcome, relabelled
from .resolving import resolve

__all__ = [
    "Encounter",
    "Identities",
    "IdentityParams",
    "LabelOutcome",
    "postprocess",
    "relabelled",
    "resolve",
]

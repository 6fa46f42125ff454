from .following import follow
from .results import start_of

__all__ = [
    "follow",
    "start_of",
]

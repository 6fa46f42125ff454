from .rauch_tung_striebel import backward_step

__all__ = [
    "backward_step",
]

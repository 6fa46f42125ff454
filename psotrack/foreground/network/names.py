"""How options name a network. Importing this module is fast: `--help` needs the names."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

#: How files of trained networks end (`psotrack train`).
MODEL_SUFFIX = ".model"
#: Name of the network that comes with the package; `make network` trains it.
NETWORK = "network"


def model_path(name: str) -> Path | None:
    """The file of a network that a background model's or a detector's name means; None where it means no network."""
    if name == NETWORK:
        return Path(str(resources.files(__package__).joinpath(f"drones{MODEL_SUFFIX}")))
    return Path(name) if Path(name).suffix == MODEL_SUFFIX else None

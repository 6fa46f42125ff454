"""The small recording of the tests of commands, which no test changes."""

from pathlib import Path

import pytest
import worlds


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sequences `flight` and `second`, and `tracks.csv` of the first."""
    return worlds.two_flights(tmp_path_factory)


@pytest.fixture(scope="session")
def flight(world: Path) -> Path:
    """A recording of two drones by three cameras."""
    return world / "flight"

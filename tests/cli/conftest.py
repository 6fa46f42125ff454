"""The small recording of the tests of commands, which no test changes, and a limit on memory."""

import resource
from collections.abc import Iterator
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


@pytest.fixture
def little_memory() -> Iterator[None]:
    """A wrong allocation is an error, not a machine that swaps; the limit is far above what the tests need."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)

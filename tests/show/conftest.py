"""The small flight that the tests of this folder show."""

import pytest
from worlds import two_flights

from psotrack.show.flights import read_flight


@pytest.fixture(scope="session")
def world(tmp_path_factory):
    """A folder with the sequence `flight` and the tracks `tracks.csv`, which no test changes."""
    return two_flights(tmp_path_factory)


@pytest.fixture
def flight(world):
    return read_flight([world / "tracks.csv"], world / "flight")

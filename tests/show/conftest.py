"""The small flight that the tests of this folder show."""

import pytest

from psotrack.show.flights import read_flight


@pytest.fixture
def flight(world):
    return read_flight([world / "tracks.csv"], world / "flight")

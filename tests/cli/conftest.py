"""A limit on the memory of tests of commands."""

import resource
from pathlib import Path

import pytest


@pytest.fixture
def little_memory():
    """A wrong allocation is an error, not a machine that swaps; the limit is far above what the tests need."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (2 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)

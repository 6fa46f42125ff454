"""An archive for tests that an old version wrote."""

from pathlib import Path

#: An archive of format version 1; tests/data/README.md says how it was made.
OLD = Path(__file__).parent / "data" / "version_1.psotrack"

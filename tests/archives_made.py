"""Archives for tests: one that an old version wrote, and small ones with whatever a test puts in."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

#: An archive of format version 1; tests/data/README.md says how it was made.
OLD = Path(__file__).parent / "data" / "version_1.psotrack"
#: Content of a small archive.
FILES = {"tracks.csv": b"frame,drone,x_m,y_m,z_m\n", "tracks.json": b"{}"}


def crafted(
    path: Path, entries: list[tuple[str | zipfile.ZipInfo, bytes]] | None = None, **manifest: Any
) -> Path:
    """Write an archive with some files, which is right but for what the arguments say."""
    entries = list(FILES.items()) if entries is None else entries
    names = [name if isinstance(name, str) else name.filename for name, _ in entries]
    described = {
        "format": "psotrack archive", "version": 1, "psotrack": "0.2.0", "sequence": "S", "tracks": "tracks.csv",
        "settings": {}, "files": names, **manifest,
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("psotrack.json", json.dumps(described))
        for name, content in entries:
            zipped.writestr(name, content)
    return path

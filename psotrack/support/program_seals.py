"""Digests of compiled programs: a changed program gives other numbers or ends the process, so none is run unchecked."""

from __future__ import annotations

import hashlib
from pathlib import Path

#: First bytes of a stored program; the digest of the rest follows, then the rest.
_MAGIC, _DIGEST_BYTES = b"psotrack program 1\n", 32


def seal_program(content: bytes) -> bytes:
    """What is stored of a program: its digest, then its bytes."""
    return _MAGIC + hashlib.sha256(content).digest() + content


def unseal_program(stored: bytes) -> bytes | None:
    """The bytes of a program; None where what was stored is damaged, or was not written by psotrack."""
    content = stored[len(_MAGIC) + _DIGEST_BYTES :]
    return content if stored == seal_program(content) else None


def is_whole_program(path: Path) -> bool:
    """Whether a file is a stored program of which no byte was changed."""
    try:
        return unseal_program(path.read_bytes()) is not None
    except OSError:
        return False

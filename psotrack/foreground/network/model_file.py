"""A trained network in a file: one line of JSON, which says what it is, and its numbers.

Reading such a file runs no code: the numbers are arrays in NumPy's format, as Equinox writes them.
"""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx

from psotrack.errors import InputError
from psotrack.foreground.network.network import Network, untrained
from psotrack.support import atomic_write

_KIND, _VERSION = "psotrack network", 1
_EXPECTED = f"a network of `psotrack train`, version {_VERSION}"


@dataclass(frozen=True)
class Model:
    """A trained network.

    Attributes:
        network: the network.
        card: on what it was trained, with which settings, and how it did; fit for JSON.
    """

    network: Network
    card: Mapping[str, Any]


def write_model(path: Path, model: Model) -> None:
    """Write a network to a file.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(
            to_bytes(model.network, {"kind": _KIND, "version": _VERSION, "card": model.card})
        )


def model_at(path: Path) -> Model:
    """The network of a file, which is read once.

    Raises:
        InputError: the file cannot be read, or is of another kind or version, or damaged.
    """
    return _read(path, path.stat().st_mtime_ns if path.exists() else 0)


@functools.lru_cache(maxsize=4)
def _read(path: Path, _modified_ns: int) -> Model:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(path, expected=_EXPECTED, found=(error.strerror or f"{error}").lower()) from error
    head = head_of(content)
    if head.get("kind") != _KIND:
        raise InputError(path, expected=_EXPECTED, found="another kind of file")
    if head.get("version") != _VERSION:
        remedy = "train it again with this version of psotrack"
        raise InputError(path, expected=_EXPECTED, found=f"version {head.get('version')}", remedy=remedy)
    try:
        network: Network = from_bytes(content, untrained())
    except (EOFError, OSError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(path, expected=_EXPECTED, found="a damaged file") from error
    return Model(network, head["card"])


def to_bytes(tree: Any, head: Mapping[str, Any]) -> bytes:
    """A tree of arrays behind a line of JSON."""
    stream = io.BytesIO()
    stream.write(json.dumps(head, sort_keys=True).encode() + b"\n")
    eqx.tree_serialise_leaves(stream, tree)
    return stream.getvalue()


def head_of(content: bytes) -> dict[str, Any]:
    """The line of JSON; empty where there is none."""
    try:
        head = json.loads(content[: content.index(b"\n")])
    except ValueError:
        return {}
    return head if isinstance(head, dict) else {}


def from_bytes(content: bytes, like: Any) -> Any:
    """The tree of arrays behind the line of JSON, of the same structure as another tree."""
    stream = io.BytesIO(content)
    stream.readline()
    return eqx.tree_deserialise_leaves(stream, like)

"""Plain data -> records, every fault named by its field: what msgspec finds, said as all our errors are.

msgspec's own sentence is for programmers ("Expected `float` > 0.0 - at `$.drones[0].flight.period_s`"); here it
becomes the place, what was expected there, what was found, and the nearest right name where a name is wrong.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from psotrack.errors import InputError, PsotrackError
from psotrack.support.files import read_text

#: A fault: its field, what was expected, what was found, what to do.
Raise = Callable[[str, str, str, str], PsotrackError]
Record = TypeVar("Record", bound=msgspec.Struct)

_SENTENCE = re.compile(r"(?P<fault>.*?)(?: - at `\$\.?(?P<path>.*)`)?", re.DOTALL)
_TOKEN = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "text",
    "array": "a list",
    "object": "a table",
}
#: What is quoted of a value that is wrong.
_QUOTED = 60


def convert(data: dict[str, Any], kind: type[Record], error: Raise) -> Record:
    """The record that the data describe.

    Args:
        data: as read from TOML.
        kind: of the record.
        error: makes the exception from field, expected, found and remedy.
    """
    for path, value in _numbers(data, ""):
        if not math.isfinite(value):
            raise error(path, "a finite number", f"{value}", "")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as fault:
        raise error(*_explained(str(fault), data, kind)) from None


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        InputError: the file cannot be read, or is no TOML; the message names the line.
    """
    try:
        return tomllib.loads(read_text(Path(path)))
    except ValueError as error:
        # A TOMLDecodeError, or an integer of thousands of digits.
        reason, _, place = str(error).removesuffix(")").partition(" (at ")
        where = f"{path}, {place.partition(',')[0]}" if place else path
        found = f"what is none ({reason[:1].lower()}{reason[1:]})"
        raise InputError(where, expected="TOML", found=found) from error


def assign(data: dict[str, Any], path: str, value: Any, error: Raise) -> None:
    """Put a value at a dotted path, such as `drones[0].model`, in place.

    A table that is not there yet begins empty. Whether its fields exist is for `convert` to find.

    Args:
        error: makes the exception where no value can be.
    """
    *outer, last = _tokens(path) or [path]
    missing = error(path, "a field of the scenario", "none", "")
    place: Any = data
    for token in outer:
        if not _fits(place, token):
            raise missing
        if isinstance(place, dict) and place.get(token) is None:
            place[token] = {}
        place = place[token]
    if not _fits(place, last):
        raise missing
    place[last] = value


def nearest(name: str, names: Iterable[str]) -> str:
    """The one of `names` that is most like `name`, or "" where none is; of dotted names the last parts may do."""

    def likeness(other: str) -> float:
        pairs = ((name, other), (name.rpartition(".")[2], other.rpartition(".")[2]))
        return max(difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)

    best = max(names, key=likeness, default="")
    # The limit of `difflib.get_close_matches`.
    return best if best and likeness(best) >= 0.6 else ""


def _fits(place: Any, token: str | int) -> bool:
    """Whether something can be put at the key, or replaced at the index."""
    if isinstance(place, list):
        return isinstance(token, int) and token < len(place)
    return isinstance(place, dict) and isinstance(token, str)


def _tokens(path: str) -> list[str | int]:
    return [int(index) if index else key for index, key in _TOKEN.findall(path)]


def _numbers(value: Any, path: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _numbers(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _numbers(inner, f"{path}[{index}]")
    elif isinstance(value, float):
        yield path, value


def _explained(sentence: str, data: Any, kind: type) -> tuple[str, str, str, str]:
    match = _SENTENCE.fullmatch(sentence)
    assert match
    fault, path = match["fault"], match["path"] or ""
    name = _on_one_line(next(iter(re.findall(r"`(.*)`", fault, re.DOTALL)), ""))
    if fault.startswith("Object contains unknown field"):
        names = [field.encode_name for field in _struct_at(data, kind, path).fields]
        return f"{path}.{name}" if path else name, *_one_of(names, name)
    if fault.startswith("Object missing required field"):
        return f"{path}.{name}" if path else name, "a value", "none", ""
    found = data
    for token in _tokens(path):
        found = found[token]
    if fault.startswith("Invalid value"):
        tags = [struct.tag for struct in _structs_at(data, kind, path.rpartition(".")[0])]
        return path, *_one_of([str(tag) for tag in tags], found)
    if fault.startswith("Invalid enum value"):
        literals = [one for one in _types_at(data, kind, path) if isinstance(one, inspect.LiteralType)]
        return path, *_one_of([str(value) for one in literals for value in one.values], str(found))
    return path, _in_words(fault), _quoted(found), ""


def _one_of(names: list[str], found: str) -> tuple[str, str, str]:
    near = nearest(found, names)
    return f"one of {', '.join(names)}", _on_one_line(found), f"did you mean {near}?" if near else ""


def _on_one_line(name: str) -> str:
    return name if name.isprintable() else _quoted(name)


def _in_words(fault: str) -> str:
    """`Expected `array` of length 3, got 2` -> `a list of length 3`."""
    words = fault.removeprefix("Expected ").partition(", got ")[0]
    if words == fault:
        # Such as an integer that is too long for a float.
        return "a value that fits"
    if "matching regex" in words:
        return "a name of letters, digits, dots, dashes and underscores, the first a letter or digit"
    words = re.sub(r" ?\| null", "", words).replace(" | ", "` or `")
    words = re.sub(r"`(\w+)`", lambda match: _WORDS.get(match[1], match[1]), words)
    words = re.sub(r"(\d)\.0\b", r"\1", words)
    for sign, word in ((">=", "of at least"), ("<=", "of at most"), (">", "above"), ("<", "below")):
        words = words.replace(f" {sign} ", f" {word} ")
    return words.replace("of length of", "of length")


def _quoted(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."


def _structs_at(data: Any, kind: type, path: str) -> list[inspect.StructType]:
    """The records that may stand at a path."""
    return [one for one in _types_at(data, kind, path) if isinstance(one, inspect.StructType)]


def _types_at(data: Any, kind: type, path: str) -> list[inspect.Type]:
    """The types of what may stand at a path."""
    types: list[inspect.Type] = [inspect.type_info(kind)]
    for token in _tokens(path):
        if isinstance(token, int):
            types = [_item(one, token) for one in types if isinstance(one, _LISTS)]
        else:
            fields = [field for struct in _matching(types, data) for field in struct.fields]
            types = [field.type for field in fields if field.encode_name == token]
        types = [
            inner for one in types for inner in (one.types if isinstance(one, inspect.UnionType) else (one,))
        ]
        data = data[token]
    return types


def _struct_at(data: Any, kind: type, path: str) -> inspect.StructType:
    """The record at a path, picked by its tag where several may stand there."""
    value = data
    for token in _tokens(path):
        value = value[token]
    return _matching(list(_structs_at(data, kind, path)), value)[0]


def _matching(types: list[Any], value: Any) -> list[inspect.StructType]:
    structs = [one for one in types if isinstance(one, inspect.StructType)]
    return [one for one in structs if one.tag is None or value.get(one.tag_field) == one.tag]


_LISTS = (inspect.TupleType, inspect.VarTupleType)


def _item(of: inspect.TupleType | inspect.VarTupleType, index: int) -> inspect.Type:
    return of.item_types[index] if isinstance(of, inspect.TupleType) else of.item_type

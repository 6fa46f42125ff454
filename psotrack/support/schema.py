"""Conversion of plain data (TOML) to msgspec records, with error messages for users.

msgspec's messages are for programmers ("Expected `float` > 0.0 - at `$.drones[0].flight.period_s`"). This module
converts them to the four parts of `PsotrackError`, and suggests the nearest correct name for a misspelt name.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from inspect import BoundArguments, Parameter, Signature
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from psotrack.errors import InputError, PsotrackError, SettingsError
from psotrack.support.files import atomic_write, read_text
from psotrack.support.numbers import MODERATE, is_moderate

Record = TypeVar("Record", bound=msgspec.Struct)

_MSGSPEC_MESSAGE = re.compile(r"(?P<fault>.*?)(?: - at `\$\.?(?P<path>.*)`)?", re.DOTALL)
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_TOKEN = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_TYPE_WORDS = {
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "text",
    "array": "a list",
    "object": "a table",
}
#: Longest part of a wrong value that a message quotes, characters.
_QUOTED = 60
#: Least similarity of a name that is suggested (`difflib`): a wrong letter in three.
_SIMILAR = 0.65


def convert(
    data: dict[str, Any], kind: type[Record], prefix: str = "", error: type[PsotrackError] = InputError
) -> Record:
    """Convert plain data to a record and check the data.

    Args:
        data: tables as read from TOML or JSON.
        kind: type of the record.
        prefix: what stands before the name of a wrong field in messages, such as the file.
        error: the exception for a wrong field.
    """
    for path, value in _floats(data, ""):
        if not is_moderate(value):
            expected = MODERATE if math.isfinite(value) else "a finite number"
            raise error(f"{prefix}{path}", expected=expected, found=f"{value}")
    try:
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as fault:
        path, expected, found, remedy = _translate(str(fault), data, kind)
        raise error(f"{prefix}{path}", expected=expected, found=found, remedy=remedy) from None


def check_types(record: msgspec.Struct, prefix: str = "") -> None:
    """Raise `SettingsError` for a field whose value has another type than the field's annotation.

    Args:
        record: a record that was made in Python, where msgspec checks no types.
        prefix: what stands before the names of fields in messages.
    """
    for field in msgspec.structs.fields(record):
        value = plain(getattr(record, field.name))
        try:
            msgspec.convert(value, field.type)
        except msgspec.ValidationError as fault:
            # Records check by themselves whether a text is one of several.
            if not str(fault).startswith("Invalid enum value"):
                expected = _expected_words(str(fault).partition(" - at ")[0])
                raise SettingsError(
                    f"{prefix}{field.name}", expected=expected, found=_quoted(value)
                ) from None


def plain(value: Any) -> Any:
    """Numbers and arrays of NumPy as numbers and lists of Python, paths as text, and other values as they are."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def read_toml(path: Path | str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Raises:
        InputError: the file cannot be read or is not valid TOML; the message names the line.
    """
    try:
        return tomllib.loads(read_text(path))
    except ValueError as error:
        # Either a TOMLDecodeError or an integer with thousands of digits.
        reason, _, place = str(error).removesuffix(")").partition(" (at ")
        where = f"{path}, {place.partition(',')[0]}" if place else path
        raise InputError(
            where, expected="valid TOML", found=f"an error ({reason[:1].lower()}{reason[1:]})"
        ) from error
    except RecursionError as error:
        raise InputError(path, expected="valid TOML", found="brackets in hundreds of brackets") from error


def read_json(path: Path | str, expected: str = "a JSON object", remedy: str = "") -> dict[str, Any]:
    """Read the object of a JSON file.

    Args:
        path: path of the file.
        expected: noun phrase for the content, for messages.
        remedy: what the user can do about another content, for messages.

    Raises:
        InputError: the file cannot be read, is not valid JSON, or has another value than an object.
    """
    try:
        content = json.loads(read_text(path))
    # A ValueError is also an integer with thousands of digits.
    except (ValueError, RecursionError) as error:
        found = (
            f"an error ({error})" if isinstance(error, ValueError) else "brackets in thousands of brackets"
        )
        raise InputError(path, expected=expected, found=found, remedy=remedy) from error
    if not isinstance(content, dict):
        raise InputError(
            path, expected=expected, found=f"JSON with a {type(content).__name__}", remedy=remedy
        )
    return content


def json_text(content: Any) -> str:
    """The content as JSON. JSON has no NaN: a missing number is null. Infinite numbers are an error of the caller."""
    return json.dumps(_with_null(content), indent=2, allow_nan=False)


def write_json(path: Path | str, content: Any) -> None:
    """Write a JSON file; see `json_text`.

    Raises:
        OutputError: the file cannot be written; an older one is unchanged.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json_text(content) + "\n", encoding="utf-8")


def toml_key(name: str) -> str:
    """A name as key of a TOML file, in quotes where it needs them."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A text, a number or a list as value of a TOML file; numbers have all their digits."""
    # Texts and lists in JSON are valid TOML, except for the control character DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_text(tables: Mapping[tuple[str, ...], Mapping[str, Any]]) -> str:
    """Text of a TOML file.

    Args:
        tables: values by key, by the place of their table such as `("cameras", "left")`; `()` is the top of the file.
    """
    blocks = []
    for place, values in tables.items():
        lines = [f"[{'.'.join(map(toml_key, place))}]"] if place else []
        lines += [f"{toml_key(key)} = {toml_value(value)}" for key, value in values.items()]
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def write_toml(path: Path | str, tables: Mapping[tuple[str, ...], Mapping[str, Any]]) -> None:
    """Write a TOML file; see `toml_text`.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(toml_text(tables), encoding="utf-8")


def assign(data: dict[str, Any], path: str, value: Any) -> None:
    """Set the value at a dotted path in nested tables, in place.

    Tables that do not exist yet are created. The names of the fields are not checked here, but by `convert`.

    Args:
        data: nested tables.
        path: dotted path, such as `drones[0].model`.
        value: new value.

    Raises:
        SettingsError: the path cannot exist, such as an index beyond the end of a list.
    """
    *outer, last = _tokens(path) or [path]
    missing = SettingsError(path, expected="a field of the scenario", found="none")
    container: Any = data
    for token in outer:
        if not _can_hold(container, token):
            raise missing
        if isinstance(container, dict) and container.get(token) is None:
            container[token] = {}
        container = container[token]
    if not _can_hold(container, last):
        raise missing
    container[last] = value


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """The question after the name in `names` that was probably meant, for messages; "" if there is none.

    That is the most similar name of about this length, compared as a whole or by its last part where names have dots;
    or the only one that begins with `name`.
    """
    last_parts = {other.rpartition(".")[2]: other for other in names}
    wholes = {other: other for other in last_parts.values()}
    last = name.rpartition(".")[2]
    for word, others in ((name, wholes), (last, last_parts)):
        # "median" is similar to "mean", but is another word and no slip.
        near = [other for other in others if abs(len(other) - len(word)) <= -(-len(word) // 4)]
        if close := difflib.get_close_matches(word, near, 1, _SIMILAR):
            return f"did you mean {others[close[0]]}?"
    begun = [other for part, other in last_parts.items() if len(last) > 2 and part.startswith(last)]
    return f"did you mean {begun[0]}?" if len(begun) == 1 else ""


def bind(name: str, signature: Signature, args: Sequence[Any], kwargs: dict[str, Any]) -> BoundArguments:
    """The arguments of a call by name.

    Raises:
        SettingsError: an argument is unknown, given twice, or missing.
    """
    try:
        return signature.bind(*args, **kwargs)
    except TypeError as error:
        variable = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
        parameters = [key for key, each in signature.parameters.items() if each.kind not in variable]
        unknown = next((each for each in kwargs if each not in parameters), None)
        raise SettingsError(
            name,
            expected=f"the arguments {', '.join(parameters)}" if parameters else "no arguments",
            found=f"{unknown}" if unknown else f"{error}",
            remedy=did_you_mean(unknown, parameters) if unknown else "",
        ) from None


def _with_null(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _with_null(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_with_null(value) for value in content]
    return None if isinstance(content, float) and math.isnan(content) else content


def _can_hold(container: Any, token: str | int) -> bool:
    """Whether the container has this index (list), or can have this key (dict)."""
    if isinstance(container, list):
        return isinstance(token, int) and token < len(container)
    return isinstance(container, dict) and isinstance(token, str)


def _tokens(path: str) -> list[str | int]:
    return [int(index) if index else key for index, key in _TOKEN.findall(path)]


def _floats(value: Any, path: str) -> Iterator[tuple[str, float]]:
    """Paths and values of all floats in nested data."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _floats(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            yield from _floats(inner, f"{path}[{index}]")
    elif isinstance(value, float):
        yield path, value


def _translate(message: str, data: Any, kind: type) -> tuple[str, str, str, str]:
    """Field, expected, found and remedy from msgspec's message."""
    match = _MSGSPEC_MESSAGE.fullmatch(message)
    assert match
    fault, path = match["fault"], match["path"] or ""
    name = _on_one_line(next(iter(re.findall(r"`(.*)`", fault, re.DOTALL)), ""))
    if fault.startswith("Object missing required field"):
        return f"{path}.{name}" if path else name, "a value", "none", ""
    found = data
    for token in _tokens(path):
        if not _can_hold(found, token) or (isinstance(found, dict) and token not in found):
            # msgspec does not say which key of a mapping is meant.
            words = _words_of(fault.partition(", got ")[2])
            return path, _expected_words(fault), words or "another value", ""
        found = found[token]
    if fault.startswith("Object contains unknown field"):
        structs = _structs_with_tag_of(found, _types_at(data, kind, path))
        names = [field.encode_name for field in structs[0].fields]
        return f"{path}.{name}" if path else name, *_suggestion(names, name)
    if fault.startswith("Invalid value"):
        structs = _structs(_types_at(data, kind, path.rpartition(".")[0]))
        return path, *_suggestion([str(struct.tag) for struct in structs], found)
    if fault.startswith("Invalid enum value"):
        types = _types_at(data, kind, path)
        values = [value for each in types if isinstance(each, inspect.LiteralType) for value in each.values]
        return path, *_suggestion([str(value) for value in values], str(found))
    return path, _expected_words(fault), _quoted(found), ""


def _suggestion(names: list[str], found: str) -> tuple[str, str, str]:
    """Expected, found and remedy for a name that is not in `names`."""
    return f"one of {', '.join(names)}", _on_one_line(found), did_you_mean(found, names)


def _on_one_line(name: str) -> str:
    return name if name.isprintable() else _quoted(name)


def _words_of(types: str) -> str:
    """Words for users instead of msgspec's names of types."""
    return re.sub(r"`(\w+)`", lambda match: _TYPE_WORDS.get(match[1], match[1]), types)


def _expected_words(fault: str) -> str:
    """Words for users: `Expected `array` of length 3, got 2` -> `a list of length 3`."""
    words = fault.removeprefix("Expected ").partition(", got ")[0]
    if words == fault:
        # For example an integer with too many digits for a float.
        return "a value in the allowed range"
    if "matching regex" in words:
        return "a name of letters, digits, dots, dashes and underscores, the first a letter or digit"
    words = _words_of(re.sub(r" ?\| null", "", words).replace(" | ", "` or `"))
    words = re.sub(r"(\d)\.0\b", r"\1", words)
    for sign, word in ((">=", "of at least"), ("<=", "of at most"), (">", "above"), ("<", "below")):
        words = words.replace(f" {sign} ", f" {word} ")
    return words.replace("of length of", "of length")


def _quoted(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."


def _types_at(data: Any, kind: type, path: str) -> list[inspect.Type]:
    """Types that are allowed at a path."""
    types: list[inspect.Type] = [inspect.type_info(kind)]
    for token in _tokens(path):
        if isinstance(token, int):
            types = [
                each.item_types[token] if isinstance(each, inspect.TupleType) else each.item_type
                for each in types
                if isinstance(each, inspect.TupleType | inspect.VarTupleType)
            ]
        else:
            fields = [field for struct in _structs_with_tag_of(data, types) for field in struct.fields]
            types = [field.type for field in fields if field.encode_name == token]
        unions = [each.types if isinstance(each, inspect.UnionType) else (each,) for each in types]
        types = [each for union in unions for each in union]
        data = data[token]
    return types


def _structs(types: list[inspect.Type]) -> list[inspect.StructType]:
    return [each for each in types if isinstance(each, inspect.StructType)]


def _structs_with_tag_of(value: Any, types: list[inspect.Type]) -> list[inspect.StructType]:
    """Record types without a tag, or with the tag of the value."""
    return [each for each in _structs(types) if each.tag is None or value.get(each.tag_field) == each.tag]

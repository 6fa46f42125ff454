"""XML, and YAML of OpenCV, ROS and Kalibr, as plain data, read with guards against what no calibration has.

In XML, entities are refused, and texts that are too long. OpenCV's own reader of YAML is not used, because damaged
files can end the process. Scalars are read by the rules of YAML 1.2, except that 07 and other digits after a zero stay
text, as they are names. References between parts of a file are refused: a few lines of them can stand for any amount
of data.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from psotrack.errors import InputError
from psotrack.geometry.rig_files.fields import CameraFields, quoted

#: Longest text that is parsed, characters; a calibration of a hundred cameras has about a hundred thousand.
_LONGEST = 16 * 2**20
_INTEGER = re.compile(r"[-+]?(0|[1-9]\d{0,17})")
_FLOAT = re.compile(r"[-+]?(?!0\d)(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_WORDS = {
    "": None, "~": None, "null": None, "true": True, "false": False,
    ".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf,
}  # fmt: skip


def parse_xml(path: Path, text: str) -> ElementTree.Element:
    """The root element of an XML file.

    Raises:
        InputError: the file is too long, declares entities or a document type, or is not valid XML.
    """
    if len(text) > _LONGEST:
        raise InputError(path, expected="a calibration", found=f"{len(text):,} characters")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        expected = "XML without document type and entities"
        raise InputError(path, expected=expected, found="such a declaration")
    try:
        return ElementTree.fromstring(text.lstrip())
    except ElementTree.ParseError as error:
        where, reason = f"{path}, line {error.position[0]}", str(error).partition(":")[0]
    except ValueError as error:
        where, reason = f"{path}", str(error)
    raise InputError(where, expected="valid XML", found=f"an error ({reason})") from None


def attributes(path: Path, place: str, element: ElementTree.Element) -> CameraFields:
    """The attributes of an element, as lists of the numbers that they hold; other texts stay texts."""
    return CameraFields(path, place, {key: _numbers(text) for key, text in element.attrib.items()})


def number(fields: CameraFields, name: str) -> float:
    """A number of an attribute."""
    values = fields.values.get(name)
    if not isinstance(values, list) or len(values) != 1:
        raise fields.error(name, "a number", "none" if values is None else quoted(values))
    return float(fields.array((name,), (1,))[0])


def _numbers(text: str) -> list[float] | str:
    try:
        return [float(word) for word in text.split()] or text
    except ValueError:
        return text


def parse_yaml(path: Path, text: str) -> dict[str, Any]:
    """The top level of a YAML or JSON file; maps with rows, cols and data become arrays.

    Raises:
        InputError: the file is not valid; the message names the line.
    """
    text = text.lstrip("\ufeff \n\r\t")
    if text.startswith("%YAML"):
        # OpenCV's header is not one of YAML's.
        text = "\n" + text.partition("\n")[2]
    place = ""
    try:
        is_json = text.startswith("{")
        content = (
            json.loads(text, object_hook=as_matrix)
            if is_json
            else _plain(yaml.compose(text, yaml.SafeLoader), set())
        )
        return content if isinstance(content, dict) else {}
    except json.JSONDecodeError as error:
        place, reason = f", line {error.lineno}", error.msg
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error).splitlines()[0]
    except (RecursionError, ValueError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
    raise InputError(f"{path}{place}", expected="valid YAML or JSON", found=f"an error ({reason})") from None


def _plain(node: yaml.Node | None, seen: set[int]) -> Any:
    """Plain data of a node, whatever its tag, and OpenCV's matrices; a node that was seen before is a reference."""
    if node is None:
        return None
    if id(node) in seen:
        raise yaml.MarkedYAMLError(problem="a reference", problem_mark=node.start_mark)
    seen.add(id(node))
    if isinstance(node, yaml.ScalarNode):
        return node.value if node.style else _scalar(node.value)
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, seen) for item in node.value]
    return as_matrix({str(key.value): _plain(value, seen) for key, value in node.value})


def as_matrix(values: dict[str, Any]) -> Any:
    """An array for a map with rows, cols and data; its plain numbers if they do not fill it; else the map itself."""
    if not {"rows", "cols", "data"} <= values.keys():
        return values
    data = values["data"]
    try:
        return np.array(data, np.float64).reshape(int(values["rows"]), int(values["cols"]))
    except (TypeError, ValueError, OverflowError):
        return data


def _scalar(text: str) -> Any:
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INTEGER.fullmatch(text):
        return int(text)
    return float(text) if _FLOAT.fullmatch(text) else text

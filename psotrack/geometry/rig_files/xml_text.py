"""XML files, read with guards against entities and against sizes that no calibration has."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from psotrack.errors import InputError
from psotrack.geometry.rig_files.fields import CameraFields, quoted

#: Longest text that is parsed, characters; a calibration of a hundred cameras has about a hundred thousand.
_LONGEST = 16 * 2**20


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

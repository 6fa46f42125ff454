"""XML files, read with guards against entities and against sizes that no calibration has."""

from __future__ import annotations

from xml.etree import ElementTree

from psotrack.errors import InputError
from psotrack.geometry.rig_files.entries import Source
from psotrack.geometry.rig_files.fields import CameraFields, quoted

#: Longest text that is parsed, characters; a calibration of a hundred cameras has about a hundred thousand.
_LONGEST = 16 * 2**20


def parse_xml(source: Source) -> ElementTree.Element:
    """The root element of an XML file.

    Raises:
        InputError: the file is too long, declares entities or a document type, or is not valid XML.
    """
    if len(source.text) > _LONGEST:
        raise InputError(source.path, expected="a calibration", found=f"{len(source.text):,} characters")
    if "<!DOCTYPE" in source.text or "<!ENTITY" in source.text:
        raise InputError(
            source.path, expected="XML without document type and entities", found="such a declaration"
        )
    try:
        return ElementTree.fromstring(source.text.lstrip())
    except ElementTree.ParseError as error:
        line = error.position[0]
        reason = str(error).partition(":")[0]
        raise InputError(
            f"{source.path}, line {line}", expected="valid XML", found=f"an error ({reason})"
        ) from None
    except ValueError as error:
        raise InputError(source.path, expected="valid XML", found=f"an error ({error})") from None


def attributes(source: Source, place: str, element: ElementTree.Element) -> CameraFields:
    """The attributes of an element, as lists of the numbers that they hold; other texts stay texts."""
    return CameraFields(source.path, place, {key: _numbers(text) for key, text in element.attrib.items()})


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

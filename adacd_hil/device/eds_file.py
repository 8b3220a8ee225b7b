"""EDS files: their content checked, and read by canopen as an object dictionary. Source: CiA 306."""

import configparser
import functools
import io
import re
from pathlib import Path
from typing import Any

import canopen

from adacd_hil.device.canopen_bus import UNFORESEEN
from adacd_hil.file_access import read_input
from adacd_hil.settings.schema import ConfigError
from adacd_hil.wire.eds_text import readable_eds

_EDS_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x19\x1b-\x1f\x7f]")
"""All but tab, the ends of lines and the end of a file under DOS."""
_EDS_OBJECT = re.compile("[0-9A-Fa-f]{4}(?:[Ss]ub[0-9A-Fa-f]+)?")
_MAKERS_OBJECTS = range(0x2000, 0x6000)
"""Manufacturer objects: those that a profile names have a default or no value; the others' values don't matter."""
_EDS_INTEGERS = {
    form
    for number in canopen.objectdictionary.INTEGER_TYPES
    if number != canopen.objectdictionary.BOOLEAN
    for form in (str(number), f"0X{number:X}", f"0X{number:02X}", f"0X{number:04X}")
}
_EDS_NUMBERS = ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit")
_EDS_KINDS = ("ObjectType", "DataType", "PDOMapping")
_EDS_NUMBER = re.compile(r"(?i:\s*(?:\$NODEID\s*\+?)?\s*[-+]?\s*(?:0x[0-9a-f]+|[0-9]+)?\s*(?:\+?\s*\$NODEID)?\s*)")
"""CiA 306, 4.5.1: decimal, octal or hexadecimal, the node id before or after it."""


def read_eds(path: Path, node_id: int | None) -> Any:
    """Return canopen's object dictionary of an EDS file; `$NODEID` in it becomes `node_id`, see `parse_eds`.

    Raises ConfigError if it can't be read or parsed.
    """
    return parse_eds(eds_bytes(path), path, node_id)


def eds_bytes(path: Path) -> bytes:
    """Return the content of an EDS file. Raises ConfigError if it can't be read."""
    try:
        return read_input(path)
    except OSError as error:
        raise ConfigError(f"EDS {path}: {error.strerror}") from None


def parse_eds(data: bytes, path: Path, node_id: int | None) -> Any:
    """Return canopen's object dictionary of an EDS; `$NODEID` in it becomes `node_id`; None: the node id of a DCF.

    Values that canopen can't read as a number are dropped. The same data give the same object: don't change it. `path`:
    names the EDS in errors. Raises ConfigError for an EDS that can't be parsed, has control characters, or gives a
    standard integer object a value that is no number.
    """
    try:
        return _parse(data, node_id)
    except ConfigError as error:
        raise ConfigError(f"EDS {path}: {error}") from None
    except (*UNFORESEEN, configparser.Error, RecursionError) as error:
        raise ConfigError(f"EDS {path}: {' '.join(str(error).split()) or repr(error)}") from None


@functools.lru_cache(maxsize=32)
def _parse(data: bytes, node_id: int | None) -> Any:
    """Check an EDS; return canopen's object dictionary of it, the same one for the same arguments.

    Raises ConfigError for a control character, and as `_check_numbers`; errors of configparser and canopen pass.
    """
    text = data.decode("utf-8", "replace").removeprefix("\ufeff")
    if found := _EDS_CONTROL.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise ConfigError(f"line {line} has the control character 0x{ord(found[0]):02X}")
    text = readable_eds(text)
    _check_numbers(text)
    stream = io.StringIO(text)
    stream.name = "object dictionary.eds"
    return canopen.import_od(stream, node_id)


def _check_numbers(text: str) -> None:
    """Raise ConfigError for no object, and values or types of objects that are no numbers. text: as of `readable_eds`.

    The values are those of standard integer objects.
    """
    eds = configparser.RawConfigParser()
    eds.optionxform = str  # type: ignore[assignment,method-assign]
    eds.read_string(text)
    objects = [section for section in eds.sections() if _EDS_OBJECT.fullmatch(section)]
    if not objects:
        raise ConfigError("no object is in it")
    for section in objects:
        entries = eds[section]
        is_standard = int(section[:4], 16) not in _MAKERS_OBJECTS
        is_checked = is_standard and entries.get("DataType", "").strip().upper() in _EDS_INTEGERS
        for key in (*_EDS_KINDS, *(_EDS_NUMBERS if is_checked else ())):
            value = entries.get(key, "")
            if value and not _EDS_NUMBER.fullmatch(value):
                raise ConfigError(f"[{section}] {key} = {value[:40]!r} is no integer")

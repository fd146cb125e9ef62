"""A JSON object as a line of text with a checksum (CRC-32), so that a damaged line is noticed."""

from __future__ import annotations

import json
import zlib
from typing import Any

_CHECKSUM = "crc32"


def seal(record: dict[str, Any]) -> str:
    """The record as a line; its last key is the checksum of the JSON of all others."""
    return json.dumps({**record, _CHECKSUM: _checksum(record)}) + "\n"


def unseal(line: str) -> dict[str, Any]:
    """The record of a line.

    Raises:
        ValueError: the line is damaged.
    """
    try:
        record = json.loads(line)
        if record.pop(_CHECKSUM) == _checksum(record):
            return record
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError("it is no sealed line of JSON") from error
    raise ValueError("it does not fit its checksum")


def _checksum(record: dict[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(record).encode()):08x}"

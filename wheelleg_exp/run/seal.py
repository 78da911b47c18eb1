"""A document's digest of itself, so that a changed byte in it is noticed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.files import dump_json, json_plain

KEY = "sha256"
_UNSEALED = "0" * 64
_END = re.compile(rb'"sha256": "([0-9a-f]{64})"\n\}\n\Z')


def sealed_text(document: Mapping[str, Any], *, broken: bool = False) -> str:
    """Return the document as JSON whose last key, ``sha256``, is the digest of all bytes of the text.

    What is digested has 64 zeros in the digest's place. An earlier digest is replaced.

    Args:
        document: what is written.
        broken: write a digest that does not hold, because the document was changed by others before.
    """
    text = dump_json({**_content(document), KEY: _UNSEALED})
    digest = _UNSEALED if broken else hashlib.sha256(text.encode("utf-8")).hexdigest()
    head, _, tail = text.rpartition(_UNSEALED)
    return f"{head}{digest}{tail}"


def bytes_hold(data: bytes) -> bool:
    """Return whether these are, byte for byte, what ``sealed_text`` returned."""
    found = _END.search(data)
    if found is None:
        return False
    unsealed = data[: found.start(1)] + _UNSEALED.encode() + data[found.end(1) :]
    return hashlib.sha256(unsealed).hexdigest() == found.group(1).decode()


def values_hold(document: Mapping[str, Any]) -> bool | None:
    """Return whether a document holds the values that were digested, as format 1 did; None when it has no digest.

    Other bytes of the same value, such as the last digits of a number that rounds alike, go unseen.
    """
    if KEY not in document:
        return None
    text = json.dumps(json_plain(_content(document)), sort_keys=True, allow_nan=False)
    return document[KEY] == hashlib.sha256(text.encode()).hexdigest()


def _content(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key != KEY}

"""A document's digest of itself, so that a changed byte in it is noticed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.run.files import json_plain

KEY = "sha256"


def sealed(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the document with its digest as the last key, ``sha256``; an earlier one is replaced."""
    content = _content(document)
    return {**content, KEY: _digest(content)}


def seal_holds(document: Mapping[str, Any]) -> bool | None:
    """Return whether a document still is what it was sealed as; None when it has no seal."""
    return document[KEY] == _digest(_content(document)) if KEY in document else None


def _content(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key != KEY}


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(json_plain(content), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()

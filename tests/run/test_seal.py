from __future__ import annotations

import json
from typing import Any

import pytest

from wheelleg_exp.run.manifest import bytes_match_digest, text_with_digest, values_match_digest

DOCUMENT: dict[str, Any] = {"a": [1, 0.1, None, {"b": "ü"}], "c": {"x": True}}
# An old program wrote this manifest of format 1 with a digest of its values.
OF_VALUES: dict[str, Any] = {**DOCUMENT, "sha256": "1be7de195f5b192e19776cdec00626a6bc2cc5c73c1eba2d48160f1066d09ddd"}


def test_a_sealed_text_is_the_document_with_its_digest_at_the_end_and_can_be_sealed_as_broken():
    text = text_with_digest(DOCUMENT)
    assert bytes_match_digest(text.encode())
    assert (list(json.loads(text).items())[:-1], text_with_digest(json.loads(text))) == (list(DOCUMENT.items()), text)
    text = text_with_digest(DOCUMENT, broken=True)
    assert not bytes_match_digest(text.encode())
    assert {**json.loads(text), "sha256": None} == {**DOCUMENT, "sha256": None}


def test_every_changed_bit_breaks_it():
    data = text_with_digest(DOCUMENT).encode()
    for at in range(len(data)):
        for bit in range(8):
            assert not bytes_match_digest(data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]), (at, bit)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"0.1,", b"0.10000000000000001,"),
        (b'"c": {', b'"c":  {'),
        (b"\xc3\xbc", b"\\u00fc"),
        (b"\n}\n", b"\n}\n\n"),
    ],
)
def test_other_bytes_of_the_same_values_break_it(old, new):
    data = text_with_digest(DOCUMENT).encode()
    assert data.replace(old, new) != data
    assert not bytes_match_digest(data.replace(old, new))


@pytest.mark.parametrize(
    ("change", "matches"),
    [
        (lambda d: None, True),
        (lambda d: d.update(a=d.pop("a")), True),  # the order of keys
        (lambda d: d.pop("sha256"), None),
        (lambda d: d["a"].__setitem__(1, 0.2), False),
        (lambda d: d.pop("c"), False),
        (lambda d: d["c"].update(x=1), False),
        (lambda d: d.update(sha256="0" * 64), False),
    ],
)
def test_a_manifest_of_format_1_is_sealed_by_its_values(change, matches):
    document = json.loads(json.dumps(OF_VALUES))
    change(document)
    assert values_match_digest(document) is matches

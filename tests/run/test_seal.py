from __future__ import annotations

import json

import pytest

from wheelleg_exp.run.seal import seal_holds, sealed

DOCUMENT = {"a": [1, 2.5, None, {"b": "ü"}], "c": {"x": True}}


def test_a_sealed_document_holds_also_after_it_was_written_and_read():
    assert seal_holds(sealed(DOCUMENT)) is True
    assert seal_holds(json.loads(json.dumps(sealed(DOCUMENT)))) is True
    assert sealed(sealed(DOCUMENT)) == sealed(DOCUMENT)


def test_the_order_of_keys_does_not_count():
    assert seal_holds(dict(reversed(sealed(DOCUMENT).items()))) is True


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["a"].__setitem__(1, 2.6),
        lambda d: d.pop("c"),
        lambda d: d.update(more=None),
        lambda d: d["c"].update(x=1),
        lambda d: d.update(sha256="0" * 64),
    ],
)
def test_any_change_breaks_it(change):
    document = json.loads(json.dumps(sealed(DOCUMENT)))
    change(document)
    assert seal_holds(document) is False


def test_a_document_without_a_seal_says_nothing():
    assert seal_holds(DOCUMENT) is None

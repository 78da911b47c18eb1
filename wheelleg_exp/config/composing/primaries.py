"""Which primary config words are of; imports nothing, because a TAB must be quick."""

from __future__ import annotations

PIPELINE = "pipeline"  # the primary config of pipelines, and their key


def names_pipeline(word: str) -> bool:
    """Return whether an override, or a key, chooses or changes a pipeline, and not what its phases train."""
    return word.lstrip("+~").partition("=")[0].split(".")[0] == PIPELINE

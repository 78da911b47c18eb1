"""The texts inside a recording: what was run, from what source, by which command."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import dump_json, read_text
from wheelleg_exp.plain_yaml import dump_yaml
from wheelleg_exp.reading import json_value
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.inventory import MANIFEST_NAME
from wheelleg_exp.run.recorded import CONFIG

_LARGEST = 400_000  # characters of a text: a viewer is to show it


def fenced(text: str, language: str) -> str:
    """Return a text as a markdown block."""
    if len(text) > _LARGEST:
        text = f"{text[:_LARGEST]}\n… ({len(text)} characters in all)"
    return f"```{language}\n{text.rstrip()}\n```"


def run_documents(directory: RunDirectory) -> dict[str, str]:
    """Return the texts that a run directory tells of its training: manifest, source state, command line.

    A file that is missing or cannot be read has no text.
    """
    found = {}
    manifest = _text(directory, MANIFEST_NAME)
    if manifest is not None:
        found["manifest"] = fenced(manifest, "json")
        found |= command_document(_command(manifest))
    source = _text(directory, "source/git.json")
    if source is not None:
        found["git"] = fenced(source, "json")
    config = _text(directory, CONFIG)
    if config is not None:
        found["config"] = fenced(config, "yaml")
    return found


def command_document(command: Sequence[str]) -> dict[str, str]:
    """Return the command line as a text, none for an empty one."""
    return {"command": fenced(shlex.join(command), "sh")} if command else {}


def config_document(config: Mapping[str, Any]) -> dict[str, str]:
    """Return a composed config as a text."""
    return {"config": fenced(dump_yaml(dict(config)), "yaml")}


def json_document(name: str, value: Any) -> dict[str, str]:
    """Return a value as a text of JSON."""
    return {name: fenced(dump_json(value), "json")}


def _text(directory: RunDirectory, name: str) -> str | None:
    try:
        return read_text(directory.path / name)
    except RunDirectoryError:
        return None


def _command(manifest: str) -> list[str]:
    try:
        return [str(word) for word in json_value(manifest)["command"]]
    except (ValueError, LookupError, TypeError):
        return []

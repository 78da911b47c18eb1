"""The files of a project that do not depend on its robot: texts with ``{{name}}`` in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

_TEMPLATES = {
    "pyproject.toml": "pyproject.toml.txt",
    ".gitignore": "gitignore.txt",
    "README.md": "README.md.txt",
    "{{name}}/__init__.py": "init.py.txt",
    "{{name}}/terms.py": "terms.py.txt",
    "tests/test_{{name}}.py": "test.py.txt",
}
_SAID = {
    "action": "what a unit of action moves",
    "observation": "positions of the legs alone",
    "reward": "the weight of a reward of this project's own",
    "termination": "which links may not touch anything",
}


def project_files(name: str, asset: str, configs: Sequence[str]) -> dict[str, str]:
    """Return the texts, by path below the project.

    Args:
        name: the project's name.
        asset: the robot's file, relative to the project's assets.
        configs: the config files, relative to the project's configs.
    """
    rows = [f"| `configs/{file}` | {_SAID[group]} |" for file in configs if (group := file.split("/")[0]) in _SAID]
    words = {"name": name, "asset": asset, "terms": "\n".join(rows)}
    folder = resources.files("wheelleg_exp.project") / "templates"
    return {
        _filled(file, words): _filled((folder / template).read_text(encoding="utf-8"), words)
        for file, template in _TEMPLATES.items()
    }


def _filled(text: str, words: Mapping[str, str]) -> str:
    for key, value in words.items():
        text = text.replace("{{" + key + "}}", value)
    return text


def write(folder: Path, texts: Mapping[str, str]) -> None:
    """Write texts by path below a folder."""
    for file, text in texts.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")

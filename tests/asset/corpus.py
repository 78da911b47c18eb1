"""The corpus of real robots: a folder outside the repository with ``assets/``, ``expected/*.json``, and ``check.py``.

The option ``pytest --corpus DIR`` or the variable ``WHEELLEG_USD_CORPUS`` gives the path of the corpus. Without a
corpus, the tests that need the corpus are skipped.
"""

import importlib.util
import json
import os
from pathlib import Path
from types import ModuleType
from typing import Any

from wheelleg_exp.asset import Conversion, convert

VARIABLE = "WHEELLEG_USD_CORPUS"
ABSENT = f"no corpus of USD robots: set {VARIABLE} or pass --corpus DIR"


def corpus_folder(option: str | None) -> Path | None:
    text = option or os.environ.get(VARIABLE)
    if not text:
        return None
    folder = Path(text).resolve()
    if not (folder / "expected").is_dir():
        raise FileNotFoundError(f"{VARIABLE} or --corpus: the corpus has no folder '{folder / 'expected'}'")
    return folder


def expectations(folder: Path | None) -> list[dict[str, Any]]:
    files = sorted((folder / "expected").glob("*.json")) if folder else []
    return [json.loads(path.read_text(encoding="utf-8")) for path in files]


def check_module(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("corpus_check", folder / "check.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def convert_asset(folder: Path, expected: dict[str, Any], output: Path) -> Conversion:
    words = expected.get("args", [])
    pairs = list(zip(words[::2], words[1::2], strict=True))
    variants = dict(value.split("=", 1) for flag, value in pairs if flag == "--variant")
    base = next((value for flag, value in pairs if flag == "--base"), "auto")
    return convert(folder / expected["asset"], output, base=base, variants=variants)

"""Several mistakes in one error."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NoReturn

from wheelleg_exp.errors import ConfigError


def join(errors: Sequence[ConfigError]) -> ConfigError:
    """Return one error that tells all of ``errors``, one a line; a single error is returned as it is."""
    if len(errors) == 1:
        return errors[0]
    lines = "\n".join(f"  {error}" for error in errors)
    return ConfigError(f"{len(errors)} mistakes in the config:\n{lines}")


def raise_all(errors: Sequence[ConfigError], cause: Exception | None = None) -> NoReturn:
    """Raise ``errors`` as one."""
    raise join(errors) from cause

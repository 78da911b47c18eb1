"""Every mistake of a config, those included that Hydra would stop at, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hydra.errors import MissingConfigException

from wheelleg_exp.config.checking.check import check, follows_from
from wheelleg_exp.config.checking.diagnose import DoesNotMerge
from wheelleg_exp.config.checking.diagnose_groups import NowhereMounted
from wheelleg_exp.config.composing.compose import Composed, compose, override_texts
from wheelleg_exp.config.composing.headers import package_meant, usual_header
from wheelleg_exp.config.composing.tolerant_loader import Leniency, TolerantLoader
from wheelleg_exp.config.problems import override_of, parts, raise_all
from wheelleg_exp.errors import ConfigError

_MOST_ATTEMPTS = 50


@dataclass
class _Search:
    """What is left of a config when each mistake that stops Hydra has been taken out of it."""

    overrides: list[str]
    primary: str
    folders: tuple[Path, ...]
    found: list[ConfigError] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)  # keys whose content is not known
    leniency: Leniency = field(default_factory=Leniency)
    loader: TolerantLoader | None = None

    def compose(self) -> Composed | None:
        """Compose, taking out what is wrong and starting again, until it works or nothing more can be taken out."""
        for _ in range(_MOST_ATTEMPTS):
            try:
                return compose(self.overrides, primary=self.primary, config_dirs=self.folders, loader=self._make_loader)
            except ConfigError as error:
                self.found += [part for part in parts(error) if not self.follows(part)]
                if not self._take_out(error):
                    return None
        return None

    def _make_loader(self, folders: Sequence[Path]) -> TolerantLoader:
        self.loader = TolerantLoader(folders, self.leniency)
        return self.loader

    def _take_out(self, error: ConfigError) -> bool:
        """Take out what the error blames; False when that is not known."""
        blamed = {override_of(part) for part in parts(error)} - {None}
        kept = [text for text in self.overrides if text not in blamed]
        if len(kept) < len(self.overrides):
            self.overrides = kept
            return True
        if blamed:  # it is no single override
            return False
        return self._empty_file(error) or self._skip_default(error) or self._null_values(error)

    def _empty_file(self, error: ConfigError) -> bool:
        """Count a file that is broken, or not there, as empty."""
        cause = error.__cause__
        path, self.leniency.failed = self.leniency.failed, None
        if isinstance(cause, MissingConfigException):
            path = (cause.missing_cfg_file or "").removesuffix(".yaml")
        elif path is None and isinstance(error, DoesNotMerge):
            path = error.config_path
        if not path or path == self.primary or path in self.leniency.empty:
            return False
        self.leniency.empty.add(path)
        self.lost += self._places(path)
        if error.nearest:  # settings for what was meant are no mistakes
            self.lost.append(f".{error.nearest}")
        return True

    def _places(self, path: str) -> list[str]:
        """Return the keys that a file would have filled; "" stands for all."""
        group, _, name = path.rpartition("/")
        if self.loader is None:
            return [""]
        files = self.loader.repository_used.files(path)
        package = (package_meant(files[0]) if files else None) or usual_header(self.loader.repository_used, group)
        if package is not None:
            return ["" if package == "_global_" else package, group]
        return [f".{name}", group]

    def follows(self, error: ConfigError) -> bool:
        """Return whether an error only tells of something that has been taken out."""
        return follows_from(error, self.lost)

    def _skip_default(self, error: ConfigError) -> bool:
        """Leave out an ``override`` of a defaults list that overrides nothing."""
        if error.key is None or not isinstance(error, NowhereMounted) or error.key in self.leniency.unused:
            return False
        self.leniency.unused.add(error.key)
        return True

    def _null_values(self, error: ConfigError) -> bool:
        """Put null in the place of values that are missing or cannot be worked out."""
        keys = [part.key for part in parts(error) if part.key and part.where]
        plain = [key for key in keys if "[" not in key and key not in self.lost]
        if not plain or len(plain) < len(keys):
            return False
        self.lost += plain
        self.overrides = [*self.overrides, *(f"++{key}=null" for key in plain)]
        return True


def find_mistakes(
    overrides: Sequence[str] = (), *, primary: str = "train", config_dirs: Sequence[Path] = ()
) -> tuple[Composed | None, list[ConfigError]]:
    """Compose and check, and return the config and all mistakes; without mistakes it is what ``compose`` returns.

    What stops Hydra is taken out (a wrong override, a file that is broken or not there, a value that is missing)
    and the rest is looked at as if it had not been there. Mistakes that only follow from that are left out.

    Args:
        overrides: Hydra overrides.
        primary: name of the primary config.
        config_dirs: the user's config folders.

    Returns:
        The config, or None when there is none to look at; and the mistakes, those that stop Hydra first.
    """
    search = _Search(override_texts(overrides), primary, tuple(config_dirs))
    composed = search.compose()
    behind = [] if composed is None or "" in search.lost else check(composed)
    mistakes = _once([*search.found, *(error for error in behind if not search.follows(error))])
    return (composed if not search.found else None), mistakes


def compose_valid(overrides: Sequence[str] = (), *, config_dirs: Sequence[Path] = ()) -> Composed:
    """Compose a config that has no mistakes.

    Raises:
        ConfigError: there are mistakes; it tells all of them.
    """
    composed, mistakes = find_mistakes(overrides, config_dirs=config_dirs)
    if mistakes:
        raise_all(mistakes)
    assert composed is not None
    return composed


def _once(errors: Sequence[ConfigError]) -> list[ConfigError]:
    return list({str(error): error for error in errors}.values())

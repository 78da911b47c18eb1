"""Options and fixtures that all tests share."""

from __future__ import annotations

import functools
import gc
import hashlib
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from wheelleg_exp.machine import prepare_threads, share_cores
from wheelleg_exp.paths import cache_dir

if TYPE_CHECKING:
    from jobs.small import Trained

    from wheelleg_exp.env import ManagerBasedRLEnv

# Set the variables before torch is imported; child processes inherit them and compute the same numbers.
prepare_threads()
share_cores()

# Kernels of Warp take 30 s to compile, so all processes share the user's cache, also with another WHEELLEG_CACHE.
os.environ.setdefault("WARP_CACHE_PATH", str(cache_dir() / "warp"))

# With nohup or a shell's "&", signals are ignored in this process and in all child processes.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number, handler in {signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: lambda *_: None}.items():
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, handler)

# Files of tests need not survive a power failure, and a small training would sync to the disk eighty times.
os.fsync = lambda descriptor: os.fstat(descriptor) and None

# With Python's threshold of 700 objects, the search for cyclic garbage takes 8 % of the time.
gc.set_threshold(50_000)

EnvMaker = Callable[..., "ManagerBasedRLEnv"]


@pytest.fixture(scope="session", autouse=True)
def _equal_compositions(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Merge equal config files only once, because Hydra needs 0.3 s; only overrides of values are applied again.

    Two merges are equal if the overrides that select options, the search path, and the user's config files are equal.
    Other merges use the parsed stock files again. The processes that share the tests share merges of stock files.
    """
    from hydra._internal import defaults_list
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from omegaconf import _utils
    from omegaconf import base as nodes

    from wheelleg_exp.config.composing.config_loader import Loader, Repository
    from wheelleg_exp.paths import configs_dir

    merge, known, stock = ConfigLoaderImpl.load_configuration, {}, configs_dir()
    load, parsed = Repository._load_file, {}
    # The parse tree of a reference, such as `${env.sim.dt}`, depends only on its text; its value is found each time.
    parse = _utils.parse
    _utils.parse = nodes.parse = functools.lru_cache(4096)(parse)
    choices = defaults_list._create_interpolation_map  # Hydra calls it for each file, and reads it for references only.

    def choices_for_references(overrides: Any, defaults: Any, self_added: bool) -> Any:
        return choices(overrides, defaults, self_added) if any(d.is_interpolation() for d in defaults) else None

    defaults_list._create_interpolation_map = choices_for_references
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "merged"
    shared.mkdir(exist_ok=True)

    def read_once(self: Repository, config_path: str) -> Any:
        files = self.files(config_path)
        if len(files) > 1 or not files[0].is_relative_to(stock):
            return load(self, config_path)
        if config_path not in parsed:
            result = load(self, config_path)
            parsed[config_path] = pickle.dumps((result, self.loaded[config_path]))
        result, self.loaded[config_path] = pickle.loads(parsed[config_path])
        return result

    def remembered(self: ConfigLoaderImpl, *words: Any, **named: Any) -> Any:
        if not isinstance(self, Loader):
            return merge(self, *words, **named)
        repository, before = self.repository_used, len(self.problems)
        if vars(repository).setdefault("merged", False):  # After a mistake, Loader changes the repository.
            return merge(self, *words)
        repository.merged = True
        sources = [(source.scheme(), source.path) for source in repository.get_sources()]
        folders = [Path(path) for scheme, path in sources if scheme == "file" and Path(path) != stock]
        files = [
            file for folder in folders for file in folder.rglob("*.yaml") if os.access(file, os.R_OK) and file.is_file()
        ]
        chosen = [override.input_line for override in self.overrides if self._selects(override)]
        key = pickle.dumps((words, sources, chosen, [(file, file.read_bytes()) for file in files]))
        file = shared / hashlib.sha256(key).hexdigest()
        if key not in known and file.exists():
            known[key] = pickle.loads(file.read_bytes())
        if key in known:
            data, caches = known[key]
            tree, self.files, self.provenance, repository.loaded, repository.missing = pickle.loads(data)
            repository.cache = caches
            tree.hydra.runtime.cwd = str(Path.cwd())
            return tree
        tree = merge(self, *words)
        if len(self.problems) == before:
            state = (tree, self.files, self.provenance, repository.loaded, repository.missing)
            known[key] = (pickle.dumps(state), repository.cache)
            if not files:
                part = file.with_suffix(f".{os.getpid()}")
                part.write_bytes(pickle.dumps(known[key]))
                part.rename(file)
        return tree

    ConfigLoaderImpl.load_configuration, Repository._load_file = remembered, read_once
    yield
    ConfigLoaderImpl.load_configuration, Repository._load_file = merge, load
    _utils.parse, nodes.parse, defaults_list._create_interpolation_map = parse, parse, choices


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option ``--corpus DIR``, a folder with USD robots that are not in the repository."""
    parser.addoption("--corpus", metavar="DIR", help="folder of USD robots, in place of WHEELLEG_USD_CORPUS")


@pytest.fixture(scope="module", autouse=True)
def _own_projects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Remove user projects and their imported modules after each test module, because test modules run in any order.

    A training records all modules that were imported from such projects as a part of its source code.
    """
    from wheelleg_exp import packages

    before, known = dict(packages._joined), set(sys.modules)
    yield
    packages._joined.clear()
    packages._joined.update(before)
    base = f"{tmp_path_factory.getbasetemp()}{os.sep}"
    for name in set(sys.modules) - known:
        spec = getattr(sys.modules[name], "__dict__", {}).get("__spec__")
        places = (getattr(spec, "origin", None), *(getattr(spec, "submodule_search_locations", None) or ()))
        if any(place and place.startswith(base) for place in places):
            del sys.modules[name]


@pytest.fixture
def make_env() -> EnvMaker:
    """Build an environment on a small robot: ``make_env("rover", seed=1, rewards={...})``."""
    from sim.small_envs import ASSETS, env_config

    from wheelleg_exp.env import ManagerBasedRLEnv

    def make(name: str = "rover", /, *, seed: int = 0, **changes: Any) -> ManagerBasedRLEnv:
        return ManagerBasedRLEnv(env_config(name, **changes), ASSETS / f"{name}.xml", seed)

    return make


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Return the small training that tests share; a test that changes the run must copy it."""
    from jobs.small import trained_once

    return trained_once(tmp_path_factory)


@pytest.fixture(scope="session")
def graphics() -> str:
    """Return the rendering backend of this machine, or skip the test if no backend works."""
    from wheelleg_exp.errors import WheellegError
    from wheelleg_exp.rendering.render_job import Order
    from wheelleg_exp.rendering.render_scene import Scene
    from wheelleg_exp.rendering.renderer import drawing

    try:
        with drawing(Order(Scene({}, (), None, 0, 1.0), 32, 32, 0)) as process:
            return process.backend
    except WheellegError as error:
        pytest.skip(f"no graphics: {error}")


@pytest.fixture
def allow_test_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add the folder of the test to the import path, so that configs can name its terms."""
    from wheelleg_exp.terms import term_binding

    packages = term_binding.allowed_packages()
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: (*packages, "managers", "mdp", "env", "sim"))

"""Cache converted robots, with the files that a config names in addition, by a hash of the robot's source files."""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.asset.convert_robot import convert, is_urdf
from wheelleg_exp.asset.file_limits import bounded_memory
from wheelleg_exp.asset.robot_description import BaseMode
from wheelleg_exp.asset.urdf.urdf_robot import source_files
from wheelleg_exp.asset.usd.usd_stage import open_stage
from wheelleg_exp.constraints import PathBelow
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import sha256, temporary_folder
from wheelleg_exp.paths import CACHE_KEY, GROUND, NETWORKS, find_asset
from wheelleg_exp.plain_data import json_value
from wheelleg_exp.terms.config_values import require_fit


def find_extra_files(env: Mapping[str, object], roots: Sequence[Path] = ()) -> dict[str, Path]:
    """Return the actuator networks and the terrain file that an ``env`` section names, by path of their copies.

    The paths are in the MJCF's folder. ``roots`` are user-defined asset folders.
    """
    robot, scene = env["robot"], env.get("scene")
    groups = robot.get("actuators") if isinstance(robot, Mapping) else None
    named = [
        (node.get("network_file"), f"env.robot.actuators.{name}.network_file", NETWORKS, "network")
        for name, node in (groups.items() if isinstance(groups, Mapping) else ())
        if isinstance(node, Mapping)
    ]
    terrain = scene.get("terrain") if isinstance(scene, Mapping) else None
    if isinstance(terrain, Mapping):
        named.append((terrain.get("file"), "env.scene.terrain.file", GROUND, "ground"))
    found = {}
    for file, key, folder, what in named:
        if file is not None:
            require_fit(key, file, PathBelow)
            found[f"{folder}/{file}"] = find_asset(file, roots, key=key, what=what)
    return found


MODEL, REPORT, CONTENTS = "model.xml", "report.json", "contents.json"
_ATTEMPTS = 3  # attempts per cache entry


@dataclass(frozen=True)
class CachedConversion:
    """An MJCF in the cache, and each source's sha256 by relative path; ``fresh`` is false if it was there before."""

    output: Path
    report: Report
    sources: dict[str, str]
    key: str
    fresh: bool

    @property
    def meshes(self) -> tuple[Path, ...]:
        """The mesh files to which the cached MJCF refers."""
        return tuple(sorted(self.output.parent.glob(f"{self.output.stem}_meshes/*")))

    @property
    def extra_files(self) -> tuple[Path, ...]:
        """The copies of actuator networks and of the terrain file in the MJCF's folder."""
        folders = (self.output.parent / name for name in (NETWORKS, GROUND))
        return tuple(sorted(path for folder in folders for path in folder.glob("**/*") if path.is_file()))


def source_digest(
    source: Path, variants: Mapping[str, str] | None = None, extra_files: Mapping[str, Path] | None = None
) -> dict[str, str]:
    """Return the sha256 of all source files and ``extra_files``, by path relative to the robot file's folder."""
    source, chosen = Path(source), variants or {}
    with bounded_memory(source):
        files = source_files(source) if is_urdf(source, chosen) else open_stage(source, chosen).layers
    return {**files, **{name: sha256(path) for name, path in sorted((extra_files or {}).items())}}


def convert_cached(
    source: Path,
    *,
    base: BaseMode = "auto",
    variants: Mapping[str, str] | None = None,
    cache_dir: Path,
    extra_files: Mapping[str, Path] | None = None,
) -> CachedConversion:
    """Convert the robot file ``source``, or return the cached conversion if no source file has changed.

    The cache key is a hash of every USD layer or mesh in use, the options, the converter's code, and the versions of
    the converter's libraries. ``convert_cached`` replaces a damaged cache entry. Several processes can call
    ``convert_cached`` at once. ``extra_files`` maps paths in the MJCF's folder to the files that are copied there.
    """
    source, chosen = Path(source), dict(variants or {})
    sources = source_digest(source, chosen, extra_files)
    parts = {
        "source": source.name,
        "sources": sources,
        "base": base,
        "variants": chosen,
        "converter": _converter_digest(),
        "libraries": {name: metadata.version(name) for name in ("mujoco-core", "numpy", "usd-core")},
    }
    key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:32]
    entry = Path(cache_dir) / key
    if (report := _read(entry)) is not None:
        return CachedConversion(entry / MODEL, report, sources, key, fresh=False)
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(entry) as folder:
            draft = folder / "entry"
            report = convert(source, draft / MODEL, base=base, variants=chosen).report
            (draft / REPORT).write_text(report.to_json(), encoding="utf-8")
            for name, path in (extra_files or {}).items():
                (target := draft / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
            (draft / CONTENTS).write_text(json.dumps(_hashes(draft), indent=1), encoding="utf-8")
            _publish(draft, entry, folder)
    except OSError as error:
        message = f"cannot write the cache '{entry.parent}': {error.strerror or error}"
        raise WheellegError(message, key=CACHE_KEY, expected="a writable folder") from None
    return CachedConversion(entry / MODEL, report, sources, key, fresh=True)


@functools.cache
def _converter_digest() -> str:
    """Return the sha256 of the converter's code, so that changed code never reads a cache entry of older code."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _read(entry: Path) -> Report | None:
    try:
        if not (entry / CONTENTS).is_file():
            return None
        contents = json_value((entry / CONTENTS).read_text(encoding="utf-8"))
        return None if _hashes(entry) != contents else Report.from_json((entry / REPORT).read_text(encoding="utf-8"))
    except (OSError, TypeError, ValueError):
        return None


def _hashes(entry: Path) -> dict[str, str]:
    files = sorted(path for path in entry.rglob("*") if path.is_file() and path.name != CONTENTS)
    return {path.relative_to(entry).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _publish(draft: Path, entry: Path, scratch: Path) -> None:
    """Rename a converted robot's folder to the path of its cache entry, unless another process has made the entry."""
    for attempt in range(_ATTEMPTS):
        try:
            # Renaming the draft folder is atomic, and fails if another process has already created the cache entry.
            draft.rename(entry)
            return
        except OSError:
            if _read(entry) is not None:
                return
            if attempt == _ATTEMPTS - 1:
                raise
            with suppress(FileNotFoundError):
                entry.rename(scratch / f"damaged_{attempt}")

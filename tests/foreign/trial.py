"""A run directory with a planted file, and the effects that a command on this run directory must not have."""

import hashlib
import os
import stat
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from jobs.small import Words, wheelleg

from wheelleg_exp.files import write_text
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import text_with_digest
from wheelleg_exp.run.run_directory import RunDirectory

VARIABLE, SECRET = "TRIAL_VARIABLE", "hunter2-of-this-machine"
_LOCKS = (".lock", ".manifest.lock")
_SMALL = 1 << 20

State = dict[str, tuple[Any, ...]]


def every_second(rows: Collection[Any], columns: Sequence[Any]) -> list[tuple[Any, Any]]:
    """Return every second pair of a row and a column; all rows and all columns are in a pair."""
    return [(row, column) for number, row in enumerate(rows) for column in columns[number % 2 :: 2]]


def state(root: Path, without: Path | None = None) -> State:
    """Return kind, size, and content of all entries below a folder, without following links or reading pipes."""
    found: State = {}
    for folder, folders, names in os.walk(root):
        folders[:] = [name for name in folders if Path(folder, name) != without]
        for path in (Path(folder, name) for name in [*folders, *names]):
            facts = path.lstat()
            content: Any = None
            if stat.S_ISLNK(facts.st_mode):
                content = str(path.readlink())
            elif stat.S_ISREG(facts.st_mode) and facts.st_size < _SMALL:
                content = hashlib.sha256(path.read_bytes()).hexdigest()
            size = facts.st_size if stat.S_ISREG(facts.st_mode) else 0
            found[str(path.relative_to(root))] = (stat.S_IFMT(facts.st_mode), size, content)
    return found


def plant_project(folder: Path, code: str) -> Path:
    """Write a project whose package ``evil`` runs ``code`` when it is imported, and return its config folder."""
    term = "evil: {_target_: evil.terms.f, weight: 1.0}\n"
    texts = {
        "pyproject.toml": '[project.entry-points."wheelleg_exp.packages"]\nx = "evil"\n',
        "evil/__init__.py": code,
        "evil/terms.py": "def f(env):\n    return 1.0\n",
        "configs/reward/evil.yaml": term,
        "configs/observation/evil.yaml": term,
    }
    for name, text in texts.items():
        write_text(folder / name, text)
    return folder / "configs"


@dataclass
class Trial:
    """A planted run directory, the healthy run directory of which it is a copy, and texts that must not be shown."""

    root: Path
    run: RunDirectory
    healthy: RunDirectory
    leaks: list[str] = field(default_factory=lambda: [SECRET])

    @property
    def canary(self) -> Path:
        """The file that planted code creates when the code runs."""
        return self.root / "ran"

    def outside(self, text: str = "precious: 1\n") -> Path:
        """Create a file of the user, whose text must not be shown, and return its path."""
        path = self.root / "here" / "precious.yaml"
        path.write_text(text)
        self.leaks.append("precious:")
        return path

    def write(self, name: str, content: str | bytes) -> None:
        path = self.run.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        self._record(name)

    def yaml(self, name: str, change: Callable[[Any], Any]) -> None:
        path = self.run.path / name
        value = yaml.load(path.read_text(), yaml.CSafeLoader)
        change(value)
        path.write_text(yaml.dump(value, Dumper=yaml.CSafeDumper, sort_keys=False))
        self._record(name)

    def manifest(self, **changes: Any) -> None:
        """Write the manifest of the healthy run with changes, and sign it for the current files."""
        data = {**self.healthy.manifest().data, "files": inventory(self.run.path)}
        write_text(self.run.path / "manifest.json", text_with_digest({**data, **changes}))

    def replace(self, name: str, make: Callable[[Path], Any]) -> None:
        """Replace a file or folder of the run."""
        path = self.run.path / name
        if path.exists():
            path.rename(self.root / f"taken_{name.replace('/', '_')}")
        path.parent.mkdir(parents=True, exist_ok=True)
        make(path)
        self._record(name)

    def _record(self, name: str) -> None:
        """Make the manifest record the current files, as the author of a planted file would do."""
        if name != "manifest.json":
            self.manifest()

    def words(self, command: str) -> list[str | Path]:
        run, runs = self.run.path, self.root / "runs"
        return {
            "play": ["play", run, "env.num_envs=2", "recording.enabled=false"],
            "resume": ["resume", run, "agent.max_iterations=9"],
            "report": ["report", run, "--no-pictures"],
            "verify": ["verify", run],
            "compare": ["verify", run, self.healthy.path],
            "inspect": ["inspect", run],
            "diff": ["diff", run, self.healthy.path],
            "list": ["list", "runs", "--root", runs],
            "json": ["list", "runs", "--root", runs, "--json"],
            "replay": ["replay", run, "--root", runs],
        }[command]

    def try_each(self, commands: Collection[str], status: int | Collection[int], *told: str) -> None:
        for command in commands:
            self.try_(command, status, *told)

    def try_(self, command: str, status: int | Collection[int], *told: str) -> Words:
        """Run a command on the planted run, and check the exit status, the output, and all files."""
        before, inside = state(self.root, self.run.path), state(self.run.path)
        said = wheelleg(*self.words(command))
        report = self.run.path / "report.html"
        page = report.read_text() if command == "report" and said.status == 0 else ""
        answer = f"{said.out}\n{said.err}\n{page}"
        assert not self.canary.exists(), f"code ran: {said.err}"
        allowed = {status} if isinstance(status, int) else set(status)
        assert said.status in allowed, (said.status, said.err, said.out[-2000:])
        assert "Traceback" not in said.err
        assert "--debug" not in said.err, said.err
        if said.status == 2:
            assert said.err.count("wheelleg: error: ") == 1, said.err
        for text in told:
            assert text in answer, (text, said.err, said.out[-2000:])
        for text in (*self.leaks, "\x1b[", "\x9b"):
            assert text not in answer, text
        assert state(self.root, self.run.path) == before
        # The command changed no file of the run, except for the files that the command adds.
        after = state(self.run.path)
        added = {"report": ("report.html", "manifest.json"), "play": ("play", "manifest.json")}.get(command, ())
        own = (*_LOCKS, *(added if said.status == 0 else ()))
        changed = [name for name in {*inside, *after} if inside.get(name) != after.get(name)]
        assert [name for name in changed if Path(name).parts[0] not in own] == []
        for name in (name for name in changed if after.get(name) and Path(name).suffix):
            assert SECRET.encode() not in (self.run.path / name).read_bytes()
        return said

"""Define the converters that ``converters.py`` compares, and run each converter in a separate Python environment."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import wheelleg_exp
from wheelleg_exp.errors import WheellegError

WORKERS = Path(__file__).resolve().parent / "converter_workers"
INSTALL_LIMIT = 1800.0  # seconds


class BenchmarkError(WheellegError):
    """The comparison is impossible, for example without a corpus or without the Python environment of a converter."""


@dataclass(frozen=True)
class Tool:
    """A converter: what to install, and the command that converts.

    The function ``command`` gets the source file, the output file and the options of ``wheelleg convert`` for the
    asset, and returns the arguments of the Python interpreter. Without ``pins``, the tool runs in the environment of
    this script.
    """

    name: str
    pins: tuple[str, ...]
    command: Callable[[Path, Path, Sequence[str]], list[str]]
    note: str = ""

    @property
    def version(self) -> str:
        """Return the names and versions of the packages that the tool uses."""
        own = (f"wheelleg_exp=={wheelleg_exp.__version__}", f"mujoco-core=={metadata.version('mujoco-core')}")
        return " ".join(self.pins or own) + (f", {self.note}" if self.note else "")


def _wheelleg(source: Path, output: Path, options: Sequence[str]) -> list[str]:
    return ["-m", "wheelleg_exp.cli.main", "convert", str(source), "-o", str(output), *options, "--json"]


def _mujoco_usd(source: Path, output: Path, _options: Sequence[str]) -> list[str]:
    return [str(WORKERS / "mujoco_usd_worker.py"), str(source), str(output)]


def _newton(*words: str) -> Callable[[Path, Path, Sequence[str]], list[str]]:
    def command(source: Path, output: Path, options: Sequence[str]) -> list[str]:
        floating = ["floating"] if list(options) == ["--base", "floating"] else []
        return [str(WORKERS / "newton_worker.py"), str(source), str(output), *words, *floating]

    return command


NEWTON = ("newton[sim,importers]==1.8.0", "mujoco==3.17.0", "usd-core==26.8")
TOOLS = {
    tool.name: tool
    for tool in (
        Tool("wheelleg", (), _wheelleg),
        Tool("mujoco-usd", ("mujoco-core==4.0.1", "mujoco-usd==4.0.1", "usd-core==25.11"), _mujoco_usd),
        Tool("newton", NEWTON, _newton(), "SolverMuJoCo(save_to_mjcf=...)"),
        Tool("newton-resolvers", NEWTON, _newton("resolvers"), "with the MuJoCo, PhysX and Newton schema resolvers"),
    )
}


def interpreter(tool: Tool, work: Path) -> Path:
    """Return the Python interpreter of a tool's environment; create the environment at the first call.

    Raises:
        BenchmarkError: the environment cannot be made, such as without a network.
    """
    if not tool.pins:
        return Path(sys.executable)
    digest = hashlib.sha256(" ".join((sys.version, *tool.pins)).encode()).hexdigest()[:12]
    folder = work / "environments" / digest
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    if not (folder / "complete").exists():
        print(f"making the environment of {tool.name}: {' '.join(tool.pins)}", file=sys.stderr)
        shutil.rmtree(folder, ignore_errors=True)
        _install(tool, [sys.executable, "-m", "venv", str(folder)])
        _install(tool, [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *tool.pins])
        (folder / "complete").touch()
    return python


def _install(tool: Tool, command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=INSTALL_LIMIT)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise _no_environment(tool, str(error)) from None
    if done.returncode:
        raise _no_environment(tool, last_line(done.stderr or done.stdout))


def _no_environment(tool: Tool, reason: str) -> BenchmarkError:
    return BenchmarkError(
        f"the environment of {tool.name} cannot be made: {reason}",
        key="--tools",
        expected="a package index with " + " ".join(tool.pins),
    )


@dataclass(frozen=True)
class Run:
    """One conversion: seconds from the start of the interpreter to its end, and what went wrong."""

    seconds: float
    problem: str


def convert(tool: Tool, python: Path, source: Path, output: Path, options: Sequence[str], limit: float) -> Run:
    """Convert one file in a separate process, which is killed after ``limit`` seconds."""
    shutil.rmtree(output.parent, ignore_errors=True)
    output.parent.mkdir(parents=True)
    start = time.perf_counter()
    try:
        done = subprocess.run(
            [str(python), *tool.command(source, output, options)],
            capture_output=True,
            text=True,
            timeout=limit,
            cwd=output.parent,
        )
        problem = f"exit {done.returncode}: {last_line(done.stderr or done.stdout)}" if done.returncode else ""
    except subprocess.TimeoutExpired:
        problem = f"not done after {limit:g} s"
    return Run(time.perf_counter() - start, problem)


def last_line(text: str) -> str:
    """Return the last line that contains the word "error", otherwise the last line; cut the line to 300 characters."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if "error" in line.lower()]
    return (errors or lines or ["no message"])[-1][:300]

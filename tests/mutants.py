"""Plant the faults of mutants.yaml one at a time in a copy of the repository, and check that tests catch each fault.

    python tests/mutants.py [WORD ...]

Without WORD, all faults are planted; otherwise those whose description or file contains a WORD. The script prints one
line per fault and a total. It exits with 1 if a test passes in spite of its fault, or fails without any fault.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml

REPOSITORY = Path(__file__).resolve().parents[1]
LIST = Path(__file__).with_name("mutants.yaml")
_TESTS_FAILED, _LIMIT_S = 1, 900


@dataclass(frozen=True)
class Fault:
    """A mistake in one file: ``text``, which occurs once, becomes ``becomes``; at least one of ``tests`` must fail."""

    fault: str
    file: str
    text: str
    becomes: str
    tests: list[str]

    def plant(self, root: Path) -> None:
        path = root / self.file
        content = path.read_text(encoding="utf-8")
        if (count := content.count(self.text)) != 1:
            raise ValueError(f"{self.file} contains {count} times {self.text!r}; expected once: {self.fault}")
        path.write_text(content.replace(self.text, self.becomes), encoding="utf-8")


def load() -> list[Fault]:
    return [Fault(**entry) for entry in yaml.safe_load(LIST.read_text(encoding="utf-8"))]


def copied(root: Path) -> None:
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    names = subprocess.run(listed, cwd=REPOSITORY, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        if (REPOSITORY / name).is_file():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPOSITORY / name, root / name)


def exit_status(root: Path, tests: Iterable[str]) -> int:
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-m", "not full"]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    try:
        return subprocess.run(
            [*words, *tests], cwd=root, env=environment, stdout=subprocess.DEVNULL, timeout=_LIMIT_S
        ).returncode
    except subprocess.TimeoutExpired:
        return -1


def is_caught(root: Path, fault: Fault, number: int) -> bool:
    """Plant a fault, run its tests, and restore the file; ``number`` must differ between the faults of a copy."""
    path, moment = root / fault.file, time.time() + 2 * number
    original = path.read_bytes()
    try:
        fault.plant(root)  # Python recognises a changed module by its size and its time in whole seconds.
        os.utime(path, (moment, moment))
        return exit_status(root, fault.tests) == _TESTS_FAILED
    finally:
        path.write_bytes(original)
        os.utime(path, (moment + 1, moment + 1))


def main(words: Sequence[str]) -> int:
    """Plant the faults, print which of them were caught, and return the exit status."""
    faults = [fault for fault in load() if not words or any(word in f"{fault.fault} {fault.file}" for word in words)]
    caught = 0
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        copied(root)
        if status := exit_status(root, dict.fromkeys(test for fault in faults for test in fault.tests)):
            sys.stdout.write(f"without any fault, pytest exits with {status}; expected 0\n")
            return 1
        for number, fault in enumerate(faults, start=1):
            start = time.monotonic()
            result = "caught" if is_caught(root, fault, number) else "missed"
            caught += result == "caught"
            sys.stdout.write(f"{result} {fault.file}: {fault.fault} ({time.monotonic() - start:.0f} s)\n")
            sys.stdout.flush()
    sys.stdout.write(f"caught {caught} of {len(faults)} faults\n")
    return int(caught < len(faults))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

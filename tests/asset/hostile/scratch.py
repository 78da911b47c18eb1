"""Run ``wheelleg`` on hostile robot files, and check that the command only prints an answer or writes its output."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from foreign.trial import state
from jobs.small import Words, wheelleg
from pxr import Sdf

from wheelleg_exp.errors import EXIT_INPUT, EXIT_OK

from .. import small_urdf, small_usd

CANARY = "only its owner reads this"
SECONDS = 120  # against hanging alone
GROWTH = 2**30  # bytes

Maker = Callable[[Path], Path]
"""A function that writes a robot into a folder and returns the path of the robot file."""


class Scratch:
    """A temporary folder with a robot file in ``robot/``, and with files that no conversion may read or change."""

    def __init__(self, root: Path) -> None:
        self.root, self.robot, self.out = root, root / "robot", root / "out"
        self.robot.mkdir()
        for name in ("canary", "canary.usda", "canary.png", "robot/id_rsa"):
            (root / name).write_text(CANARY)

    def convert(self, make: Maker, *words: str) -> Words:
        return self.run("convert", make(self.robot), "-o", self.out / "bot.xml", *words)

    def run(self, *words: str | Path) -> Words:
        before = state(self.root)
        with _bounded():
            said = wheelleg(*words)
        after = state(self.root)
        assert said.status in (EXIT_OK, EXIT_INPUT), said.err
        assert "Traceback" not in said.out + said.err
        assert "\x1b" not in said.out + said.err
        assert {name: after.get(name) for name in before} == before
        new = sorted(after.keys() - before.keys())
        assert all(Path(name).parts[0] == "out" for name in new), new
        files = [self.root / name for name in new if (self.root / name).is_file()]
        assert said.status == EXIT_OK or not files
        assert not [path for path in files if CANARY in path.read_text(errors="replace")]
        return said


@contextmanager
def _bounded() -> Iterator[None]:
    def stop(_: int, __: FrameType | None) -> None:
        raise AssertionError(f"the command gave no answer within {SECONDS} s")

    before, used = signal.signal(signal.SIGALRM, stop), _most_memory()
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    assert _most_memory() - used < GROWTH


def _most_memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def sparse(path: Path, size: int, head: bytes = b"") -> Path:
    with path.open("wb") as file:
        file.write(head)
        file.truncate(size)
    return path


def crate(text_layer: Path) -> Path:
    path = text_layer.with_suffix(".usdc")
    assert Sdf.Layer.FindOrOpen(str(text_layer)).Export(str(path))
    text_layer.unlink()
    return path


def usd(inside: str, *, outside: str = "", header: str = small_usd.SI) -> Maker:
    return lambda folder: small_usd.write(folder, small_usd.link("a") + inside, outside=outside, header=header)


def urdf(text: str) -> Maker:
    return lambda folder: small_urdf.write(folder, text)

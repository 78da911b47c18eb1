"""A damaged USD crate file gives an MJCF or one error message, whatever sizes the crate file declares."""

from __future__ import annotations

import os
import random
import re
import resource
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from wheelleg_exp.asset import convert, file_limits
from wheelleg_exp.errors import AssetError, WheellegError
from wheelleg_exp.paths import find_asset

from .. import small_usd
from ..small_usd import cube_inside, hinge, link
from .scratch import Maker, Scratch, crate


def claiming(claim: int) -> Maker:
    def make(folder: Path) -> Path:
        corners = ", ".join(str(i % 8) for i in range(999))
        block = re.sub(r"(faceVertexIndices = )\[.*?\]", rf"\1[{corners}]", cube_inside("convexHull"))
        block = re.sub(r"(faceVertexCounts = )\[.*?\]", rf"\1[{', '.join(['3'] * 333)}]", block)
        path = crate(small_usd.write(folder, link("a", inside=block)))
        data = path.read_bytes()
        assert data.count(struct.pack("<Q", 999)) == 1
        path.write_bytes(data.replace(struct.pack("<Q", 999), struct.pack("<Q", claim)))
        return path

    return make


@pytest.mark.parametrize("claim", [2**30, 2**31 - 1, 2**40, 2**63, 2**64 - 1])
def test_a_crate_that_declares_more_than_it_contains_takes_no_memory(scratch, monkeypatch, claim):
    monkeypatch.setattr(file_limits, "MOST", 2**29)
    said = scratch.convert(claiming(claim))
    assert said.status == 2
    assert "bot.usdc" in said.err


def test_a_bound_on_memory_ends_with_the_conversion(scratch: Scratch) -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    scratch.convert(lambda folder: small_usd.write(folder, link("a")))
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


@pytest.mark.parametrize("command", ["convert", "check"])
@pytest.mark.parametrize("megabytes", [300, 800, 1200])
def test_too_little_memory_is_an_error_and_no_crash(tmp_path: Path, command: str, megabytes: int) -> None:
    words = {"convert": ["convert", str(find_asset("wheelleg/wheelleg.usda")), "-o", str(tmp_path / "out.xml")]}
    code = "import sys; from wheelleg_exp.cli.main import main; sys.exit(main(sys.argv[1:]))"
    said = subprocess.run(
        [sys.executable, "-c", code, *words.get(command, ["check", "task=stand"])],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20)),
        env=os.environ | {"WHEELLEG_CACHE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert said.returncode == 2
    assert re.match(r"wheelleg: error: ulimit -v: the limit leaves .* of memory to this process; expected", said.stderr)


def test_a_conversion_starts_only_with_enough_memory() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    used = next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if "VmData" in line)
    resource.setrlimit(resource.RLIMIT_DATA, ((used << 10) + 2**26, hard))
    try:
        with pytest.raises(WheellegError, match="ulimit -d: the limit leaves"), file_limits.bounded_memory(Path("bot")):
            pass
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def test_bounds_on_memory_may_overlap(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    first, second = file_limits.bounded_memory(tmp_path), file_limits.bounded_memory(tmp_path)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert resource.getrlimit(resource.RLIMIT_DATA) != before
    second.__exit__(None, None, None)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


MANY = """def PointInstancer "many"
{
    rel prototypes = </bot/many/ball>
    int[] protoIndices = [0, 0]
    point3f[] positions = [(0, 0, 0), (1, 1, 1)]
    float3[] scales = [(1, 1, 1), (2, 2, 2)]
    def Sphere "ball" {}
}
"""
CAPSULE = 'def Capsule "c" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n}\n'
DRIVEN = hinge("j", "a", "b", apis="PhysicsDriveAPI:angular", text="float drive:angular:physics:stiffness = 1")
ROBOT = link("a", inside=cube_inside("convexHull")) + link("b", "(1, 0, 0)", inside=CAPSULE) + DRIVEN + MANY


@pytest.mark.parametrize("seed", range(40))
def test_a_crate_with_changed_bytes_gives_a_model_or_one_error_message(tmp_path: Path, seed: int) -> None:
    dice = random.Random(seed)
    path = crate(small_usd.write(tmp_path, ROBOT))
    data = bytearray(path.read_bytes())
    for _ in range(dice.choice([1, 1, 2, 4])):
        place = dice.randrange(len(data) - 8)
        if dice.random() < 0.5:
            data[place] = dice.randrange(256)
        else:
            data[place : place + 8] = struct.pack("<Q", dice.choice([0, 1, 2**20, 2**31, 2**32 - 1, 2**63 - 1]))
    path.write_bytes(data)
    try:
        convert(path, tmp_path / "out" / "bot.xml")
    except AssetError as error:
        said = error
    else:
        return
    assert said.key or path.name in str(said)
    assert not list(tmp_path.glob("out/*"))

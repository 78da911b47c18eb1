"""Robot files can name any path: a conversion reads no pipe, no device, no private file, and no network address."""

from __future__ import annotations

import hashlib
import json
import os
import re
import socket
import zipfile
from pathlib import Path

import pytest

from .. import small_urdf
from ..small_usd import SI
from .scratch import CANARY, Maker, Scratch, sparse, usd

GIGABYTES_64 = 64 * 2**30


def urdf(inside: str, before: str = "") -> Maker:
    return lambda folder: small_urdf.write(folder, before + small_urdf.link("a", inside))


def beside(make: Maker, name: str, kind: str | bytes) -> Maker:
    def both(folder: Path) -> Path:
        odd(folder / name, kind)
        return make(folder)

    return both


def odd(path: Path, kind: str | bytes) -> Path:
    if isinstance(kind, bytes):
        path.write_bytes(kind)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "huge":
        sparse(path, GIGABYTES_64, b"#usda 1.0\n")
    else:
        path.symlink_to({"zero": "/dev/zero", "memory": "/proc/self/mem", "loop": path.name}[kind])
    return path


def reference(asset: str, kind: str = "references") -> str:
    return f'def Xform "x" ({kind} = @{asset}@)\n{{\n}}\n'


def mesh(name: str, kind: str = "collision") -> str:
    return f'<{kind}><geometry><mesh filename="{name}"/></geometry></{kind}>'


VARIANT = """def Xform "v" (
    variants = { string s = "a" }
    prepend variantSets = "s"
) {
    variantSet "s" = {
        "a" {
        }
        "b" (references = @./odd.usda@</x>) {
        }
    }
}
"""
SHADER = """def Shader "s"
{
    uniform token info:id = "UsdUVTexture"
    asset inputs:file = @./odd.usda@
    asset info:mdl:sourceAsset = @../canary@
}
"""
COMPUTED = SI + "\n    subLayers = [@`'odd.usda'`@]"
ODD_ASSETS = "asset[] assetPaths = [@./odd.usda@]\nasset manifestAssetPath = @./odd.usda@"
CLIPS = f'def Xform "x" (\nclips = {{ dictionary default = {{ {ODD_ASSETS} }} }}\n)\n{{\n}}\n'
ARGUMENTS = reference("./odd.py:SDF_FORMAT_ARGS:a=b", "payload")
SCRIPT = b"raise SystemExit(7)"
INCLUDES = """<mujoco><include file="../canary"/><extension><plugin plugin="mujoco.elasticity.cable"/></extension>
<asset><texture name="t" file="../canary"/><hfield name="h" file="../canary"/></asset></mujoco>"""
XINCLUDE = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="../canary" parse="text"/>'
PLUGIN = small_urdf.link("a&quot;/&gt;&lt;plugin/&gt;&lt;x y=&quot;")
COMMENT = f'<robot name="--&gt; &lt;include file=&quot;x&quot;/&gt;">{small_urdf.link("a")}</robot>'.encode()

SOURCES = {
    "a pipe": ("pipe", "is a pipe or a device"),
    "a device without end": ("zero", "is a pipe or a device"),
    "the memory of the process": ("memory", "cannot be read"),
    "a link to itself": ("loop", "cannot be read"),
    "a folder": ("folder", "is a folder"),
    "a file of 64 GB": ("huge", "is larger than"),
}

REFUSED: dict[str, tuple[Maker, str]] = {
    "reference to a pipe": (beside(usd(reference("./odd.usda")), "odd.usda", "pipe"), "/bot/x: '.*odd.usda' is a pipe"),
    "pipe in a variant not chosen": (beside(usd(VARIANT), "odd.usda", "pipe"), "odd.usda' is a pipe"),
    "reference to a device": (beside(usd(reference("./odd.usda")), "odd.usda", "zero"), "odd.usda' is a pipe or a dev"),
    "reference to 64 GB": (beside(usd(reference("./odd.usda")), "odd.usda", "huge"), "odd.usda' is larger than"),
    "name that is computed": (usd("", header=COMPUTED), "computes the name of a layer"),
    "mesh that is the process's memory": (beside(urdf(mesh("odd.stl")), "odd.stl", "memory"), "cannot be read"),
    "bytes that are no text": (
        lambda f: odd(f / "bot.usda", b'#usda 1.0\ndef Xform "\xff\xfe" {\n}\n'),
        "expected UTF-8",
    ),
    "substitution of a package": (urdf(mesh("$(find pkg)/$(arg part).stl")), "xacro"),
}


PASSED: dict[str, tuple[Maker, str]] = {
    "reference to a link to itself": (beside(usd(reference("./odd.usda")), "odd.usda", "loop"), "odd.usda"),
    "reference to no layer": (usd(reference("../canary")), "canary"),
    "reference to a variable": (usd(reference("$HOME/canary.usda")), "HOME"),
    "reference to a name without end": (usd(reference("a" * 5000 + ".usda")), "not found"),
    "reference to a script": (beside(usd(reference("odd.py")), "odd.py", SCRIPT), "odd.py"),
    "arguments of a format": (beside(usd(ARGUMENTS), "odd.py", SCRIPT), "not found"),
    "texture that is a pipe": (beside(usd(SHADER), "odd.usda", "pipe"), ""),
    "clips that are a pipe": (beside(usd(CLIPS), "odd.usda", "pipe"), ""),
    "mesh that is a pipe": (beside(urdf(mesh("odd.stl")), "odd.stl", "pipe"), "not found"),
    "mesh that is a link to itself": (beside(urdf(mesh("odd.stl")), "odd.stl", "loop"), "not found"),
    "mesh that is none": (urdf(mesh("../canary")), "not a supported mesh format"),
    "mesh out of its package": (urdf(mesh("package://../../canary")), "not a supported mesh format"),
    "MuJoCo's include and plugins": (urdf("", INCLUDES), ""),
    "XML's include": (urdf("", XINCLUDE), ""),
    "MJCF in a name": (lambda folder: small_urdf.write(folder, PLUGIN), ""),
    "end of a comment in a name": (lambda folder: odd(folder / "bot.urdf", COMMENT), ""),
}


@pytest.mark.parametrize("ending", ["usda", "usdc", "usdz", "urdf"])
@pytest.mark.parametrize("name", SOURCES)
def test_a_source_that_is_not_a_regular_file_is_refused(scratch: Scratch, name: str, ending: str) -> None:
    kind, words = SOURCES[name]
    said = scratch.convert(lambda folder: odd(folder / f"bot.{ending}", kind))
    assert said.status == 2
    assert words in said.err
    assert f"bot.{ending}" in said.err


@pytest.mark.parametrize("name", REFUSED)
def test_files_that_would_never_end_are_refused_by_name(scratch: Scratch, name: str) -> None:
    make, words = REFUSED[name]
    said = scratch.convert(make)
    assert said.status == 2
    assert re.search(words, said.err), said.err


@pytest.mark.parametrize("name", PASSED)
def test_files_that_belong_to_no_robot_are_reported_and_not_read(scratch: Scratch, name: str) -> None:
    make, words = PASSED[name]
    said = scratch.convert(make)
    assert said.status == 0, said.err
    assert words in said.out
    model = (scratch.out / "bot.xml").read_text()
    assert not re.search(r"<(include|plugin|extension|hfield|texture)\b", re.sub(r"<!--.*?-->", "", model, flags=re.S))


@pytest.mark.parametrize("make", [urdf(mesh("../canary")), usd(reference("../canary"))], ids=["urdf", "usd"])
def test_a_report_contains_nothing_of_files_that_belong_to_no_robot(scratch: Scratch, make: Maker) -> None:
    said = scratch.convert(make, "--json")
    assert hashlib.sha256(CANARY.encode()).hexdigest() not in said.out
    assert len(json.loads(said.out)["layers"]) == 1


@pytest.mark.parametrize("url", ["http://127.0.0.1:{}/a.usda", "http://127.0.0.1:{}/a.stl"])
def test_a_conversion_opens_no_network_connection(scratch: Scratch, url: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        name = url.format(server.getsockname()[1])
        assert scratch.convert(urdf(mesh(name)) if name.endswith("stl") else usd(reference(name))).status == 0
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize("command", ["check", "zero-agent", "train"])
def test_commands_with_a_refused_robot_name_its_key_once(scratch: Scratch, command: str) -> None:
    make, words = REFUSED["reference to a pipe"]
    said = scratch.run(command, "task=stand", f"env.robot.asset={make(scratch.robot)}")
    assert said.status == 2
    assert said.err.startswith("wheelleg: error: env.robot.asset: /bot/x: ")
    assert re.search(words, said.err)
    assert said.err.count("expected a layer of USD") == 1


# ---------------------------------------------------------------- packages
def package(names: list[str], compression: int = zipfile.ZIP_STORED, more: str = "") -> Maker:
    def make(folder: Path) -> Path:
        inner = usd(more)(folder)
        with zipfile.ZipFile(folder / "bot.usdz", "w", compression) as file:
            for name in names:
                file.write(inner, name)
        return folder / "bot.usdz"

    return make


def claiming(make: Maker, signature: bytes, offset: int) -> Maker:
    def claim(folder: Path) -> Path:
        path = make(folder)
        data = bytearray(path.read_bytes())
        start = data.find(signature) + offset
        data[start : start + 8] = b"\xf0\xff\xff\xff" * 2
        path.write_bytes(data)
        return path

    return claim


PLAIN = package(["bot.usda"])
PACKAGES: dict[str, tuple[Maker, int]] = {
    "names that climb": (package(["../../bot.usda"]), 0),
    "absolute names": (package(["/canary.usda"]), 0),
    "reference out of it": (package(["bot.usda"], more=reference("../../canary")), 0),
    "pipe beside it": (beside(package(["bot.usda"], more=reference("./odd.usda")), "odd.usda", "pipe"), 0),
    "compressed": (package(["bot.usda"], zipfile.ZIP_DEFLATED), 2),
    "nothing in it": (package([]), 2),
    "sizes of 4 GB": (claiming(PLAIN, b"PK\3\4", 18), 2),
}


@pytest.mark.parametrize("name", PACKAGES)
def test_packages_do_not_reach_out_of_themselves(scratch: Scratch, name: str) -> None:
    make, status = PACKAGES[name]
    assert scratch.convert(make).status == status

"""Converts a USD file to an MJCF that appears whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.asset.description import BaseMode, RobotDescription
from wheelleg_exp.asset.reader.robot import read_usd
from wheelleg_exp.asset.report import Report
from wheelleg_exp.asset.writer.effective import with_force_gains
from wheelleg_exp.asset.writer.meshes import file_name, obj_text
from wheelleg_exp.asset.writer.mjcf import Writer
from wheelleg_exp.asset.writer.verify import load, verify
from wheelleg_exp.errors import AssetError


@dataclass(frozen=True)
class Conversion:
    """The MJCF that was written, what it says, and how it came about."""

    output: Path
    description: RobotDescription
    report: Report


def convert(
    source: Path, output: Path, *, base: BaseMode = "auto", variants: Mapping[str, str] | None = None
) -> Conversion:
    """Convert a USD file to MJCF. Meshes go to the folder ``<output's stem>_meshes`` beside it.

    Args:
        source: a .usd, .usda, .usdc or .usdz file.
        output: the MJCF to write; an older one is replaced.
        base: ``auto`` as authored; ``floating`` drops the fixed joint to the world; ``fixed`` removes the
            free joint.
        variants: selections by variant set, in place of the authored ones.

    Raises:
        AssetError: the source cannot be read or holds no robot, or the output cannot be written.
    """
    source, output = Path(source), Path(output)
    robot, report = read_usd(source, base, variants or {})
    robot = with_force_gains(robot)
    write(robot, report, output)
    return Conversion(output, robot, report)


def write(robot: RobotDescription, report: Report, output: Path) -> None:
    """Write the MJCF and its meshes, after loading them in MuJoCo and comparing.

    Raises:
        AssetError: MuJoCo refuses the model, or the output cannot be written.
    """
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=output.parent, prefix=f".{output.stem}.") as folder:
            draft = Path(folder) / output.name
            meshes = mesh_folder(draft)
            _write_draft(robot, report, draft, meshes)
            verify(load(draft, report.source), robot, report.source)
            _publish_meshes(meshes, mesh_folder(output), Path(folder) / "old")
            draft.replace(output)
    except OSError as error:
        raise AssetError(f"cannot write '{output}': {error.strerror}", key="-o") from None


def mesh_folder(output: Path) -> Path:
    """Return the folder of the meshes that belong to an MJCF."""
    return output.with_name(f"{output.stem}_meshes")


def _write_draft(robot: RobotDescription, report: Report, draft: Path, meshes: Path) -> None:
    notes = [f"{item.path}: {item.rule}: {item.value}" for item in report.assumptions]
    draft.write_text(Writer(robot, meshes.name, notes).text(), encoding="utf-8")
    for mesh in robot.meshes:
        if len(mesh.faces):
            meshes.mkdir(exist_ok=True)
            (meshes / file_name(mesh)).write_text(obj_text(mesh), encoding="utf-8")


def _publish_meshes(new: Path, target: Path, old: Path) -> None:
    """Put the new folder in the place of the old one, which may hold nothing but meshes."""
    if target.exists():
        foreign = [path.name for path in target.iterdir() if path.suffix != ".obj"]
        if foreign:
            raise AssetError(f"'{target}' holds other files, such as '{foreign[0]}'", key="-o", expected="meshes only")
        target.replace(old)
        shutil.rmtree(old)
    if new.exists():
        new.replace(target)

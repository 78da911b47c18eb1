"""Convert a robot's USD or URDF file to an MJCF file. A failed conversion leaves an older MJCF file unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import mujoco

from wheelleg_exp.asset.conversion_report import UNITS, Assumption, LeftOut, Report, size_problem
from wheelleg_exp.asset.file_limits import POINT_BYTES, bounded_memory, require_near
from wheelleg_exp.asset.mjcf.compile_mjcf import load, mujoco_warnings, verify, with_model_values
from wheelleg_exp.asset.mjcf.mjcf_document import Writer, file_name, obj_text
from wheelleg_exp.asset.report_writer import measure_sizes, values_of
from wheelleg_exp.asset.rigid_geometry import Frame
from wheelleg_exp.asset.robot_description import BaseMode, Body, Part, RobotDescription, depth_first
from wheelleg_exp.asset.urdf.urdf_robot import SUFFIXES as URDF
from wheelleg_exp.asset.urdf.urdf_robot import read_urdf
from wheelleg_exp.asset.usd.usd_robot import read_usd
from wheelleg_exp.asset.usd.usd_stage import SUFFIXES as USD
from wheelleg_exp.errors import AssetError
from wheelleg_exp.files import temporary_folder
from wheelleg_exp.machine import machine_memory, shown_bytes

MESHES = "_meshes"
_TRIALS = 64  # attributes that are left out on trial
_LIGHT = 1e-4  # A root link with at most 0.01 % of the robot's mass counts as massless.


@dataclass(frozen=True)
class Conversion:
    """Result of a conversion: the MJCF's path, the robot description, and the report."""

    output: Path
    description: RobotDescription
    report: Report


def convert(
    source: Path, output: Path, *, base: BaseMode = "auto", variants: Mapping[str, str] | None = None
) -> Conversion:
    """Convert a USD or URDF file to MJCF. The folder of the meshes is ``<output's stem>_meshes``.

    ``floating`` removes joints that fix the robot to the world, ``fixed`` the root's free joint, and ``auto`` neither;
    a URDF robot without a joint to the world floats. ``variants`` selects USD variants. An existing output is replaced.
    """
    source, output = Path(source), Path(output)
    try:
        str(output).encode()
        with suppress(FileNotFoundError):
            output.lstat()
        problem = _problem_of(source, output)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise AssetError(f"cannot write '{output}': {reason}", key="-o") from None
    if problem:
        raise AssetError(problem, key="-o", expected="a new name that ends in .xml")
    with mujoco_warnings() as logged, bounded_memory(source):
        robot, report = read(source, base, variants or {})
        for name in report.layers:
            if (source.resolve().parent / name).resolve().is_relative_to(mesh_folder(output).resolve()):
                raise AssetError(f"mesh files would overwrite the input '{name}'", key="-o", expected="another name")
        robot, report, model = _built(robot, report, output)
        sizes = [(item, size_problem(**item.numbers)) for item in measure_sizes(robot, model)]
    warnings = (*report.warnings, *(f"{text}; {UNITS}" for _, text in sizes if text), *dict.fromkeys(logged))
    findings = (*report.findings, *(item for item, text in sizes if text))
    return Conversion(output, robot, replace(report, values=values_of(robot), warnings=warnings, findings=findings))


def _built(robot: RobotDescription, report: Report, output: Path) -> tuple[RobotDescription, Report, mujoco.MjModel]:
    """Write a robot's MJCF without attributes that MuJoCo refuses; the returned report names these attributes."""
    try:
        driven = with_model_values(robot)
        return driven, report, write(driven, report, output)
    except AssetError as error:
        refusal = error.message
        parts: list[Part] = [*robot.bodies, *robot.dofs, *robot.geoms, *robot.closures, *robot.couplings]
        parts += [*robot.tendons, *robot.actuators, *robot.keyframes]
        found = [(part.name, part.path, part.extra) for part in parts]
        found += [(kind, report.root, getattr(robot, kind)) for kind in ("option", "flag", "compiler")]
        suspects = [(*part, key) for part in found for key in part[2] if "MuJoCo cannot build" in refusal]
        # MuJoCo's reason contains the name of the element or of the attribute.
        suspects.sort(key=lambda one: (f"'{one[0]}'" not in refusal, one[3] not in refusal))
        for name, path, extra, key in suspects[:_TRIALS]:
            value = extra.pop(key)
            try:
                write(with_model_values(robot), report, output)
            except AssetError as other:
                if other.message == refusal:
                    extra[key] = value
                    continue
            reason = f"MuJoCo refuses it: {refusal.partition(': ')[2]}"
            text = f"{path}: the attribute {key} = {value} of '{name}' was left out; {reason}"
            mapped = tuple(item for item in report.mapped if (item.path, item.became) != (path, key))
            left = (*report.left_out, LeftOut(key, reason, {path: str(value)}))
            without = replace(report, mapped=mapped, left_out=left, warnings=(*report.warnings, text))
            return _built(robot, without, output)
        raise


def read(source: Path, base: BaseMode, variants: Mapping[str, str]) -> tuple[RobotDescription, Report]:
    """Read a USD or URDF file into a robot description and a conversion report."""
    robot, report = read_urdf(source, base) if is_urdf(source, variants) else read_usd(source, base, variants)
    robot, report = _rooted_at_mass(robot, report)
    for body in robot.bodies:
        require_near((*body.pose.position, *body.inertial.center_of_mass), key=body.path, where=str(source))
        for dof in body.dofs:
            require_near(dof.anchor, key=dof.path, where=str(source))
    for geom in robot.geoms:
        require_near((*geom.pose.position, *geom.size), key=geom.path, where=str(source))
    points, available = sum(len(mesh.vertices) + len(mesh.faces) for mesh in robot.meshes), machine_memory()
    need = points * POINT_BYTES
    message = f"meshes with {points:,} points and triangles take about {shown_bytes(need)} of memory"
    if need > available:
        expected = f"less than the {shown_bytes(available)} of this machine: meshes with fewer triangles"
        raise AssetError(message, where=str(source), expected=expected)
    return robot, replace(report, warnings=(*report.warnings, f"{message}: simplify them")) if need > 2**30 else report


def _rooted_at_mass(robot: RobotDescription, report: Report) -> tuple[RobotDescription, Report]:
    """Make the first link with mass the robot's root, in place of nearly massless parents such as base_footprint.

    Tasks measure height, velocity, and tilt at the root link. No link moves: massless links are welded to the new root.
    """
    root = next(robot.children(None), None)
    least = _LIGHT * robot.mass
    if root is None or root.inertial.mass > least or not root.floating or robot.keyframes or any(root.velocity):
        return robot, report
    paths = [[root]]
    for path in paths:
        if path[-1].inertial.mass > least:
            break
        welded = (body for body in robot.children(path[-1].name) if not (body.dofs or body.floating or body.mocap))
        paths += [[*path, body] for body in welded]
    else:
        return robot, report
    frame, turned = Frame.of(root.pose), list[Body]()
    for body, child in pairwise(path):
        # The massless link becomes the child of its former child, so the relative pose of both is inverted.
        inside = Frame.of(child.pose)
        turned.append(replace(body, parent=child.name, floating=False, pose=inside.inverse().pose()))
        frame = frame @ inside
    turned.append(replace(path[-1], parent=None, floating=True, pose=frame.pose()))
    rule = "the root link has next to no mass: the first link with mass is the root"
    report = replace(report, assumptions=(*report.assumptions, Assumption(root.path, rule, path[-1].name)))
    unchanged = (body for body in robot.bodies if body not in path)
    bodies = depth_first((*reversed(turned), *unchanged), attrgetter("name"), attrgetter("parent"))
    return replace(robot, bodies=bodies), report


def is_urdf(source: Path, variants: Mapping[str, str]) -> bool:
    """Return true for a URDF file and false for a USD file, judged by the file's suffix."""
    suffix, where = source.suffix.lower(), str(source)
    if suffix in URDF:
        if variants:
            choice = "=".join(next(iter(variants.items())))
            raise AssetError("a URDF file has no variants", key=f"--variant {choice}", where=where)
        return True
    if suffix == ".xacro":
        message = f"'{source.name}' contains xacro macros, which this converter does not expand"
        raise AssetError(message, where=where, expected="a URDF: xacro IN -o OUT.urdf")
    if suffix in (".xml", ".mjcf"):
        message = f"'{source.name}' looks like an MJCF file, which this converter does not read"
        expected = "a USD: mujoco_usd_converter IN OUT (package mujoco-usd-converter, in its own environment)"
        raise AssetError(message, where=where, expected=expected)
    if suffix not in USD and source.is_file():
        raise AssetError(f"'{source.name}' is not a USD or URDF file", where=where, expected=", ".join((*USD, *URDF)))
    return False


def write(robot: RobotDescription, report: Report, output: Path) -> mujoco.MjModel:
    """Compile a robot's MJCF, compare the model with the robot description, and write the MJCF and the meshes."""
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(output) as folder:
            draft = folder / output.name
            meshes = mesh_folder(draft)
            draft.write_text(Writer(robot, meshes.name, report.assumptions).text(), encoding="utf-8")
            for mesh in robot.meshes:
                if len(mesh.faces):
                    meshes.mkdir(exist_ok=True)
                    (meshes / file_name(mesh)).write_text(obj_text(mesh), encoding="utf-8")
            model = load(draft, report.source)
            verify(model, robot, report.source)
            _publish(draft, output, folder / "old")
            return model
    except OSError as error:
        raise AssetError(f"cannot write '{output}': {error.strerror or error}", key="-o") from None


def mesh_folder(output: Path) -> Path:
    """Return the path of the folder that contains the mesh files of the MJCF file ``output``."""
    return output.with_name(output.stem + MESHES)


def _problem_of(source: Path, output: Path) -> str | None:
    if output.is_dir():
        return f"'{output}' is a folder"
    if output.suffix.lower() != ".xml":
        return f"'{output.name}' is not an MJCF file name"
    if output.exists() and source.exists() and output.samefile(source):
        return f"'{output}' is the source itself"
    folder = output.parent
    if folder.name.endswith(MESHES) and folder.with_name(folder.name.removesuffix(MESHES) + ".xml").exists():
        return f"'{folder}' contains the meshes of another MJCF"
    return None


def _publish(draft: Path, output: Path, old: Path) -> None:
    """Move a new MJCF and its meshes to the output path; after an error, restore the old MJCF and its meshes."""
    new, target = mesh_folder(draft), mesh_folder(output)
    text = output.read_text(encoding="utf-8", errors="replace") if target.exists() and output.is_file() else ""
    foreign = [path.name for path in target.iterdir() if f'file="{path.name}"' not in text] if target.exists() else []
    if foreign:
        message = f"'{target}' contains files other than the meshes of '{output.name}', such as '{foreign[0]}'"
        raise AssetError(message, key="-o", expected="another name, or move that folder away")
    try:
        if target.exists():
            target.replace(old)
        if new.exists():
            new.replace(target)
        draft.replace(output)
    except BaseException:
        # If the old MJCF file was not replaced, move the folder with the old file's meshes back to its place.
        if draft.exists() and old.exists():
            if target.exists():
                target.replace(new)
            old.replace(target)
        raise

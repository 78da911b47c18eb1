"""Groups joints that share gains and passive forces, so that a number stands once in the file."""

from __future__ import annotations

from collections.abc import Iterable

from wheelleg_exp.asset.description import Dof, Drive
from wheelleg_exp.asset.writer.xml import Value

VISUAL, COLLISION = "visual", "collision"


def joint_attributes(dof: Dof) -> dict[str, Value]:
    """Return what joints may share."""
    return {
        "stiffness": dof.stiffness or None,
        "damping": dof.damping or None,
        "armature": dof.armature or None,
        "frictionloss": dof.frictionloss or None,
        "actuatorfrcrange": dof.force_range,
    }


def drive_attributes(drive: Drive) -> dict[str, Value]:
    """Return what actuators may share; gains in N·m/rad and N·m·s/rad (N/m, N·s/m)."""
    return {
        "kp": drive.stiffness if drive.kind == "position" else None,
        "kv": drive.damping if drive.kind != "motor" and drive.damping > 0 else None,
        "forcerange": None if drive.effort is None else (-drive.effort, drive.effort),
    }


def _key(dof: Dof) -> tuple[object, ...]:
    drive = dof.drive
    gains = tuple(drive_attributes(drive).items()) if drive else ()
    return (dof.kind, drive.kind if drive else "", gains, tuple(joint_attributes(dof).items()))


def group(dofs: Iterable[Dof]) -> dict[str, list[Dof]]:
    """Return class names and their joints, for joints that have something in common with another one.

    A class is called after what its joints are: ``position_hinge``, ``velocity_hinge_2``.
    """
    shared: dict[tuple[object, ...], list[Dof]] = {}
    for dof in dofs:
        if any(v is not None for v in joint_attributes(dof).values()) or dof.drive:
            shared.setdefault(_key(dof), []).append(dof)
    out: dict[str, list[Dof]] = {}
    for members in shared.values():
        if len(members) < 2:
            continue
        drive = members[0].drive
        stem = f"{drive.kind if drive else 'passive'}_{members[0].kind}"
        name = stem if stem not in out else f"{stem}_{sum(key.startswith(stem) for key in out) + 1}"
        out[name] = members
    return out

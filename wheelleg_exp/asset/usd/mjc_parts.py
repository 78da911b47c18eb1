"""Read actuators, tendons, and keyframes of MuJoCo's USD schemas, with their attributes in MJCF's types.

``mjc_parts`` reads only authored attributes, not the default values of USD schemas. If a USD file has only one end of a
range, the other end is 0. A keyframe's arrays are in the order of the MuJoCo model from which the USD file was made.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pxr import Usd

from wheelleg_exp.asset import robot_description as desc
from wheelleg_exp.asset.usd.bodies.rigid_bodies import Links, named
from wheelleg_exp.asset.usd.colliders import is_site
from wheelleg_exp.asset.usd.gprims import shape_of
from wheelleg_exp.asset.usd.usd_stage import Stage

Names = Mapping[str, str]  # maps paths of USD prims to names of MJCF elements
Attribute = str | int | float | bool | tuple[float, ...]
EXACT = {"wind": 3, "magnetic": 3, "rgba": 4}  # required number of numbers
LONGEST = {  # largest number of numbers
    **dict.fromkeys(["solref", "solreflimit", "solreffriction", "o_solref", "springdamper", "springlength"], 2),
    **dict.fromkeys(["solimp", "solimplimit", "solimpfriction", "o_solimp", "o_friction"], 5),
    "gear": 6,
    **dict.fromkeys(["gainprm", "biasprm", "dynprm"], 10),
}
WORDS = {"cone": {"pyramidal", "elliptic"}}


def numbers(stage: Stage, prim: Usd.Prim, name: str, became: str) -> tuple[float, ...] | None:
    """Return the numbers of a USD array attribute; None if the array is empty or not authored."""
    value = stage.ledger.read(prim, name, became)
    found = None if value is None else tuple(float(v) for v in np.atleast_1d(value))
    return found if found and _fits(stage, prim, name, became, found) else None


def indices(stage: Stage, prim: Usd.Prim, name: str, became: str) -> list[int]:
    """Return the integers of a USD array attribute; [] if the array is not authored."""
    return [int(v) for v in numbers(stage, prim, name, became) or ()]


def attributes(stage: Stage, prim: Usd.Prim, names: Mapping[str, str]) -> dict[str, Attribute]:
    """Return a prim's authored, finite attributes for the MJCF; ``names`` maps USD names to MJCF names."""
    found: dict[str, Attribute] = {}
    for name, became in names.items():
        value = stage.ledger.read(prim, name, became)
        plain = None if value is None else _plain(value)
        if plain is not None and _fits(stage, prim, name, became, plain):
            found[became] = plain
    return found


def _fits(stage: Stage, prim: Usd.Prim, name: str, became: str, value: Attribute) -> bool:
    if isinstance(value, tuple) and len(value) != EXACT.get(became, len(value)):
        reason = f"MuJoCo's {became} has {EXACT[became]} numbers, not {len(value)}"
    elif isinstance(value, tuple) and len(value) > LONGEST.get(became, len(value)):
        reason = f"MuJoCo's {became} has {LONGEST[became]} numbers, not {len(value)}"
    elif isinstance(value, str) and value not in WORDS.get(became, {value}):
        reason = f"MuJoCo's {became} is one of {', '.join(sorted(WORDS[became]))}"
    else:
        return True
    stage.ledger.leave_and_warn(prim.GetPath(), name, reason, name, value)
    return False


def _plain(value: object) -> Attribute | None:
    if isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    array = tuple(np.asarray(value, dtype=float).tolist())
    return array if array and all(math.isfinite(v) for v in array) else None


def limits(stage: Stage, prim: Usd.Prim, stem: str, switch: str, became: str) -> dict[str, Attribute]:
    """Return a range such as ``mjc:ctrlRange`` and its switch as MJCF attributes: ``ctrlrange`` and ``ctrllimited``."""
    switched = became.removesuffix("range") + "limited"
    ends = [stage.ledger.read(prim, f"{stem}:{end}", became) for end in ("min", "max")]
    token = stage.ledger.read(prim, switch, switched) or "auto"
    found: dict[str, Attribute] = {}
    low, high = (0.0 if end is None else float(end) for end in ends)
    proper = low < high and math.isfinite(low) and math.isfinite(high)
    if proper:
        found[became] = (low, high)
    if token == "false" and proper:
        found[switched] = False
    elif token == "true" and not proper:
        stage.ledger.warn(f"{prim.GetPath()}: {switch} is true, but {stem} is not a range; unlimited")
    return found


def leave(stage: Stage, prim: Usd.Prim, name: str, reason: str) -> None:
    """Record that the MJCF omits a USD attribute, unless the attribute is already recorded."""
    value = stage.ledger.read(prim, name)
    if value is not None and not stage.ledger.knows(prim.GetPath(), name):
        stage.ledger.leave(prim.GetPath(), name, reason, value)


Transmission = Literal["joint", "jointinparent", "tendon", "site", "body", "cranksite"]
# MJCF transmissions and names, by prim path, of all elements that an actuator can drive
Targets = Mapping[str, tuple[Transmission, str]]
ACTUATOR = "MjcActuator"
TYPES = {  # MJCF's words
    "dynType": {"none", "integrator", "filter", "filterexact", "muscle", "user"},
    "gainType": {"fixed", "affine", "muscle", "user"},
    "biasType": {"none", "affine", "muscle", "user"},
}
_OF_ACTUATORS = "group actDim actEarly crankLength inheritRange"
ACTUATOR_ATTRIBUTES = {f"mjc:{name}": name.lower() for name in _OF_ACTUATORS.split()}


def read_actuators(stage: Stage, targets: Targets, ranged: set[str]) -> Iterator[desc.Actuator]:
    """Yield the actuators whose targets the MJCF contains; ``ranged`` names the joints and tendons with limits."""
    for prim, name in named(stage.of_type(ACTUATOR)):
        found = _actuator(stage, prim, name, targets, ranged)
        if isinstance(found, str):
            stage.ledger.leave_and_warn(prim.GetPath(), ACTUATOR, found, "this actuator")
        else:
            yield found


def _actuator(stage: Stage, prim: Usd.Prim, name: str, targets: Targets, ranged: set[str]) -> desc.Actuator | str:
    paths = [str(path) for path in stage.ledger.targets(prim, "mjc:target", f"actuator {name}")]
    if not paths or paths[0] not in targets:
        return "its target is not in the model"
    kinds = {key: stage.ledger.read(prim, f"mjc:{key}", key.lower()) for key in TYPES}
    strange = [f"{key} {kind}" for key, kind in kinds.items() if kind is not None and kind not in TYPES[key]]
    if strange:
        return f"MuJoCo has no {', '.join(strange)}"
    transmission, name_of_target = targets[paths[0]]
    extra: dict[str, Attribute] = {}
    if transmission == "site":
        for attribute, became in (("mjc:refSite", "refsite"), ("mjc:sliderSite", "slidersite")):
            for path in stage.ledger.targets(prim, attribute, became)[:1]:
                kind_of_target, site = targets.get(str(path), ("", ""))
                if kind_of_target != "site":
                    return "a site that it names is not in the model"
                extra[became] = site
        transmission = "cranksite" if "slidersite" in extra else "site"
    if transmission == "joint" and stage.ledger.read(prim, "mjc:jointInParent", "jointinparent"):
        transmission = "jointinparent"
    extra |= {key.lower(): kind for key, kind in kinds.items() if kind is not None}
    found: dict[str, Attribute] = {}
    for key in ("gear", "dynPrm", "gainPrm", "biasPrm"):
        if (values := numbers(stage, prim, f"mjc:{key}", key.lower())) is not None:
            last = max((i for i, v in enumerate(values) if v != 0.0), default=0)
            found[key.lower()] = values[: last + 1]
    for key in ("ctrl", "force", "act"):
        found |= limits(stage, prim, f"mjc:{key}Range", f"mjc:{key}Limited", f"{key}range")
    ends = [stage.ledger.read(prim, f"mjc:lengthRange:{end}", "lengthrange") for end in ("min", "max")]
    if any(end is not None for end in ends):
        found["lengthrange"] = tuple(float(end or 0.0) for end in ends)
    extra |= found | attributes(stage, prim, ACTUATOR_ATTRIBUTES)
    if extra.get("inheritrange") and name_of_target not in ranged:
        reason = f"{name_of_target} has no limits that the controls could inherit"
        inherited = extra.pop("inheritrange")
        stage.ledger.leave_and_warn(prim.GetPath(), "mjc:inheritRange", reason, "mjc:inheritRange", inherited)
    stage.ledger.mapped(prim.GetPath(), ACTUATOR, f"actuator {name}")
    return desc.Actuator(name, str(prim.GetPath()), transmission, name_of_target, extra)


TENDON = "MjcTendon"
_OF_TENDONS = """springlength stiffness damping frictionloss armature margin solreflimit solimplimit solreffriction
solimpfriction group"""
TENDON_ATTRIBUTES = {f"mjc:{name}": name for name in _OF_TENDONS.split()}
DRAWN = {"mjc:width": "width", "mjc:rgba": "rgba"}
OF_SPATIAL = (*DRAWN, "mjc:path:segments", "mjc:path:divisors", "mjc:sideSites:indices")


def read_tendons(stage: Stage, joints: Names, sites: Names, geoms: Names) -> Iterator[desc.Tendon]:
    """Yield the USD stage's tendons, except those with a site, geom, or joint that the MJCF lacks."""
    for prim, name in named(stage.of_type(TENDON)):
        fixed = stage.ledger.read(prim, "mjc:type", "fixed or spatial") == "fixed"
        try:
            factors = _factors(stage, prim, joints) if fixed else ()
            points = () if fixed else _points(stage, prim, sites, geoms)
        except _BrokenPath as error:
            stage.ledger.leave_and_warn(prim.GetPath(), TENDON, str(error), "this tendon")
            continue
        extra = attributes(stage, prim, TENDON_ATTRIBUTES | ({} if fixed else DRAWN))
        for other in OF_SPATIAL if fixed else ("mjc:path:coef",):
            leave(stage, prim, other, "only spatial tendons have it" if fixed else "only fixed tendons have it")
        bounds = limits(stage, prim, "mjc:range", "mjc:limited", "range")
        extra |= limits(stage, prim, "mjc:actuatorfrcrange", "mjc:actuatorfrclimited", "actuatorfrcrange")
        extra |= {key: value for key, value in bounds.items() if key != "range"}
        stage.ledger.mapped(prim.GetPath(), TENDON, f"tendon {name}")
        span = bounds.get("range")
        length = (span[0], span[1]) if isinstance(span, tuple) else None
        yield desc.Tendon(name, str(prim.GetPath()), points, factors, length, extra)


class _BrokenPath(Exception):
    """A tendon's path in the USD file is invalid."""


def _route(stage: Stage, prim: Usd.Prim) -> list[str]:
    targets = [str(path) for path in stage.ledger.targets(prim, "mjc:path", "the tendon's path")]
    order = indices(stage, prim, "mjc:path:indices", "the tendon's path") or list(range(len(targets)))
    if not order or not all(0 <= i < len(targets) for i in order):
        raise _BrokenPath("the tendon's path is empty, or 'mjc:path:indices' contains an index beyond the path's end")
    return [targets[i] for i in order]


def _factors(stage: Stage, prim: Usd.Prim, joints: Mapping[str, str]) -> tuple[tuple[str, float], ...]:
    route = _route(stage, prim)
    factors = numbers(stage, prim, "mjc:path:coef", "the tendon's coefficients") or ()
    if len(factors) != len(route):
        raise _BrokenPath(f"the tendon has {len(route)} joints, but {len(factors)} coefficients")
    missing = [path for path in route if path not in joints]
    if missing:
        raise _BrokenPath(f"the tendon's joint '{missing[0]}' is missing in the model")
    return tuple((joints[path], factor) for path, factor in zip(route, factors, strict=True))


def _points(stage: Stage, prim: Usd.Prim, sites: Names, geoms: Names) -> tuple[desc.TendonPoint, ...]:
    route = _route(stage, prim)
    segments = indices(stage, prim, "mjc:path:segments", "the tendon's pulleys") or [0] * len(route)
    divisors = numbers(stage, prim, "mjc:path:divisors", "the tendon's pulleys") or (1.0,)
    count = len(route)
    targets = [str(path) for path in stage.ledger.targets(prim, "mjc:sideSites", "the tendon's side sites")]
    order = indices(stage, prim, "mjc:sideSites:indices", "the tendon's side sites") or [-1] * count
    if len(order) != count or max(order) >= len(targets):
        raise _BrokenPath("the tendon's side sites do not match the tendon's path")
    missing = [path for path in targets if path not in sites]
    if missing:
        raise _BrokenPath(f"the tendon's site '{missing[0]}' is missing in the model")
    sides = [sites[targets[i]] if i >= 0 else None for i in order]
    if len(segments) != len(route) or max(segments) >= len(divisors):
        raise _BrokenPath("the tendon's segments do not match the tendon's path")
    points: list[desc.TendonPoint] = []
    current = 0
    for path, segment, side in zip(route, segments, sides, strict=True):
        # In an MJCF file, each new segment of a tendon starts with a pulley element, which has the segment's divisor.
        if segment != current or (not points and divisors[0] != 1.0):
            points.append(desc.TendonPoint("pulley", divisor=divisors[segment]))
        current = segment
        if path not in sites and path not in geoms:
            raise _BrokenPath(f"the tendon's site or geom '{path}' is missing in the model")
        points.append(
            desc.TendonPoint("site", sites[path]) if path in sites else desc.TendonPoint("geom", geoms[path], side)
        )
    return tuple(points)


WRAPPED = {"sphere", "cylinder"}


def with_wraps(stage: Stage, links: Links, robot: desc.RobotDescription) -> desc.RobotDescription:
    """Add a geom for each sphere or cylinder that a tendon wraps around, unless the robot already has this geom."""
    known = {geom.path for geom in robot.geoms}
    found: dict[str, Usd.Prim] = {}
    for tendon in stage.of_type(TENDON):
        for target in stage.ledger.targets(tendon, "mjc:path"):
            wrapped = stage.usd.GetPrimAtPath(target)
            if wrapped and not is_site(wrapped):
                found[str(target)] = wrapped
    prims = named([prim for prim in found.values() if str(prim.GetPath()) not in known])
    taken = desc.Numbered(geom.name for geom in robot.geoms)
    added: dict[str | None, list[desc.Geom]] = {}
    for prim, own_name in prims:
        link = links.owner(prim.GetPath())
        inside = link.frame.inverse().matrix() @ stage.matrix(prim) if link else stage.matrix(prim)
        shape = shape_of(prim, inside)
        if shape is None or shape.kind not in WRAPPED:
            continue
        path = str(prim.GetPath())
        name = taken.take(own_name)
        stage.ledger.mapped(path, str(prim.GetTypeName()), f"geom {name}, which tendons wrap around")
        geom = desc.Geom(name, path, shape.kind, shape.size, shape.frame.pose(), collides=False, drawn=False)
        added.setdefault(link.path if link else None, []).append(geom)
    if not added:
        return robot
    bodies = tuple(replace(b, geoms=(*b.geoms, *added[b.path])) if b.path in added else b for b in robot.bodies)
    return replace(robot, bodies=bodies, static_geoms=(*robot.static_geoms, *added.get(None, [])))


KEYFRAME = "MjcKeyframe"
KEYFRAME_ATTRIBUTES = {f"mjc:{name}": name for name in ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")}


def read_keyframes(stage: Stage, robot: desc.RobotDescription) -> Iterator[desc.Keyframe]:
    """Yield the keyframes whose arrays fit the robot's numbers of coordinates, velocities, and controls."""
    free = sum(body.floating for body in robot.bodies)
    balls = sum(dof.kind == "ball" for dof in robot.dofs)
    single = len(robot.dofs) - balls
    mocap = sum(body.mocap for body in robot.bodies)
    states = 0
    for actuator in robot.actuators:
        own = actuator.extra.get("actdim", -1)
        stateful = actuator.extra.get("dyntype", "none") != "none"
        states += own if isinstance(own, int) and own >= 0 else int(stateful)
    counts = {
        "qpos": 7 * free + 4 * balls + single,
        "qvel": 6 * free + 3 * balls + single,
        "ctrl": len(robot.actuators) + sum(dof.drive is not None for dof in robot.dofs),
        "act": states,
        "mpos": 3 * mocap,
        "mquat": 4 * mocap,
    }
    for prim, name in named(stage.of_type(KEYFRAME)):
        extra = attributes(stage, prim, KEYFRAME_ATTRIBUTES)
        sizes = {key: len(value) for key, value in extra.items() if isinstance(value, tuple)}
        wrong = next((key for key in counts if sizes.get(key, counts[key]) != counts[key]), None)
        if wrong is not None:
            reason = f"its {wrong} has {sizes[wrong]} numbers, the model {counts[wrong]}"
            stage.ledger.leave_and_warn(prim.GetPath(), KEYFRAME, reason, "this keyframe")
            continue
        stage.ledger.mapped(prim.GetPath(), KEYFRAME, f"keyframe {name}")
        yield desc.Keyframe(name, str(prim.GetPath()), extra)

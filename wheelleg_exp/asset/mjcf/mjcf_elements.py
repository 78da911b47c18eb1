"""MJCF elements: an XML tree that prints the same bytes for the same content, and the attributes of each robot part."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from xml.sax.saxutils import quoteattr

from wheelleg_exp.asset.robot_description import Actuator, Closure, Coupling, Dof, Drive, Geom, Pose, Quat, Tendon

Value = str | int | float | bool | Iterable[float] | None


@dataclass
class Element:
    """An XML element of an MJCF, with the ``comment`` before it; an attribute whose value is None is omitted."""

    tag: str
    attributes: dict[str, Value] = field(default_factory=dict)
    children: list[Element] = field(default_factory=list)
    comment: str = ""

    def add(self, tag: str, given: Mapping[str, Value] | None = None, **attributes: Value) -> Element:
        """Append a child element and return it; the argument ``class_`` sets the XML attribute ``class``."""
        named = {key.rstrip("_"): value for key, value in attributes.items()}
        child = Element(tag, {**named, **(given or {})})
        self.children.append(child)
        return child

    def text(self) -> str:
        """Return the XML element and its descendants, which can be nested to any depth, as indented text."""
        lines: list[str] = []
        stack: list[tuple[Element | str, int]] = [(self, 0)]
        while stack:
            item, depth = stack.pop()
            pad = "  " * depth
            if isinstance(item, str):
                lines.append(f"{pad}</{item}>")
                continue
            if item.comment:
                # An XML comment must not contain two hyphens in a row or end with a hyphen.
                safe = re.sub("-(?=-)|-$", "- ", item.comment)
                inner = [f"{pad}  {line}".rstrip() for line in safe.splitlines()]
                lines += [f"{pad}<!-- {safe} -->"] if len(inner) == 1 else [f"{pad}<!--", *inner, f"{pad}-->"]
            given = {key: value_text(value) for key, value in item.attributes.items() if value is not None}
            head = "".join(f" {key}={quoteattr(text)}" for key, text in given.items())
            lines.append(f"{pad}<{item.tag}{head}{'>' if item.children else '/>'}")
            if item.children:
                stack.append((item.tag, depth))
                stack.extend((child, depth + 1) for child in reversed(item.children))
        return "\n".join(lines)

    def depth(self) -> int:
        """Return the number of levels from this XML element down to the deepest descendant."""
        deepest, level = 0, [self]
        while level:
            deepest += 1
            level = [child for element in level for child in element.children]
        return deepest


def value_text(value: Value) -> str:
    """Return an attribute's text: shortest lossless floats, sequences separated by spaces."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return number(value)
    if isinstance(value, (str, int)) or value is None:
        return str(value)
    return " ".join(number(float(v)) for v in value)


def number(value: float) -> str:
    """Return the shortest text of a number that is read back as the same number."""
    return str(int(value)) if math.isfinite(value) and abs(value) < 1e15 and value == int(value) else repr(value)


IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
GREY = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's default colour of a geom without material is grey.
GROUP_VISUAL, GROUP_COLLIDER = 2, 3  # By default, MuJoCo's viewer shows only geoms of groups 0 to 2.

Attributes = dict[str, Value]
PLAIN: Attributes = {  # MuJoCo's default values; the MJCF file omits attributes with these values.
    **dict.fromkeys(("solref", "solreflimit", "solreffriction"), (0.02, 1.0)),
    **dict.fromkeys(("solimp", "solimplimit", "solimpfriction"), (0.9, 0.95, 0.001, 0.5, 2.0)),
    **dict.fromkeys(("margin", "gap", "stiffness", "damping", "armature", "frictionloss"), 0.0),
    **{"condim": 3, "priority": 0, "solmix": 1.0},
}


def pose(at: Pose) -> Attributes:
    """Return the MJCF attributes ``pos`` and ``quat`` of a pose; None stands for a zero position or rotation."""
    return {"pos": at.position if any(at.position) else None, "quat": None if at.rotation == IDENTITY else at.rotation}


def given(attributes: Attributes) -> Attributes:
    """Return the attributes without those that are None or have MuJoCo's default value."""
    return {k: v for k, v in attributes.items() if v is not None and (k not in PLAIN or v != PLAIN[k])}


def joint(dof: Dof) -> Attributes:
    """Return the MJCF attributes that several joints can share: passive forces and constraint parameters."""
    own: Attributes = {
        "stiffness": dof.stiffness or None,
        "damping": dof.damping or None,
        "armature": dof.armature or None,
        "frictionloss": dof.frictionloss or None,
        "actuatorfrcrange": dof.force_range,
    }
    return given({**own, **dof.extra})


def drive(of: Drive) -> Attributes:
    """Return the MJCF attributes that several actuators can share; gains are in N·m/rad and N·m·s/rad (N/m, N·s/m)."""
    return given(
        {
            "kp": of.stiffness if of.kind == "position" else None,
            "kv": of.damping if of.kind != "motor" and of.damping > 0 else None,
            "forcerange": None if of.effort is None else (-of.effort, of.effort),
        }
    )


def actuator(item: Actuator) -> Attributes:
    """Return a general actuator's MJCF attributes, except the site names ``refsite`` and ``slidersite``."""
    return {key: value for key, value in item.extra.items() if key not in ("refsite", "slidersite")}


def tendon(item: Tendon) -> Attributes:
    """Return the MJCF attributes of a tendon's springs, limits, and colour."""
    return given({"range": item.range, **item.extra})


def key(item: Closure | Coupling) -> str:
    """Return a unique key of a MuJoCo equality, because a loop closure and a joint coupling can have the same name."""
    return item.name if isinstance(item, Closure) else f"{item.name} (coupling)"


def equality(item: Closure | Coupling) -> Attributes:
    """Return a MuJoCo equality constraint's MJCF attributes ``solref``, ``solimp``, and ``active``."""
    return given({k: v for k, v in item.extra.items() if k in ("solref", "solimp", "active")})


def geom(item: Geom, static: bool = False) -> Attributes:
    """Return the MJCF attributes of a geom; a collider of the world body stays in MuJoCo's default ``group``."""
    group = GROUP_VISUAL if not item.collides or item.drawn else GROUP_COLLIDER
    plain = GREY if item.collides and item.drawn and not static else None
    own: Attributes = {
        "type": item.kind,
        "group": None if static and item.collides else group,
        "material": item.material,
        "rgba": item.rgba or plain,
        "friction": None if item.friction is None else (item.friction,),
    }
    return given({**own, **item.extra})

"""Attributes of MJCF elements: what each part of a robot says of itself, apart from names and places."""

from __future__ import annotations

from wheelleg_exp.asset.description import Actuator, Closure, Coupling, Dof, Drive, Geom, Pose, Quat, Site, Tendon
from wheelleg_exp.asset.mjcf.xml import Value

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
GREY = (0.5, 0.5, 0.5, 1.0)  # the colour that lets a material's show
GROUP_VISUAL, GROUP_COLLIDER = 2, 3  # MuJoCo shows groups 0 to 2 unless told otherwise

Attributes = dict[str, Value]
PLAIN: Attributes = {  # MuJoCo's own defaults, which need not be written
    "solref": (0.02, 1.0),
    "solimp": (0.9, 0.95, 0.001, 0.5, 2.0),
    "solreflimit": (0.02, 1.0),
    "solimplimit": (0.9, 0.95, 0.001, 0.5, 2.0),
    "solreffriction": (0.02, 1.0),
    "solimpfriction": (0.9, 0.95, 0.001, 0.5, 2.0),
    "condim": 3,
    "priority": 0,
    "solmix": 1.0,
    "margin": 0.0,
    "gap": 0.0,
    "stiffness": 0.0,
    "damping": 0.0,
    "armature": 0.0,
    "frictionloss": 0.0,
}


def pose(at: Pose) -> Attributes:
    """Return position and rotation where they are not zero."""
    return {
        "pos": at.position if any(at.position) else None,
        "quat": None if at.rotation == IDENTITY else at.rotation,
    }


def given(attributes: Attributes) -> Attributes:
    """Return the attributes that have a value other than MuJoCo's own default."""
    return {k: v for k, v in attributes.items() if v is not None and (k not in PLAIN or v != PLAIN[k])}


def joint(dof: Dof) -> Attributes:
    """Return what joints may share: passive forces and the parameters of their constraints."""
    own: Attributes = {
        "stiffness": dof.stiffness or None,
        "damping": dof.damping or None,
        "armature": dof.armature or None,
        "frictionloss": dof.frictionloss or None,
        "actuatorfrcrange": dof.force_range,
    }
    return given({**own, **dof.extra})


def drive(of: Drive) -> Attributes:
    """Return what actuators may share; gains in N·m/rad and N·m·s/rad (N/m, N·s/m)."""
    return given(
        {
            "kp": of.stiffness if of.kind == "position" else None,
            "kv": of.damping if of.kind != "motor" and of.damping > 0 else None,
            "forcerange": None if of.effort is None else (-of.effort, of.effort),
        }
    )


def actuator(item: Actuator) -> Attributes:
    """Return the parameters of a general actuator; sites that belong to its target are not shared."""
    return {key: value for key, value in item.extra.items() if key not in ("refsite", "slidersite")}


def tendon(item: Tendon) -> Attributes:
    """Return a tendon's springs, limits and looks."""
    return given({"range": item.range, **item.extra})


def key(item: Closure | Coupling) -> str:
    """Return what tells a closure from a coupling of the same name."""
    return item.name if isinstance(item, Closure) else f"{item.name} (coupling)"


def equality(item: Closure | Coupling) -> Attributes:
    """Return the parameters of an equality's constraint."""
    return given({k: v for k, v in item.extra.items() if k in ("solref", "solimp", "active")})


def site(item: Site) -> Attributes:
    """Return how a site looks."""
    return dict(item.extra)


def geom(item: Geom, static: bool = False) -> Attributes:
    """Return a shape's kind, looks and contact parameters. Of static shapes nothing is shared."""
    group = GROUP_VISUAL if not item.collides or item.drawn else GROUP_COLLIDER
    plain = GREY if item.collides and item.drawn and not static else None  # not the colour of hidden colliders
    own: Attributes = {
        "type": item.kind,
        "group": None if static and item.collides else group,
        "material": item.material,
        "rgba": item.rgba or plain,
        "friction": None if item.friction is None else (item.friction,),
    }
    return given({**own, **item.extra})

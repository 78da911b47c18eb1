"""Names every element and attribute of a URDF that nothing was made of."""

from __future__ import annotations

from wheelleg_exp.asset.urdf.document import Document
from wheelleg_exp.asset.urdf.xml import Element

READ = {  # what a kind of element may hold; everything else is left as a whole
    "robot": {"link", "joint", "material", "mujoco"},
    "link": {"inertial", "visual", "collision"},
    "inertial": {"origin", "mass", "inertia"},
    "visual": {"origin", "geometry", "material"},
    "collision": {"origin", "geometry"},
    "geometry": {"box", "sphere", "cylinder", "capsule", "mesh"},
    "material": {"color"},
    "joint": {"origin", "axis", "parent", "child", "limit", "dynamics", "mimic"},
    "mujoco": {"compiler"},
}

REASONS = {  # by the element's tag
    "gazebo": "settings of Gazebo",
    "transmission": "names of hardware; what drives a joint comes from the task's configuration",
    "ros2_control": "names of hardware; what drives a joint comes from the task's configuration",
    "sensor": "sensors are not read; observations come from the task's configuration",
    "safety_controller": "soft limits of a hardware's controller",
    "calibration": "the calibration of a hardware's encoder",
    "contact": "PyBullet's contact parameters; bodies keep MuJoCo's friction",
    "texture": "textures are not read",
    "specular": "only colours are read",
    "material": "colliders are drawn in one colour",
    "joint_properties": "an old spelling of <dynamics>, which other readers pass over too",
    "option": "settings of MuJoCo; the conversion has its own",
    "size": "settings of MuJoCo; the conversion has its own",
}

ATTRIBUTES = {  # by tag and name
    ("limit", "lower"): "a joint of this kind has no limits",
    ("limit", "upper"): "a joint of this kind has no limits",
    ("limit", "effort"): "a joint of this kind has no effort limit in the model",
    ("limit", "velocity"): "a joint of this kind has no velocity limit in the model",
    ("axis", "xyz"): "a joint of this kind has no axis",
    ("axis", "rpy"): "an axis is a direction",
    ("robot", "version"): "the version of the format",
}


def audit(document: Document) -> None:
    """Name what nothing read."""
    document.ledger.mapped(document.root.path, "name", "model name")
    _visit(document, document.root)


def _visit(document: Document, element: Element) -> None:
    for name, value in element.attributes.items():
        if not name.startswith("xmlns") and not document.ledger.knows(element.path, name):
            reason = ATTRIBUTES.get((element.tag, name), "not supported here")
            document.ledger.leave(element.path, name, reason, value)
    known = READ.get(element.tag, set())
    for child in element.children:
        if child.tag in known:
            _visit(document, child)
        else:
            reason = REASONS.get(child.tag, "no part of URDF that is read here")
            document.ledger.leave(child.path, child.tag, reason, summary(child))


def summary(element: Element) -> str:
    """Return what an element holds, on one line and not too long."""
    found = []
    for item in element.walk():
        found += [f"{item.tag} {name}={value}" for name, value in item.attributes.items()]
        found += [f"{item.tag} {text}"] if (text := " ".join(item.text.split())) else []
    return ", ".join(found)[:200]

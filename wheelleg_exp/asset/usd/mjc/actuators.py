"""Reads MjcActuator prims: what they act on, and the parameters of MuJoCo's general actuator."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from pxr import Usd

from wheelleg_exp.asset.description import Actuator
from wheelleg_exp.asset.naming import unique_names
from wheelleg_exp.asset.usd.bodies.rigid_bodies import shown_names
from wheelleg_exp.asset.usd.mjc.values import Attribute, attributes, limits, numbers
from wheelleg_exp.asset.usd.stage import Stage

Transmission = Literal["joint", "jointinparent", "tendon", "site", "body", "cranksite"]
KIND = "MjcActuator"
TYPES = {  # what MuJoCo knows, and how MJCF writes it
    "dynType": {"none", "integrator", "filter", "filterexact", "muscle", "user"},
    "gainType": {"fixed", "affine", "muscle", "user"},
    "biasType": {"none", "affine", "muscle", "user"},
}
PLAIN = {
    "mjc:group": "group",
    "mjc:actDim": "actdim",
    "mjc:actEarly": "actearly",
    "mjc:crankLength": "cranklength",
    "mjc:inheritRange": "inheritrange",
}


@dataclass(frozen=True)
class Targets:
    """Names in the model by prim path of what an actuator may act on; ``ranged`` of them have limits."""

    ranged: set[str] = field(default_factory=set)
    joints: dict[str, str] = field(default_factory=dict)
    tendons: dict[str, str] = field(default_factory=dict)
    sites: dict[str, str] = field(default_factory=dict)
    bodies: dict[str, str] = field(default_factory=dict)

    def find(self, path: str) -> tuple[Transmission, str] | None:
        """Return the kind and the name of what is at ``path``."""
        kinds: tuple[tuple[Transmission, dict[str, str]], ...] = (
            ("joint", self.joints),
            ("tendon", self.tendons),
            ("site", self.sites),
            ("body", self.bodies),
        )
        return next(((kind, names[path]) for kind, names in kinds if path in names), None)


def read_actuators(stage: Stage, targets: Targets) -> tuple[Actuator, ...]:
    """Return the actuators whose target is in the model, in the order of the stage."""
    prims = [prim for prim in stage.prims if prim.GetTypeName() == KIND]
    names = unique_names([str(prim.GetPath()) for prim in prims], shown_names(prims))
    found = (_actuator(stage, prim, names[str(prim.GetPath())], targets) for prim in prims)
    return tuple(actuator for actuator in found if actuator is not None)


def _actuator(stage: Stage, prim: Usd.Prim, name: str, targets: Targets) -> Actuator | None:
    paths = [str(path) for path in stage.ledger.targets(prim, "mjc:target", f"actuator {name}")]
    target = targets.find(paths[0]) if paths else None
    if target is None:
        _leave(stage, prim, "it acts on nothing that is in the model")
        return None
    kinds = {key: stage.ledger.read(prim, f"mjc:{key}", key.lower()) for key in TYPES}
    strange = [f"{key} {kind}" for key, kind in kinds.items() if kind is not None and kind not in TYPES[key]]
    if strange:
        _leave(stage, prim, f"MuJoCo has no {', '.join(strange)}")
        return None
    transmission, name_of_target = target
    extra: dict[str, Attribute] = {}
    if transmission == "site":
        sites = _sites(stage, prim, targets)
        if sites is None:
            _leave(stage, prim, "a site that it names is not in the model")
            return None
        extra |= sites
        transmission = "cranksite" if "slidersite" in sites else "site"
    if transmission == "joint" and stage.ledger.read(prim, "mjc:jointInParent", "jointinparent"):
        transmission = "jointinparent"
    extra |= {key.lower(): kind for key, kind in kinds.items() if kind is not None}
    extra |= _parameters(stage, prim)
    if extra.get("inheritrange") and name_of_target not in targets.ranged:
        reason = f"{name_of_target} has no limits that the controls could inherit"
        stage.ledger.leave(prim.GetPath(), "mjc:inheritRange", reason, extra.pop("inheritrange"))
        stage.ledger.warn(f"{prim.GetPath()}: mjc:inheritRange was left out: {reason}")
    stage.ledger.mapped(prim.GetPath(), KIND, f"actuator {name}")
    return Actuator(name, str(prim.GetPath()), transmission, name_of_target, extra)


def _leave(stage: Stage, prim: Usd.Prim, reason: str) -> None:
    stage.ledger.leave(prim.GetPath(), KIND, reason)
    stage.ledger.warn(f"{prim.GetPath()}: this actuator was left out: {reason}")


def _sites(stage: Stage, prim: Usd.Prim, targets: Targets) -> dict[str, Attribute] | None:
    """Return the further sites of an actuator, None when one of them is not in the model."""
    found: dict[str, Attribute] = {}
    for name, became in (("mjc:refSite", "refsite"), ("mjc:sliderSite", "slidersite")):
        for path in stage.ledger.targets(prim, name, became)[:1]:
            if str(path) not in targets.sites:
                return None
            found[became] = targets.sites[str(path)]
    return found


def _parameters(stage: Stage, prim: Usd.Prim) -> dict[str, Attribute]:
    found: dict[str, Attribute] = {}
    for key in ("gear", "dynPrm", "gainPrm", "biasPrm"):
        if (values := numbers(stage, prim, f"mjc:{key}", key.lower())) is not None:
            found[key.lower()] = _without_zeros(values)
    for key in ("ctrl", "force", "act"):
        found |= limits(stage, prim, f"mjc:{key}Range", f"mjc:{key}Limited", f"{key}range")
    ends = [stage.ledger.read(prim, f"mjc:lengthRange:{end}", "lengthrange") for end in ("min", "max")]
    if any(end is not None for end in ends):
        found["lengthrange"] = tuple(float(end or 0.0) for end in ends)
    return found | attributes(stage, prim, PLAIN)


def _without_zeros(values: tuple[float, ...]) -> tuple[float, ...]:
    """Return the array without the zeros at its end, which MuJoCo adds again; one number stays."""
    last = max((i for i, v in enumerate(values) if v != 0.0), default=0)
    return values[: last + 1]

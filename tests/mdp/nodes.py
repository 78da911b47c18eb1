from __future__ import annotations

from typing import Any

MDP = "wheelleg_exp.mdp."


def event(name: str, mode: str = "startup", **fields: Any) -> dict[str, Any]:
    return {"_target_": f"{MDP}events.{name}", "mode": mode, **fields}


def _entity(**names: Any) -> dict[str, Any]:
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", **names}


def bodies(*names: str) -> dict[str, Any]:
    return _entity(body_names=list(names))


def joints(*names: str) -> dict[str, Any]:
    return _entity(joint_names=list(names))

"""How one frame of an observation turns in a mirror, by its rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.rl.symmetry import rules, sensed
from wheelleg_exp.rl.symmetry.bodies import BodyImages

# Where each number of an image comes from, and its sign.
Turned = list[tuple[int, float]]
Rule = str | Sequence[float]
_SAME = 1e-6  # of a cycle


class Turning:
    """Knows of each rule what it makes of a term.

    Args:
        env: the environment.
        joint_images: the index of each joint's image.
        joint_signs: the sign with which it moves.
        action: how the action vector turns.
    """

    def __init__(
        self, env: ManagerBasedRLEnv, joint_images: Sequence[int], joint_signs: Sequence[float], action: Turned
    ) -> None:
        self._env, self._images, self._signs, self._action = env, list(joint_images), list(joint_signs), action
        robot = env.scene.robot
        self._bodies = BodyImages(env.scene.model, robot.body_names, robot.joint_names, joint_images)

    def frame(self, rule: Rule, term: ObservationTerm) -> Turned:
        """Return where each number of a frame's image comes from, and its sign."""
        path = term.term.path
        if not isinstance(rule, str):
            return [(i, float(sign)) for i, sign in enumerate(rule)]
        if rule in rules.SIGNS:
            return [(i, float(sign)) for i, sign in enumerate(rules.SIGNS[rule])]
        if rule == "invariant":
            return [(i, 1.0) for i in range(term.width)]
        if rule == "phases":
            return self._phases(term, path)
        if rule == "actions":
            return self._action_of(term)
        if rule in rules.OF_BODIES:
            return self._bodies_of(rule, term, path)
        if rule == "rays":
            return sensed.rays(self._sensor(term, "sensor_cfg"), self._bodies, path)
        if rule in rules.OF_IMUS:
            return sensed.imu(self._sensor(term, "asset_cfg"), rules.OF_IMUS[rule], self._bodies, path)
        joints = self._joints_of(term, path)
        if rule == "joints_sin_cos":
            return joints + [(len(joints) + source, 1.0) for source, _ in joints]
        return joints

    def command(self, term: ObservationTerm) -> str | None:
        """Return the rule of the command that a term shows."""
        found: Any = self._env.command_manager.get_term(str(term.term.params["command_name"]))
        if hasattr(found, "body_name"):
            key = f"env.commands.{term.term.params['command_name']}.body_name"
            image = self._bodies.image(found.body_name, key, with_axes=True)
            if image != found.body_name:
                message = f"the image of a pose of '{found.body_name}' is one of '{image}'"
                raise ConfigError(message, key=key, expected="a body in the middle of the robot")
        names = (kind.__name__ for kind in type(found).__mro__)
        return next((rules.OF_COMMANDS[name] for name in names if name in rules.OF_COMMANDS), None)

    def _sensor(self, term: ObservationTerm, parameter: str) -> Any:
        return self._env.scene[self._entity(term, parameter).name]

    def _entity(self, term: ObservationTerm, parameter: str) -> Any:
        found = term.term.params.get(parameter)
        if found is None:
            raise ConfigError(f"has no {parameter}", key=term.term.path, expected="a parameter that names the sensor")
        return found

    def _phases(self, term: ObservationTerm, path: str) -> Turned:
        """Return the clock half a cycle later, if that lets the legs of both sides change their parts."""
        offsets = [float(offset) % 1.0 for offset in term.term.params.get("offsets", (0.0,))]
        for offset in offsets:
            apart = [abs((offset + 0.5 - other + 0.5) % 1.0 - 0.5) for other in offsets]
            if min(apart) > _SAME:
                raise ConfigError(
                    f"the clock at {offset:g} of the cycle has none half a cycle later",
                    key=f"{path}.offsets",
                    expected="offsets of both sides, such as [0.0, 0.5]; or agent.symmetry.terms with 'invariant' for"
                    " legs that move together, or a list of a sign for each number",
                )
        return [(i, -1.0) for i in range(term.width)]

    def _bodies_of(self, rule: str, term: ObservationTerm, path: str) -> Turned:
        signs, parameter, with_axes = rules.OF_BODIES[rule]
        entity = self._entity(term, parameter)
        owner = self._env.scene[entity.name]
        names = _chosen(entity.body_ids, owner.body_names)
        found: Turned = []
        for name in names:
            image = self._bodies.image(name, path, with_axes=with_axes)
            if image not in names:
                raise ConfigError(
                    f"'{name}' is observed, and its image '{image}' is not", key=path, expected="bodies of both sides"
                )
            first = names.index(image) * len(signs)
            found += [(first + i, float(sign)) for i, sign in enumerate(signs)]
        return found

    def _joints_of(self, term: ObservationTerm, path: str) -> Turned:
        entity = term.term.params.get("asset_cfg")
        names = self._env.scene.robot.joint_names
        ids = _chosen(getattr(entity, "joint_ids", slice(None)), list(range(len(names))))
        for joint in ids:
            if self._images[joint] not in ids:
                raise ConfigError(
                    f"'{names[joint]}' is observed, and its image '{names[self._images[joint]]}' is not",
                    key=path,
                    expected="joints of both sides",
                )
        return [(ids.index(self._images[joint]), self._signs[joint]) for joint in ids]

    def _action_of(self, term: ObservationTerm) -> Turned:
        """Return how the last action turns, of the whole vector or of one term's part."""
        manager, name = self._env.action_manager, term.term.params.get("action_name")
        if name is None:
            return self._action
        start = sum(manager.action_term_dim[: manager.active_terms.index(name)])
        part = self._action[start : start + manager.get_term(name).action_dim]
        return [(source - start, sign) for source, sign in part]


def _chosen(ids: Any, every: list[Any]) -> list[Any]:
    return every[ids] if isinstance(ids, slice) else [every[int(i)] for i in ids]

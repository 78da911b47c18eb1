"""Chains from the base to the wheels, and what closes loops beside them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import mujoco

from wheelleg_exp.lint.anatomy.parts import Leg
from wheelleg_exp.lint.anatomy.tree import Tree

_HOLDS = {int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)}
_BODY = int(mujoco.mjtObj.mjOBJ_BODY)


def find_legs(tree: Tree, wheels: Sequence[int], driven: Collection[int]) -> list[Leg]:
    """Return the leg of each wheel.

    Args:
        tree: the robot.
        wheels: the joints that wheels turn on.
        driven: the joints that something drives.
    """
    model = tree.model
    chains = {wheel: tree.chain(int(model.jnt_bodyid[wheel]))[:-1] for wheel in wheels}
    on_chains = {joint for chain in chains.values() for joint in chain} | set(wheels)
    closures = _closures(tree)
    limbs = _limbs(tree, [pair for _, pair in closures])
    legs = []
    for wheel, chain in chains.items():
        limb = limbs.get(int(model.jnt_bodyid[wheel]), set())
        beside = [joint for joint in tree.joints if int(model.jnt_bodyid[joint]) in limb and joint not in on_chains]
        legs.append(
            Leg(
                wheel=tree.joint_name(wheel),
                joints=tuple(map(tree.joint_name, chain)),
                passive=tuple(tree.joint_name(joint) for joint in chain if joint not in driven),
                beside=tuple(map(tree.joint_name, beside)),
                loops=tuple(name for name, pair in closures if limb & set(pair)),
            )
        )
    return legs


def _closures(tree: Tree) -> list[tuple[str, tuple[int, int]]]:
    """Return the equality constraints that hold two bodies of the robot together: name, bodies."""
    model, found = tree.model, []
    for index in range(model.neq):
        if int(model.eq_type[index]) not in _HOLDS:
            continue
        pair = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        if model.eq_objtype[index] != _BODY:
            pair = int(model.site_bodyid[pair[0]]), int(model.site_bodyid[pair[1]])
        if set(pair) <= set(tree.bodies):
            found.append((mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, index) or f"#{index}", pair))
    return found


def _limbs(tree: Tree, closures: Sequence[tuple[int, int]]) -> dict[int, set[int]]:
    """Return, for each body that is not fixed to the base, the bodies that hang together without the base."""
    fixed = set(tree.fixed_to(tree.base))
    limbs = {body: {body} for body in tree.bodies if body not in fixed}
    links = [(body, int(tree.model.body_parentid[body])) for body in limbs]
    for one, other in [*links, *closures]:
        if one in limbs and other in limbs and limbs[one] is not limbs[other]:
            limbs[one] |= limbs[other]
            for body in limbs[other]:
                limbs[body] = limbs[one]
    return limbs

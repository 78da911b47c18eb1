"""Compare two MuJoCo models: match parts by name, copy the state, and compute relative differences."""

from __future__ import annotations

import mujoco
import numpy as np

from ..small_urdf import mass_matrix
from ..small_usd import tensor

Obj = mujoco.mjtObj
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
WIDTHS = {FREE: (7, 6), BALL: (4, 3)}


def name_of(model: mujoco.MjModel, kind: Obj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or ""


def difference(first: np.ndarray, second: np.ndarray, floor: float = 1e-9) -> float:
    first, second = np.asarray(first, float), np.asarray(second, float)
    return float(np.abs(first - second).max() / max(np.abs(first).max(), floor)) if first.size else 0.0


def converged(model: mujoco.MjModel) -> mujoco.MjModel:
    option = model.opt
    option.solver, option.iterations, option.ls_iterations = int(mujoco.mjtSolver.mjSOL_NEWTON), 500, 200
    option.tolerance, option.ls_tolerance, option.timestep = 1e-14, 1e-8, 0.002
    option.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


class Pair:
    def __init__(self, original: mujoco.MjModel, ours: mujoco.MjModel) -> None:
        self.original, self.ours = converged(original), converged(ours)
        self.bodies = self._matched(Obj.mjOBJ_BODY, original.nbody, first=1)
        self.actuators = self._matched(Obj.mjOBJ_ACTUATOR, original.nu)
        self.tendons = self._matched(Obj.mjOBJ_TENDON, original.ntendon)
        self.joints = [self._joint(index) for index in range(original.njnt)]
        self.positions, self.velocities = self._coordinates()
        self.data = mujoco.MjData(original), mujoco.MjData(ours)

    def _matched(self, kind: Obj, count: int, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        pairs = []
        for index in range(first, count):
            if name := name_of(self.original, kind, index):
                other = mujoco.mj_name2id(self.ours, kind, name)
                assert other >= 0, f"{name} did not come back"
                pairs.append((index, other))
        ids = np.array(pairs, int).reshape(-1, 2)
        return ids[:, 0], ids[:, 1]

    def _joint(self, index: int) -> int:
        original, ours = self.original, self.ours
        name = name_of(original, Obj.mjOBJ_JOINT, index)
        found = mujoco.mj_name2id(ours, Obj.mjOBJ_JOINT, name) if name else -1
        if found < 0:
            body = original.jnt_bodyid[index]
            other = ours.body(name_of(original, Obj.mjOBJ_BODY, body)).id
            found = ours.body_jntadr[other] + index - original.body_jntadr[body]
        assert original.jnt_type[index] == ours.jnt_type[found]
        return int(found)

    def _coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        original, ours = self.original, self.ours
        positions, velocities = np.zeros(original.nq, int), np.zeros(original.nv, int)
        for index, other in enumerate(self.joints):
            width, speed = WIDTHS.get(int(original.jnt_type[index]), (1, 1))
            at, to = original.jnt_qposadr[index], ours.jnt_qposadr[other]
            positions[at : at + width] = np.arange(to, to + width)
            at, to = original.jnt_dofadr[index], ours.jnt_dofadr[other]
            velocities[at : at + speed] = np.arange(to, to + speed)
        return positions, velocities

    def draw(self, random: np.random.Generator) -> None:
        model = self.original
        qpos = np.array(model.qpos0)
        for index in range(model.njnt):
            at, kind = model.jnt_qposadr[index], int(model.jnt_type[index])
            if kind in WIDTHS:
                turn = slice(at + 3, at + 7) if kind == FREE else slice(at, at + 4)
                qpos[turn] = random.normal(size=4) + np.array([2.0, 0, 0, 0])
                qpos[turn] /= np.linalg.norm(qpos[turn])
            else:
                low, high = model.jnt_range[index] if model.jnt_limited[index] else (-1.0, 1.0)
                qpos[at] = random.uniform(low, high)
        ranges = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0])
        qvel, ctrl = random.normal(size=model.nv), random.uniform(ranges[:, 0], ranges[:, 1])
        first, second = self.data
        mujoco.mj_resetData(self.original, first)
        mujoco.mj_resetData(self.ours, second)
        first.qpos[:], first.qvel[:], first.ctrl[:] = qpos, qvel, ctrl
        second.qpos[self.positions], second.qvel[self.velocities] = qpos, qvel
        second.ctrl[self.actuators[1]] = ctrl[self.actuators[0]]
        mujoco.mj_forward(self.original, first)
        mujoco.mj_forward(self.ours, second)

    def masses(self) -> tuple[np.ndarray, np.ndarray]:
        theirs, ours = (mass_matrix(*pair) for pair in zip((self.original, self.ours), self.data, strict=True))
        return theirs, ours[np.ix_(self.velocities, self.velocities)]

    def tensors(self) -> tuple[np.ndarray, np.ndarray]:
        pairs = zip((self.original, self.ours), self.bodies, strict=True)
        theirs, ours = (np.array([tensor(model, body) for body in bodies]) for model, bodies in pairs)
        return theirs, ours

"""Record episodes in the training's simulation, and compare each policy file of a bundle with the recorded actions.

The policy files get the recorded observations as inputs, because in a closed loop rounding errors would grow.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from onnx.reference import ReferenceEvaluator
from tensordict import TensorDict

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.exported_observations import reading
from wheelleg_exp.managers.non_finite import require_finite_actions
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.user_exceptions import ending_as

READING = "reading:"


@ending_as(SimulationFailure)
@torch.inference_mode()
def recorded_episodes(
    adapter: RslRlVecEnv,
    policy: Callable[[TensorDict], torch.Tensor],
    trained: Callable[[TensorDict], torch.Tensor],
    groups: Sequence[str],
    names: Sequence[str],
    clip_actions: float | None,
    steps: int,
) -> dict[str, np.ndarray]:
    """Record a policy's observations and actions in the first environment, as float32, one row per control step.

    ``policy`` controls the robot in float64; ``trained`` computes the same actions in float32, as in training. The
    result: ``reset`` (T,) bool, true where an episode starts; ``reading:<name>`` (T, width); ``observations`` (T, O);
    clipped ``actions`` and ``actions_float32`` (T, A); ``targets`` (T, 3, J): positions, velocities, efforts.
    """
    env, begins = adapter.env, True
    rows: dict[str, list[np.ndarray | np.bool_]] = {}
    for _ in range(steps):
        seen = adapter.get_observations()
        actions, rounded = policy(seen), trained(seen)
        require_finite_actions(env, actions)
        if clip_actions is not None:
            actions, rounded = (found.clamp(-clip_actions, clip_actions) for found in (actions, rounded))
        row = {READING + name: reading(name).of(env) for name in names}
        row |= {"observations": torch.cat([seen[group] for group in groups], dim=1), "actions": actions}
        row |= {"actions_float32": rounded, "targets": _targets(adapter, actions)}
        for name, value in row.items():
            rows.setdefault(name, []).append(value[0].numpy().astype(np.float32))
        rows.setdefault("reset", []).append(np.bool_(begins))
        _, _, dones, _ = adapter.step(actions)
        begins = bool(dones[0])
        if begins:
            env.reset()  # Clear the observation histories, because a deployed policy starts with empty histories.
    return {name: np.stack(values) for name, values in rows.items()}


def _targets(adapter: RslRlVecEnv, actions: torch.Tensor) -> torch.Tensor:
    """Return the joint targets (N, 3, J) that ``actions`` would give in the next physics step."""
    # The training does not clip joint targets, but the exported ``runner.py`` clips them to the joint limits.
    env = adapter.env
    manager, kept = env.action_manager, env.action_manager.state_dict()
    manager.process_action(actions)
    manager.apply_action()
    targets = env.scene.robot.targets
    low, high = env.scene.robot.layout.joint_pos_limits.unbind(dim=1)
    found = torch.stack((targets.pos.clamp(low, high), targets.vel, targets.effort), dim=1)
    manager.load_state_dict(kept)
    return found


# Outputs of policy files must satisfy |output - recorded| / max(1, |recorded|) <= TOLERANCE (or TOLERANCE_FLOAT32).
TOLERANCE, TOLERANCE_FLOAT32 = 1e-6, 1e-4
_FLOAT64 = ("observations", "actions", "targets", "c_double")
_COMPILERS = ("cc", "gcc", "clang")
_MOST_S = 300.0
_MAIN = """
#include "policy.h"
#include <stdio.h>
#define READ(x) (fread(&x, sizeof x, 1, stdin) == 1)
#define WRITE(x) fwrite(&x, sizeof x, 1, stdout)
int main(void) {
    static policy_state s, whole;
    static policy_readings readings;
    static policy_targets targets;
    static float starts, observation[POLICY_OBSERVATIONS], action[POLICY_ACTIONS];
    while (READ(starts) && READ(readings) && READ(observation) && READ(action)) {
        if (starts) policy_reset(&s);
        whole = s;
        if (policy_step(&whole, &readings, &targets)) return 1;
        policy_observe(&s, &readings);
        WRITE(s.observation);
        memcpy(s.observation, observation, sizeof observation);
        policy_network(&s);
        WRITE(s.action);
        memcpy(s.action, action, sizeof action);
        if (policy_act(&s, readings.joint_pos, &targets)) return 1;
        WRITE(targets);
    }
    return 0;
}
"""


def compare(folder: Path, torchscript: bytes, onnx: bytes, header: str) -> tuple[dict[str, float], list[str]]:
    """Return each policy file's largest difference from ``check.npz``, and a note if no C compiler is installed.

    A difference beyond the tolerance raises SimulationFailure.
    """
    found, clipped = dict(runner.check(folder)), runner.Policy(folder).clipped
    recorded = dict(np.load(folder / "check.npz").items())
    seen = recorded["observations"]
    by_onnx = ReferenceEvaluator(onnx).run(None, {"obs": seen})[0]
    load: Callable[[io.BytesIO], torch.nn.Module] = torch.jit.load
    by_torch = load(io.BytesIO(torchscript))(torch.from_numpy(seen)).detach().numpy()
    for name, actions in (("onnx", by_onnx), ("torchscript", by_torch)):
        found[name] = runner.largest_difference(clipped(actions), recorded["actions"])
    differences, notes = _compare_header(header, recorded)
    return within_tolerances(found | differences), notes


def within_tolerances(differences: dict[str, float]) -> dict[str, float]:
    """Return ``differences`` from recorded values; raise SimulationFailure if one of them exceeds its tolerance."""
    for name, difference in differences.items():
        tolerance = TOLERANCE if name in _FLOAT64 else TOLERANCE_FLOAT32
        if not difference <= tolerance:
            message = f"the exported policy is not the trained policy: its {name} differ by {difference:.3g}"
            raise SimulationFailure(message, expected=f"at most {tolerance:g}, relative to max(1, |recorded|)")
    return differences


def _compare_header(header: str, recorded: Mapping[str, np.ndarray]) -> tuple[dict[str, float], list[str]]:
    compiler = next(filter(None, map(shutil.which, _COMPILERS)), None)
    if compiler is None:
        return {}, [f"policy.h, which was not compared: there is no C compiler ({', '.join(_COMPILERS)})"]
    names = ("reset", *(name for name in recorded if name.startswith(READING)), "observations", "actions")
    steps, outputs = len(recorded["reset"]), ("observations", "actions", "targets")
    rows, wanted = (
        np.concatenate([recorded[name].reshape(steps, -1) for name in columns], axis=1, dtype=np.float32)
        for columns in (names, outputs)
    )
    found = {}
    with tempfile.TemporaryDirectory(prefix="wheelleg-header-") as folder:
        for name, text in (("policy.h", header), ("main.c", _MAIN)):
            Path(folder, name).write_text(text, encoding="utf-8")
        for real in ("double", "float"):
            command = [compiler, "-std=c99", "-O1", f"-DPOLICY_REAL={real}", "main.c", "-o", "main", "-lm"]
            try:
                subprocess.run(command, cwd=folder, capture_output=True, check=True, timeout=_MOST_S)
                said = subprocess.run([f"{folder}/main"], input=rows.tobytes(), capture_output=True, timeout=_MOST_S)
            except (OSError, subprocess.SubprocessError) as error:
                return {}, [f"policy.h, which was not compared: {compiler} failed: {error}"]
            whole = said.returncode == 0 and len(said.stdout) == wanted.nbytes
            values = np.frombuffer(said.stdout, np.float32).reshape(wanted.shape) if whole else np.inf
            found[f"c_{real}"] = runner.largest_difference(values, wanted)
    return found, []

import pytest
import torch

from sim.small_envs import ASSETS
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv

ENVS, STEPS = 64, 40


def stand(device: str, graph_step: bool) -> ManagerBasedRLEnv:
    words = ["task=stand", "env.sim.engine=warp", f"env.sim.device={device}", f"env.num_envs={ENVS}"]
    short = ["env.episode_length_s=0.3", f"env.sim.graph_step={str(graph_step).lower()}"]
    env = ManagerBasedRLEnv(compose([*words, *short]).config["env"], ASSETS / "legged.xml", 0)
    env.reset(seed=0)
    return env


def test_a_captured_step_is_the_step_itself_through_resets_and_a_changed_weight(device):
    if not device.startswith("cuda"):
        pytest.skip("CUDA graphs need a GPU")
    plain, captured = stand(device, False), stand(device, True)
    assert captured.graph_capture is not None
    gen = torch.Generator().manual_seed(1)
    ended = 0
    for index in range(STEPS):
        if index == STEPS // 2:
            for env in (plain, captured):
                env.reward_manager.get_term_cfg("alive").weight = 3.0
        captured.load_state_dict(plain.state_dict())
        action = 0.4 * torch.randn(ENVS, plain.action_manager.total_action_dim, generator=gen).to(plain.device)
        theirs, ours = plain.step(action), captured.step(action)
        for group, value in theirs[0].items():
            torch.testing.assert_close(ours[0][group], value, atol=2e-2, rtol=2e-2)
        torch.testing.assert_close(ours[1], theirs[1], atol=2e-2, rtol=2e-2)
        assert torch.equal(ours[3], theirs[3])
        ended += int(theirs[3].sum())
    assert ended > 0
    parts = captured.graph_capture.parts
    assert all(part.recordings for name, part in parts.items() if name not in ("_reset_rows", "_advance_without_draws"))
    assert not any(part.fails for part in parts.values())


def waits(env) -> torch.Tensor:
    alive = (~env.termination_manager.terminated).float()
    return alive if bool(alive.sum() > 0) else 2.0 * alive


def test_a_term_that_synchronises_is_named_and_its_step_runs_kernel_by_kernel(device):
    if not device.startswith("cuda"):
        pytest.skip("CUDA graphs need a GPU")
    plain, captured = stand(device, False), stand(device, True)
    for env in (plain, captured):
        env.reward_manager.get_term_cfg("alive").func = waits
    action = torch.zeros(ENVS, plain.action_manager.total_action_dim, device=plain.device)

    def both() -> None:
        for _ in range(10):
            captured.load_state_dict(plain.state_dict())
            theirs, ours = plain.step(action), captured.step(action)
            torch.testing.assert_close(ours[1], theirs[1], atol=2e-2, rtol=2e-2)

    with pytest.warns(UserWarning, match=r"without a CUDA graph: env\.rewards\.alive") as told:
        both()
    assert len([one for one in told if "without a CUDA graph" in str(one.message)]) == 1

import mujoco
import pytest
import torch

from sim.warp.models import XML, model, options
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.warp_engine import WarpEngine

N = 8
# Boxes that lie on the ground and on each other; two of three hinges are at their limit.
PILE = """
<mujoco><option timestep=".005" integrator="implicitfast"/>
  <default><joint axis="0 1 0" limited="true" range="-.1 .1" frictionloss=".02" armature=".01"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body pos="0 0 .1"><freejoint/><geom type="box" size=".2 .1 .1" mass="2"/>
      <body pos=".3 0 -.05"><joint name="a"/><geom type="box" size=".08 .05 .05" mass=".3"/></body>
      <body pos="-.3 0 -.05"><joint name="b"/><geom type="capsule" size=".05 .05" mass=".3"/></body>
      <body pos="0 .2 -.05"><joint name="c"/><geom type="cylinder" size=".05 .05" mass=".3"/></body>
    </body>
    <body pos="0 0 .25"><freejoint/><geom type="box" size=".1 .1 .05" mass="1"/></body>
  </worldbody>
  <sensor>
    <contact geom1="floor" num="4" reduce="mindist" data="force pos"/>
    <contact geom1="floor" num="4" reduce="none" data="force pos"/>
  </sensor>
</mujoco>
"""


def pile(device: str, **changes) -> WarpEngine:
    engine = WarpEngine(model(PILE), N, options(device, graph=False, **changes))
    noise = torch.randn(N, engine.model.nv, generator=torch.Generator().manual_seed(1))
    engine.view("qvel").copy_(0.3 * noise)
    engine.view("qpos")[:, 7:10] = torch.tensor([0.101, -0.102, 0.0])
    return engine


def run(engine: WarpEngine, shuffle_seed: int, monkeypatch) -> torch.Tensor:
    """Make steps in which the geom pairs reach the narrow phase in a random order, as from a GPU's threads."""
    from mujoco_warp._src import collision_driver

    find, wp, gen = collision_driver.nxn_broadphase, engine._wp, torch.Generator().manual_seed(shuffle_seed)

    def shuffled(m, d, ctx, awake=None):
        find(m, d, ctx, awake)
        order = torch.randperm(int(d.ncollision.numpy()[0]), generator=gen).to(engine.device)
        for array in (ctx.collision_pair, ctx.collision_pairid, ctx.collision_worldid):
            values = wp.to_torch(array)
            values[: len(order)] = values[order]

    monkeypatch.setattr(collision_driver, "nxn_broadphase", shuffled)
    first = engine.state_dict()
    found = []
    for _ in range(5):
        engine.step()
        found.append(torch.cat((engine.state, engine.view("sensordata")), dim=1))
    engine.load_state_dict(first)
    monkeypatch.undo()
    return torch.stack(found)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_no_result_depends_on_the_order_in_which_contacts_are_found(device, cone, monkeypatch):
    for deterministic in (True, False):
        engine = pile(device, cone=cone, deterministic=deterministic)
        one, other = (run(engine, seed, monkeypatch) for seed in (1, 2))
        assert int(engine._d.nacon.numpy()[0]) > 5 * N  # With few contacts, their order could not matter.
        assert torch.equal(one, other) == deterministic
        assert engine.exact or device != "cpu"


def test_rows_of_limits_and_friction_are_sorted_by_type_and_joint(device):
    from mujoco_warp._src import constraint

    engine = pile(device, deterministic=True)
    with engine._in_order():
        engine._mjw.forward(engine._m, engine._d)
        wp, data = engine._wp, engine._d
        fields = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss", "J")
        rows = [wp.to_torch(getattr(data.efc, name)) for name in fields]
        count = int((wp.to_torch(data.nf) + wp.to_torch(data.nl)).min())
        expected = [values.clone() for values in rows]
        order = torch.randperm(count, generator=torch.Generator().manual_seed(4)).to(engine.device)
        for values in rows:
            values[:, :count] = values[:, order]
        assert not torch.equal(rows[1], expected[1])
        constraint._sort_constraints(engine._m, data)
    assert count == 5
    assert all(map(torch.equal, rows, expected))
    kinds = [int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)] * 3 + [int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)] * 2
    assert rows[0][0, :count].tolist() == kinds
    assert rows[1][0, :count].tolist() == [6, 7, 8, 1, 2]  # degrees of freedom, then joints


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_a_fixed_order_agrees_with_mujoco_warps_own_kernels_to_single_precision(device, cone):
    ours, theirs = (pile(device, cone=cone, deterministic=each) for each in (True, False))
    ours.step()
    theirs.step()
    for name, most in (("qpos", 1e-6), ("qvel", 1e-4)):
        torch.testing.assert_close(ours.view(name), theirs.view(name), rtol=0, atol=most)
    forces = [engine.view("sensordata").view(N, 2, 4, 6)[..., :3].sum(dim=2) for engine in (ours, theirs)]
    assert forces[1].abs().max() > 10.0  # The pile weighs 39 N.
    torch.testing.assert_close(*forces, rtol=1e-3, atol=1e-2)


def test_models_whose_sums_have_no_fixed_order_are_rejected(device, monkeypatch):
    floating = XML.replace('<body name="arm" ', '<body name="arm" gravcomp="1" ')
    with pytest.raises(ConfigError, match=r"env\.sim\.deterministic: .* robots with gravity compensation"):
        WarpEngine(model(floating), 1, options(device, deterministic=True))
    monkeypatch.setattr("wheelleg_exp.sim.warp_order.version", lambda name: "4.1.0")
    with pytest.raises(ConfigError, match=r"mujoco-warp is 4\.1\.0"):
        WarpEngine(model(), 1, options(device, deterministic=True))

"""MJCF that others made into USD comes back as the model that it was: go1, cassie, barkour_vb, tidybot, aero_hand.

The originals are ``assets/<name>/mjcf/<name>.xml`` of the corpus. They are written with six significant digits, while
their USD was made from more; that alone is up to 5e-6.
"""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdGeom

from ..corpus import convert_asset, expectations
from .same_model import Obj, Pair, converged, difference, name_of

pytestmark = pytest.mark.corpus

ROBOTS = ("go1", "cassie", "barkour_vb", "tidybot", "aero_hand")
TOLERANCE = 1e-5
# Cassie's loops are closed by stiff connects: what its text leaves away after six digits moves its accelerations by
# as much (test_digits_that_cassies_text_leaves_away_move_it). Some bodies of aero_hand are turned by 8e-5 rad, in the
# USD itself (test_the_usd_of_the_hand_holds_other_rotations); its tendons go over them.
WIDER = {
    ("cassie", "acceleration"): 5e-4,
    ("aero_hand", "rotation"): 2e-4,
    ("aero_hand", "acceleration"): 2e-4,
    ("aero_hand", "tendon"): 5e-5,
}
JOINT = ("jnt_stiffness", "jnt_actfrclimited", "jnt_actgravcomp", "jnt_limited")
LIMIT = ("jnt_range", "jnt_solref", "jnt_solimp", "jnt_margin")
DOF = ("dof_armature", "dof_damping", "dof_frictionloss")
ACTUATOR = (
    *("gainprm", "biasprm", "dynprm", "gaintype", "biastype", "dyntype", "trntype", "gear", "group"),
    *("ctrlrange", "ctrllimited", "forcerange", "forcelimited", "actlimited"),
)
TENDON = (
    *("num", "stiffness", "damping", "frictionloss", "armature", "limited", "range", "margin"),
    *("length0", "lengthspring", "rgba", "width", "group"),
)


@pytest.fixture(scope="module", params=ROBOTS)
def pair(request, corpus, tmp_path_factory) -> Pair:
    name = request.param
    expected = next(item for item in expectations(corpus) if item["name"] == name)
    done = convert_asset(corpus, expected, tmp_path_factory.mktemp(name) / f"{name}.xml")
    made = Pair(original(corpus, name), mujoco.MjModel.from_xml_path(str(done.output)))
    made.name = name
    return made


def original(corpus: Path, name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(text_of(corpus, name)))


def text_of(corpus: Path, name: str) -> Path:
    return corpus / "assets" / name / "mjcf" / f"{name}.xml"


def within(pair: Pair, what: str) -> float:
    return WIDER.get((pair.name, what), TOLERANCE)


@pytest.mark.parametrize("what", ["nbody", "njnt", "nv", "nu", "na", "ntendon", "neq"])
def test_nothing_is_lost_and_nothing_is_added(pair, what):
    assert getattr(pair.ours, what) == getattr(pair.original, what)


def test_masses_centres_and_inertias(pair):
    first, second = pair.bodies
    heavy = pair.original.body_mass[first] > 0
    for values in ("body_mass", "body_ipos"):
        before, after = getattr(pair.original, values)[first][heavy], getattr(pair.ours, values)[second][heavy]
        for one, other in zip(before, after, strict=True):
            assert difference(one, other) < TOLERANCE
    assert (pair.ours.body_mass[second][~heavy] == 0).all()
    for before, after in zip(*pair.tensors(), strict=True):
        assert difference(before, after) < TOLERANCE


def test_joints_with_their_limits_and_passive_forces(pair):
    kinds = pair.original.jnt_type
    single = [i for i in range(pair.original.njnt) if has_one_coordinate(kinds[i])]
    ours = [pair.joints[i] for i in single]
    for values in JOINT:
        assert difference(getattr(pair.original, values)[single], getattr(pair.ours, values)[ours]) < TOLERANCE, values
    limited = [i for i in single if pair.original.jnt_limited[i]]
    ours = [pair.joints[i] for i in limited]
    for values in LIMIT:
        assert difference(getattr(pair.original, values)[limited], getattr(pair.ours, values)[ours]) < TOLERANCE, values
    for values in DOF:
        assert difference(getattr(pair.original, values), getattr(pair.ours, values)[pair.velocities]) < TOLERANCE
    for values in ("qpos0", "qpos_spring"):
        assert difference(getattr(pair.original, values), getattr(pair.ours, values)[pair.positions], 1.0) < TOLERANCE


def has_one_coordinate(kind: int) -> bool:
    return int(kind) in (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


def test_actuators(pair):
    first, second = pair.actuators
    assert len(first) == pair.original.nu
    for key in ACTUATOR:
        before, after = (getattr(m, f"actuator_{key}") for m in (pair.original, pair.ours))
        assert difference(before[first], after[second]) < TOLERANCE, key
    for one, other in zip(first, second, strict=True):
        assert target(pair.ours, other) == target(pair.original, one)


def target(model: mujoco.MjModel, actuator: int) -> str:
    kind = {int(mujoco.mjtTrn.mjTRN_JOINT): Obj.mjOBJ_JOINT, int(mujoco.mjtTrn.mjTRN_TENDON): Obj.mjOBJ_TENDON}
    return name_of(model, kind[int(model.actuator_trntype[actuator])], model.actuator_trnid[actuator][0])


def test_tendons(pair):
    first, second = pair.tendons
    for key in TENDON:
        before, after = (getattr(m, f"tendon_{key}") for m in (pair.original, pair.ours))
        assert difference(before[first], after[second]) < within(pair, "tendon"), key


def test_equalities(pair):
    for key in ("eq_type", "eq_solref", "eq_solimp", "eq_active0"):
        np.testing.assert_allclose(getattr(pair.ours, key), getattr(pair.original, key), rtol=TOLERANCE)


def test_what_the_scene_says(pair):
    for key in ("gravity", "cone", "impratio", "integrator"):
        np.testing.assert_allclose(getattr(pair.ours.opt, key), getattr(pair.original.opt, key), rtol=1e-7)
    assert pair.ours.opt.disableflags == pair.original.opt.disableflags


def test_contact_parameters_of_colliders(pair):
    """By body and as sets, because most of the originals' geoms have no name; their USD holds no ellipsoid."""
    for one, other in zip(*pair.bodies, strict=True):
        for key in ("condim", "priority", "friction", "solref", "solimp", "margin", "gap"):
            before, after = contacts(pair.original, one, key), contacts(pair.ours, other, key)
            assert before.shape == after.shape
            np.testing.assert_allclose(after, before, rtol=TOLERANCE, atol=1e-9)


def contacts(model: mujoco.MjModel, body: int, key: str) -> np.ndarray:
    touches = (model.geom_contype | model.geom_conaffinity) > 0
    kept = touches & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_ELLIPSOID))
    rows = getattr(model, f"geom_{key}")[(model.geom_bodyid == body) & kept]
    return np.sort(rows.reshape(len(rows), rows[0].size if len(rows) else 0), axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_poses_mass_matrix_and_accelerations_in_random_states(pair, seed):
    pair.draw(np.random.default_rng(seed))
    first, second = pair.data
    theirs, ours = pair.bodies
    assert difference(first.xpos[theirs], second.xpos[ours]) < TOLERANCE
    assert difference(first.xmat[theirs], second.xmat[ours]) < within(pair, "rotation")
    assert difference(*pair.masses()) < TOLERANCE
    assert difference(first.qacc, second.qacc[pair.velocities]) < within(pair, "acceleration")
    assert difference(first.qfrc_actuator, second.qfrc_actuator[pair.velocities]) < within(pair, "acceleration")
    assert difference(first.qfrc_passive, second.qfrc_passive[pair.velocities]) < within(pair, "acceleration")


# ------------------------------------------------------------------ why some tolerances are wider
def test_digits_that_cassies_text_leaves_away_move_it(corpus):
    """The seventh digit of the original's own numbers, drawn at random, changes accelerations by more than 1e-5."""
    random = np.random.default_rng(1)
    text = text_of(corpus, "cassie").read_text()
    other = mujoco.MjModel.from_xml_string(re.sub(r"(?<=[ \"])-?0\.\d{6}(?=[ \"])", lambda m: blurred(m, random), text))
    pair = Pair(original(corpus, "cassie"), converged(other))
    worst = 0.0
    for _ in range(4):
        pair.draw(random)
        worst = max(worst, difference(pair.data[0].qacc, pair.data[1].qacc[pair.velocities]))
    assert TOLERANCE < worst < 10 * WIDER["cassie", "acceleration"]


def blurred(number: re.Match[str], random: np.random.Generator) -> str:
    """A number of six decimals within the half unit that its last digit leaves open."""
    return repr(float(number.group()) + random.uniform(-0.5e-6, 0.5e-6))


def test_the_usd_of_the_hand_holds_other_rotations(corpus):
    """Read from the USD's own transform: the turn of a fingertip is not that of the MJCF."""
    expected = next(item for item in expectations(corpus) if item["name"] == "aero_hand")
    stage = Usd.Stage.Open(str(corpus / expected["asset"]))
    prim = next(p for p in stage.Traverse() if p.GetName() == "right_index_distal_link")
    turn = UsdGeom.Xformable(prim).GetLocalTransformation().ExtractRotationQuat()
    model = original(corpus, "aero_hand")
    half = model.body("right_index_distal_link").quat[1]
    assert abs(2 * (turn.GetImaginary()[0] - half)) == pytest.approx(8e-5, rel=0.05)

"""A fixed order of contacts, constraint rows, and sums in mujoco-warp, so that a GPU repeats a simulation to the bit.

mujoco-warp 4.0.0 gives each contact and each constraint row the next free slot of a buffer, in the order in which the
GPU's threads arrive. Sums over slots then round differently in each run. ``FixedOrder`` groups the contacts by
simulation, sorts those of a simulation by their geoms, and numbers the constraint rows in this order. One thread adds
the terms of a sum, so that no sum uses atomic additions of floats.
"""

import dataclasses
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src import collision_driver, constraint, math, sensor, solver, types

from wheelleg_exp.errors import ConfigError

# Do not import annotations from __future__ here, because Warp reads annotations as types, not as strings.
wp.set_module_options({"enable_backward": False})

KEY = "env.sim.deterministic"
_VERSION = "4.0.0"
_LEAST_MATCHES = 64  # A contact sensor drops contacts above this number, in no fixed order.
_MOVED = (
    *("dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp", "dim", "geom"),
    *("worldid", "type", "geomcollisionid", "adhesion"),
)
_ROW_FIELDS = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss", "J")
_ADDING_SENSORS = (mujoco.mjtSensor.mjSENS_TOUCH, mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE)


def unordered(model: mujoco.MjModel, on_device: Any) -> str | None:
    """Return a property of the model for which mujoco-warp adds numbers in no fixed order; None if there is none."""
    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    found = {
        "more than 32 degrees of freedom": on_device.is_sparse,
        "tendons": model.ntendon,
        "flexes": model.nflex,
        "gravity compensation": model.body_gravcomp.any(),
        "actuators that do not drive a joint": not np.isin(model.actuator_trntype, joints).all(),
        "more than two actuators on a joint": np.bincount(model.actuator_trnid[:, 0].clip(0)).max(initial=0) > 2,
        "sensors of touch, force, or torque": np.isin(model.sensor_type, [int(kind) for kind in _ADDING_SENSORS]).any(),
    }
    return next((name for name, has in found.items() if has), None)


class FixedOrder:
    """Replaces functions of mujoco-warp while a physics step of one engine is launched or captured.

    Raise ConfigError if the installed version of mujoco-warp is not the one that this module was written for, or if
    sums of the model have no fixed order.
    """

    def __init__(self, model: mujoco.MjModel, on_device: Any, data: Any) -> None:
        if (found := version("mujoco-warp")) != _VERSION:
            raise ConfigError(f"mujoco-warp is {found}", key=KEY, expected=f"false, or mujoco-warp {_VERSION}")
        if (reason := unordered(model, on_device)) is not None:
            message = f"the engine 'warp' does not repeat robots with {reason} to the bit"
            raise ConfigError(message, key=KEY, expected="false, or engine: mujoco")
        on_device.opt.deterministic = int(types.DeterminismType.CONSTRAINT)  # Only this calls _sort_constraints.
        on_device.opt.contact_sensor_maxmatch = max(_LEAST_MATCHES, on_device.opt.contact_sensor_maxmatch)
        self._found = dataclasses.replace(
            data.contact, **{name: wp.empty_like(getattr(data.contact, name)) for name in _MOVED}
        )
        self._next = wp.empty(data.naconmax, dtype=int)
        self._first, self._count, self._start = (wp.empty(data.nworld, dtype=int) for _ in range(3))
        self._used = wp.empty(1, dtype=int)
        self._find = collision_driver._narrowphase
        self._replaced = (
            (collision_driver, "_narrowphase", self._narrowphase),
            (constraint, "_sort_constraints", _sort_constraints),
            (constraint, "_efc_contact_init", lambda cone, *_: _contact_rows(cone == types.ConeType.ELLIPTIC)),
            (solver, "_use_incremental", lambda m: False),  # Its sums are in the order in which rows change state.
            (solver, "_update_gradient_grad", lambda *_: _gradient),
            (solver, "_update_gradient_JTCJ_dense", lambda *_: _cone_hessian),
            (sensor, "_contact_sort", lambda *_: _sort_matches),
        )

    @contextmanager
    def active(self) -> Iterator[None]:
        """Replace the functions inside the ``with`` block."""
        before = [(module, name, getattr(module, name)) for module, name, _ in self._replaced]
        try:
            for module, name, new in self._replaced:
                setattr(module, name, new)
            yield
        finally:
            for module, name, old in before:
                setattr(module, name, old)

    def _narrowphase(self, m: Any, d: Any, ctx: Any) -> None:
        """Find the contacts, and copy them to ``d.contact`` in the order of simulations and geoms."""
        self._find(m, dataclasses.replace(d, contact=self._found), ctx)
        self._first.fill_(-1)
        self._count.zero_()
        self._used.zero_()
        found = [getattr(self._found, name) for name in _MOVED]
        wp.launch(
            _link,
            dim=d.naconmax,
            inputs=[d.nacon, self._found.worldid],
            outputs=[self._first, self._count, self._next],
        )
        wp.launch(_reserve, dim=d.nworld, inputs=[self._count], outputs=[self._used, self._start])
        wp.launch(
            _place,
            dim=d.naconmax,
            inputs=[d.nacon, self._first, self._next, self._start, *found],
            outputs=[*(getattr(d.contact, name) for name in _MOVED), d.contact.efc_address],
        )


@wp.kernel
def _link(
    nacon: wp.array[int],
    world: wp.array[int],
    first: wp.array[int],
    count: wp.array[int],
    following: wp.array[int],
) -> None:
    """Make a linked list of the contacts of each simulation, in any order, and count them."""
    contact = wp.tid()
    if contact < wp.min(nacon[0], world.shape[0]):
        following[contact] = wp.atomic_exch(first, world[contact], contact)
        wp.atomic_add(count, world[contact], 1)


@wp.kernel
def _reserve(count: wp.array[int], used: wp.array[int], start: wp.array[int]) -> None:
    """Reserve consecutive slots for the contacts of each simulation; no result depends on which ones."""
    world = wp.tid()
    start[world] = wp.atomic_add(used, 0, count[world])


@wp.kernel
def _place(
    nacon: wp.array[int],
    first: wp.array[int],
    following: wp.array[int],
    start: wp.array[int],
    dist: wp.array[float],
    pos: wp.array[wp.vec3],
    frame: wp.array[wp.mat33],
    includemargin: wp.array[float],
    friction: wp.array[types.vec5],
    solref: wp.array[wp.vec2],
    solreffriction: wp.array[wp.vec2],
    solimp: wp.array[types.vec5],
    dim: wp.array[int],
    geom: wp.array[wp.vec2i],
    world: wp.array[int],
    kind: wp.array[int],
    number: wp.array[int],
    adhesion: wp.array[float],
    dist_out: wp.array[float],
    pos_out: wp.array[wp.vec3],
    frame_out: wp.array[wp.mat33],
    includemargin_out: wp.array[float],
    friction_out: wp.array[types.vec5],
    solref_out: wp.array[wp.vec2],
    solreffriction_out: wp.array[wp.vec2],
    solimp_out: wp.array[types.vec5],
    dim_out: wp.array[int],
    geom_out: wp.array[wp.vec2i],
    world_out: wp.array[int],
    kind_out: wp.array[int],
    number_out: wp.array[int],
    adhesion_out: wp.array[float],
    efc_address_out: wp.array2d[int],
) -> None:
    """Copy each contact to its place among the contacts of its simulation.

    The order is that of the first geom, the second geom, and the contact's number within this pair of geoms.
    """
    own = wp.tid()
    if own >= wp.min(nacon[0], world.shape[0]):
        return
    one, two, three = geom[own][0], geom[own][1], number[own]
    slot = int(start[world[own]])
    other = int(first[world[own]])
    while other >= 0:
        a, b, c = geom[other][0], geom[other][1], number[other]
        if a < one or (a == one and (b < two or (b == two and c < three))):
            slot += 1
        other = following[other]
    dist_out[slot] = dist[own]
    pos_out[slot] = pos[own]
    frame_out[slot] = frame[own]
    includemargin_out[slot] = includemargin[own]
    friction_out[slot] = friction[own]
    solref_out[slot] = solref[own]
    solreffriction_out[slot] = solreffriction[own]
    solimp_out[slot] = solimp[own]
    dim_out[slot] = dim[own]
    geom_out[slot] = geom[own]
    world_out[slot] = world[own]
    kind_out[slot] = kind[own]
    number_out[slot] = number[own]
    adhesion_out[slot] = adhesion[own]
    for i in range(efc_address_out.shape[1]):
        efc_address_out[slot, i] = -1


@wp.func
def _is_first(contact: int, world: wp.array[int]) -> bool:
    """Return whether a contact is the first one of its simulation."""
    if contact == 0:
        return True
    return world[contact - 1] != world[contact]


# The parameters of the following kernels are those of the kernels that they replace.


@functools.cache
def _contact_rows(elliptic: bool) -> Any:
    """Return the kernel that numbers the constraint rows of contacts; one thread per simulation works."""

    @wp.kernel(module="unique", enable_backward=False)
    def contact_rows(
        body_weldid: wp.array[int],
        body_dofnum: wp.array[int],
        body_dofadr: wp.array[int],
        dof_parentid: wp.array[int],
        geom_bodyid: wp.array[int],
        njmax: int,
        njmax_nnz: int,
        nacon: wp.array[int],
        dist: wp.array[float],
        condim: wp.array[int],
        includemargin: wp.array[float],
        adhesion: wp.array[float],
        world_of: wp.array[int],
        geom: wp.array[wp.vec2i],
        kind: wp.array[int],
        nefc: wp.array[int],
        efc_address: wp.array2d[int],
        efc_id: wp.array2d[int],
        jtdaj_adr: wp.array2d[int],
        jtdaj_nrow: wp.array2d[int],
        jtdaj_nblock: wp.array[int],
        J_rownnz: wp.array2d[int],
        J_rowadr: wp.array2d[int],
        Jqvel: wp.array2d[float],
        efc_nnz: wp.array[int],
    ) -> None:
        first = wp.tid()
        count = wp.min(nacon[0], world_of.shape[0])
        if first >= count:
            return
        if not _is_first(first, world_of):
            return
        world = world_of[first]
        row = int(nefc[world])
        for contact in range(first, count):
            if world_of[contact] != world:
                break
            is_active = dist[contact] < includemargin[contact] or adhesion[contact] != 0.0
            if is_active and (kind[contact] & int(types.ContactType.CONSTRAINT.value)) != 0:
                rows = condim[contact]
                if wp.static(not elliptic):
                    rows = wp.max(1, 2 * (rows - 1))
                for i in range(rows):
                    if row < njmax:
                        efc_address[contact, i] = row
                        efc_id[world, row] = contact
                    row += 1
        nefc[world] = row

    return contact_rows


@wp.kernel
def _gradient(
    qfrc_smooth: wp.array2d[float],
    qfrc_constraint: wp.array2d[float],
    efc_Ma: wp.array2d[float],
    state_changed_count: wp.array[int],
    done: wp.array[bool],
    grad: wp.array2d[float],
    grad_dot: wp.array[float],
) -> None:
    """Compute the solver's gradient; the thread of the first degree of freedom adds the squares."""
    world, dof = wp.tid()
    if done[world]:
        return
    grad[world, dof] = efc_Ma[world, dof] - qfrc_smooth[world, dof] - qfrc_constraint[world, dof]
    if dof == 0:
        total = float(0.0)
        for i in range(qfrc_smooth.shape[1]):
            value = efc_Ma[world, i] - qfrc_smooth[world, i] - qfrc_constraint[world, i]
            total += value * value
        grad_dot[world] = total


@wp.kernel
def _cone_hessian(
    impratio_invsqrt: wp.array[float],
    dof_tri_row: wp.array[int],
    dof_tri_col: wp.array[int],
    dist: wp.array[float],
    includemargin: wp.array[float],
    friction: wp.array[types.vec5],
    condim: wp.array[int],
    efc_address: wp.array2d[int],
    world_of: wp.array[int],
    J: wp.array3d[float],
    D: wp.array2d[float],
    state: wp.array2d[int],
    naconmax: int,
    nacon: wp.array[int],
    Jaref: wp.array2d[float],
    done: wp.array[bool],
    passes: int,
    threads: int,
    h: wp.array3d[float],
) -> None:
    """Add the curvature of friction cones to an entry of the Hessian; one thread adds all contacts of a simulation."""
    start, entry = wp.tid()
    one, two = dof_tri_row[entry], dof_tri_col[entry]
    count = wp.min(nacon[0], naconmax)
    for i in range(passes):
        first = start + i * threads
        if first >= count:
            return
        world = world_of[first]
        if done[world]:
            continue
        if not _is_first(first, world_of):
            continue
        total = float(0.0)
        for contact in range(first, count):
            if world_of[contact] != world:
                break
            normal = efc_address[contact, 0]
            if condim[contact] == 1 or normal < 0 or dist[contact] >= includemargin[contact]:
                continue
            if state[world, normal] != int(types.ConstraintState.CONE.value):
                continue
            scales = friction[contact]
            mu = scales[0] * impratio_invsqrt[world % impratio_invsqrt.shape[0]]
            dm = math.safe_div(D[world, normal], mu * mu * (1.0 + mu * mu))
            tt = float(0.0)
            sum1 = float(0.0)
            sum2 = float(0.0)
            dot = float(0.0)
            for k in range(1, condim[contact]):
                row = efc_address[contact, k]
                if row >= 0:
                    u = Jaref[world, row] * scales[k - 1]
                    z1 = scales[k - 1] * J[world, row, one]
                    z2 = scales[k - 1] * J[world, row, two]
                    tt += u * u
                    sum1 += u * z1
                    sum2 += u * z2
                    dot += z1 * z2
            inverse = math.safe_div(1.0, wp.max(wp.sqrt(tt), types.MJ_MINVAL))
            ratio = mu * Jaref[world, normal] * mu * inverse
            total += solver._elliptic_hessian_entry_from_projections(
                dm,
                mu,
                ratio,
                mu * mu - ratio,
                mu * J[world, normal, one],
                mu * J[world, normal, two],
                sum1 * inverse,
                sum2 * inverse,
                dot,
            )
        h[world, one, two] = h[world, one, two] + total


@wp.kernel
def _sort_matches(
    sensor_intprm: wp.array2d[int],
    sensor_adr: wp.array[int],
    nmatch: wp.array2d[int],
    match: wp.array3d[int],
    criterion: wp.array3d[float],
    match_out: wp.array3d[int],
) -> None:
    """Sort the contacts of a sensor in place, by the sensor's criterion and then by the order of the contacts.

    ``match_out`` is ``match``. The complement of a contact's number stands for a contact in the other direction.
    """
    world, own, lane = wp.tid()
    if lane > 0:
        return
    for i in range(1, wp.min(nmatch[world, own], match.shape[2])):
        for k in range(i):
            b = i - k
            x, y = float(criterion[world, own, b - 1]), float(criterion[world, own, b])
            one, two = int(match[world, own, b - 1]), int(match[world, own, b])
            if not (x > y or (x == y and wp.max(one, ~one) > wp.max(two, ~two))):
                break
            criterion[world, own, b - 1] = y
            criterion[world, own, b] = x
            match_out[world, own, b - 1] = two
            match_out[world, own, b] = one


def _sort_constraints(m: Any, d: Any) -> None:
    """Sort the rows of equalities, friction, and limits by type and object; the rows of contacts are already sorted."""
    rows = [getattr(d.efc, name) for name in _ROW_FIELDS]
    wp.launch(_sort_rows, dim=d.nworld, inputs=[d.ne, d.nf, d.nl, d.njmax, m.nv, *rows])


@wp.func
def _swap(values: wp.array2d[Any], world: int, a: int, b: int):  # type: ignore[no-untyped-def]  # noqa: ANN202
    kept = values.dtype(values[world, a])
    values[world, a] = values[world, b]
    values[world, b] = kept


@wp.kernel
def _sort_rows(
    ne: wp.array[int],
    nf: wp.array[int],
    nl: wp.array[int],
    njmax: int,
    nv: int,
    kind: wp.array2d[int],
    number: wp.array2d[int],
    pos: wp.array2d[float],
    margin: wp.array2d[float],
    D: wp.array2d[float],
    vel: wp.array2d[float],
    aref: wp.array2d[float],
    frictionloss: wp.array2d[float],
    J: wp.array3d[float],
) -> None:
    """Sort the rows of one simulation by insertion; several rows of one object keep their order."""
    world = wp.tid()
    for i in range(1, wp.min(ne[world] + nf[world] + nl[world], njmax)):
        for k in range(i):
            b = i - k
            a = b - 1
            one, two = kind[world, a], kind[world, b]
            if one < two or (one == two and number[world, a] <= number[world, b]):
                break
            _swap(kind, world, a, b)
            _swap(number, world, a, b)
            _swap(pos, world, a, b)
            _swap(margin, world, a, b)
            _swap(D, world, a, b)
            _swap(vel, world, a, b)
            _swap(aref, world, a, b)
            _swap(frictionloss, world, a, b)
            for dof in range(nv):
                kept = float(J[world, a, dof])
                J[world, a, dof] = J[world, b, dof]
                J[world, b, dof] = kept

"""Which contacts a plan has by default, where a model has more than can be computed, or others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjx_drax.physics._mjx import mjx
from mjx_drax.physics.agreement.checks import Findings, examine, samples
from mjx_drax.physics.c_engine.states import Engine, quiet, set_state
from mjx_drax.physics.contacts.collision import corners
from mjx_drax.physics.contacts.pairs import (
    Contacts,
    Pair,
    contact_pairs,
    geom_name,
    of_hulls,
    touching,
)
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjx_model import OTHER_CONTACTS, kept_contacts, put_model

MOST_WORK = 2_000_000
"""Pairs of corners of hulls that a step may compare: MJX compares every edge with every other."""

EACH = 20_000
"""What every pair counts besides, because each function of MJX takes time to compile."""

NEAR, MOTIONS = 0.1, 4
"""Distances up to which they are exact [m], and random motions from x_init of 0.6 s that are looked
at."""


def affordable(
    model: mujoco.MjModel, name: str, x_init: np.ndarray, bounded: np.ndarray, contacts: Contacts
) -> tuple[Contacts, str | None]:
    """`contacts`; or, for True and a model that has too many, pairs that come close near x_init.

    Pairs are kept from the nearest on, where `MOST_WORK` allows. Also a sentence about what is left
    out, None if nothing is.
    """
    if contacts is not True:
        return contacts, None
    every = list(contact_pairs(model))
    work = [_work(model, *pair) for pair in every]
    if sum(work) <= MOST_WORK:
        return True, None
    distance = _least_distances(model, every, x_init, bounded)
    kept: list[Pair] = []
    spent = 0.0
    for i in np.argsort(distance, kind="stable"):
        if spent + work[i] + EACH <= MOST_WORK:
            spent += work[i] + EACH
            kept.append(every[i])
    first = next(pair for pair in every if pair not in kept)
    names = " with ".join(repr(geom_name(model, g)) for g in first)
    note = (
        f"{name} has {len(every)} pairs of geoms that may touch, and too many corners of meshes: "
        f"the plan has contacts of {len(kept)} that come closest in motions from x_init, and of no "
        f'other, such as {names}. Choose them by contacts=[("foot_*", "floor"), ...].'
    )
    return sorted(kept), note


def parts_differ(
    model: mujoco.MjModel, x_init: np.ndarray, bounded: np.ndarray, contacts: Contacts
) -> bool:
    """Whether parts of one robot that MJX computes differently touch in states about x_init."""
    engine = Engine(model, contacts)
    differ = _own(model, contacts)[0]
    acting = [engine.touching(x) for x in samples(engine, x_init, bounded).x]
    return any(pair in differ or pair[::-1] in differ for pairs in acting for pair in pairs)


def without_own(
    model: mujoco.MjModel,
    name: str,
    x_init: np.ndarray,
    bounded: np.ndarray,
    contacts: Contacts,
    derivatives: bool = False,
) -> tuple[mjx.Model, Findings] | None:
    """The model of a plan with fewer contacts than one is refused with, and its findings.

    Left out are those of one robot's parts with each other that MJX computes differently, as of two
    cylinders; if that is not enough, those of hulls too. They are rarely meant, and replays have
    them. None if that does not help.
    """
    every = touching(model, contacts)
    differ, hulls = _own(model, contacts)
    tried: set[Pair] = set()
    for other in (differ, differ | hulls):
        if other == tried:
            continue
        tried = other
        fewer: Contacts = sorted(every - other) or False
        planned = put_model(model, fewer, bounded)
        kept = kept_contacts(planned)
        found = examine(model, name, x_init, fewer, bounded, kept, derivatives)
        if found.obstacle is None:
            names = " with ".join(repr(geom_name(model, g)) for g in min(other))
            note = (
                f"the plan has no contacts of {len(other)} pairs of parts of {name} with each "
                f"other, such as {names}: MJX computes them differently. Replays have them."
            )
            return planned, replace(found, notes=(note, *found.notes))
    return None


def _own(model: mujoco.MjModel, contacts: Contacts) -> tuple[set[Pair], set[Pair]]:
    """Pairs of parts of one robot, those that MJX computes differently, and those of hulls."""
    root = model.body_rootid[model.geom_bodyid]
    own = {(a, b) for a, b in touching(model, contacts) if root[a] == root[b]}
    differ = {pair for pair in own if tuple(model.geom_type[list(pair)]) in OTHER_CONTACTS}
    return differ, {pair for pair in own if of_hulls(model, pair)}


def _work(model: mujoco.MjModel, a: int, b: int) -> int:
    """Pairs of corners of two geoms."""
    return corners(model, a) * corners(model, b)


def _least_distances(
    model: mujoco.MjModel, pairs: list[Pair], x_init: np.ndarray, bounded: np.ndarray
) -> np.ndarray:
    """Least distances [m] of pairs of geoms over states about x_init, or lower bounds of them."""
    engine, data = Engine(model), mujoco.MjData(model)
    least = np.full(len(pairs), np.inf)
    states = [samples(engine, x_init, bounded, seed).x for seed in range(MOTIONS)]
    a, b = np.array(pairs).T
    radius = model.geom_rbound[a] + model.geom_rbound[b]
    radius[(model.geom_rbound[a] == 0) | (model.geom_rbound[b] == 0)] = np.inf  # planes
    for x in np.concatenate(states):
        set_state(model, data, x)
        with quiet():
            mujoco.mj_kinematics(model, data)
        apart = np.linalg.norm(data.geom_xpos[a] - data.geom_xpos[b], axis=1) - radius
        least = np.minimum(least, np.maximum(apart, NEAR))
        for i in np.flatnonzero(apart < NEAR):
            with quiet():
                found = mujoco.mj_geomDistance(model, data, *pairs[i], NEAR, None)
            least[i] = min(least[i], found)
    return least

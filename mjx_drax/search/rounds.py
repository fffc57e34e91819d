"""What follows the iterations of an attempt where contacts act: rollouts, and rounds of them.

Each step goes from a stage to the next one. See `Rollouts`, whose numbers say how many there are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from mjx_drax.method.descent import DAMPING_RANGE, LESS_DAMPING, MORE_DAMPING, Info
from mjx_drax.method.langevin import State
from mjx_drax.search.chains import Chains, Stage, best_of
from mjx_drax.search.iterate import box_of_controls
from mjx_drax.search.replayer import Replayer
from mjx_drax.search.restarts import Rollouts
from mjx_drax.search.shooting import Shots, shoot


def begun(stage: Stage, rollouts: Rollouts, replayer: Replayer, fresh: bool) -> Stage:
    """The stage before its next rollout, round or shot.

    At the first one, and if the chains are `fresh` from the attempt: where all of a problem's are
    sound, rounds are for what random shooting changes.
    """
    now, count, damping = stage.now, stage.rollouts, stage.damping
    if count or not fresh:
        return stage
    sound = now.feasible & ~replayer.missed(now)
    whole = sound.reshape(len(replayer.indices), -1).all(axis=1)
    damping = np.where(np.repeat(whole, len(sound) // len(whole)), np.inf, damping)
    if whole.all():
        count = _without_more_rounds(stage, rollouts, replayer)
    return replace(stage, damping=damping, rollouts=count)


def rolled_out(stage: Stage, replayer: Replayer) -> Stage:
    """After a rollout without feedback, later ones with it."""
    rows, with_feedback = np.flatnonzero(np.isfinite(stage.damping)), float(stage.rollouts > 0)
    now = replayer.rolled_out(stage.now, rows, with_feedback, stage.done)
    return replace(stage, now=now, rollouts=stage.rollouts + 1)


def shot(
    stage: Stage,
    rollouts: Rollouts,
    replayer: Replayer,
    seed: int,
    tell: Callable[[Stage], None],
) -> tuple[Stage, bool]:
    """After random shooting by chains that it may help, and whether it was not interrupted."""
    now, damping, ended = stage.now, stage.damping, True
    rows = np.flatnonzero(_unsure(now, replayer))
    if len(rows):
        knots = replace(now.state.trajectory, slack=None)
        box = box_of_controls(*reversed(replayer.question), knots)
        keys = np.stack([replayer.of[rows], rows % replayer.places], axis=1)

        def told(shots: Shots) -> None:
            cost, worst = np.array(now.info.cost), np.array(now.info.max_defect)
            cost[rows], worst[rows] = shots.cost, shots.broken
            info = replace(now.info, cost=jnp.asarray(cost), max_defect=jnp.asarray(worst))
            tell(replace(stage, now=replace(now, info=info)))

        shots, ended = shoot(
            lambda some, controls: replayer.fired(knots, rows[some], controls),
            np.asarray(knots.u)[rows],
            [np.asarray(end, float)[rows] for end in box],
            replayer.floor[rows],
            [(seed, stage.attempt, *key) for key in keys.tolist()],
            (rollouts.samples, rollouts.generations),
            told,
        )
        found = replayer.taken(now, rows, shots, stage.done)
        before, now = now, best_of(now, found, np.arange(len(now.missed)), replayer.floor)
        damping = np.where(_same(before, now), damping, 1.0)
    count = stage.rollouts + 1 if np.isfinite(damping).any() else rollouts.total
    return replace(stage, now=now, damping=damping, rollouts=count), ended


def after_round(
    stage: Stage,
    rollouts: Rollouts,
    replayer: Replayer,
    iterated: Callable[[np.ndarray], tuple[State, Info]],
) -> Stage:
    """After a round: iterations with a damping of each row, and rollouts of what they changed."""
    now, damping, count = stage.now, stage.damping, stage.rollouts + 1
    done = stage.done + rollouts.iterations
    # Chains that the largest damping has left as they were would come to the same again
    rows, most = np.flatnonzero(np.isfinite(damping)), DAMPING_RANGE[1]
    missed = np.ones(len(now.missed), bool)  # until it is shown
    found = Chains(*iterated(np.minimum(damping, most)), np.full(len(missed), done), missed)
    found, better = replayer.rolled_out_in_part(now, found, rows, done)
    before, now = now, best_of(now, found, np.arange(len(now.missed)), replayer.floor)
    factor = np.where(better == 1.0, LESS_DAMPING, np.where(better > 0.0, 1.0, MORE_DAMPING))
    settled = _same(before, now) & (better == 0.0) & (damping >= most)
    damping = np.where(settled, np.inf, np.clip(damping * factor, *DAMPING_RANGE))
    stage = replace(stage, now=now, damping=damping)
    if not better.any() and (damping >= most).all():
        count = _without_more_rounds(stage, rollouts, replayer)
    return replace(stage, rollouts=count)


def _without_more_rounds(stage: Stage, rollouts: Rollouts, replayer: Replayer) -> int:
    """Where `Stage.rollouts` goes on if rounds change nothing: random shooting, or the end."""
    shoots = stage.rollouts <= rollouts.shoot_at and _unsure(stage.now, replayer).any()
    return rollouts.shoot_at if shoots else rollouts.total


def _unsure(now: Chains, replayer: Replayer) -> np.ndarray:
    """Which chains random shooting may help, (rows,): those that are not sound.

    Without a goal all of them: a motion that touches nothing may be sound, and worth nothing.
    """
    return ~now.sound | (replayer.family.problem.goal is None)


def _same(before: Chains, now: Chains) -> np.ndarray:
    """Which chains nothing better was found for, (rows,)."""
    of_both = (np.stack([a.cost, a.info.max_defect]) for a in (before, now))
    return np.equal(*of_both).all(axis=0)

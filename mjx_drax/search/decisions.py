"""What a search decides of its chains: which are done, which go on, and who gets what was found.

The rules are those of `attempts`. Here they are asked of a stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jax.sharding import Mesh

from mjx_drax.method.langevin import State
from mjx_drax.polish.interior_point import Polish
from mjx_drax.search.attempts import (
    AttemptSoFar,
    done_up_to,
    noise_is_better,
    owners_of_places,
    wanted,
)
from mjx_drax.search.chains import CHEAPER, Chains, Stage
from mjx_drax.search.devices import on_host
from mjx_drax.search.restarts import WITHIN_KINKED, Restarts

STRAGGLERS = 0.0005
"""Share of chains for which the polish of the others does not wait."""


@dataclass(frozen=True)
class Decisions:
    """The decisions of one call, from where its chains are.

    Attributes:
        settings: with a value for everything.
        chains: of each problem.
        alone: whether it has a single problem.
        mesh: the devices, or None for one.
    """

    settings: Restarts
    chains: int
    alone: bool
    mesh: Mesh | None

    @property
    def polish(self) -> Polish | None:
        """What follows the noise; None: the flow's tail."""
        polish = self.settings.polish
        return polish if polish and polish.iterations else None

    @property
    def done_share(self) -> float:
        """Of the chains, so many are to be done."""
        assert self.settings.done_share is not None
        return self.settings.done_share

    @property
    def thorough(self) -> bool:
        """Whether all attempts are asked for, to find better optima than those that come easily."""
        return self.done_share > 1.0

    @property
    def ends_early(self) -> bool:
        """Whether attempts end early, and a finish follows: not if rollouts follow."""
        rollouts = self.settings.rollouts
        assert rollouts is not None
        polished = self.polish is not None
        return self.alone and polished and not self.thorough and not rollouts.asked

    def moving(self, state: State) -> np.ndarray:
        """Which chains the polish still moves, (rows,)."""
        flags = state.polish.optimal, state.polish.stalled, state.alive
        optimal, stalled, alive = on_host(flags, self.mesh)
        return np.asarray(replace(state.polish, optimal=optimal, stalled=stalled).active & alive)

    def unfinished(self, stage: Stage, chains: Chains) -> np.ndarray:
        """Which chains the finish polishes, (rows,): those that move and have iterations left.

        They need one more in the end, which measures their residual. For a share `STRAGGLERS` it
        does not wait. While no chain at the best cost has settled, or none is sound, those there
        get more.
        """
        polish = self.polish
        assert polish is not None
        moves = self.moving(chains.state)
        done, most = on_host(chains.state.polish.iterations, self.mesh), polish.iterations - 1
        left = moves & (done < most)
        if left.sum() > STRAGGLERS * self.chains:
            return left
        costs, size = chains.sound_cost - stage.floor[0], np.asarray(chains.info.size)
        bar = done_up_to(costs, size, CHEAPER, stage.cost_scale[0])
        near = costs <= bar if chains.sound.any() else moves
        return moves & near & (done < polish.patience * most) & (moves | ~near).all()

    def waits(self, stage: Stage, indices: np.ndarray, usual: int, later: int) -> bool:
        """Whether to go on with an attempt of a single problem's polish; see `AttemptSoFar`.

        Where a finish will follow, what is left of an attempt is polished there. Else all that
        matters is waited for, but for a share `STRAGGLERS`.

        Args:
            stage, indices: where it is, and the problems of the chunk.
            usual: iterations since this was asked last.
            later: places of the next attempt.
        """
        now = stage.now
        if stage.finishing:
            return bool(self.unfinished(stage, now).any())
        active = self.moving(now.state)
        last = stage.attempt + 1 == self.settings.attempts
        if not last or (self.ends_early and stage.attempt > 0):
            bar, floor = self.done_up_to(stage, indices, now).item(), stage.floor[0]
            count = wanted(self.chains, len(active))
            if stage.kept is not None:
                count = int((stage.kept.sound_cost - floor > bar).sum())
            so_far = AttemptSoFar(
                active=active,
                cost=now.sound_cost - floor,
                before=stage.before - floor,
                bar=bar,
                wanted=count,
                needless=(1.0 - self.done_share) * max(self.chains, count),
                iterations=stage.step,
                since=usual,
                wider=later / len(active),
            )
            if self.ends_early and so_far.over:
                return False
            active = so_far.waited_for
        return bool(active.sum() > STRAGGLERS * len(active))

    def next_attempt(self, stage: Stage, first: int) -> tuple[np.ndarray, bool]:
        """Which problems another attempt is for, and whether it has noise.

        With `heated=True` the second attempt has noise, and so have later ones at a single problem
        if noise has brought more chains, or if all attempts are asked for. With `heated=None`
        attempts at a single problem are with and without noise in turns until one has made a chain
        done; from then on they are of the kind that has brought more. In a batch, where answers
        must not depend on others, all have noise, or none.

        Where chains cost at most `WITHIN_KINKED` more than the best, no more attempts are made if
        all that are left are not expected to make half of the missing ones done.

        Args:
            stage: all that is kept.
            first: places of the first attempt.
        """
        kept, everyone = stage.kept, np.arange(len(stage.cost_scale))
        assert kept is not None
        bar = self.done_up_to(stage, everyone)
        costs = self.sound_costs(stage, kept, everyone)
        missing = (costs > bar).sum(axis=1)
        found = np.array([(end - stage.floor[0] <= bar[0]).sum() for end in stage.ends])
        many = self.chains
        if self.alone and stage.attempt == 0:
            many = wanted(self.chains, first)
            missing = np.maximum(many - found[:1], 0)
        heated = bool(self.settings.heated)
        if self.alone:
            better = noise_is_better(found, stage.work)
            if self.settings.heated is None:
                heated = better if found.any() else not stage.heated
            elif stage.attempt > 0 and not self.thorough:
                heated &= better
        needless = (1.0 - self.done_share) * many
        asked = missing > needless
        if self.alone and stage.attempt > 0 and not self.thorough:
            far = self.done_up_to(stage, everyone, within=WITHIN_KINKED)
            kind, left = int(heated), self.settings.attempts - 1 - stage.attempt
            rate = (found[kind] + 1) / max(len(stage.ends[kind]), 1)
            asked &= ((costs > far).sum(axis=1) > needless) | (
                2 * rate * left * len(stage.now.missed) >= missing
            )
        if not asked.any() and self.alone and self.settings.heated:
            heated = self._better_may_be_left(stage)
            asked |= heated
        return np.flatnonzero(asked), heated

    def _better_may_be_left(self, stage: Stage) -> bool:
        """Whether an attempt with noise at a single problem may bring a better optimum.

        After the first attempt, if its places have converged to optima of different costs: there
        are several basins. Later, if the latest attempt came to the best one, as the first to do
        so, and only once.
        """
        kept, now, scale, floor = stage.kept, stage.now, stage.cost_scale[0], stage.floor[0]
        assert kept is not None
        best = kept.sound_cost - floor
        bar = done_up_to(best, np.asarray(kept.info.size), CHEAPER, scale)
        if stage.attempt > 0:
            came = stage.ends[int(stage.heated)] - floor <= bar
            return bool(came.sum() == came[-len(now.missed) :].sum() == 1)
        if self.polish is None:
            return False
        optimal, alive = on_host((now.state.polish.optimal, now.state.alive), self.mesh)
        return bool((optimal & alive & now.sound & (now.cost - floor > bar)).any())

    def sound_costs(self, stage: Stage, chains: Chains, indices: np.ndarray) -> np.ndarray:
        """Costs of those problems' chains, from their floors, (len(indices), chains)."""
        costs = self._costs_to_beat(chains, len(stage.cost_scale))[indices]
        return costs - stage.floor[indices, None]

    def _costs_to_beat(self, chains: Chains, problems: int) -> np.ndarray:
        """`sound_cost` of chains, (problems, each).

        In a batch many goals may be out of reach: a chain that misses counts, where all do.
        """
        if self.alone:
            return chains.sound_cost.reshape(problems, -1)
        feasible, missed = (a.reshape(problems, -1) for a in (chains.feasible, chains.missed))
        arrives = (feasible & ~missed).any(axis=1, keepdims=True)
        costs = chains.cost.reshape(problems, -1)
        return np.where(feasible & ~(missed & arrives), costs, np.inf)

    def done_up_to(
        self,
        stage: Stage,
        indices: np.ndarray,
        now: Chains | None = None,
        within: float | None = None,
    ) -> np.ndarray:
        """Up to which cost, from their floors, chains of those problems are done, (n, 1).

        By what is kept, and by the rows of the chunk `now`. Where cheaper plans miss the goal, what
        reaches it may be far from its best, so no chain is done. The share is that of the settings,
        or `within`.
        """
        kept, n = stage.kept, len(indices)
        costs, sizes = [stage.least[indices, None]], [np.full((n, 1), np.nan)]
        if kept is not None:
            costs.append(self.sound_costs(stage, kept, indices))
            sizes.append(np.asarray(kept.info.size).reshape(-1, self.chains)[indices])
        if now is not None:
            costs.append(self._costs_to_beat(now, n) - stage.floor[indices, None])
            sizes.append(np.asarray(now.info.size).reshape(n, -1))
        share = self.settings.within if within is None else within
        assert share is not None
        both = np.concatenate(costs, axis=1), np.concatenate(sizes, axis=1)
        return done_up_to(*both, share, stage.cost_scale[indices])

    def owners(self, stage: Stage, indices: np.ndarray, now: Chains) -> np.ndarray:
        """Which of its problem's chains gets what each place of the chunk has found, (n, places).

        In the first attempt at a single problem the best places are its chains, -1 elsewhere.
        """
        kept, order = stage.kept, now.order(len(indices))
        if kept is None:
            owners = np.full_like(order, -1)
            owners[0, np.sort(order[0, : self.chains])] = np.arange(self.chains)
            return owners
        done = self._are_done(stage, indices, now, kept)
        return owners_of_places(done, self.sound_costs(stage, kept, indices), order)

    def _are_done(self, stage: Stage, indices: np.ndarray, now: Chains, kept: Chains) -> np.ndarray:
        """Which kept chains of those problems are, now that this was found, (n, chains)."""
        bar = self.done_up_to(stage, indices, now)
        return (self.sound_costs(stage, kept, indices) <= bar) & (self.done_share <= 1.0)

    def not_for_done_chains(self, stage: Stage, now: Chains, owners: np.ndarray) -> Chains:
        """What a single problem's places have found; chains that are done take none that moves.

        A plan that is not settled may be cheap because it uses the tolerance of the dynamics.

        Args:
            stage: what is kept.
            now: the places.
            owners: which chain gets what each has found, (places,).
        """
        if not self.ends_early:
            return now
        assert stage.kept is not None
        done = self._are_done(stage, np.zeros(1, int), now, stage.kept)[0]
        return replace(now, missed=now.missed | (self.moving(now.state) & done[owners]))

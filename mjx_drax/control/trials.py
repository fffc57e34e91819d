"""A policy in the loop with a plant, run after run, and what came of it in numbers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.base.errors import DraxError, require_positive, require_whole
from mjx_drax.control.background import Background
from mjx_drax.control.mpc import MPC, Statistics
from mjx_drax.control.open_quantities import driven
from mjx_drax.control.plant import Plant, Push, random_pushes
from mjx_drax.kernels.linalg import full_precision
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.problem.data import rows as data_rows
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Stagewise, Trajectory

SETTLE = 4.0
"""Time without pushes at the end of a run [s], at least."""

ARROW, SHOWN = 0.4, 0.3
"""Of pushes in films: length of the strongest, in sizes of the model; the least time [s]."""

PERCENTILES = 50, 90, 99


@dataclass(frozen=True)
class Motion:
    """One run in the loop.

    Attributes:
        times: of the states, (T + 1,) [s].
        states: of the plant at every physics step, (T + 1, nx).
        controls: that were applied, (T, nu).
        statistics: of the policy.
        reached: whether the run ended in the goal; None without a goal.
        pushes: what it had to bear.
        further: the further states of the problem in the plan in use, (T, n).
        behind: how far the plant fell behind the clock on the wall at most [s], where it runs by
            it; else 0.
    """

    times: np.ndarray
    states: np.ndarray
    controls: np.ndarray
    statistics: Statistics
    reached: bool | None
    pushes: Sequence[Push]
    further: np.ndarray
    behind: float


def simulate(
    policy: MPC,
    plant: Plant,
    duration: float,
    *,
    realtime: bool = False,
    pushes: Sequence[Push] = (),
) -> Motion:
    """Drive the plant for so many seconds from its time on, more than 0.

    Args:
        policy: that has been reset, or rewound, to the plant's time.
        plant, duration: from where it starts, for how long [s].
        realtime: the plant runs by the clock on the wall while a thread plans; else it waits for
            each plan.
        pushes: the plant's, to be reported.
    """
    require_positive("duration", duration, "a positive number of seconds")
    times, states, controls, further = [plant.time], [plant.state], [], []
    stop, behind = plant.time + duration, 0.0
    with Background(policy) if realtime else nullcontext(policy) as act:
        began = time.perf_counter() - plant.time
        while plant.time < stop - 1e-9:
            u = act(plant.measured(), plant.time)
            plant.step(u)
            controls.append(u)
            further.append(policy.latest.x[0, len(plant.state) :])
            times.append(plant.time)
            states.append(plant.state)
            if realtime:
                ahead = began + plant.time - time.perf_counter()
                behind = max(behind, -ahead)
                time.sleep(max(0.0, ahead))
    end = states[-1]
    reached = policy.problem.reached(end, plant.time) if np.isfinite(end).all() else False
    found = np.array(times), np.array(states), np.array(controls)
    return Motion(*found, policy.statistics, reached, pushes, np.array(further), behind)


@dataclass(frozen=True)
class Trials:
    """Several runs of one policy, each with pushes of its own."""

    policy: MPC
    duration: float
    realtime: bool
    motions: list[Motion] = field(default_factory=list)

    def check(self, count: int, pushes: int) -> tuple[float, float]:
        """When pushes begin and end [s], if runs leave time for them; call it before `reset`."""
        require_whole("runs", count)
        require_whole("pushes", pushes, 0)
        require_positive("duration", self.duration, "a positive number of seconds")
        begin, end = float(self.policy.problem.times[-1]), self.duration - SETTLE
        if pushes and begin >= end:
            raise DraxError(
                f"a run of {self.duration:g} s leaves no time for pushes: they come after the "
                f"horizon of {begin:g} s and {SETTLE:g} s before the end. Make it longer."
            )
        return begin, end

    def run(
        self,
        count: int,
        pushes: int,
        push: float,
        seed: int = 0,
        report: Callable[[int, Motion], None] | None = None,
        **plant: Any,
    ) -> Trials:
        """`count` runs from the problem's x_init, with so many pushes of a size [m/s] in each.

        Pushes fall between the end of the first horizon and `SETTLE` before the end; see `check`.
        `plant` holds arguments of `Plant`; run i has the seed `seed` + i.
        """
        problem = self.policy.problem
        begin, end = self.check(count, pushes)
        for i in range(count):
            hits = random_pushes(problem, pushes, push, (begin, end), seed + i) if pushes else []
            self.policy.rewind()
            body = Plant(problem, pushes=hits, seed=seed + i, **plant)
            motion = simulate(self.policy, body, self.duration, realtime=self.realtime, pushes=hits)
            self.motions.append(motion)
            if report is not None:
                report(i, motion)
        return self

    def summary(self) -> dict[str, Any]:
        """What `mpc.json` holds. Costs are those of the problem, summed over the steps driven."""
        policy, runs = self.policy, [m.statistics for m in self.motions]
        latencies = np.concatenate([s.latencies for s in runs])
        plans = sum(s.plans for s in runs)
        some = plans > 0
        judged = [m.reached for m in self.motions if m.reached is not None]
        driven, worst = zip(*(_driven(policy, m) for m in self.motions), strict=True)
        return {
            "task": policy.problem.name,
            "device": jax.devices()[0].device_kind,
            "horizon": policy.problem.horizon,
            "dt": float(policy.problem.dynamics.dt),
            "chains": policy.chains,
            "explorers": policy.explorers,
            "iterations": policy.iterations,
            "every": policy.every,
            "seed": policy.seed,
            "realtime": self.realtime,
            "behind_s": max(m.behind for m in self.motions),
            "duration": self.duration,
            "first_solve_s": policy.first_solve,
            "plans": plans,
            "plans_per_s": float(1.0 / latencies.mean()) if some else None,
            "latency_s": {
                f"p{p}": float(np.percentile(latencies, p)) if some else None for p in PERCENTILES
            },
            "failed_plans": sum(s.failed for s in runs),
            "infeasible_plans": sum(s.infeasible for s in runs),
            "switches": sum(s.switches for s in runs),
            "runs": len(self.motions),
            "reached": sum(judged) if judged else None,
            "success_rate": float(np.mean(judged)) if judged else None,
            "cost": float(np.mean(driven)),
            "costs": list(driven),
            "broken": {kind: max(each[kind] for each in worst) for kind in worst[0]},
            "pushes": [[vars(push) for push in m.pushes] for m in self.motions],
        }


def _driven(policy: MPC, motion: Motion) -> tuple[float, dict[str, float]]:
    """What a run came to.

    Its cost, phi at the end plus the running cost at the start of every control step. And by how
    much it broke constraints of the stages and bounds of states, in the user's units.
    """
    problem = policy.original
    problem, dynamics = problem.at_time(float(motion.times[0])), problem.dynamics
    each = round(float(dynamics.dt) / (motion.times[1] - motion.times[0]))
    x, u = np.append(motion.states[:-1:each], motion.states[-1:], axis=0), motion.controls[::each]
    if isinstance(dynamics, Extended):
        further = np.append(motion.further[::each], motion.further[-1:], axis=0)
        x = driven(dynamics, np.append(x, further, axis=1), u)
        phases = (len(u),) * len(dynamics.phases)
        problem = replace(problem, dynamics=replace(dynamics, phases=phases))
    row = np.minimum(np.arange(len(u) + 1), problem.horizon)  # the last one stays
    with problem.arithmetic():
        data = jax.tree.map(lambda a: a[row], problem.data)
        whole = replace(problem, x_init=jnp.asarray(x[0]), horizon=len(u), data=data)
        if problem.data_at is not None:
            whole = replace(whole, data=data_rows(problem.data_at, whole.times))
        driven_knots = Trajectory(jnp.asarray(x[1:]), jnp.asarray(u))
        cost, found = _cost_and_constraints(whole, driven_knots)
    rows = np.asarray(found.stage)
    equal, box = problem.constraint.equalities, problem.bounds
    own = slice(policy.original.dynamics.given_nx)
    above, below = x[1:] - np.asarray(box.x_upper), np.asarray(box.x_lower) - x[1:]
    broken = {
        "equality": np.abs(rows[:, :equal]),
        "inequality": rows[:, equal:],
        "state bounds": np.maximum(above, below)[:, own],
    }
    worst = {kind: float(by.max(initial=0.0)) for kind, by in broken.items() if by.size}
    return float(cost), worst


@jax.jit
@full_precision
def _cost_and_constraints(problem: Problem, knots: Trajectory) -> tuple[Array, Stagewise]:
    return problem.cost(knots), problem.constraints(knots)


def lines(numbers: dict[str, Any]) -> list[str]:
    """The summary for a person."""
    rate = "no further plans"
    latency = "none"
    if numbers["plans"]:
        rate = f"{numbers['plans_per_s']:.1f} plans/s"
        latency = ", ".join(f"{p} {1e3 * s:.1f}" for p, s in numbers["latency_s"].items()) + " ms"
    waits = "the plant waits for each plan"
    if numbers["realtime"]:
        waits = f"in real time, {1e3 * numbers['behind_s']:.1f} ms behind the clock at most"
    share = numbers["success_rate"]
    count = sum(map(len, numbers["pushes"]))
    broken = ", ".join(f"{kind} by {by:.2g}" for kind, by in numbers["broken"].items() if by > 0)
    outcome = (
        "no goal to judge by"
        if share is None
        else (f"{numbers['reached']} of {numbers['runs']} end in the goal ({share:.0%})")
    )
    return [
        f"rate      {rate} on {numbers['device']}; {waits}",
        f"latency   {latency} over {numbers['plans']} plans, {numbers['failed_plans']} failed, "
        f"{numbers['infeasible_plans']} infeasible",
        f"cost      {numbers['cost']:.4g} a run of {numbers['duration']:g} s, on average",
        f"runs      {outcome}; {count} pushes in all",
        *([f"broken    {broken}, at most"] if broken else []),
    ]


def film(
    problem: Problem,
    motion: Motion,
    path: str | os.PathLike[str],
    *,
    caption: bool = True,
    **look: Any,
) -> Path:
    """A film of one run, with an arrow while a push lasts; see `view.video.render_motion`."""
    from mjx_drax.view.scene import posed
    from mjx_drax.view.video import render_motion

    model = mujoco_model(problem.dynamics)
    assert model is not None  # for the type checker: a plant has one
    lines_ = [f"{problem.name}, model predictive control", "t = {time}"]
    lines_ += [f"push of {p.force[0]:+.1f} N on {p.body} at {p.time:.2f} s" for p in motion.pushes]
    qpos = motion.states[:, : model.nq]
    strongest = max((np.linalg.norm(p.force) for p in motion.pushes), default=0.0) or 1.0
    length = ARROW * float(model.stat.extent)

    def arrows(time: float) -> list[tuple[np.ndarray, np.ndarray]]:
        found = []
        now = min(int(np.searchsorted(motion.times, time)), len(qpos) - 1)
        pose = next(posed(model, qpos[now : now + 1]))
        for push in motion.pushes:
            if push.time <= time < push.time + max(push.lasts, SHOWN):
                vector = length * np.asarray(push.force) / strongest
                centre = pose.xipos[model.body(push.body).id]
                found.append((centre - vector, vector))  # it ends where it pushes
        return found

    overlay = lines_ if caption else []
    return render_motion(model, qpos, motion.times, path, overlay=overlay, arrows=arrows, **look)

"""Theorem 2 at the pendulum's optimum: mu*, where the flow is stable, and its energy.

With v = grad L_mu, h = 0 at the optimum, and the barrier rho b in the cost,

    A = Hessian of c + rho b + lambda'h, + mu J'J

is positive definite for mu > mu*. The linearized flow is, in d = (z - z*, lambda - lambda*),

    d' = [[-A / 2, -J' / 2], [mu J, 0]] d,      d <- d - alpha [[A, J'], [-2 mu J, 0]] d

in continuous time and per iteration. The proof's energy E = |v|^2 / 2 + |h|^2 / 2 has, under the
flow with lambda' = mu h, dE/dt = -v'A v / 2 + (mu - 1/2) v'J'h. With |v|^2 / 2 + mu |h|^2 the last
term is 0.
All in float64, dense.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from matplotlib.figure import Figure

from mjx_drax import tasks
from mjx_drax.base.errors import DraxError
from mjx_drax.method.langevin import Langevin
from mjx_drax.method.schedules import Constant, Geometric
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.solve import solve
from mjx_drax.studies.reproduce import settings
from mjx_drax.studies.reproduce.output import Numbers, tell
from mjx_drax.view.plotting import BLACK, CURVES, label_axes, new_figure

DESCENT = Langevin(
    iterations=0,
    tail=300,
    penalty=Constant(100.0),
    damping=Geometric(1e-2, 1e-3, 1e-3),
)
"""Finds the optima, without noise, for a constant weight of the barrier."""

NEAR = 1e-2
"""Standard deviation of the starts about the optimum, from which the energy is followed."""


@dataclass(frozen=True)
class Optimum:
    """A point that satisfies the first-order conditions for a weight rho of the barrier.

    Attributes:
        rho: of the barrier.
        z, multipliers: the point (n,) and lambda (m,).
        hessian: of c + rho b + lambda'h, (n, n).
        jacobian: J, (m, n).
    """

    rho: float
    z: np.ndarray
    multipliers: np.ndarray
    hessian: np.ndarray
    jacobian: np.ndarray

    def A(self, mu: float) -> np.ndarray:
        """The matrix of the theorem, (n, n)."""
        return np.asarray(self.hessian + mu * self.jacobian.T @ self.jacobian)

    def definite_from(self) -> float:
        """mu*: the least mu for which A is positive definite."""
        return _threshold(lambda mu: bool(np.linalg.eigvalsh(self.A(mu))[0] > 0.0))

    def stable_from(self) -> float:
        """The least mu from which on the linearized flow is stable in continuous time."""
        return _threshold(lambda mu: bool(np.linalg.eigvals(self._flow(mu)).real.max() < 0.0))

    def largest_step(self, mu: float) -> float | None:
        """The largest alpha for which the linearized iteration is stable; None if none is."""
        low = 1e-6
        found = _threshold(lambda step: not self.decay(mu, step) > 0.0, low=low, high=1.0)
        return None if found <= low else found

    def decay(self, mu: float, step: float) -> float:
        """By which share the slowest mode shrinks in an iteration; negative if one grows."""
        n, m = len(self.z), len(self.multipliers)
        change = np.eye(n + m)
        change[:n] -= step * np.hstack([self.A(mu), self.jacobian.T])
        change[n:, :n] += 2.0 * step * mu * self.jacobian
        return float(1.0 - np.abs(np.linalg.eigvals(change)).max())

    def _flow(self, mu: float) -> np.ndarray:
        m = len(self.multipliers)
        above = np.hstack([-0.5 * self.A(mu), -0.5 * self.jacobian.T])
        return np.vstack([above, np.hstack([mu * self.jacobian, np.zeros((m, m))])])


def _threshold(holds: Callable[[float], bool], low: float = 1e-4, high: float = 1e5) -> float:
    """The least number of an interval from which on something holds, to three digits.

    It is looked for from above, on a logarithmic scale; below it may hold again.
    """
    if not holds(high):
        return float("nan")
    steps = np.geomspace(high, low, round(np.log10(high / low)) * 4 + 1)
    for above, below in pairwise(steps):
        if not holds(float(below)):
            good, bad = float(above), float(below)
            while good / bad > 1.001:
                middle = (good * bad) ** 0.5
                good, bad = (middle, bad) if holds(middle) else (good, middle)
            return good
    return low


def make(
    chains: int = 8,
    iterations: int | None = None,
    barriers: Sequence[float] = (1e-4, 1e-3, 1e-2, 1e-1),
    penalties: Sequence[float] = (0.1, 1.0, 10.0, 100.0),
) -> tuple[Numbers, Figure]:
    """mu* over rho, steps and rates of decay over mu, and energies from starts near each optimum.

    There are `chains` starts, whose energy is followed for 4,000 iterations by default; barriers
    are values of rho, rising, penalties values of mu. Energies are drawn for the first rho.
    """
    with jax.enable_x64(True):
        problem = tasks.load("pendulum").make()
        functions = _Functions(problem)
        rows: list[dict[str, Any]] = []
        optima: list[Optimum] = []
        for rho in barriers:
            tell(f"theorem-2: optimum and thresholds at ρ = {rho:g}")
            optimum = _optimum(functions, problem, rho, optima[-1] if optima else None)
            optima.append(optimum)
            rows.append(
                {
                    "rho": rho,
                    "cost": float(functions.cost(optimum.z, 0.0)),
                    "mu* (A positive definite)": optimum.definite_from(),
                    "linearized flow stable from mu": optimum.stable_from(),
                    **{f"largest α, μ = {mu:g}": optimum.largest_step(mu) for mu in penalties},
                    "slowest mode, μ = 10, α = 0.025, per iteration": optimum.decay(10.0, 0.025),
                }
            )
        energies = {}
        for optimum, row in zip(optima, rows, strict=True):
            tell(f"theorem-2: energies at ρ = {optimum.rho:g}")
            names = {mu: f"largest α, μ = {mu:g}" for mu in penalties}
            # where no step is stable, that of the first ρ shows how the energy grows
            steps = {mu: 0.2 * (row[key] or rows[0][key] or 0.0) for mu, key in names.items()}
            energies[f"{optimum.rho:g}"] = _energies(
                functions, optimum, chains, iterations or 4000, steps
            )
    figure = new_figure(10.2, 3.6)
    left, right = figure.subplots(1, 2)
    weights = [row["rho"] for row in rows]
    for name, color in zip(list(rows[0])[2:4], CURVES, strict=False):
        words = name.replace("mu", "μ")
        left.loglog(weights, [row[name] for row in rows], "o-", color=color, label=words)
    label_axes(left, "barrier weight ρ", "penalty μ")
    left.set_title("pendulum: where theorem 2 holds", loc="left", fontsize=9)
    left.legend(fontsize=7, loc="upper left")
    drawn = energies[f"{barriers[0]:g}"]
    for (mu, curve), color in zip(drawn.items(), CURVES, strict=False):
        for name, style in (("the proof's", "--"), ("with μ|h|²", "-")):
            label = f"μ = {mu}" if style == "-" else None
            right.semilogy(curve["iteration"], curve[name], style, color=color, lw=1.2, label=label)
    right.plot([], [], "--", color=BLACK, label="the proof's |v|²/2 + |h|²/2")
    right.plot([], [], "-", color=BLACK, label="|v|²/2 + μ |h|²")
    label_axes(right, "iteration", "energy, relative to the first")
    right.set_title(f"energy from near the optimum, ρ = {barriers[0]:g}", loc="left", fontsize=9)
    right.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    rises = [
        {
            "rho": float(rho),
            "mu": float(mu),
            "step size": curve["step size"],
            "rises of the proof's energy": curve["rises"][0],
            "rises with μ|h|²": curve["rises"][1],
            "energy left (the proof's)": curve["the proof's"][-1],
        }
        for rho, of_rho in energies.items()
        for mu, curve in of_rho.items()
    ]
    flow = settings.PENDULUM_FLOW
    return {"rows": rows, "energies": rises, "series": energies, "settings": {"flow": flow}}, figure


def _rises(energy: np.ndarray) -> np.ndarray:
    """The share of steps in which an energy (iterations, ...) rises, as long as it is finite."""
    known = np.isfinite(energy[1:])
    rises = known & (np.diff(energy, axis=0) > 1e-12 * energy[:-1])
    return np.asarray(rises.sum(axis=0) / np.maximum(known.sum(axis=0), 1))


class _Functions:
    """Cost, barrier and defects of flat knots z (n,), and their derivatives."""

    def __init__(self, problem: Problem) -> None:
        like = jax.vmap(problem.draw)(jax.random.split(jax.random.key(0), 1))
        zero, self._knots = ravel_pytree(jax.tree.map(lambda a: a[0], like))
        self.size, self._problem = len(zero), problem
        box, bounds = problem.bounds, settings.PENDULUM_FLOW.bounds

        def cost(z: Array, rho: Array) -> Array:
            knots = self._knots(z)
            return problem.cost(knots) + rho * jnp.sum(bounds.value(box, knots))

        def h(z: Array) -> Array:
            return problem.defects(self._knots(z)).ravel()

        def lagrangian(z: Array, lambda_: Array, rho: Array, mu: Array) -> Array:
            return cost(z, rho) + lambda_ @ h(z) + 0.5 * mu * h(z) @ h(z)

        self.cost = jax.jit(cost)
        self.h, self.jacobian = jax.jit(h), jax.jit(jax.jacfwd(h))
        self.gradient = jax.jit(jax.grad(lagrangian))
        self.hessian = jax.jit(jax.hessian(lagrangian))

    def flat(self, knots: Any) -> np.ndarray:
        """Knots as z."""
        return np.asarray(ravel_pytree(knots)[0])

    def slack(self, z: np.ndarray, step: np.ndarray) -> float:
        """The largest share of a step that uses up at most 0.9 of every slack."""
        share = 1.0
        for end in map(self.flat, self._problem.bounds.sides(self._knots(jnp.asarray(z)))):
            known = np.isfinite(end)  # before products: inf times 0 is no number
            change, toward = step[known], (end - z)[known] * np.sign(step[known])
            moves = toward > 0
            share = np.min(0.9 * toward[moves] / np.abs(change[moves]), initial=share)
        return float(share)


def _optimum(
    functions: _Functions, problem: Problem, rho: float, before: Optimum | None
) -> Optimum:
    """An optimum with a barrier of weight rho, refined by Newton's method.

    It is near the one of the barrier before, or near the cheapest of a few solves. These do not
    converge where the barrier is so heavy that the flow is not stable.
    """
    if before is None:
        solver = replace(DESCENT, barrier_weight=Constant(rho))
        found = solve(problem, 4, seed=1, solver=solver, precision=64)
        best = int(np.argmin(np.where(found.feasible, found.cost, np.inf)))
        knots = jax.tree.map(lambda a: jnp.asarray(a[best]), found.trajectories)
        at = functions.flat(knots), np.asarray(found.multipliers.dynamics[best]).ravel()
    else:
        at = before.z, before.multipliers
    z, lambda_ = _newton(functions, *at, rho)
    hessian, J = functions.hessian(z, lambda_, rho, 0.0), functions.jacobian(z)
    return Optimum(rho, z, lambda_, np.asarray(hessian), np.asarray(J))


def _newton(
    functions: _Functions, z: np.ndarray, lambda_: np.ndarray, rho: float
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point with grad c + rho grad b + J'lambda = 0 and h = 0."""
    n = functions.size
    for _ in range(100):
        J, h = np.asarray(functions.jacobian(z)), np.asarray(functions.h(z))
        gradient = np.asarray(functions.gradient(z, lambda_, rho, 0.0))
        if max(np.abs(gradient).max(), np.abs(h).max()) < 1e-9:
            return z, lambda_
        H = np.asarray(functions.hessian(z, lambda_, rho, 0.0))
        K = np.block([[H, J.T], [J, np.zeros((len(h), len(h)))]])
        step = np.linalg.solve(K, -np.concatenate([gradient, h]))
        share = functions.slack(z, step[:n])
        z, lambda_ = z + share * step[:n], lambda_ + share * step[n:]
    raise DraxError(f"Newton's method found no optimum at rho = {rho:g}: give other barriers.")


def _energies(
    functions: _Functions,
    optimum: Optimum,
    chains: int,
    iterations: int,
    steps: dict[float, float],
) -> dict[str, Any]:
    """Both energies, the mean over the chains, along the flow without noise.

    `steps` has a step size alpha for every mu.
    """
    random = np.random.default_rng(0).normal(size=(chains, functions.size))
    z = jnp.asarray(optimum.z)
    starts = jnp.stack([z + functions.slack(optimum.z, NEAR * r) * NEAR * r for r in random])
    lambdas = jnp.broadcast_to(optimum.multipliers, (chains, len(optimum.multipliers)))

    def step(state: Any, _: None, alpha: Array, mu: Array) -> tuple[Any, Array]:
        z, lambda_ = state
        h = jax.vmap(functions.h)(z)
        v = jax.vmap(lambda z, m: functions.gradient(z, m, optimum.rho, mu))(z, lambda_)
        kinetic, violation = (jnp.sum(jnp.square(a), axis=-1) for a in (v, h))
        both = jnp.stack([0.5 * kinetic + 0.5 * violation, 0.5 * kinetic + mu * violation])
        return (z - alpha * v, lambda_ + 2.0 * alpha * mu * h), both.mean(axis=1)

    @jax.jit
    def run(alpha: Array, mu: Array) -> Array:
        return jax.lax.scan(
            lambda s, x: step(s, x, alpha, mu), (starts, lambdas), None, iterations
        )[1]

    found, every = {}, max(1, iterations // 400)
    for mu, alpha in steps.items():
        values = np.asarray(run(jnp.asarray(alpha), jnp.asarray(mu)))
        values = values / values[0]
        found[f"{mu:g}"] = {
            "step size": alpha,
            "rises": _rises(values).tolist(),
            "iteration": list(range(0, iterations, every)),
            "the proof's": values[::every, 0].tolist(),
            "with μ|h|²": values[::every, 1].tolist(),
        }
    return found

"""Discrete-time dynamics x_{k+1} = f(x_k, u_k), and the arithmetic of its states.

A state x holds nx numbers. Differences between states live in the tangent space and hold ndx
numbers; on a vector space the two are the same. Everything that is solved for (defects,
linearizations, multipliers, noise) lives in tangent space.

A system of your own is a frozen dataclass under `mjx_drax.register_dataclass` with the fields `dt`,
`nx` and `nu` and one method, `step`. One whose states are no vectors (angles that wrap,
quaternions) brings three, `step`, `difference` and `integrate`, and `ndx`. The rest has defaults.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, Self, TypeVar

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.problem import rollout
from mjx_drax.problem.cost import at_knot, in_float64
from mjx_drax.problem.trajectory import Knot, Trajectory

System = TypeVar("System")


@dataclass(frozen=True)
class Unlimited(Generic[System]):
    """A system whose actuators give any force, and where those of the true one have ends.

    Attributes:
        dynamics: the system.
        useful: the ends (..., nu) of controls of use at states (..., nx); see `useful_controls`.
        at_once: by how much controls of a stage are beyond the ends, from what functions of a stage
            are called with, (rows,): no force then leaves its range as the knot begins.
        all_along: the same of controls at whose ends forces are largest until the next knot, by an
            estimate: a motion should need none beyond.
        rows: of both.
        held: the nearest control (nu,) to one that gives no force beyond its range at a state
            (nx,), from both, on the host.
    """

    dynamics: System
    useful: Callable[[Array], tuple[Array, Array] | None]
    at_once: Partial
    all_along: Partial
    rows: int
    held: Callable[[np.ndarray, np.ndarray], np.ndarray]


class Dynamics:
    """f(x, u), and how states are compared and displaced.

    Attributes:
        nx: numbers in a state.
        ndx: numbers in a difference of states; nx by default.
        nu: numbers in a control.
        dt: time between knots [s].
        kinked: whether f has kinks, as contacts make them. Then all chains start near x_init, and
            the default solver rolls plans out (`Restarts.rollouts`).
        constraint_rows: rows that a step solves constraint forces for.
        state_damping: damping of states beside that of controls in `GaussNewton`.
        twice: whether the polish differentiates f twice; else it learns what curvature f has.
        checked: f has been tried where it was made, and need not be traced once more; a knot where
            it has no derivative is passed over (`without_gaps`).
        phases: numbers of knots of the phases of free duration; () where dt is fixed.
        x_names, u_names: of the entries of states and controls, for tables, plots and errors, such
            as "angle [rad]"; without them x0, x1, ... and u0, u1, ...
    """

    nx: int
    nu: int
    dt: float
    kinked: bool = False
    constraint_rows: int = 0
    state_damping: float = 1.0
    twice: bool = True
    checked: bool = False
    phases: tuple[int, ...] = ()
    x_names: tuple[str, ...] = ()
    u_names: tuple[str, ...] = ()

    @property
    def ndx(self) -> int:
        """Numbers in a difference of states."""
        return self.nx

    @property
    def given_nx(self) -> int:
        """Numbers in a state as a user gives it, without what the problem has added."""
        return self.nx

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u): the state (nx,) one knot after x (nx,) under the control u (nu,)."""
        raise NotImplementedError

    def at(self, knot: Knot) -> Self:
        """The same system at one knot, where `step` and `observe` depend on its time or data."""
        return self

    def difference(self, x: Array, y: Array) -> Array:
        """x - y in the tangent space at y, (ndx,), so that integrate(y, x - y) = x."""
        return x - y

    def integrate(self, x: Array, dx: Array) -> Array:
        """x + dx: the state (nx,) reached from x (nx,) along the tangent vector dx (ndx,)."""
        return x + dx

    def valid(self, x: Array) -> Array:
        """The state next to numbers (..., nx) that need not be one, as random numbers are not."""
        return x

    def tangent(self, numbers: Array) -> Array:
        """Of numbers for the entries of a state (..., nx), those for its tangent (..., ndx).

        Bounds are on entries of states; their forces act in tangent space. By default there are
        none where the two differ in size: such a system needs an own method to have bounds.
        """
        return numbers if self.ndx == self.nx else jnp.zeros((*numbers.shape[:-1], self.ndx))

    def useful_controls(self, x: Array) -> tuple[Array, Array] | None:
        """Ends (..., nu) of controls beyond which f hardly changes at states (..., nx).

        As beyond those at which an actuator gives its largest force. The search starts between
        them, and goes back there, since f has no slope beyond. None if there are none.
        """
        return None

    def unlimited(self) -> Unlimited[Self] | None:
        """The same system with actuators whose forces have no ends, if they are in the way.

        f then has a slope wherever controls are. None if no controls of use end, as by default.
        """
        return None

    def observe(self, x: Array, u: Array) -> Any:
        """What cost functions receive for the knot (x, u): here the state itself."""
        return x

    def differentiator(self, by: Any) -> Any:
        """How costs and constraints of one knot are differentiated, if asked to by `by`."""
        return by

    def step_differentiator(self, by: Any) -> Any:
        """How f is differentiated, if asked to by `by`."""
        return by

    def in_float64(self) -> Any:
        """The same system, for float64: own functions must not have been traced in float32.

        Its numbers may stay in float32; who asks for this makes them float64.
        """
        return self

    @property
    def engine(self) -> str:
        """What replays a result, in words."""
        return "rollout of f, float64"

    def fingerprint(self) -> bytes:
        """What replays depend on besides the numbers of the pytree; checkpoints keep its digest."""
        return b""

    def replay(
        self,
        plan: np.ndarray,
        u: np.ndarray,
        gains: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        knots: Knot,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run u_k + K_k (x_k - plan_k), clipped to the control limits, in float64.

        Args:
            plan: planned states x_0..x_K, (chains, K + 1, nx); each replay starts at its x_0.
            u: planned controls, (chains, K, nu).
            gains: feedback K_k, (chains, K, nu, ndx); zeros replay open loop.
            limits: (lower, upper), each broadcastable to (K, nu).
            knots: those of the K stages, for all chains, or for each with an axis in front.

        Returns:
            states (chains, K + 1, nx) and the controls that were applied (chains, K, nu).
        """
        return rollout.replay(self, plan, u, gains, limits, knots)

    def stepper(self, x: np.ndarray) -> Any:
        """An engine of its own with states (chains, nx) to step; None: f in float64."""
        return None

    def configured(
        self, stepper: Any, dt: np.ndarray, parameters: Mapping[str, Any] | None
    ) -> None:
        """Give every chain of a stepper its time between knots [s] and parameters; None: as are."""
        raise NotImplementedError

    def of_parameters(self, parameters: Mapping[str, Any]) -> Dynamics:
        """The same with those parameters in what it has on the host; here nothing depends on it."""
        return self

    def times(self, states: np.ndarray, t_init: float) -> np.ndarray:
        """Times of x_0..x_K (K + 1, nx), (K + 1,) [s]."""
        return t_init + float(self.dt) * np.arange(len(states))

    def consistent(self, knots: Trajectory) -> Trajectory:
        """Drawn or guessed knots, with those states that must agree with others."""
        return knots

    def host_difference(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """`difference` of states (..., nx) on the host, in float64, (..., ndx)."""
        if type(self).difference is Dynamics.difference:
            return np.asarray(x - y)
        return rollout.apply(self, "difference", x, y)

    def host_integrate(self, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """`integrate` of states (..., nx) by (..., ndx) on the host, in float64."""
        if type(self).integrate is Dynamics.integrate:
            return np.asarray(x + dx)
        return rollout.apply(self, "integrate", x, dx)

    def observe_replayed(self, x: np.ndarray, time: float) -> Any:
        """What goal functions receive for a replayed state (nx,) at a time [s]: here the state."""
        return x

    def left_out(self, states: np.ndarray) -> tuple[int, str] | None:
        """The first of some states (n, nx) where something acts that replays have and f has not.

        Returns:
            the number of the state, and in words what acts there; None if nothing does.
        """
        return None

    def observer(self) -> Callable[[np.ndarray, float], Any]:
        """`observe_replayed` for many states: what it returns may change with its next call."""
        return self.observe_replayed


@register_dataclass
@dataclass(frozen=True)
class FunctionDynamics(Dynamics):
    """Dynamics given as a JAX function f(x (nx,), u (nu,)) -> x_next (nx,) on a vector space.

    f may have a third parameter, `knot`.
    """

    function: Partial
    dt: float
    nx: int = field(metadata=Static)
    nu: int = field(metadata=Static)
    x_names: tuple[str, ...] = field(default=(), metadata=Static)
    u_names: tuple[str, ...] = field(default=(), metadata=Static)

    def step(self, x: Array, u: Array) -> Array:
        """f(x, u), (nx,)."""
        return self.function(x, u)

    def at(self, knot: Knot) -> Self:
        """The same at one knot."""
        function: Any = at_knot(self.function, knot)
        return replace(self, function=function)

    def in_float64(self) -> FunctionDynamics:
        """The same with a function that has not been traced in float32."""
        return replace(self, function=in_float64(self.function))

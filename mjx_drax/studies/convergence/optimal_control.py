"""Optimal control problems of textbooks, with a first guess that knows nothing but both ends.

Where a continuous problem is known, `runge_kutta` makes the step, with the control held between
knots; costs that are integrals are computed by the same method. The optimum of such a problem nears
the continuous one as knots are added. The controls of all problems but the chain's are bounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.physics.actuators import middle_control
from mjx_drax.problem.build import from_function
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Trajectory

Rate = Callable[[Array, Array], Array]


@dataclass(frozen=True)
class Case:
    """A problem and its first guess.

    Attributes:
        make: builds the problem.
        end: where the straight line of states ends, (nx,); None: the initial state is held.
        source: where the problem comes from.
        optimum: the least cost of the continuous problem, where it is known.
        error: by how much the least cost with this many knots may differ from it, relative.
    """

    make: Callable[[], Problem]
    end: Sequence[float] | None
    source: str
    optimum: float | None = None
    error: float = 3e-3

    def guess(self, problem: Problem) -> Trajectory:
        """The straight line from x_init to `end`, (K, nx), and middles of the control box."""
        return straight(problem, self.end)


def straight(problem: Problem, end: Sequence[float] | None = None) -> Trajectory:
    """States on the straight line from x_init to `end` (nx,), and controls in their middles.

    Quaternions are made unit ones. A control that is free is 0, one with a single bound lies at
    that bound or at 0. Parameters and durations are in the middle of their bounds, a free x_0 is
    next to x_init.
    """
    K, nu, bounds = problem.horizon, problem.dynamics.nu, problem.bounds
    start = np.asarray(problem.x_init, float)[: problem.dynamics.given_nx]
    goal = start if end is None else np.asarray(end, float)
    share = np.arange(1, K + 1)[:, None] / K
    x = jnp.asarray(start + share * (goal - start))
    u = np.broadcast_to(middle_control(bounds), (K, nu))
    return problem.started(Trajectory(x, jnp.asarray(u)))


def runge_kutta(rate: Rate, dt: Array | float) -> Rate:
    """x after dt [s] of x' = rate(x, u) under a constant u, by the classical method of order 4."""

    def step(x: Array, u: Array) -> Array:
        a = rate(x, u)
        b = rate(x + 0.5 * dt * a, u)
        c = rate(x + 0.5 * dt * b, u)
        d = rate(x + dt * c, u)
        return x + dt / 6 * (a + 2 * b + 2 * c + d)

    return step


def integral(rate: Rate, density: Rate, dt: Array | float) -> Rate:
    """The integral of density(x, u) over one step of `runge_kutta`, as a running cost."""

    def both(y: Array, u: Array) -> Array:
        return jnp.append(rate(y[:-1], u), density(y[:-1], u))

    def cost(x: Array, u: Array) -> Array:
        return runge_kutta(both, dt)(jnp.append(x, 0.0), u)[-1]

    return cost


def held(
    rate: Rate, density: Rate | None = None, *, dt: float, nu: int = 1, **rest: Any
) -> Problem:
    """A problem with steps of `runge_kutta` and, if a density is given, its integral as cost."""
    if density is not None:
        rest["running_cost"] = integral(rate, density, dt)
    return from_function(runge_kutta(rate, dt), nu=nu, dt=dt, **rest)


def van_der_pol(constrained: bool = False) -> Problem:
    """An oscillator with negative damping; constrained: x_1 >= -1/4, and at rest at the end."""

    def rate(x: Array, u: Array) -> Array:
        return jnp.array([(1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]])

    return held(
        rate,
        lambda x, u: jnp.sum(x**2) + u[0] ** 2,
        x_init=[0.0, 1.0],
        dt=0.1,
        horizon=10.0,
        inequality=(lambda x, u: -0.25 - x[:1]) if constrained else None,
        terminal_equality=(lambda x: x) if constrained else None,
        u_bounds=(-1.0, 1.0),
    )


def rayleigh() -> Problem:
    """Current of an oscillator with a tunnel diode."""

    def rate(x: Array, u: Array) -> Array:
        return jnp.array([x[1], -x[0] + x[1] * (1.4 - 0.14 * x[1] ** 2) + 4 * u[0]])

    return held(
        rate,
        lambda x, u: x[0] ** 2 + u[0] ** 2,
        x_init=[-5.0, -5.0],
        dt=0.05,
        horizon=4.5,
        terminal_equality=lambda x: x,
        u_bounds=(-1.0, 1.0),
    )


def hanging_chain() -> Problem:
    """A chain of length 4 between two points hangs where its potential energy is least.

    The place along the ground stands for time; x = [height, length so far], u = slope.
    """

    def rate(x: Array, u: Array) -> Array:
        return jnp.array([u[0], jnp.sqrt(1 + u[0] ** 2)])

    return held(
        rate,
        lambda x, u: x[0] * jnp.sqrt(1 + u[0] ** 2),
        x_init=[1.0, 0.0],
        dt=0.01,
        horizon=1.0,
        terminal_equality=lambda x: x - jnp.array([3.0, 4.0]),
    )


def crane() -> Problem:
    """A container crane moves its load from a ship to a truck, with little swing and effort."""

    def rate(x: Array, u: Array) -> Array:
        swing = -(u[0] + 27.0756 * x[2] + 2 * x[4] * x[5]) / x[1]
        return jnp.array([x[3], x[4], x[5], u[0] + 17.2656 * x[2], u[1], swing])

    def swing_and_effort(x: Array, u: Array) -> Array:
        return 0.5 * (x[2] ** 2 + x[5] ** 2 + 0.01 * jnp.sum(u**2))

    return held(
        rate,
        swing_and_effort,
        x_init=[0.0, 22.0, 0.0, 0.0, -1.0, 0.0],
        nu=2,
        dt=0.1,
        horizon=9.0,
        terminal_equality=lambda x: x - jnp.array([10.0, 14.0, 0.0, 2.5, 0.0, 0.0]),
        x_bounds=([-np.inf] * 3 + [-2.5, -1.0, -np.inf], [np.inf] * 3 + [2.5, 1.0, np.inf]),
        u_bounds=([-2.83374, -0.80865], [2.83374, 0.71265]),
    )


def robot_arm() -> Problem:
    """Two links turn by 0.522 rad with the least effort, in hardly more than the least time."""
    dt = 0.05

    def rate(x: Array, u: Array) -> Array:
        s, c = jnp.sin(x[2]), jnp.cos(x[2])
        below = 31 / 36 + 2.25 * s**2
        first = s * (2.25 * c * x[0] ** 2 + 2 * x[1] ** 2) + 4 / 3 * (u[0] - u[1]) - 1.5 * c * u[1]
        second = s * (2.25 * c * x[1] ** 2 + 3.5 * x[0] ** 2) - 7 / 3 * u[1]
        second = second + 1.5 * c * (u[0] - u[1])
        return jnp.array([first / below, -second / below, x[1] - x[0], x[0]])

    return held(
        rate,
        x_init=[0.0, 0.0, 0.5, 0.0],
        nu=2,
        dt=dt,
        horizon=3.2,
        running_residual=lambda x, u: np.sqrt(2 * dt) * u,
        terminal_equality=lambda x: x - jnp.array([0.0, 0.0, 0.5, 0.522]),
        u_bounds=(-1.0, 1.0),
    )


def catalytic_cracker() -> Problem:
    """Two catalysts are mixed along a reactor, for the most product; a part of u is singular."""

    def rate(x: Array, u: Array) -> Array:
        first = u[0] * (10 * x[1] - x[0])
        return jnp.array([first, -first - (1 - u[0]) * x[1]])

    return held(
        rate,
        x_init=[1.0, 0.0],
        dt=0.01,
        horizon=1.0,
        terminal_cost=lambda x: x[0] + x[1] - 1,
        u_bounds=(0.0, 1.0),
    )


def batch_reactor() -> Problem:
    """A -> B -> C, with as much B as possible; u is the temperature [100 K]."""

    def rate(x: Array, u: Array) -> Array:
        made = 4000 * jnp.exp(-25 / u[0]) * x[0] ** 2
        return jnp.array([-made, made - 620000 * jnp.exp(-50 / u[0]) * x[1]])

    return held(
        rate,
        x_init=[1.0, 0.0],
        dt=0.02,
        horizon=1.0,
        terminal_cost=lambda x: -x[1],
        u_bounds=(2.98, 3.98),
    )


def stirred_tank() -> Problem:
    """A stirred-tank reactor is brought back to its unstable steady state."""

    def rate(x: Array, u: Array) -> Array:
        reaction = (x[1] + 0.5) * jnp.exp(25 * x[0] / (x[0] + 2))
        return jnp.array([-(2 + u[0]) * (x[0] + 0.25) + reaction, 0.5 - x[1] - reaction])

    return held(
        rate,
        lambda x, u: jnp.sum(x**2) + 0.1 * u[0] ** 2,
        x_init=[0.09, 0.09],
        dt=0.02,
        horizon=0.78,
        x_bounds=(-1.0, 1.0),  # further off the reaction's rate overflows
        u_bounds=(-20.0, 20.0),
    )


def bryson_denham() -> Problem:
    """A cart turns round before a wall at 1/9 m, with the least effort; the wall is a bound."""
    dt = 0.02

    def rate(x: Array, u: Array) -> Array:
        return jnp.array([x[1], u[0]])

    return held(
        rate,
        x_init=[0.0, 1.0],
        dt=dt,
        horizon=1.0,
        running_residual=lambda x, u: np.sqrt(dt) * u,
        terminal_equality=lambda x: x - jnp.array([0.0, -1.0]),
        x_bounds=(-np.inf, [1 / 9, np.inf]),
        u_bounds=(-20.0, 20.0),
    )


def rocket(x: Array, u: Array) -> Array:
    """x' of `goddard`, in units of the start; x = [height, speed, mass]."""
    h, v, m = x
    drag = 310.0 * v**2 * jnp.exp(500.0 * (1 - h))
    return jnp.array([v, (u[0] - drag) / m - 1 / h**2, -2.0 * u[0]])


def goddard() -> Problem:
    """A rocket climbs as high as its fuel lets it in 0.2 units of time; x = [height, speed, mass].

    Height counts from the earth's middle; all units are those of the start. A part of u, the
    thrust, is singular.
    """
    return held(
        rocket,
        x_init=[1.0, 0.0, 1.0],
        dt=0.002,
        horizon=0.2,
        terminal_cost=lambda x: -x[0],
        x_bounds=([1.0, -np.inf, 0.6], np.inf),
        u_bounds=(0.0, 3.5),
    )


def bead(x: Array, u: Array) -> Array:
    """x' of a bead on a wire; x = [sideways, down, speed], u is the angle from down."""
    return jnp.array([x[2] * jnp.sin(u[0]), x[2] * jnp.cos(u[0]), 9.81 * jnp.cos(u[0])])


def brachistochrone() -> Problem:
    """A bead on a wire gets as far sideways as it can in a second; u is the angle from down."""
    return held(
        bead,
        x_init=[0.0, 0.0, 0.0],
        dt=0.02,
        horizon=1.0,
        terminal_cost=lambda x: -x[0],
        u_bounds=(-np.pi, np.pi),
    )


def orbit_transfer() -> Problem:
    """Low thrust, the largest circular orbit; x = [radius, speed out, speed along, mass]."""
    duration = 3.32
    dt = duration / 83

    def rate(x: Array, u: Array) -> Array:
        r, out, along, mass = x
        push = 0.1405 / mass
        faster_out = along**2 / r - 1 / r**2 + push * jnp.sin(u[0])
        faster_along = -out * along / r + push * jnp.cos(u[0])
        return jnp.array([out, faster_out, faster_along, -0.0749])

    return held(
        rate,
        x_init=[1.0, 0.0, 1.0, 1.0],
        dt=dt,
        horizon=duration,
        terminal_cost=lambda x: -x[0],
        terminal_equality=lambda x: jnp.array([x[1], x[2] - 1 / jnp.sqrt(x[0])]),
        u_bounds=(-np.pi, np.pi),
    )


def unicycle_discs() -> Problem:
    """A unicycle drives past two discs, with the least effort; x = [x, y, heading]."""
    dt, centres, radii = 0.1, np.array([[0.9, 0.7], [1.3, 1.7]]), np.array([0.5, 0.3])

    def step(x: Array, u: Array) -> Array:
        return x + dt * jnp.array([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])

    def inside(x: Array, u: Array) -> Array:
        return jnp.square(radii) - jnp.sum((x[:2] - centres) ** 2, axis=1)

    return from_function(
        step,
        x_init=[0.0, 0.0, 0.0],
        nu=2,
        dt=dt,
        horizon=5.0,
        running_residual=lambda x, u: np.sqrt(2 * dt) * u,
        inequality=inside,
        terminal_equality=lambda x: x - jnp.array([2.0, 2.0, np.pi / 2]),
        u_bounds=(-1.5, 1.5),
    )


def car_parking() -> Problem:
    """A car parks; x = [x, y, heading, speed of the front wheels], u = [steering, acceleration]."""
    dt, length = 0.03, 2.0

    def smooth(x: Array, width: Array | float) -> Array:
        return jnp.sqrt(x**2 + width**2) - width

    def step(x: Array, u: Array) -> Array:
        rolled = dt * x[3]
        forward = length + rolled * jnp.cos(u[0])
        forward = forward - jnp.sqrt(length**2 - (rolled * jnp.sin(u[0])) ** 2)
        turn = jnp.arcsin(jnp.sin(u[0]) * rolled / length)
        way = jnp.array([forward * jnp.cos(x[2]), forward * jnp.sin(x[2]), turn, dt * u[1]])
        return x + way

    def running(x: Array, u: Array) -> Array:
        return 1e-2 * u[0] ** 2 + 1e-4 * u[1] ** 2 + 1e-3 * jnp.sum(smooth(x[:2], 0.1))

    return from_function(
        step,
        x_init=[1.0, 1.0, 1.5 * np.pi, 0.0],
        nu=2,
        dt=dt,
        horizon=15.0,
        running_cost=running,
        terminal_cost=lambda x: jnp.sum(smooth(x, jnp.array([0.1, 0.1, 0.01, 1.0]))),
        u_bounds=([-0.5, -2.0], [0.5, 2.0]),
    )


def cartpole_euler() -> Problem:
    """A weak force on a cart of 10 kg swings up a pole; x = [place, angle, and their rates]."""
    dt, goal = 0.1, np.array([0.0, np.pi, 0.0, 0.0])
    cart, pole, length, gravity = 10.0, 1.0, 0.5, 9.81

    def step(x: Array, u: Array) -> Array:
        s, c = jnp.sin(x[1]), jnp.cos(x[1])
        push = u[0] + pole * s * (length * x[3] ** 2 + gravity * c)
        faster = push / (cart + pole * s**2)
        turning = -(faster * c + gravity * s) / length
        return x + dt * jnp.array([x[2], x[3], faster, turning])

    return from_function(
        step,
        x_init=[0.0, 0.0, 0.0, 0.0],
        nu=1,
        dt=dt,
        horizon=5.0,
        running_residual=lambda x, u: jnp.append(np.sqrt(0.2) * (x - goal), np.sqrt(0.02) * u),
        terminal_residual=lambda x: np.sqrt(2000.0) * (x - goal),
        u_bounds=(-5.0, 5.0),
    )


CASES = {
    "van_der_pol": Case(van_der_pol, [0.0, 0.0], "van der Pol, 1926; an example of CasADi"),
    "van_der_pol_constrained": Case(
        lambda: van_der_pol(constrained=True), [0.0, 0.0], "the same, constrained"
    ),
    "rayleigh": Case(rayleigh, [0.0, 0.0], "Jacobson and Mayne, 1970; Maurer, 2001", 44.72),
    "hanging_chain": Case(
        hanging_chain, [3.0, 4.0], "Galileo; COPS of Dolan, More and Munson, 2004", 5.0685
    ),
    "crane": Case(crane, [10.0, 14.0, 0.0, 2.5, 0.0, 0.0], "Sakawa and Shindo, 1982", 0.0375),
    "robot_arm": Case(robot_arm, [0.0, 0.0, 0.5, 0.522], "Weinreb and Bryson, 1985; Luus, 2000"),
    "catalytic_cracker": Case(
        catalytic_cracker, None, "Gunn and Thomas, 1965; von Stryk, 1993", -0.0480557
    ),
    "batch_reactor": Case(batch_reactor, None, "Ray, 1981; Luus, 2000", -0.610775),
    "stirred_tank": Case(stirred_tank, [0.0, 0.0], "Lapidus and Luus, 1967", 0.13309),
    "bryson_denham": Case(bryson_denham, [0.0, -1.0], "Bryson, Denham and Dreyfus, 1963", 4.0),
    "goddard": Case(goddard, [1.01, 0.0, 0.6], "Goddard, 1919; COPS, 2004", -1.01283),
    "brachistochrone": Case(
        brachistochrone, None, "Bernoulli, 1696; Bryson and Ho, 1975", -9.81 / np.pi
    ),
    "orbit_transfer": Case(
        orbit_transfer, [1.5, 0.0, 0.8165, 0.75133], "Moyer and Pinkham, 1964", -1.525
    ),
    "unicycle_discs": Case(unicycle_discs, [2.0, 2.0, np.pi / 2], "a common test of planners"),
    "car_parking": Case(car_parking, [0.0] * 4, "Tassa, Mansard and Todorov, 2014"),
    "cartpole_euler": Case(
        cartpole_euler, None, "Barto, Sutton and Anderson, 1983; a large terminal weight"
    ),
}
"""By name."""

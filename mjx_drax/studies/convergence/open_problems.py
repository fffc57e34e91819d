"""Problems of textbooks that leave a duration, parameters or x_0 open, or follow a reference.

Steps and guesses are those of `optimal_control`: the control is held between knots; where the
duration is free, the step is `knot.dt`. Durations and parameters start in the middle of their
bounds. The optimum comes from a formula where there is one, else it is the published one. Each case
says by how much the least cost may differ from it because of the number of knots.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.problem.build import from_function
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Knot
from mjx_drax.studies.convergence.optimal_control import (
    Case,
    Rate,
    bead,
    integral,
    rocket,
    runge_kutta,
)

COPS = "COPS of Dolan, More and Munson, 2004"


def in_time(rate: Rate, nu: int = 1, **rest: Any) -> Problem:
    """A problem of free duration: x' = rate(x, u); without a cost of its own, of least time."""

    def f(x: Array, u: Array, knot: Knot) -> Array:
        return runge_kutta(rate, knot.dt)(x, u)

    if "terminal_cost" not in rest:
        rest["running_cost"] = lambda x, u, knot: knot.dt
    return from_function(f, nu=nu, **rest)


def double_integrator_time() -> Problem:
    """A mass moves by 1 m from rest to rest, with an acceleration of at most 1 m/s^2."""
    return in_time(
        lambda x, u: jnp.array([x[1], u[0]]),
        x_init=[0.0, 0.0],
        horizon=(0.5, 5.0),
        knots=40,
        terminal_equality=lambda x: x - jnp.array([1.0, 0.0]),
        u_bounds=(-1.0, 1.0),
    )


def there_and_back() -> Problem:
    """The same mass is to be at 1 m between two phases, and back at rest at the end."""
    return in_time(
        lambda x, u: jnp.array([x[1], u[0]]),
        x_init=[0.0, 0.0],
        horizon=[(0.5, 5.0), (0.5, 5.0)],
        knots=[20, 20],
        equality=lambda x, u, knot: jnp.where(knot.index == 20, x[:1] - 1.0, 0.0),
        terminal_equality=lambda x: x,
        u_bounds=(-1.0, 1.0),
    )


def brachistochrone_time() -> Problem:
    """A bead slides 10 m sideways and 5 m down; x = [sideways, down, speed], u from down."""
    return in_time(
        bead,
        x_init=[0.0, 0.0, 0.0],
        horizon=(0.5, 5.0),
        knots=60,
        terminal_equality=lambda x: x[:2] - jnp.array([10.0, 5.0]),
        u_bounds=(-np.pi, np.pi),
    )


def cycloid() -> float:
    """The least time of `brachistochrone_time`, a sqrt(r / g) [s].

    The wheel of radius r rolls by the angle a: r (a - sin a) = 10 and r (1 - cos a) = 5.
    """
    angle = 3.508368768524476
    return angle * float(np.sqrt(5 / (1 - np.cos(angle)) / 9.81))


def zermelo() -> Problem:
    """A ship of speed 1 crosses a current of speed -y to the origin; u is its heading.

    It starts where the way with headings from 105 to 240 degrees is the fastest one.
    """
    first, last = np.radians([105.0, 240.0])
    sec, tan = 1 / np.cos([first, last]), np.tan([first, last])
    away = np.log((tan[1] + sec[1]) / (tan[0] + sec[0]))
    away = 0.5 * (sec[1] * (tan[1] - tan[0]) - tan[0] * (sec[1] - sec[0]) + away)
    return in_time(
        lambda x, u: jnp.array([jnp.cos(u[0]) - x[1], jnp.sin(u[0])]),
        x_init=[-away, sec[0] - sec[1]],
        horizon=(1.0, 15.0),
        knots=60,
        terminal_equality=lambda x: x,
        u_bounds=(0.0, 2 * np.pi),
    )


def dubins() -> Problem:
    """A car of speed 1 that turns with radius 1 at least turns round, 4 m to its left."""
    return in_time(
        lambda x, u: jnp.array([jnp.cos(x[2]), jnp.sin(x[2]), u[0]]),
        x_init=[0.0, 0.0, 0.0],
        horizon=(1.0, 15.0),
        knots=60,
        terminal_equality=lambda x: x - jnp.array([0.0, 4.0, np.pi]),
        u_bounds=(-1.0, 1.0),
    )


def particle_steering() -> Problem:
    """A push of 100, whose direction is u, brings a particle to height 5 and to speed 45 along."""
    return in_time(
        lambda x, u: jnp.array([x[2], x[3], 100 * jnp.cos(u[0]), 100 * jnp.sin(u[0])]),
        x_init=[0.0, 0.0, 0.0, 0.0],
        horizon=(0.1, 2.0),
        knots=60,
        terminal_equality=lambda x: x[1:] - jnp.array([5.0, 45.0, 0.0]),
        u_bounds=(-np.pi / 2, np.pi / 2),
    )


def goddard_time() -> Problem:
    """The rocket of `optimal_control.goddard`, until it is highest; x = [height, speed, mass]."""
    return in_time(
        rocket,
        x_init=[1.0, 0.0, 1.0],
        horizon=(0.05, 0.4),
        knots=100,
        terminal_cost=lambda x: -x[0],
        x_bounds=([1.0, 0.0, 0.6], np.inf),
        u_bounds=(0.0, 3.5),
    )


def robot_arm_time() -> Problem:
    """An arm of length 5 slides and turns; x = [reach, two angles, and their rates]."""

    def rate(x: Array, u: Array) -> Array:
        inertia = ((5 - x[0]) ** 3 + x[0] ** 3) / 3
        faster = [u[0] / 5, u[1] / (inertia * jnp.sin(x[2]) ** 2), u[2] / inertia]
        return jnp.concatenate([x[3:], jnp.stack(faster)])

    end = np.array([4.5, 2 * np.pi / 3, np.pi / 4, 0.0, 0.0, 0.0])
    return in_time(
        rate,
        x_init=[4.5, 0.0, np.pi / 4, 0.0, 0.0, 0.0],
        nu=3,
        horizon=(2.0, 20.0),
        knots=60,
        terminal_equality=lambda x: x - end,
        x_bounds=([0.0, -np.pi, 0.0] + [-np.inf] * 3, [5.0, np.pi, np.pi] + [np.inf] * 3),
        u_bounds=(-1.0, 1.0),
    )


def hang_glider() -> Problem:
    """A glider sinks by 100 m through a thermal, as far as it can; x = [place, height, rates]."""

    def rate(x: Array, u: Array) -> Array:
        off = (x[0] / 100 - 2.5) ** 2
        rise = x[3] - 2.5 * (1 - off) * jnp.exp(-off)
        speed = jnp.sqrt(x[2] ** 2 + rise**2)
        push = 0.5 * 1.13 * 14.0 * speed / 100.0  # of air on wings, for the mass, over speed
        lift, drag = push * u[0], push * (0.034 + 0.069662 * u[0] ** 2)
        slower, faster = -lift * rise - drag * x[2], lift * x[2] - drag * rise
        return jnp.stack([x[2], x[3], slower, faster - 9.80665])

    end = np.array([900.0, 13.2275675, -1.28750052])
    return in_time(
        rate,
        x_init=[0.0, 1000.0, *end[1:]],
        horizon=(50.0, 150.0),
        knots=100,
        terminal_cost=lambda x: -x[0],
        terminal_equality=lambda x: x[1:] - end,
        x_bounds=([0.0, -np.inf, 0.0, -np.inf], np.inf),
        u_bounds=(0.0, 1.4),
    )


def forced_oscillator() -> Problem:
    """A damped spring in resonance with a force cos t is held still, in a periodic motion.

    x'' + 0.2 x' + x = cos t + u, for the least integral of x^2 + u^2 over a period.
    """
    dt = 2 * np.pi / 60

    def rate(y: Array, u: Array) -> Array:  # y = [place, speed, time]
        return jnp.array([y[1], jnp.cos(y[2]) - y[0] - 0.2 * y[1] + u[0], 1.0])

    whole = integral(rate, lambda y, u: y[0] ** 2 + u[0] ** 2, dt)
    return from_function(
        lambda x, u, knot: runge_kutta(rate, dt)(jnp.append(x, knot.time), u)[:2],
        x_init=[0.0, 0.0],
        x_init_bounds=(-5.0, 5.0),
        nu=1,
        dt=dt,
        horizon=2 * np.pi,
        running_cost=lambda x, u, knot: whole(jnp.append(x, knot.time), u),
        terminal_equality=lambda x, knot: x - knot.x_init,
        u_bounds=(-5.0, 5.0),
    )


def tracking() -> Problem:
    """x' = u follows sin t from 0 to 5 pi / 2: the least integral of (x - sin t)^2 + u^2.

    The data of a knot are the reference there, half a step later and a step later.
    """
    K = 100
    dt = 2.5 * np.pi / K
    shares = np.array([0.0, 0.5, 1.0])

    def cost(x: Array, u: Array, knot: Knot) -> Array:  # by Simpson's rule, as the steps are
        off = x[0] + dt * shares * u[0] - knot.data
        return dt * (off**2 @ jnp.array([1 / 6, 4 / 6, 1 / 6]) + u[0] ** 2)

    return from_function(
        lambda x, u: x + dt * u,
        x_init=[0.0],
        nu=1,
        dt=dt,
        horizon=2.5 * np.pi,
        running_cost=cost,
        data=lambda t: jnp.sin(t + dt * shares),
    )


def estimation(
    rate: Any, begins: list[float], times: np.ndarray, measured: np.ndarray, upper: Any
) -> Problem:
    """Parameters of x' = rate(x, p) for which x(times) is next to `measured`, by least squares.

    Args:
        rate: x', with the parameters p.
        begins: x at time 0, (nx,), known.
        times: ends of steps, (K,) [s].
        measured: x at those times, (K, nx), NaN where it is not measured.
        upper: ends of the parameters, (np,); the lower ones are 0.
    """
    known = np.isfinite(measured)
    rows = {
        "step": np.append(np.diff(times, prepend=0.0), 0.0),
        "x": np.concatenate([np.zeros((1, len(begins))), np.where(known, measured, 0.0)]),
        "weight": np.concatenate([np.zeros((1, len(begins))), np.sqrt(2.0) * known]),
    }

    def f(x: Array, u: Array, knot: Knot) -> Array:
        p = knot.parameters["p"]
        return runge_kutta(lambda x, u: rate(x, p), knot.data["step"])(x, u)

    def off(x: Array, knot: Knot) -> Array:
        return knot.data["weight"] * (x - knot.data["x"])

    return from_function(
        f,
        x_init=begins,
        nu=1,  # a control without effect, which its cost keeps at 0: a problem needs one
        dt=1.0,
        horizon=float(len(times)),
        running_residual=lambda x, u, knot: jnp.append(off(x, knot), u),
        terminal_residual=off,
        parameters={"p": (0.0, np.asarray(upper))},
        data=rows,
    )


GAS_OIL = """
    0.025 0.8105 0.2000  0.050 0.6208 0.2886  0.075 0.5258 0.3010  0.100 0.4345 0.3215
    0.125 0.3903 0.3123  0.150 0.3342 0.2716  0.175 0.3034 0.2551  0.200 0.2735 0.2258
    0.225 0.2405 0.1959  0.250 0.2283 0.1789  0.300 0.2071 0.1457  0.350 0.1669 0.1198
    0.400 0.1530 0.0909  0.450 0.1339 0.0719  0.500 0.1265 0.0561  0.550 0.1200 0.0460
    0.650 0.0990 0.0280  0.750 0.0870 0.0190  0.850 0.0770 0.0140  0.950 0.0690 0.0100
"""
"""Times, and the amounts of gas oil and gasoline that were measured."""

PINENE = """
     1230 88.35  7.3 2.3 0.4  1.75   3060 76.4 15.6 4.5 0.7  2.8   4920 65.1 23.1 5.3 1.1  5.8
     7800 50.40 32.9 6.0 1.5  9.30  10680 37.5 42.7 6.0 1.9 12.0  15030 25.9 49.1 5.9 2.2 17.0
    22620 14.00 57.4 5.1 2.6 21.00  36420  4.5 63.1 3.8 2.9 25.7
"""
"""Times [min], and the amounts of five substances that were measured [%]."""


def table(text: str, nx: int, knots: int) -> tuple[np.ndarray, np.ndarray]:
    """Measurements, and `knots` equal steps from each to the next: times and NaN in between."""
    rows = np.array(text.split(), float).reshape(-1, 1 + nx)
    ends, K = rows[:, 0], knots * len(rows)
    times = np.interp(np.arange(1, K + 1) / knots, range(len(ends) + 1), [0, *ends])
    measured = np.full((K, nx), np.nan)
    measured[knots - 1 :: knots] = rows[:, 1:]
    return times, measured


def gas_oil() -> Problem:
    """Rates at which gas oil cracks into gasoline and other products."""
    return estimation(
        lambda y, p: jnp.array([-(p[0] + p[2]) * y[0] ** 2, p[0] * y[0] ** 2 - p[1] * y[1]]),
        [1.0, 0.0],
        *table(GAS_OIL, 2, 2),
        np.full(3, 20.0),
    )


def alpha_pinene() -> Problem:
    """Rates at which alpha-pinene turns into other substances when heated [1e-5 / min]."""

    def rate(y: Array, p: Array) -> Array:
        a, b, c, d, e = 1e-5 * p
        gain = c * y[2], d * y[2] - e * y[4]
        return jnp.stack([-(a + b) * y[0], a * y[0], b * y[0] - sum(gain), *gain])

    return estimation(rate, [100.0, 0.0, 0.0, 0.0, 0.0], *table(PINENE, 5, 6), np.full(5, 50.0))


CASES = {
    "double_integrator_time": Case(
        double_integrator_time, [1.0, 0.0], "2 sqrt(distance / acceleration)", 2.0, 1e-5
    ),
    "there_and_back": Case(there_and_back, None, "4 sqrt(distance / acceleration)", 4.0, 1e-5),
    "brachistochrone_time": Case(
        brachistochrone_time, [10.0, 5.0, 9.9], "Bernoulli, 1696; the cycloid", cycloid(), 1e-4
    ),
    "zermelo": Case(
        zermelo, [0.0, 0.0], "Zermelo, 1931; tan 240 - tan 105 degrees", 2 + 2 * 3**0.5, 1e-4
    ),
    "dubins": Case(
        dubins, [0.0, 4.0, np.pi], "Dubins, 1957; two quarters of a circle and 2 m", np.pi + 2, 1e-4
    ),
    "particle_steering": Case(
        particle_steering, [0.0, 5.0, 45.0, 0.0], f"Bryson and Ho, 1975; {COPS}", 0.554577, 1e-4
    ),
    "goddard_time": Case(goddard_time, [1.01, 0.0, 0.6], f"Goddard, 1919; {COPS}", -1.01283, 1e-4),
    "robot_arm_time": Case(
        robot_arm_time, [4.5, 2 * np.pi / 3, np.pi / 4, 0.0, 0.0, 0.0], COPS, 9.14093, 2e-4
    ),
    "hang_glider": Case(
        hang_glider,
        [1300.0, 900.0, 13.2275675, -1.28750052],
        f"Bulirsch and others, 1993; {COPS}",
        -1248.03,
        5e-4,
    ),
    "forced_oscillator": Case(
        forced_oscillator, None, "pi |F|^2 / (1 + |P|^2), P = 0.2 i", np.pi / 1.04, 2e-3
    ),
    "tracking": Case(tracking, None, "x = sin(t) / 2, of x'' = x - sin t", 5 * np.pi / 8, 1e-3),
    "gas_oil": Case(gas_oil, [0.069, 0.01], f"Tjoa and Biegler, 1991; {COPS}", 5.2366e-3, 1e-4),
    "alpha_pinene": Case(
        alpha_pinene, [4.5, 63.1, 3.8, 2.9, 25.7], f"Box and others, 1973; {COPS}", 19.8721, 1e-4
    ),
}
"""By name."""

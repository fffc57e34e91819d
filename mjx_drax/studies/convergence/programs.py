"""Programs of W. Hock and K. Schittkowski, "Test Examples for Nonlinear Programming Codes", 1981.

    min c(x)   s.t.   h(x) = 0,   g(x) <= 0,   x_lower <= x <= x_upper

Numbers, starting points and optima are those of the book; its constraints g(x) >= 0 have the other
sign here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_drax.problem.problem import Problem
from mjx_drax.solution.program import from_program

Rows = Callable[..., list[Array]]


@dataclass(frozen=True)
class Program:
    """One program of the book; its functions take the n numbers of x one by one.

    Attributes:
        cost: c(x), a scalar.
        start: the starting point, (n,).
        solution: where the least known cost is, (n,).
        optimum: that cost.
        equality: the entries of h(x).
        inequality: the entries of g(x).
        lower: ends of x, a number or one for each.
        upper: the other ends.
    """

    cost: Callable[..., Array]
    start: list[float]
    solution: list[float]
    optimum: float
    equality: Rows | None = None
    inequality: Rows | None = None
    lower: float | list[float] = -np.inf
    upper: float | list[float] = np.inf

    def problem(self, name: str) -> Problem:
        """The program as a problem with one knot and no state."""
        return from_program(
            len(self.start),
            cost=lambda x: self.cost(*x),
            equality=stacked(self.equality),
            inequality=stacked(self.inequality),
            bounds=(self.lower, self.upper),
            name=name,
        )


def stacked(rows: Rows | None) -> Callable[[Array], Array] | None:
    """A function of x that returns one vector, from one that returns a list of scalars."""
    return None if rows is None else lambda x: jnp.stack(rows(*x))


def _powell(a: Array, b: Array, c: Array, d: Array, e: Array) -> list[Array]:
    """The constraints of 78 and 80."""
    return [a**2 + b**2 + c**2 + d**2 + e**2 - 10, b * c - 5 * d * e, a**3 + b**3 + 1]


def _cost_100(*x: Array) -> Array:
    a, b, c, d, e, f, g = x
    squares = (a - 10) ** 2 + 5 * (b - 12) ** 2 + c**4 + 3 * (d - 11) ** 2
    rest = 10 * e**6 + 7 * f**2 + g**4 - 4 * f * g - 10 * f - 8 * g
    return squares + rest


def _cost_113(*x: Array) -> Array:
    a, b, c, d, e, f, g, h, i, j = x
    first = a**2 + b**2 + a * b - 14 * a - 16 * b + (c - 10) ** 2
    second = 4 * (d - 5) ** 2 + (e - 3) ** 2 + 2 * (f - 1) ** 2 + 5 * g**2
    third = 7 * (h - 11) ** 2 + 2 * (i - 10) ** 2 + (j - 7) ** 2 + 45
    return first + second + third


PROGRAMS = {
    "hs006": Program(
        lambda a, b: (1 - a) ** 2,
        [-1.2, 1.0],
        [1.0, 1.0],
        0.0,
        equality=lambda a, b: [10 * (b - a**2)],
    ),
    "hs007": Program(
        lambda a, b: jnp.log(1 + a**2) - b,
        [2.0, 2.0],
        [0.0, 3**0.5],
        -(3**0.5),
        equality=lambda a, b: [(1 + a**2) ** 2 + b**2 - 4],
    ),
    "hs010": Program(
        lambda a, b: a - b,
        [-10.0, 10.0],
        [0.0, 1.0],
        -1.0,
        inequality=lambda a, b: [3 * a**2 - 2 * a * b + b**2 - 1],
    ),
    "hs011": Program(
        lambda a, b: (a - 5) ** 2 + b**2 - 25,
        [4.9, 0.1],
        [1.23477280, 1.52466387],
        -8.498464223,
        inequality=lambda a, b: [a**2 - b],
    ),
    "hs012": Program(
        lambda a, b: a**2 / 2 + b**2 - a * b - 7 * a - 7 * b,
        [0.0, 0.0],
        [2.0, 3.0],
        -30.0,
        inequality=lambda a, b: [4 * a**2 + b**2 - 25],
    ),
    "hs014": Program(
        lambda a, b: (a - 2) ** 2 + (b - 1) ** 2,
        [2.0, 2.0],
        [(7**0.5 - 1) / 2, (7**0.5 + 1) / 4],
        9 - 2.875 * 7**0.5,
        equality=lambda a, b: [a - 2 * b + 1],
        inequality=lambda a, b: [a**2 / 4 + b**2 - 1],
    ),
    "hs015": Program(
        lambda a, b: 100 * (b - a**2) ** 2 + (1 - a) ** 2,
        [-2.0, 1.0],
        [0.5, 2.0],
        306.5,
        inequality=lambda a, b: [1 - a * b, -a - b**2],
        upper=[0.5, np.inf],
    ),
    "hs018": Program(
        lambda a, b: 0.01 * a**2 + b**2,
        [2.0, 2.0],
        [250**0.5, 2.5**0.5],
        5.0,
        inequality=lambda a, b: [25 - a * b, 25 - a**2 - b**2],
        lower=[2.0, 0.0],
        upper=50.0,
    ),
    "hs021": Program(
        lambda a, b: 0.01 * a**2 + b**2 - 100,
        [-1.0, -1.0],
        [2.0, 0.0],
        -99.96,
        inequality=lambda a, b: [10 - 10 * a + b],
        lower=[2.0, -50.0],
        upper=50.0,
    ),
    "hs022": Program(
        lambda a, b: (a - 2) ** 2 + (b - 1) ** 2,
        [2.0, 2.0],
        [1.0, 1.0],
        1.0,
        inequality=lambda a, b: [a + b - 2, a**2 - b],
    ),
    "hs024": Program(
        lambda a, b: ((a - 3) ** 2 - 9) * b**3 / (27 * 3**0.5),
        [1.0, 0.5],
        [3.0, 3**0.5],
        -1.0,
        inequality=lambda a, b: [b - a / 3**0.5, -a - 3**0.5 * b, a + 3**0.5 * b - 6],
        lower=0.0,
    ),
    "hs026": Program(
        lambda a, b, c: (a - b) ** 2 + (b - c) ** 4,
        [-2.6, 2.0, 2.0],
        [1.0, 1.0, 1.0],
        0.0,
        equality=lambda a, b, c: [(1 + b**2) * a + c**4 - 3],
    ),
    "hs027": Program(
        lambda a, b, c: 0.01 * (a - 1) ** 2 + (b - a**2) ** 2,
        [2.0, 2.0, 2.0],
        [-1.0, 1.0, 0.0],
        0.04,
        equality=lambda a, b, c: [a + c**2 + 1],
    ),
    "hs028": Program(
        lambda a, b, c: (a + b) ** 2 + (b + c) ** 2,
        [-4.0, 1.0, 1.0],
        [0.5, -0.5, 0.5],
        0.0,
        equality=lambda a, b, c: [a + 2 * b + 3 * c - 1],
    ),
    "hs029": Program(
        lambda a, b, c: -a * b * c,
        [1.0, 1.0, 1.0],
        [4.0, 2 * 2**0.5, 2.0],
        -16 * 2**0.5,
        inequality=lambda a, b, c: [a**2 + 2 * b**2 + 4 * c**2 - 48],
    ),
    "hs035": Program(
        lambda a, b, c: (
            9 - 8 * a - 6 * b - 4 * c + 2 * a**2 + 2 * b**2 + c**2 + 2 * a * b + 2 * a * c
        ),
        [0.5, 0.5, 0.5],
        [4 / 3, 7 / 9, 4 / 9],
        1 / 9,
        inequality=lambda a, b, c: [a + b + 2 * c - 3],
        lower=0.0,
    ),
    "hs036": Program(
        lambda a, b, c: -a * b * c,
        [10.0, 10.0, 10.0],
        [20.0, 11.0, 15.0],
        -3300.0,
        inequality=lambda a, b, c: [a + 2 * b + 2 * c - 72],
        lower=0.0,
        upper=[20.0, 11.0, 42.0],
    ),
    "hs037": Program(
        lambda a, b, c: -a * b * c,
        [10.0, 10.0, 10.0],
        [24.0, 12.0, 12.0],
        -3456.0,
        inequality=lambda a, b, c: [a + 2 * b + 2 * c - 72, -a - 2 * b - 2 * c],
        lower=0.0,
        upper=42.0,
    ),
    "hs039": Program(
        lambda a, b, c, d: -a,
        [2.0, 2.0, 2.0, 2.0],
        [1.0, 1.0, 0.0, 0.0],
        -1.0,
        equality=lambda a, b, c, d: [b - a**3 - c**2, a**2 - b - d**2],
    ),
    "hs040": Program(
        lambda a, b, c, d: -a * b * c * d,
        [0.8, 0.8, 0.8, 0.8],
        [2 ** (-1 / 3), 2 ** (-1 / 2), 2 ** (-11 / 12), 2 ** (-1 / 4)],
        -0.25,
        equality=lambda a, b, c, d: [a**3 + b**2 - 1, a**2 * d - c, d**2 - b],
    ),
    "hs042": Program(
        lambda a, b, c, d: (a - 1) ** 2 + (b - 2) ** 2 + (c - 3) ** 2 + (d - 4) ** 2,
        [1.0, 1.0, 1.0, 1.0],
        [2.0, 2.0, 0.6 * 2**0.5, 0.8 * 2**0.5],
        28 - 10 * 2**0.5,
        equality=lambda a, b, c, d: [a - 2, c**2 + d**2 - 2],
    ),
    "hs043": Program(
        lambda a, b, c, d: a**2 + b**2 + c**2 + d**2 + c**2 - 5 * a - 5 * b - 21 * c + 7 * d,
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 2.0, -1.0],
        -44.0,
        inequality=lambda a, b, c, d: [
            a**2 + b**2 + c**2 + d**2 + a - b + c - d - 8,
            a**2 + b**2 + c**2 + d**2 + b**2 + d**2 - a - d - 10,
            2 * a**2 + b**2 + c**2 + 2 * a - b - d - 5,
        ],
    ),
    "hs048": Program(
        lambda a, b, c, d, e: (a - 1) ** 2 + (b - c) ** 2 + (d - e) ** 2,
        [3.0, 5.0, -3.0, 2.0, -2.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda a, b, c, d, e: [a + b + c + d + e - 5, c - 2 * (d + e) + 3],
    ),
    "hs050": Program(
        lambda a, b, c, d, e: (a - b) ** 2 + (b - c) ** 2 + (c - d) ** 4 + (d - e) ** 2,
        [35.0, -31.0, 11.0, 5.0, -5.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda a, b, c, d, e: [
            a + 2 * b + 3 * c - 6,
            b + 2 * c + 3 * d - 6,
            c + 2 * d + 3 * e - 6,
        ],
    ),
    "hs051": Program(
        lambda a, b, c, d, e: (a - b) ** 2 + (b + c - 2) ** 2 + (d - 1) ** 2 + (e - 1) ** 2,
        [2.5, 0.5, 2.0, -1.0, 0.5],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda a, b, c, d, e: [a + 3 * b - 4, c + d - 2 * e, b - e],
    ),
    "hs052": Program(
        lambda a, b, c, d, e: (4 * a - b) ** 2 + (b + c - 2) ** 2 + (d - 1) ** 2 + (e - 1) ** 2,
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [-33 / 349, 11 / 349, 180 / 349, -158 / 349, 11 / 349],
        1859 / 349,
        equality=lambda a, b, c, d, e: [a + 3 * b, c + d - 2 * e, b - e],
    ),
    "hs053": Program(
        lambda a, b, c, d, e: (a - b) ** 2 + (b + c - 2) ** 2 + (d - 1) ** 2 + (e - 1) ** 2,
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [-33 / 43, 11 / 43, 27 / 43, -5 / 43, 11 / 43],
        176 / 43,
        equality=lambda a, b, c, d, e: [a + 3 * b, c + d - 2 * e, b - e],
        lower=-10.0,
        upper=10.0,
    ),
    "hs060": Program(
        lambda a, b, c: (a - 1) ** 2 + (a - b) ** 2 + (b - c) ** 4,
        [2.0, 2.0, 2.0],
        [1.104859024, 1.196674194, 1.535262257],
        0.03256820025,
        equality=lambda a, b, c: [a * (1 + b**2) + c**4 - 4 - 3 * 2**0.5],
        lower=-10.0,
        upper=10.0,
    ),
    "hs061": Program(
        lambda a, b, c: 4 * a**2 + 2 * b**2 + 2 * c**2 - 33 * a + 16 * b - 24 * c,
        [0.0, 0.0, 0.0],
        [5.326770157, -2.118998639, 3.210464239],
        -143.6461422,
        equality=lambda a, b, c: [3 * a - 2 * b**2 - 7, 4 * a - c**2 - 11],
    ),
    "hs063": Program(
        lambda a, b, c: 1000 - a**2 - 2 * b**2 - c**2 - a * b - a * c,
        [2.0, 2.0, 2.0],
        [3.512118414, 0.2169881741, 3.552174034],
        961.7151721,
        equality=lambda a, b, c: [8 * a + 14 * b + 7 * c - 56, a**2 + b**2 + c**2 - 25],
        lower=0.0,
    ),
    "hs065": Program(
        lambda a, b, c: (a - b) ** 2 + (a + b - 10) ** 2 / 9 + (c - 5) ** 2,
        [-5.0, 5.0, 0.0],
        [3.650461821, 3.650461821, 4.6204170507],
        0.9535288567,
        inequality=lambda a, b, c: [a**2 + b**2 + c**2 - 48],
        lower=[-4.5, -4.5, -5.0],
        upper=[4.5, 4.5, 5.0],
    ),
    "hs066": Program(
        lambda a, b, c: 0.2 * c - 0.8 * a,
        [0.0, 1.05, 2.9],
        [0.1841264879, 1.202167873, 3.327322322],
        0.5181632741,
        inequality=lambda a, b, c: [jnp.exp(a) - b, jnp.exp(b) - c],
        lower=0.0,
        upper=[100.0, 100.0, 10.0],
    ),
    "hs071": Program(
        lambda a, b, c, d: a * d * (a + b + c) + c,
        [1.0, 5.0, 5.0, 1.0],
        [1.0, 4.7429994, 3.8211503, 1.3794082],
        17.0140173,
        equality=lambda a, b, c, d: [a**2 + b**2 + c**2 + d**2 - 40],
        inequality=lambda a, b, c, d: [25 - a * b * c * d],
        lower=1.0,
        upper=5.0,
    ),
    "hs076": Program(
        lambda a, b, c, d: (
            a**2 + 0.5 * b**2 + c**2 + 0.5 * d**2 - a * c + c * d - a - 3 * b + c - d
        ),
        [0.5, 0.5, 0.5, 0.5],
        [3 / 11, 23 / 11, 0.0, 6 / 11],
        -4.681818181,
        inequality=lambda a, b, c, d: [
            a + 2 * b + c + d - 5,
            3 * a + b + 2 * c - d - 4,
            1.5 - b - 4 * c,
        ],
        lower=0.0,
    ),
    "hs077": Program(
        lambda a, b, c, d, e: (
            (a - 1) ** 2 + (a - b) ** 2 + (c - 1) ** 2 + (d - 1) ** 4 + (e - 1) ** 6
        ),
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [1.166172, 1.182111, 1.380257, 1.506036, 0.6109203],
        0.24150513,
        equality=lambda a, b, c, d, e: [
            a**2 * d + jnp.sin(d - e) - 2 * 2**0.5,
            b + c**4 * d**2 - 8 - 2**0.5,
        ],
    ),
    "hs078": Program(
        lambda a, b, c, d, e: a * b * c * d * e,
        [-2.0, 1.5, 2.0, -1.0, -1.0],
        [-1.717142, 1.595708, 1.827248, -0.7636429, -0.7636435],
        -2.91970041,
        equality=_powell,
    ),
    "hs079": Program(
        lambda a, b, c, d, e: (
            (a - 1) ** 2 + (a - b) ** 2 + (b - c) ** 2 + (c - d) ** 4 + (d - e) ** 4
        ),
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [1.191127, 1.362603, 1.472818, 1.635017, 1.679081],
        0.0787768209,
        equality=lambda a, b, c, d, e: [
            a + b**2 + c**3 - 2 - 3 * 2**0.5,
            b - c**2 + d + 2 - 2 * 2**0.5,
            a * e - 2,
        ],
    ),
    "hs080": Program(
        lambda a, b, c, d, e: jnp.exp(a * b * c * d * e),
        [-2.0, 2.0, 2.0, -1.0, -1.0],
        [-1.717143, 1.595709, 1.827247, -0.7636413, -0.7636450],
        0.0539498478,
        equality=_powell,
        lower=[-2.3, -2.3, -3.2, -3.2, -3.2],
        upper=[2.3, 2.3, 3.2, 3.2, 3.2],
    ),
    "hs100": Program(
        _cost_100,
        [1.0, 2.0, 0.0, 4.0, 0.0, 1.0, 1.0],
        [2.330499, 1.951372, -0.4775414, 4.365726, -0.6244870, 1.038131, 1.594227],
        680.6300573,
        inequality=lambda a, b, c, d, e, f, g: [
            2 * a**2 + 3 * b**4 + c + 4 * d**2 + 5 * e - 127,
            7 * a + 3 * b + 10 * c**2 + d - e - 282,
            23 * a + b**2 + 6 * f**2 - 8 * g - 196,
            4 * a**2 + b**2 - 3 * a * b + 2 * c**2 + 5 * f - 11 * g,
        ],
    ),
    "hs113": Program(
        _cost_113,
        [2.0, 3.0, 5.0, 5.0, 1.0, 2.0, 7.0, 3.0, 6.0, 10.0],
        [
            2.171996,
            2.363683,
            8.773926,
            5.095984,
            0.9906548,
            1.430574,
            1.321644,
            9.828726,
            8.280092,
            8.375927,
        ],
        24.3062091,
        inequality=lambda a, b, c, d, e, f, g, h, i, j: [
            4 * a + 5 * b - 3 * g + 9 * h - 105,
            10 * a - 8 * b - 17 * g + 2 * h,
            -8 * a + 2 * b + 5 * i - 2 * j - 12,
            3 * (a - 2) ** 2 + 4 * (b - 3) ** 2 + 2 * c**2 - 7 * d - 120,
            5 * a**2 + 8 * b + (c - 6) ** 2 - 2 * d - 40,
            0.5 * (a - 8) ** 2 + 2 * (b - 4) ** 2 + 3 * e**2 - f - 30,
            a**2 + 2 * (b - 2) ** 2 - 2 * a * b + 14 * e - 6 * f,
            -3 * a + 6 * b + 12 * (i - 8) ** 2 - 7 * j,
        ],
    ),
}
"""By the book's numbers."""

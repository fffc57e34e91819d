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

Rows = Callable[[Array], list[Array]]


@dataclass(frozen=True)
class Program:
    """One program of the book.

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

    cost: Callable[[Array], Array]
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
            cost=self.cost,
            equality=stacked(self.equality),
            inequality=stacked(self.inequality),
            bounds=(self.lower, self.upper),
            name=name,
        )


def stacked(rows: Rows | None) -> Callable[[Array], Array] | None:
    """A function of x that returns one vector, from one that returns a list of scalars."""
    return None if rows is None else lambda x: jnp.stack(rows(x))


def _product(x: Array) -> Array:
    return x[0] * x[1] * x[2] * x[3] * x[4]


def _powell(x: Array) -> list[Array]:
    """The constraints of 78 and 80."""
    return [
        jnp.sum(x**2) - 10,
        x[1] * x[2] - 5 * x[3] * x[4],
        x[0] ** 3 + x[1] ** 3 + 1,
    ]


def _cost_100(x: Array) -> Array:
    squares = (x[0] - 10) ** 2 + 5 * (x[1] - 12) ** 2 + x[2] ** 4 + 3 * (x[3] - 11) ** 2
    rest = 10 * x[4] ** 6 + 7 * x[5] ** 2 + x[6] ** 4 - 4 * x[5] * x[6] - 10 * x[5] - 8 * x[6]
    return squares + rest


def _cost_113(x: Array) -> Array:
    first = x[0] ** 2 + x[1] ** 2 + x[0] * x[1] - 14 * x[0] - 16 * x[1] + (x[2] - 10) ** 2
    second = 4 * (x[3] - 5) ** 2 + (x[4] - 3) ** 2 + 2 * (x[5] - 1) ** 2 + 5 * x[6] ** 2
    third = 7 * (x[7] - 11) ** 2 + 2 * (x[8] - 10) ** 2 + (x[9] - 7) ** 2 + 45
    return first + second + third


PROGRAMS = {
    "hs006": Program(
        lambda x: (1 - x[0]) ** 2,
        [-1.2, 1.0],
        [1.0, 1.0],
        0.0,
        equality=lambda x: [10 * (x[1] - x[0] ** 2)],
    ),
    "hs007": Program(
        lambda x: jnp.log(1 + x[0] ** 2) - x[1],
        [2.0, 2.0],
        [0.0, 3**0.5],
        -(3**0.5),
        equality=lambda x: [(1 + x[0] ** 2) ** 2 + x[1] ** 2 - 4],
    ),
    "hs010": Program(
        lambda x: x[0] - x[1],
        [-10.0, 10.0],
        [0.0, 1.0],
        -1.0,
        inequality=lambda x: [3 * x[0] ** 2 - 2 * x[0] * x[1] + x[1] ** 2 - 1],
    ),
    "hs011": Program(
        lambda x: (x[0] - 5) ** 2 + x[1] ** 2 - 25,
        [4.9, 0.1],
        [1.23477280, 1.52466387],
        -8.498464223,
        inequality=lambda x: [x[0] ** 2 - x[1]],
    ),
    "hs012": Program(
        lambda x: x[0] ** 2 / 2 + x[1] ** 2 - x[0] * x[1] - 7 * x[0] - 7 * x[1],
        [0.0, 0.0],
        [2.0, 3.0],
        -30.0,
        inequality=lambda x: [4 * x[0] ** 2 + x[1] ** 2 - 25],
    ),
    "hs014": Program(
        lambda x: (x[0] - 2) ** 2 + (x[1] - 1) ** 2,
        [2.0, 2.0],
        [(7**0.5 - 1) / 2, (7**0.5 + 1) / 4],
        9 - 2.875 * 7**0.5,
        equality=lambda x: [x[0] - 2 * x[1] + 1],
        inequality=lambda x: [x[0] ** 2 / 4 + x[1] ** 2 - 1],
    ),
    "hs015": Program(
        lambda x: 100 * (x[1] - x[0] ** 2) ** 2 + (1 - x[0]) ** 2,
        [-2.0, 1.0],
        [0.5, 2.0],
        306.5,
        inequality=lambda x: [1 - x[0] * x[1], -x[0] - x[1] ** 2],
        upper=[0.5, np.inf],
    ),
    "hs018": Program(
        lambda x: 0.01 * x[0] ** 2 + x[1] ** 2,
        [2.0, 2.0],
        [250**0.5, 2.5**0.5],
        5.0,
        inequality=lambda x: [25 - x[0] * x[1], 25 - x[0] ** 2 - x[1] ** 2],
        lower=[2.0, 0.0],
        upper=50.0,
    ),
    "hs021": Program(
        lambda x: 0.01 * x[0] ** 2 + x[1] ** 2 - 100,
        [-1.0, -1.0],
        [2.0, 0.0],
        -99.96,
        inequality=lambda x: [10 - 10 * x[0] + x[1]],
        lower=[2.0, -50.0],
        upper=50.0,
    ),
    "hs022": Program(
        lambda x: (x[0] - 2) ** 2 + (x[1] - 1) ** 2,
        [2.0, 2.0],
        [1.0, 1.0],
        1.0,
        inequality=lambda x: [x[0] + x[1] - 2, x[0] ** 2 - x[1]],
    ),
    "hs024": Program(
        lambda x: ((x[0] - 3) ** 2 - 9) * x[1] ** 3 / (27 * 3**0.5),
        [1.0, 0.5],
        [3.0, 3**0.5],
        -1.0,
        inequality=lambda x: [
            x[1] - x[0] / 3**0.5,
            -x[0] - 3**0.5 * x[1],
            x[0] + 3**0.5 * x[1] - 6,
        ],
        lower=0.0,
    ),
    "hs026": Program(
        lambda x: (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 4,
        [-2.6, 2.0, 2.0],
        [1.0, 1.0, 1.0],
        0.0,
        equality=lambda x: [(1 + x[1] ** 2) * x[0] + x[2] ** 4 - 3],
    ),
    "hs027": Program(
        lambda x: 0.01 * (x[0] - 1) ** 2 + (x[1] - x[0] ** 2) ** 2,
        [2.0, 2.0, 2.0],
        [-1.0, 1.0, 0.0],
        0.04,
        equality=lambda x: [x[0] + x[2] ** 2 + 1],
    ),
    "hs028": Program(
        lambda x: (x[0] + x[1]) ** 2 + (x[1] + x[2]) ** 2,
        [-4.0, 1.0, 1.0],
        [0.5, -0.5, 0.5],
        0.0,
        equality=lambda x: [x[0] + 2 * x[1] + 3 * x[2] - 1],
    ),
    "hs029": Program(
        lambda x: -x[0] * x[1] * x[2],
        [1.0, 1.0, 1.0],
        [4.0, 2 * 2**0.5, 2.0],
        -16 * 2**0.5,
        inequality=lambda x: [x[0] ** 2 + 2 * x[1] ** 2 + 4 * x[2] ** 2 - 48],
    ),
    "hs035": Program(
        lambda x: (
            9
            - 8 * x[0]
            - 6 * x[1]
            - 4 * x[2]
            + 2 * x[0] ** 2
            + 2 * x[1] ** 2
            + x[2] ** 2
            + 2 * x[0] * x[1]
            + 2 * x[0] * x[2]
        ),
        [0.5, 0.5, 0.5],
        [4 / 3, 7 / 9, 4 / 9],
        1 / 9,
        inequality=lambda x: [x[0] + x[1] + 2 * x[2] - 3],
        lower=0.0,
    ),
    "hs036": Program(
        lambda x: -x[0] * x[1] * x[2],
        [10.0, 10.0, 10.0],
        [20.0, 11.0, 15.0],
        -3300.0,
        inequality=lambda x: [x[0] + 2 * x[1] + 2 * x[2] - 72],
        lower=0.0,
        upper=[20.0, 11.0, 42.0],
    ),
    "hs037": Program(
        lambda x: -x[0] * x[1] * x[2],
        [10.0, 10.0, 10.0],
        [24.0, 12.0, 12.0],
        -3456.0,
        inequality=lambda x: [x[0] + 2 * x[1] + 2 * x[2] - 72, -x[0] - 2 * x[1] - 2 * x[2]],
        lower=0.0,
        upper=42.0,
    ),
    "hs039": Program(
        lambda x: -x[0],
        [2.0, 2.0, 2.0, 2.0],
        [1.0, 1.0, 0.0, 0.0],
        -1.0,
        equality=lambda x: [x[1] - x[0] ** 3 - x[2] ** 2, x[0] ** 2 - x[1] - x[3] ** 2],
    ),
    "hs040": Program(
        lambda x: -x[0] * x[1] * x[2] * x[3],
        [0.8, 0.8, 0.8, 0.8],
        [2 ** (-1 / 3), 2 ** (-1 / 2), 2 ** (-11 / 12), 2 ** (-1 / 4)],
        -0.25,
        equality=lambda x: [
            x[0] ** 3 + x[1] ** 2 - 1,
            x[0] ** 2 * x[3] - x[2],
            x[3] ** 2 - x[1],
        ],
    ),
    "hs042": Program(
        lambda x: jnp.sum((x - jnp.arange(1.0, 5.0)) ** 2),
        [1.0, 1.0, 1.0, 1.0],
        [2.0, 2.0, 0.6 * 2**0.5, 0.8 * 2**0.5],
        28 - 10 * 2**0.5,
        equality=lambda x: [x[0] - 2, x[2] ** 2 + x[3] ** 2 - 2],
    ),
    "hs043": Program(
        lambda x: jnp.sum(x**2) + x[2] ** 2 - 5 * x[0] - 5 * x[1] - 21 * x[2] + 7 * x[3],
        [0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 2.0, -1.0],
        -44.0,
        inequality=lambda x: [
            jnp.sum(x**2) + x[0] - x[1] + x[2] - x[3] - 8,
            jnp.sum(x**2) + x[1] ** 2 + x[3] ** 2 - x[0] - x[3] - 10,
            2 * x[0] ** 2 + x[1] ** 2 + x[2] ** 2 + 2 * x[0] - x[1] - x[3] - 5,
        ],
    ),
    "hs048": Program(
        lambda x: (x[0] - 1) ** 2 + (x[1] - x[2]) ** 2 + (x[3] - x[4]) ** 2,
        [3.0, 5.0, -3.0, 2.0, -2.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda x: [jnp.sum(x) - 5, x[2] - 2 * (x[3] + x[4]) + 3],
    ),
    "hs050": Program(
        lambda x: (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 2 + (x[2] - x[3]) ** 4 + (x[3] - x[4]) ** 2,
        [35.0, -31.0, 11.0, 5.0, -5.0],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda x: [x[i] + 2 * x[i + 1] + 3 * x[i + 2] - 6 for i in range(3)],
    ),
    "hs051": Program(
        lambda x: (x[0] - x[1]) ** 2 + (x[1] + x[2] - 2) ** 2 + (x[3] - 1) ** 2 + (x[4] - 1) ** 2,
        [2.5, 0.5, 2.0, -1.0, 0.5],
        [1.0, 1.0, 1.0, 1.0, 1.0],
        0.0,
        equality=lambda x: [x[0] + 3 * x[1] - 4, x[2] + x[3] - 2 * x[4], x[1] - x[4]],
    ),
    "hs052": Program(
        lambda x: (
            (4 * x[0] - x[1]) ** 2 + (x[1] + x[2] - 2) ** 2 + (x[3] - 1) ** 2 + (x[4] - 1) ** 2
        ),
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [-33 / 349, 11 / 349, 180 / 349, -158 / 349, 11 / 349],
        1859 / 349,
        equality=lambda x: [x[0] + 3 * x[1], x[2] + x[3] - 2 * x[4], x[1] - x[4]],
    ),
    "hs053": Program(
        lambda x: (x[0] - x[1]) ** 2 + (x[1] + x[2] - 2) ** 2 + (x[3] - 1) ** 2 + (x[4] - 1) ** 2,
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [-33 / 43, 11 / 43, 27 / 43, -5 / 43, 11 / 43],
        176 / 43,
        equality=lambda x: [x[0] + 3 * x[1], x[2] + x[3] - 2 * x[4], x[1] - x[4]],
        lower=-10.0,
        upper=10.0,
    ),
    "hs060": Program(
        lambda x: (x[0] - 1) ** 2 + (x[0] - x[1]) ** 2 + (x[1] - x[2]) ** 4,
        [2.0, 2.0, 2.0],
        [1.104859024, 1.196674194, 1.535262257],
        0.03256820025,
        equality=lambda x: [x[0] * (1 + x[1] ** 2) + x[2] ** 4 - 4 - 3 * 2**0.5],
        lower=-10.0,
        upper=10.0,
    ),
    "hs061": Program(
        lambda x: 4 * x[0] ** 2 + 2 * x[1] ** 2 + 2 * x[2] ** 2 - 33 * x[0] + 16 * x[1] - 24 * x[2],
        [0.0, 0.0, 0.0],
        [5.326770157, -2.118998639, 3.210464239],
        -143.6461422,
        equality=lambda x: [3 * x[0] - 2 * x[1] ** 2 - 7, 4 * x[0] - x[2] ** 2 - 11],
    ),
    "hs063": Program(
        lambda x: 1000 - x[0] ** 2 - 2 * x[1] ** 2 - x[2] ** 2 - x[0] * x[1] - x[0] * x[2],
        [2.0, 2.0, 2.0],
        [3.512118414, 0.2169881741, 3.552174034],
        961.7151721,
        equality=lambda x: [8 * x[0] + 14 * x[1] + 7 * x[2] - 56, jnp.sum(x**2) - 25],
        lower=0.0,
    ),
    "hs065": Program(
        lambda x: (x[0] - x[1]) ** 2 + (x[0] + x[1] - 10) ** 2 / 9 + (x[2] - 5) ** 2,
        [-5.0, 5.0, 0.0],
        [3.650461821, 3.650461821, 4.6204170507],
        0.9535288567,
        inequality=lambda x: [jnp.sum(x**2) - 48],
        lower=[-4.5, -4.5, -5.0],
        upper=[4.5, 4.5, 5.0],
    ),
    "hs066": Program(
        lambda x: 0.2 * x[2] - 0.8 * x[0],
        [0.0, 1.05, 2.9],
        [0.1841264879, 1.202167873, 3.327322322],
        0.5181632741,
        inequality=lambda x: [jnp.exp(x[0]) - x[1], jnp.exp(x[1]) - x[2]],
        lower=0.0,
        upper=[100.0, 100.0, 10.0],
    ),
    "hs071": Program(
        lambda x: x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        [1.0, 5.0, 5.0, 1.0],
        [1.0, 4.7429994, 3.8211503, 1.3794082],
        17.0140173,
        equality=lambda x: [jnp.sum(x**2) - 40],
        inequality=lambda x: [25 - x[0] * x[1] * x[2] * x[3]],
        lower=1.0,
        upper=5.0,
    ),
    "hs076": Program(
        lambda x: (
            x[0] ** 2
            + 0.5 * x[1] ** 2
            + x[2] ** 2
            + 0.5 * x[3] ** 2
            - x[0] * x[2]
            + x[2] * x[3]
            - x[0]
            - 3 * x[1]
            + x[2]
            - x[3]
        ),
        [0.5, 0.5, 0.5, 0.5],
        [3 / 11, 23 / 11, 0.0, 6 / 11],
        -4.681818181,
        inequality=lambda x: [
            x[0] + 2 * x[1] + x[2] + x[3] - 5,
            3 * x[0] + x[1] + 2 * x[2] - x[3] - 4,
            1.5 - x[1] - 4 * x[2],
        ],
        lower=0.0,
    ),
    "hs077": Program(
        lambda x: (
            (x[0] - 1) ** 2
            + (x[0] - x[1]) ** 2
            + (x[2] - 1) ** 2
            + (x[3] - 1) ** 4
            + (x[4] - 1) ** 6
        ),
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [1.166172, 1.182111, 1.380257, 1.506036, 0.6109203],
        0.24150513,
        equality=lambda x: [
            x[0] ** 2 * x[3] + jnp.sin(x[3] - x[4]) - 2 * 2**0.5,
            x[1] + x[2] ** 4 * x[3] ** 2 - 8 - 2**0.5,
        ],
    ),
    "hs078": Program(
        _product,
        [-2.0, 1.5, 2.0, -1.0, -1.0],
        [-1.717142, 1.595708, 1.827248, -0.7636429, -0.7636435],
        -2.91970041,
        equality=_powell,
    ),
    "hs079": Program(
        lambda x: (
            (x[0] - 1) ** 2
            + (x[0] - x[1]) ** 2
            + (x[1] - x[2]) ** 2
            + (x[2] - x[3]) ** 4
            + (x[3] - x[4]) ** 4
        ),
        [2.0, 2.0, 2.0, 2.0, 2.0],
        [1.191127, 1.362603, 1.472818, 1.635017, 1.679081],
        0.0787768209,
        equality=lambda x: [
            x[0] + x[1] ** 2 + x[2] ** 3 - 2 - 3 * 2**0.5,
            x[1] - x[2] ** 2 + x[3] + 2 - 2 * 2**0.5,
            x[0] * x[4] - 2,
        ],
    ),
    "hs080": Program(
        lambda x: jnp.exp(_product(x)),
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
        inequality=lambda x: [
            2 * x[0] ** 2 + 3 * x[1] ** 4 + x[2] + 4 * x[3] ** 2 + 5 * x[4] - 127,
            7 * x[0] + 3 * x[1] + 10 * x[2] ** 2 + x[3] - x[4] - 282,
            23 * x[0] + x[1] ** 2 + 6 * x[5] ** 2 - 8 * x[6] - 196,
            4 * x[0] ** 2 + x[1] ** 2 - 3 * x[0] * x[1] + 2 * x[2] ** 2 + 5 * x[5] - 11 * x[6],
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
        inequality=lambda x: [
            4 * x[0] + 5 * x[1] - 3 * x[6] + 9 * x[7] - 105,
            10 * x[0] - 8 * x[1] - 17 * x[6] + 2 * x[7],
            -8 * x[0] + 2 * x[1] + 5 * x[8] - 2 * x[9] - 12,
            3 * (x[0] - 2) ** 2 + 4 * (x[1] - 3) ** 2 + 2 * x[2] ** 2 - 7 * x[3] - 120,
            5 * x[0] ** 2 + 8 * x[1] + (x[2] - 6) ** 2 - 2 * x[3] - 40,
            0.5 * (x[0] - 8) ** 2 + 2 * (x[1] - 4) ** 2 + 3 * x[4] ** 2 - x[5] - 30,
            x[0] ** 2 + 2 * (x[1] - 2) ** 2 - 2 * x[0] * x[1] + 14 * x[4] - 6 * x[5],
            -3 * x[0] + 6 * x[1] + 12 * (x[8] - 8) ** 2 - 7 * x[9],
        ],
    ),
}
"""By the book's numbers."""

"""The Riccati recursion of few chains, parallel in time: segments of stages, then their ends.

A GPU is idle while few chains of small blocks go through many stages one by one. With K stages in
S segments:

1. every segment by itself: the value function at its start, for a costate z at its end, is

       V(x; z) = 1/2 x'J x + j'x + z'(Phi x + phi) - 1/2 z'C z

   by the same recursion, from the cost of the segment's last knot, with the columns Phi' beside p:
   C and phi collect what z does to the minima over u and over defects e.
2. from the last segment to the first: with the value function 1/2 x'P x + p'x after a segment, of
   which the cost of its last knot is not part, and C = R R', the minimum over z is

       W = P (I + C P)^{-1} = P - P R (I + R'P R)^{-1} R'P     P <- J + Phi'W Phi
       w = (I + P C)^{-1} p                                    p <- j + Phi'(W phi + w)

   and a step dx at the start of a segment moves its end by F dx,
   F = (I + C P)^{-1} Phi = Phi - C W Phi.
3. every segment by itself: the ordinary recursion, from P and p at its end, and the steps from
   dx = 0 at its start.
4. from the first segment to the last: dx at the ends by F. Every segment again, from there.

In sequence that is 4 K / S + 2 S stages in place of 2 K, and in float32 as exact, as long as
defects have a penalty. Without one, Phi grows with the length of a segment where the dynamics are
unstable, and a model that is convex only as a whole may not be convex in a segment: the polish has
such models, so it goes stage by stage.

The idea is that of Wright, "Partitioned dynamic programming for optimal control", 1991, and of
Sarkka and Garcia-Fernandez, "Temporal parallelization of dynamic programming and linear quadratic
control", 2023.
"""

from __future__ import annotations

from math import ceil, sqrt
from typing import Any

import jax.numpy as jnp
from jax import Array

from mjx_drax.kernels import riccati_threads as kernels
from mjx_drax.kernels.riccati_threads import Given

LEAST_STAGES = 256
"""With fewer stages less is saved than the kernels take to compile."""

MAX_ROWS = 8192
"""Segments of all chains at once: more of them wait for each other."""


def segments(given: Given) -> int:
    """In how many segments kernels go through the stages of every chain."""
    chains, stages, _ = given.h.shape
    wanted = min(round(sqrt(2 * stages)), MAX_ROWS // chains)
    pays = stages >= LEAST_STAGES and wanted > 3
    return wanted if pays and given.penalty is not None else 1


def newton_steps(
    given: Given, count: int | None = None, interpret: bool = False
) -> dict[str, Array | None]:
    """Newton step, noise and feedback of many chains (in plain JAX: `method.riccati.newton`).

    Args:
        given: the quadratic programs, a row for each chain.
        count: the number of segments; as `segments` says by default.
        interpret: run it without a GPU.

    Returns:
        dx, rate and noise_x (chains, K, ndx), du and noise_u (chains, K, nu), and gains
        (chains, K, nu, ndx); noise_x and noise_u are None without noise.
    """
    count = count or segments(given)
    if count == 1:
        return kernels.followed(given, kernels.factorized(given, interpret), None, interpret)
    chains, K, _ = given.h.shape
    length = ceil(K / count)
    count = ceil(K / length)
    parts = _divided(given, count, length)

    def by_chain(a: Array) -> Array:
        return a.reshape(chains, count, *a.shape[1:])

    def by_row(a: Array) -> Array:
        return a.reshape(chains * count, *a.shape[2:])

    links = kernels.condensed(parts, interpret)
    links = type(links)(*map(by_chain, links))
    P, p, WPhi = kernels.joined(links, interpret)
    F = links.Phi - links.R @ (jnp.swapaxes(links.R, -1, -2) @ WPhi)
    parts = parts._replace(
        Hxx=parts.Hxx.at[:, -1].add(by_row(P)), gx=parts.gx.at[:, -1].add(by_row(p))
    )
    factors = kernels.factorized(parts, interpret)
    alone = kernels.followed(parts, factors, None, interpret)
    last = [a[:, -1] for a in (alone["dx"], alone["noise_x"]) if a is not None]
    ends = by_chain(jnp.stack(last, axis=-1))
    starts = kernels.recursion(F[:, :-1], ends[:, :-1], interpret)
    starts = by_row(jnp.pad(starts, [(0, 0), (1, 0), (0, 0), (0, 0)]))
    steps = kernels.followed(parts, factors, (starts[..., 0], starts[..., -1]), interpret)

    def whole(a: Array) -> Array:
        return a.reshape(chains, count * length, *a.shape[2:])[:, :K]

    return {name: None if a is None else whole(a) for name, a in steps.items()}


def _divided(given: Given, count: int, length: int) -> Given:
    """A row for each segment; the cost of a knot between two is at the end of the first.

    Stages that fill up the last segment come after the last knot, cost nothing, and move nothing.
    """
    chains, K, n, m = given.B.shape
    more = count * length - K

    def extended(a: Array, filling: Array | float = 0.0) -> Array:
        if not more:
            return a
        return jnp.concatenate([a, jnp.broadcast_to(filling, (chains, more, *a.shape[2:]))], axis=1)

    def by_segment(a: Array) -> Array:
        return a.reshape(chains * count, length, *a.shape[2:])

    def of_states(a: Array) -> Array:
        a = extended(a)
        ends = a[:, length::length].reshape(chains * count, 1, *a.shape[2:])
        before = by_segment(a[:, :-1]).at[:, 0].set(0.0)
        return jnp.concatenate([before, ends], axis=1)

    one = {"A": jnp.eye(n, dtype=given.A.dtype), "Huu": jnp.eye(m, dtype=given.A.dtype)}
    parts: dict[str, Any] = {}
    for name, a in given._asdict().items():
        if a is None:
            parts[name] = None
        elif name == "penalty":
            parts[name] = jnp.repeat(a, count)
        elif name in ("gx", "Hxx"):
            parts[name] = of_states(a)
        else:
            parts[name] = by_segment(extended(a, one.get(name, 0.0)))
    return Given(**parts)

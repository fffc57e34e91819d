"""Times of the Riccati recursion with noise and gains: its GPU kernels beside the plain recursion.

    python -m mjx_drax.studies.recursion [NDXxNU ...] [--chains N ...] [--knots K]

A row for each size and number of chains: milliseconds of the plain recursion, of the kernels stage
by stage and in segments, and the largest difference of the Newton steps, relative to the largest
entry. Times are medians of calls in one process. The problems are random:
A = I + 0.1 N / sqrt(ndx), with N standard normal.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.kernels.linalg import full_precision
from mjx_drax.kernels.riccati_gpu import arrays_of, kernels_for
from mjx_drax.kernels.riccati_segments import newton_steps, segments
from mjx_drax.method.model import Linearization, QuadraticCost
from mjx_drax.method.riccati import White, newton

SIZES = ("4x1", "6x2", "12x4", "24x8", "36x12", "54x21")


def batch(chains: int, K: int, ndx: int, nu: int) -> Any:
    """Arguments of `newton` for many chains."""
    rng: Any = np.random.default_rng(0)
    A: Any = np.eye(ndx) + 0.1 * rng.normal(size=(chains, K, ndx, ndx)) / np.sqrt(ndx)
    B = 0.3 * rng.normal(size=(chains, K, ndx, nu))
    h, g = rng.normal(size=(chains, K, ndx)), rng.normal(size=(chains, K + 1, ndx + nu))
    half = rng.normal(size=(K + 1, ndx + nu, ndx + nu)) / np.sqrt(ndx + nu)
    H: Any = np.broadcast_to(
        half @ half.swapaxes(1, 2) + 0.1 * np.eye(ndx + nu), (chains, *half.shape)
    )
    cost = QuadraticCost(
        g[..., :ndx],
        g[:, :-1, ndx:],
        H[..., :ndx, :ndx],
        H[:, :-1, ndx:, :ndx],
        H[:, :-1, ndx:, ndx:],
    )
    white = White(rng.normal(size=(chains, K, nu)), rng.normal(size=(chains, K, ndx)))
    multipliers, penalty = rng.normal(size=(chains, K, ndx)), np.full(chains, 100.0)
    given: Any = Linearization(A, B, h), cost, multipliers, penalty, white
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), given)


def timed(step: Callable[..., Any], arguments: tuple[Any, ...], repeats: int) -> tuple[float, Any]:
    """Median seconds of a call, and its result."""
    out, seconds = jax.block_until_ready(step(*arguments)), []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(step(*arguments))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), out


def main(arguments: Sequence[str] | None = None) -> None:
    """Time and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sizes", nargs="*", default=SIZES, metavar="NDXxNU")
    parser.add_argument("--chains", type=int, nargs="+", default=[1, 32, 1024])
    parser.add_argument("--knots", type=int, default=60)
    parser.add_argument("--segments", type=int, nargs="*", help="default: as solves choose")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args(arguments)
    print(f"{jax.devices()[0].device_kind}, jax {jax.__version__}, {options.knots} knots\n")
    print(
        "| ndx, nu | chains | plain [ms] | by stages [ms] | segments | in segments [ms] | apart |"
    )
    print("|---" * 7 + "|")
    plain = jax.jit(full_precision(jax.vmap(newton.__wrapped__)))
    for size in options.sizes:
        ndx, nu = map(int, size.split("x"))
        for chains in options.chains:
            programs = batch(chains, options.knots, ndx, nu)
            given = arrays_of(programs)
            kernels = kernels_for(given)
            before, wanted = timed(plain, programs, options.repeats)
            by_stages, found = timed(steps_in(kernels, 1), (given,), options.repeats)
            row = f"| {ndx}, {nu} | {chains:,} | {1e3 * before:.3f} | {1e3 * by_stages:.3f}"
            for count in options.segments or [segments(kernels, given)]:
                cells = "- | -"
                if count > 1:
                    seconds, found = timed(steps_in(kernels, count), (given,), options.repeats)
                    cells = f"{count} | {1e3 * seconds:.3f}"
                apart = jnp.max(jnp.abs(found["dx"] - wanted.dx)) / jnp.max(jnp.abs(wanted.dx))
                print(f"{row} | {cells} | {float(apart):.0e} |", flush=True)


def steps_in(kernels: Any, count: int) -> Callable[..., Any]:
    """The kernels' Newton steps in so many segments."""
    return jax.jit(full_precision(lambda given: newton_steps(kernels, given, count)))


if __name__ == "__main__":
    main()

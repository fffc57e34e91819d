"""Times of the Riccati recursion with noise and gains: its GPU kernels beside the plain recursion.

    python -m mjx_drax.studies.recursion [NDXxNU ...] [--chains N ...] [--knots K] [--precision P]

A row for each size and number of chains: milliseconds of the plain recursion and of the kernel, and
the largest difference of the Newton steps, relative to the largest entry. A call makes ten steps,
each with defects that the one before has moved, as iterations do; times are medians of calls in one
process. The problems are random: A = I + 0.1 N / sqrt(ndx), with N standard normal.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from mjx_drax.kernels.linalg import full_precision
from mjx_drax.kernels.riccati_gpu import arrays_of, kernel_for
from mjx_drax.method.model import Linearization, QuadraticCost
from mjx_drax.method.riccati import White, newton

SIZES = ("4x1", "6x2", "12x4", "24x8", "36x12", "54x21")

STEPS = 10
"""In one call, so that what a call costs besides does not count."""


def of_joint(H: Any, g: Any, ndx: int) -> QuadraticCost:
    """The cost sum_k 1/2 z'H z + g'z of z = (x, u) at K + 1 knots, the last of which has no u.

    H (..., K+1, ndx + nu, ndx + nu) and g (..., K+1, ndx + nu).
    """
    return QuadraticCost(
        g[..., :ndx],
        g[..., :-1, ndx:],
        H[..., :ndx, :ndx],
        H[..., :-1, ndx:, :ndx],
        H[..., :-1, ndx:, ndx:],
    )


def batch(chains: int, K: int, ndx: int, nu: int, dtype: Any = jnp.float32) -> Any:
    """Arguments of `newton` for many chains."""
    rng: Any = np.random.default_rng(0)
    A: Any = np.eye(ndx) + 0.1 * rng.normal(size=(chains, K, ndx, ndx)) / np.sqrt(ndx)
    B = 0.3 * rng.normal(size=(chains, K, ndx, nu))
    h, g = rng.normal(size=(chains, K, ndx)), rng.normal(size=(chains, K + 1, ndx + nu))
    half = rng.normal(size=(K + 1, ndx + nu, ndx + nu)) / np.sqrt(ndx + nu)
    H: Any = np.broadcast_to(
        half @ half.swapaxes(1, 2) + 0.1 * np.eye(ndx + nu), (chains, *half.shape)
    )
    white = White(rng.normal(size=(chains, K, nu)), rng.normal(size=(chains, K, ndx)))
    multipliers, penalty = rng.normal(size=(chains, K, ndx)), np.full(chains, 100.0)
    given: Any = Linearization(A, B, h), of_joint(H, g, ndx), multipliers, penalty, white
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), given)


def timed(step: Callable[..., Any], given: Any, repeats: int) -> tuple[float, Array]:
    """Median seconds of a step, which returns dx, noise_x and rate, and the first dx."""

    @jax.jit
    @full_precision
    def steps(model: Any, *rest: Any) -> Any:
        first = step(model, *rest)

        def another(_: Array, found: Any) -> Any:
            return step(replace(model, h=model.h + 1e-6 * sum(found)), *rest)

        return first, lax.fori_loop(1, STEPS, another, first)

    seconds, out = median_seconds(steps, given, repeats)
    return seconds / STEPS, out[0][0]


def median_seconds(call: Callable[..., Any], given: Any, repeats: int) -> tuple[float, Any]:
    """Median seconds of call(*given) after the first, and what it returned."""
    out = jax.block_until_ready(call(*given))
    clocks = [time.perf_counter()]
    for _ in range(repeats):
        jax.block_until_ready(call(*given))
        clocks.append(time.perf_counter())
    return float(np.median(np.diff(clocks))), out


def main(arguments: Sequence[str] | None = None) -> None:
    """Time and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("sizes", nargs="*", default=SIZES, metavar="NDXxNU")
    parser.add_argument("--chains", type=int, nargs="+", default=[1, 32, 1024])
    parser.add_argument("--knots", type=int, default=60)
    parser.add_argument("--precision", type=int, choices=(32, 64), default=32)
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args(arguments)
    device = jax.devices()[0].device_kind
    print(f"{device}, jax {jax.__version__}, {options.knots} knots, float{options.precision}\n")
    print("| ndx, nu | chains | plain [ms] | kernel [ms] | apart |\n" + "|---" * 5 + "|")
    with jax.enable_x64(options.precision == 64):
        for size in options.sizes:
            for chains in options.chains:
                _row(size, chains, options)


def _row(size: str, chains: int, options: argparse.Namespace) -> None:
    ndx, nu = map(int, size.split("x"))
    dtype = jnp.dtype(f"float{options.precision}")
    given = batch(chains, options.knots, ndx, nu, dtype)
    kernel = kernel_for(arrays_of(given))

    def plain(*given: Any) -> tuple[Any, ...]:
        step = jax.vmap(newton.__wrapped__)(*given)
        return step.dx, step.noise_x, step.rate

    def by_kernel(*given: Any) -> tuple[Any, ...]:
        assert kernel is not None
        step = kernel(arrays_of(given))
        return step["dx"], step["noise_x"], step["rate"]

    before, wanted = timed(plain, given, options.repeats)
    cells = "- | -"
    if kernel is not None:
        after, found = timed(by_kernel, given, options.repeats)
        apart = float(jnp.max(jnp.abs(found - wanted)) / jnp.max(jnp.abs(wanted)))
        cells = f"{1e3 * after:.3f} | {apart:.0e}"
    print(f"| {ndx}, {nu} | {chains:,} | {1e3 * before:.3f} | {cells} |", flush=True)


if __name__ == "__main__":
    main()

"""The Riccati recursion of `method.riccati` on GPUs: which kernels serve which blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any

import jax
from jax import Array, lax

from mjx_drax.kernels import riccati_cuda, riccati_segments, riccati_threads
from mjx_drax.kernels.batching import merged_vmaps, of_one_precision, on_gpu, repeated
from mjx_drax.kernels.riccati_threads import Given

Kernel = Callable[[Given], dict[str, Array | None]]
"""Newton step, noise and feedback of many chains; see `riccati_segments.newton_steps`."""


def vmapped_as_kernel(result: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of the Newton step of one chain, whose vmap is kernels where that pays.

    That is on GPUs, in one precision, for blocks that there is a `kernel_for`. The arrays of the
    step's arguments are, in their order, those of `Given`; it returns result(dx=, du=, noise_x=,
    noise_u=, rate=, gains=).
    """

    def decorate(newton: Callable[..., Any]) -> Callable[..., Any]:
        plain = jax.vmap(newton)

        def all_chains(has_rows: tuple[bool, ...], *arguments: Any) -> Any:
            arguments = repeated(has_rows, arguments)
            kernel = kernel_for(arrays_of(arguments)) if on_gpu() else None
            if kernel is None:
                return plain(*arguments)

            def on_cuda(*arguments: Any) -> Any:
                return result(**kernel(arrays_of(arguments)))

            return lax.platform_dependent(*arguments, cuda=on_cuda, default=plain)

        return update_wrapper(merged_vmaps(newton, all_chains), newton)

    return decorate


def arrays_of(arguments: Any) -> Given:
    """The arrays of a step's arguments, with None for the penalty where there is none."""
    return Given(*jax.tree.leaves(arguments, is_leaf=lambda leaf: leaf is None))


def kernel_for(given: Given) -> Kernel | None:
    """The kernel for such blocks, if there is one."""
    ndx, nu = given.B.shape[-2:]
    there = [array for array in given if array is not None]
    if min(ndx, nu) == 0 or not of_one_precision(there):
        return None
    if ndx <= riccati_threads.MAX_NDX and nu <= riccati_threads.MAX_NU:
        return riccati_segments.newton_steps
    return riccati_cuda.newton_steps if riccati_cuda.serves(given) else None

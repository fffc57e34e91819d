"""The Riccati recursion of `method.riccati` on GPUs: which kernels serve which blocks."""

from __future__ import annotations

from collections.abc import Callable
from functools import update_wrapper
from typing import Any

import jax
import numpy as np
from jax import lax

from mjx_drax.kernels import riccati_blocks, riccati_threads
from mjx_drax.kernels.batching import merged_vmaps, of_one_precision, on_gpu, repeated
from mjx_drax.kernels.riccati_segments import newton_steps, segments
from mjx_drax.kernels.riccati_threads import Given


def vmapped_as_kernel(result: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of the Newton step of one chain, whose vmap is kernels where that pays.

    That is on GPUs, in one precision, for blocks that `riccati_threads` serves, and larger ones of
    float32 as far as `riccati_blocks` goes. The arrays of the step's arguments are, in their order,
    those of `Given`; it returns result(dx=, du=, noise_x=, noise_u=, rate=, gains=).
    """

    def decorate(newton: Callable[..., Any]) -> Callable[..., Any]:
        plain = jax.vmap(newton)

        def all_chains(has_rows: tuple[bool, ...], *arguments: Any) -> Any:
            arguments = repeated(has_rows, arguments)
            kernels = kernels_for(arrays_of(arguments)) if on_gpu() else None
            if kernels is None:
                return plain(*arguments)

            def kernel(*arguments: Any) -> Any:
                given = arrays_of(arguments)
                return result(**newton_steps(kernels, given, segments(kernels, given)))

            return lax.platform_dependent(*arguments, cuda=kernel, default=plain)

        return update_wrapper(merged_vmaps(newton, all_chains), newton)

    return decorate


def arrays_of(arguments: Any) -> Given:
    """The arrays of a step's arguments, with None for the penalty where there is none."""
    return Given(*jax.tree.leaves(arguments, is_leaf=lambda leaf: leaf is None))


def kernels_for(given: Given) -> Any:
    """The module of kernels that are made for such blocks, or None."""
    ndx, nu = given.B.shape[-2:]
    there = [array for array in given if array is not None]
    if min(ndx, nu) == 0 or not of_one_precision(there):
        return None
    for kernels in (riccati_threads, riccati_blocks):
        if ndx <= kernels.MAX_NDX and nu <= kernels.MAX_NU:
            of_blocks = kernels is riccati_blocks
            return kernels if not of_blocks or given.A.dtype == np.float32 else None
    return None

"""How the programs that a solve waits for are compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache, update_wrapper
from typing import Any

import jax

GPU_OPTIONS = {"xla_gpu_experimental_enable_fusion_autotuner": False}
"""XLA would try several ways to compile each fusion, on the GPU: up to two thirds of the time that
a contact model compiles, and solves are as fast without."""


@lru_cache
def _options() -> dict[str, bool] | None:
    """Options for the present backend, if its compiler knows them."""
    if jax.default_backend() != "gpu":
        return None
    try:
        jax.jit(lambda x: x + 1, compiler_options=GPU_OPTIONS)(0)
    except jax.errors.JaxRuntimeError:
        return None
    return GPU_OPTIONS


class compiled:
    """`jax.jit` with options for the compiler, for functions that no other jitted one calls.

    Nothing is looked up before the first call: asking for the backend is what starts it, and
    `jax.distributed.initialize` has to come first.
    """

    def __init__(self, function: Callable[..., Any], **settings: Any) -> None:
        self._function, self._settings = function, settings
        update_wrapper(self, function)

    @cached_property
    def _jitted(self) -> Any:
        return jax.jit(self._function, compiler_options=_options(), **self._settings)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the function returns."""
        return self._jitted(*arguments, **named)

    def lower(self, *arguments: Any, **named: Any) -> Any:
        """`jax.jit(...).lower`."""
        return self._jitted.lower(*arguments, **named)

    def _cache_size(self) -> int:
        return int(self._jitted._cache_size())

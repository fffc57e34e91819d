"""How the programs that a solve waits for are compiled, and where they are kept."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache, update_wrapper
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from mjx_drax.base.errors import DraxError, reason

OPTIONS: dict[str, dict[str, str | bool]] = {
    "gpu": {"xla_gpu_experimental_enable_fusion_autotuner": False},
    "cpu": {"xla_backend_optimization_level": "1"},
}
"""By backend. On the GPU XLA would try several ways to compile each fusion: up to two thirds of the
time that a contact model compiles. On the CPU LLVM's full effort takes up to almost three times as
long (a quadrotor's 103 s, not 37). Solves are as fast without."""


GRAPH: dict[str, str | bool] = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,"
    "DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
}
"""For a GPU's program that a host waits for in a loop: XLA makes CUDA graphs of loops and branches,
too, so the host launches one of them, and not hundreds of kernels."""

QUICKLY: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}
"""For a CPU's program that runs once: it compiles faster, and runs slower."""


@contextmanager
def rarely_collected() -> Iterator[None]:
    """Let Python look for garbage a hundred times less often, also as a decorator.

    While JAX traces, hardly any of its objects are garbage: to look for it took a fifth of the time
    until a quadruped's first iteration.
    """
    before = gc.get_threshold()
    gc.set_threshold(100 * before[0], *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@rarely_collected()
def run_once(function: Callable[..., Any], *arguments: Any) -> Any:
    """function(*arguments), jitted, for a program that runs once: on the CPU if JAX has one."""
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX was told to have none
        return jax.jit(function)(*arguments)
    with jax.default_device(device):
        lowered = jax.jit(function).lower(*jax.device_put(arguments, device))
        try:
            program = lowered.compile(
                compiler_options=QUICKLY | {"xla_cpu_use_fusion_emitters": False}
            )
        except jax.errors.JaxRuntimeError:  # jaxlib 0.11 does not know this option
            program = lowered.compile(compiler_options=QUICKLY)
        return jax.block_until_ready(program(*jax.device_put(arguments, device)))


@lru_cache
def known_options(graph: bool = False) -> dict[str, str | bool] | None:
    """Options for the present backend, if its compiler knows them and JAX is not told to hurry.

    Args:
        graph: whether with `GRAPH` on a GPU.
    """
    if jax.config.values["jax_disable_most_optimizations"]:
        return None
    backend = jax.default_backend()
    options = OPTIONS.get(backend)
    if graph and backend == "gpu":
        options = OPTIONS["gpu"] | GRAPH
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0)
    except jax.errors.JaxRuntimeError:
        return known_options() if graph else None
    return options


def keep_programs() -> None:
    """Keep compiled programs on disk from now on, so that a second process starts at once.

    They go to `mjx_drax/jax` in the user's folder for caches. Nothing is changed where JAX was told
    another folder, or to keep none (`jax_enable_compilation_cache`), or where none can be written.
    """
    known = jax.config.values
    if known["jax_compilation_cache_dir"] or not known["jax_enable_compilation_cache"]:
        return
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(caches) / "mjx_drax" / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # dozens of small ones
    compilation_cache.reset_cache()  # else what was compiled before settles that there is none


def keep_none() -> None:
    """Keep no programs, for measurements of compile times, unless JAX was told a folder."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_enable_compilation_cache", False)


@contextmanager
def said_plainly(what: str, hint: str = "with fewer chains") -> Iterator[None]:
    """What JAX and its compiler raise about `what` is compiled and run, as a DraxError.

    It has the first line of what they said, and what to try: the hint is for want of memory.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            hint += ", on a CPU (JAX_PLATFORMS=cpu), or with another version of jax"
        raise DraxError(
            f"JAX failed to compile or run {what} ({reason(error)}): try {hint}."
        ) from error
    except ValueError as error:
        if isinstance(error, DraxError) or "Cannot lower jaxpr" not in str(error):
            raise
        raise DraxError(
            f"JAX failed to compile {what} ({reason(error)}): give numbers to jax as "
            "jnp.asarray(array) inside of functions, or try another version of jax."
        ) from error


class compiled:
    """`jax.jit` with options for the compiler, for functions that no other jitted one calls.

    Nothing is looked up before the first call: asking for the backend is what starts it, and
    `jax.distributed.initialize` has to come first. With `graph` see `GRAPH`.
    """

    def __init__(self, function: Callable[..., Any], graph: bool = False, **settings: Any) -> None:
        self._function, self._graph, self._settings = function, graph, settings
        update_wrapper(self, function)

    @cached_property
    def _jitted(self) -> Any:
        options = known_options(graph=True) if self._graph else known_options()
        return jax.jit(self._function, compiler_options=options, **self._settings)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the function returns."""
        return self._jitted(*arguments, **named)

    def lower(self, *arguments: Any, **named: Any) -> Any:
        """`jax.jit(...).lower`."""
        return self._jitted.lower(*arguments, **named)

    def _cache_size(self) -> int:
        return int(self._jitted._cache_size())

"""How the programs that a solve waits for are compiled, and where they are kept."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from contextvars import ContextVar
from functools import cached_property, lru_cache, update_wrapper
from inspect import Signature, signature
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

from mjx_drax.base.errors import DraxError, reason
from mjx_drax.base.meanwhile import Meanwhile
from mjx_drax.kernels import kept
from mjx_drax.kernels.batching import on_gpu

OPTIONS: dict[str, dict[str, str | bool]] = {
    "gpu": {
        "xla_gpu_experimental_enable_fusion_autotuner": False,
        "xla_gpu_enable_triton_gemm": False,
    },
    "cpu": {"xla_backend_optimization_level": "1"},
}
"""By backend. On the GPU XLA would try several ways to compile each fusion, up to two thirds of the
time that a contact model compiles, and many kernels for each product of matrices: half of a
humanoid's 57 s after that. On the CPU LLVM's full effort takes up to almost three times as long (a
quadrotor's 103 s, not 37). Solves are as fast without."""


GRAPH: dict[str, str | bool] = {
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,"
    "DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE"
}
"""For a GPU's program that a host waits for in a loop: XLA makes CUDA graphs of loops and branches,
too, so the host launches one of them, and not hundreds of kernels."""

QUICKLY: dict[str, str | bool] = {"xla_backend_optimization_level": "0"}
"""For a CPU's program that runs once: it compiles faster, and runs slower."""

_config: Any = jax.config
"""Its attributes say what holds in a context, too; `values` only what was set for the process."""


def _collect_rarely() -> tuple[int, int, int]:
    before = gc.get_threshold()
    gc.set_threshold(100 * before[0], *before[1:])
    return before


rarely_collected = Meanwhile(_collect_rarely, lambda before: gc.set_threshold(*before))
"""Inside of this Python looks for garbage a hundred times less often.

While JAX traces, hardly any of its objects are garbage: to look for it took a fifth of the time
until a quadruped's first iteration."""


@rarely_collected()
def run_once(function: Callable[..., Any], *arguments: Any) -> Any:
    """function(*arguments), jitted, for a program that runs once: on the CPU if JAX has one."""
    try:
        device = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX was told to have none
        return jax.jit(function)(*arguments)
    with jax.default_device(device), kept.without_locations():
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
    if options is None or _known(options):
        return options
    return {name: value for name, value in options.items() if _known({name: value})} or None


def _known(options: dict[str, str | bool]) -> bool:
    """Whether the present compiler takes these options."""
    try:
        jax.jit(lambda x: x + 1, compiler_options=options)(0)
    except jax.errors.JaxRuntimeError:
        return False
    return True


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


@contextmanager
def while_compiling(*works: Callable[[], object]) -> Iterator[None]:
    """Do works in threads of their own, while XLA compiles the `compiled` that is called inside.

    On GPUs they wait until that is traced, or has come to an end without: JAX traces in Python,
    which does one thing at a time, and the longer program would begin to compile later. On two CPU
    cores it would compile more slowly beside them, so there they begin at once.
    """
    begun: list[Future[object]] = []
    with ThreadPoolExecutor(max(1, len(works))) as pool:

        def begin() -> None:
            if not begun:
                begun.extend(map(pool.submit, works))

        before = _waiting.set(begin)
        try:
            if not on_gpu():
                begin()
            yield
        finally:
            _waiting.reset(before)
        begin()
        for work in begun:
            work.result()


_waiting: ContextVar[Callable[[], None] | None] = ContextVar("waiting", default=None)
"""Begins what waits until a program is traced. Threads have none."""


class compiled:
    """`jax.jit` with options for the compiler, for functions that no other jitted one calls.

    Nothing is looked up before the first call: asking for the backend is what starts it, and
    `jax.distributed.initialize` has to come first. With `graph` see `GRAPH`.

    With a `key` the programs are kept on disk (see `kept`), and found there without tracing: for
    the function's arguments, it gives a text that says what the function computes of numbers in
    their place, the same in every process; None if that is not known. Then, and where arguments
    lie on other devices than the first, JAX traces the function as ever.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        graph: bool = False,
        key: Callable[..., str | None] | None = None,
        **settings: Any,
    ) -> None:
        self._function, self._graph, self._settings = function, graph, settings
        self._key = key
        self._programs: dict[Any, Any] = {}
        self._last: dict[Any, Any] = {}
        self._mark: Any = jax.jit(lambda x: x) if key else None
        update_wrapper(self, function)

    @cached_property
    def traced(self) -> Any:
        """The function by `jax.jit`, whatever is kept: for several devices."""
        options = known_options(graph=True) if self._graph else known_options()
        return jax.jit(self._function, compiler_options=options, **self._settings)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """What the function returns."""
        plain = _config.jax_disable_jit or _config.jax_debug_nans or _config.jax_debug_infs
        # Nobody has measured whether a program from the disk still is a graph
        by_jax = self._key is None or plain or (self._graph and on_gpu())
        if by_jax or kept.folder() is None:
            return self._by_jax(*arguments, **named)
        if not self._mark._cache_size():  # so jax.clear_caches() has forgotten all programs
            self._programs.clear()
            self._last.clear()
            self._mark(0)
        every = self._signature.bind(*arguments, **named).arguments
        static = {name: every.pop(name) for name in self._static if name in every}
        now = tuple(static.items()), *(getattr(_config, name) for name in _CONTEXT)
        usual = self._last.get(now)
        if usual is not None:
            with suppress(TypeError, ValueError):  # raised before it runs, for other arguments
                return usual(**every)
        program = self._program(every, static, now)
        if program is None:
            return self._by_jax(*arguments, **named)
        self._last[now] = program
        return program(**every)

    def _by_jax(self, *arguments: Any, **named: Any) -> Any:
        """What the function returns, compiled and remembered by JAX."""
        begin = _waiting.get()
        if begin is not None:
            self.traced.trace(*arguments, **named)  # which JAX remembers
            begin()
        first = self.traced._cache_size() == 0
        with kept.without_locations() if first else nullcontext():
            return self.traced(*arguments, **named)

    def _program(self, every: dict[str, Any], static: dict[str, Any], now: Any) -> Any | None:
        """The program for these arguments in this context; None if JAX is to trace the function."""
        leaves, tree = jax.tree.flatten(every)
        kinds = _kinds(leaves)
        if kinds is None:
            return None
        known = tree, kinds, now
        if known not in self._programs:
            self._programs[known] = self._found(every, static, kinds)
        return self._programs[known]

    def _found(self, every: dict[str, Any], static: dict[str, Any], kinds: Any) -> Any | None:
        """The program for these arguments from the disk, or compiled and kept there."""
        assert self._key is not None
        key = self._key(**every, **static)
        if key is None:
            return None
        here = self._function.__module__, self._function.__qualname__, self._graph
        key = repr((here, known_options(self._graph), static, kinds, key))
        try:
            program = kept.find(key, ((), every))
        except kept.CannotBeKept:
            return None
        if program is None:
            with kept.without_locations():
                lowered = self.traced.lower(**every, **static)
            if (begin := _waiting.get()) is not None:
                begin()
            with kept.unknown_to_jax():
                program = lowered.compile()
            kept.keep(key, program)
        return program

    @cached_property
    def _signature(self) -> Signature:
        return signature(self._function)

    @property
    def _static(self) -> tuple[str, ...]:
        names = self._settings.get("static_argnames", ())
        return (names,) if isinstance(names, str) else tuple(names)

    def lower(self, *arguments: Any, **named: Any) -> Any:
        """`jax.jit(...).lower`."""
        return self.traced.lower(*arguments, **named)

    def identity(self, *arguments: Any, **named: Any) -> str:
        """A text that says what the function computes of such arguments, by its key if that knows.

        The text of a traced program may differ in a process that has traced others before.
        """
        every = self._signature.bind(*arguments, **named).arguments
        known = self._key(**every) if self._key is not None else None
        return str(self.lower(*arguments, **named).as_text()) if known is None else known

    def _cache_size(self) -> int:
        return int(self.traced._cache_size()) + sum(p is not None for p in self._programs.values())


_CONTEXT = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
)
"""Settings of JAX that a context may change, and that make another program."""


def _kinds(leaves: list[Any]) -> tuple[Any, ...] | None:
    """Shapes and types of arguments; None if one of them is not on the first device."""
    here = {jax.local_devices()[0]}
    kinds: list[Any] = []
    if _config.jax_default_device not in (None, *here):
        return None
    for leaf in leaves:
        if isinstance(leaf, jax.Array):
            if isinstance(leaf, jax.core.Tracer) or leaf.devices() != here:
                return None
            kinds.append(leaf.aval)
        else:
            kinds.append((type(leaf), getattr(leaf, "shape", None), getattr(leaf, "dtype", None)))
    return tuple(kinds)

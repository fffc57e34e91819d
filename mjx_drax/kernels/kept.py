"""Compiled programs on disk that a second process finds without tracing them.

JAX's own cache is looked up by a digest of the traced program; for a robot, to trace takes most of
a second start. Here the key is a text that says what a program computes, whatever else it is made
of: who asks for one gives it, and everything that surrounds a program is added (`surroundings`).
"""

from __future__ import annotations

import os
import pickle
import platform
import time
from contextlib import suppress
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache

from mjx_drax.base.digests import DIGEST, code, code_files, digest, versions
from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import complete
from mjx_drax.base.meanwhile import Meanwhile

ENABLED, FOLDER = "jax_enable_compilation_cache", "jax_compilation_cache_dir"
"""JAX's settings of its own cache, which also say whether programs are kept here, and where."""

LOCATIONS = "jax_traceback_in_locations_limit"
"""JAX's setting of how many lines of code a program tells of each of its operations."""

_LOADED = time.time()


class CannotBeKept(Exception):
    """JAX cannot write a program, but may find it in its own cache once it is traced."""


def folder() -> Path | None:
    """Where programs are kept, below the folder of JAX's cache; None if it has none on a disk.

    Also while another thread has something `unknown_to_jax`.
    """
    known = jax.config.values
    enabled = known[ENABLED] or unknown_to_jax.lasts
    if not (enabled and known[FOLDER]) or "://" in known[FOLDER]:
        return None
    return Path(known[FOLDER]) / "programs"


def recall(key: str) -> Any | None:
    """What `remember` has written under the key on a machine like this one; None if nothing."""
    where = _place(key)
    try:
        return where and pickle.loads(where.read_bytes())
    except Exception:  # there is none, or not a whole one
        return None


def remember(key: str, value: Any) -> None:
    """Write a value that follows from its key and `surroundings` alone, if it can be written."""
    where = _place(key)
    if where is None:
        return
    try:
        content = pickle.dumps(value)
        with complete(where) as path:
            path.write_bytes(content)
    except (DraxError, pickle.PicklingError, AttributeError, TypeError):
        return  # no place, or a value of local classes


def find(key: str, arguments: Any) -> Any | None:
    """The program that was kept under the key, a `jax.stages.Compiled`; None if there is none.

    Args:
        key: what the program computes.
        arguments: a tree with the structure of (), and the named arguments of a call.

    Raises:
        CannotBeKept: it was tried, and JAX could not write this program.
    """
    found = recall(key)
    if found is None:
        return None
    result, content = found
    if content is None:
        raise CannotBeKept
    trees = jax.tree.structure(arguments), jax.tree.structure(result)
    _register_lapack()
    try:
        return serialize_executable.deserialize_and_load(
            content, *trees, execution_devices=[jax.local_devices()[0]]
        )
    except Exception:  # of another machine after all: it is compiled again
        return None


@lru_cache
def _register_lapack() -> None:
    """Let XLA find the functions of LAPACK: JAX names them to it as it lowers one of them.

    A program that is loaded and calls one that XLA does not know ends the process.
    """
    if jax.default_backend() == "cpu":
        jax.jit(jnp.linalg.eigh).lower(jnp.eye(2))


def keep(key: str, program: Any) -> None:
    """Write a program that was compiled `unknown_to_jax`, or that it cannot be written."""
    try:
        content, _, tree = serialize_executable.serialize(program)
        result = jax.tree.unflatten(tree, range(tree.num_leaves))
        pickle.dumps(result)
    except Exception:  # JAX has several, as for callbacks into this process
        result = content = None
    remember(key, (result, content))


def _use_cache(used: bool) -> None:
    jax.config.update(ENABLED, used)
    compilation_cache.reset_cache()  # it asks once whether it is used


unknown_to_jax = Meanwhile(lambda: _use_cache(False), lambda _: _use_cache(True))
"""Inside of this what is compiled is not kept twice, and is compiled anew.

On CPUs an executable from JAX's cache does not hold all that another process needs of it. Threads
that compile meanwhile do without that cache, too."""


def _leave_out_locations() -> Any:
    before = jax.config.values[LOCATIONS]
    jax.config.update(LOCATIONS, 0)
    return before


without_locations = Meanwhile(_leave_out_locations, partial(jax.config.update, LOCATIONS))
"""Programs that are lowered inside of this do not tell which lines of code they come from.

XLA reads that anew with each program that it loads, which takes longer than the rest."""


def _place(key: str) -> Path | None:
    """The file of a program; None if nothing is kept."""
    below = folder()
    if below is None or _machine() is None:
        return None
    return below / digest(key + surroundings()).removeprefix(DIGEST)


def surroundings() -> str:
    """What the same program depends on besides: versions, machine, settings of JAX and XLA."""
    changed = ENABLED, FOLDER, LOCATIONS  # also by other threads, meanwhile
    settings = {k: v for k, v in jax.config.values.items() if k not in changed}
    wide = jnp.result_type(float)  # a context may have changed what the settings say
    return repr((_machine(), str(wide), os.environ.get("XLA_FLAGS"), sorted(settings.items())))


@lru_cache
def _machine() -> tuple[Any, ...] | None:
    """Versions, this package's own code, and the processor that programs are compiled for.

    None if the code was edited after it was loaded: its digest is not that of what runs.
    """
    if max(max(stat.st_mtime, stat.st_ctime) for stat in map(Path.stat, code_files())) > _LOADED:
        return None
    device = jax.local_devices()[0]
    processor: list[Any] = [platform.machine(), platform.processor(), os.cpu_count()]
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor += sorted({line for line in lines if line.startswith(("flags", "Features"))})
    return (
        sorted(versions().items()),
        version("jaxlib"),
        code(),
        (device.platform, device.device_kind, device.client.platform_version),
        processor,
    )

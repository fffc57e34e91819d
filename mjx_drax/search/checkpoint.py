"""How far a solve is, in a file that it goes on from after it was killed.

The file is written every `EVERY` seconds of a solve and at its end, each time at once or not at
all. A solve that finds it goes on from there, and its answer is bit for bit that of a solve which
was left alone: the file holds all that the rest of a solve depends on, and belongs to one question:

    chains, seed, settings, versions, kind of device
    every number of the problem, and the C engine's model       by digest
    the initial knots, whether drawn or given                   by digest
    the program that JAX makes of all functions                 by digest of its StableHLO text

Functions have no names that another process could compare, but the text of what they are traced to
has no addresses in it and all constants that they refer to, and is the same in every process. The
solve compiles what was lowered for it, so it costs no more than to print it. Goals are left out:
they judge replays, which are made anew. They also choose which chains go on, so a file of another
goal's solve may hold none that reach this one.

Files are .npz, of numbers only: reading one runs no code.
"""

from __future__ import annotations

import json
import os
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.digests import DIGEST, code, digest, plain_array, versions
from mjx_drax.base.errors import DraxError, DraxWarning
from mjx_drax.base.files import complete, file_path
from mjx_drax.base.files import require_room as require_room_for
from mjx_drax.problem.problem import Problem

EVERY = 30.0
"""Seconds of a solve between two checkpoints."""

SHARE = 0.05
"""Largest share of a solve's time that writing them may take; beyond, fewer are written."""

FORMAT = 8
"""Changes whenever files that were written before can no longer be read."""

HEADERS = 1_000_000
"""Bytes that a file may have beside its arrays."""


class Checkpoint:
    """A file that a solve writes, and goes on from if it is there.

    Attributes:
        path: of the file.
        question: what the file belongs to, by names; `require` adds to it.
        found: the arrays in the file, by name; None if there was no file.

    Raises:
        DraxError: the file cannot be read, is damaged or is something else; there are several
            processes.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        if jax.process_count() > 1:
            raise DraxError(
                f"checkpoint is {str(path)!r}, and {jax.process_count()} processes cannot go on "
                "from one file: leave it out, or solve in one process."
            )
        self.path = file_path(path)
        self.question: dict[str, Any] = {"format": FORMAT}
        self.found, self._asked = read(self.path)
        self._due, self._warned = time.monotonic() + EVERY, False

    def answered(self, name: str) -> Any:
        """What the file's question says under a name; None if there is no file."""
        return self._asked.get(name)

    def require(self, facts: dict[str, Any]) -> None:
        """Add to the question.

        Raises:
            DraxError: the file was written for another one; the first fact that differs is named.
        """
        self.question |= facts
        if self.found is None:
            return
        for name, value in facts.items():
            before = self._asked.get(name)
            if before == value:
                continue
            what = f"other {name} than this solve has"
            if not str(value).startswith(DIGEST) and before is not None:
                what = f"{name} {before}, and this solve has {name} {value}"
            raise DraxError(
                f"{str(self.path)!r} was written for {what}: choose another file, or delete it."
            )

    def require_room(self, size: int) -> None:
        """Complain now if arrays of `size` bytes could not be written, twice for a moment."""
        size += HEADERS
        require_room_for(self.path, size if self.path.exists() else 2 * size)

    def restored(self, like: Any) -> Any:
        """A tree of the structure and types of `like`, with what `save` was given."""
        found = self.found or {}

        def restore(path: Any, leaf: Any) -> Any:
            value = found[_name(path)]
            if not isinstance(leaf, jax.Array):
                return value if isinstance(leaf, np.ndarray) else value.item()
            if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                return jax.random.wrap_key_data(jnp.asarray(value), impl=jax.random.key_impl(leaf))
            return jnp.asarray(value)

        return jax.tree_util.tree_map_with_path(restore, like)

    def save(self, tree: Callable[[], Any], now: bool = False) -> None:
        """Write the tree that `tree()` gives if it is time to, or `now`.

        A checkpoint that cannot be written does not end a solve: it warns once, and goes on.
        """
        clock = time.monotonic()
        if not now and clock < self._due:
            return
        leaves = jax.tree_util.tree_leaves_with_path(tree())
        arrays = {_name(path): plain_array(leaf) for path, leaf in leaves}
        try:
            with complete(self.path) as partial, open(partial, "wb") as file:
                np.savez(file, question=json.dumps(self.question), **arrays)  # type: ignore[arg-type]
        except DraxError as error:
            if not self._warned:
                warnings.warn(f"the solve goes on without checkpoints: {error}", DraxWarning, 3)
            self._warned = True
        after = time.monotonic()
        self._due = after + max(EVERY, (after - clock) / SHARE)


def facts(problem: Problem, chains: int, seed: int, settings: Any) -> dict[str, Any]:
    """What is known of a question before anything is compiled, by names.

    Args:
        problem: its leaves may have a leading axis of problems.
        chains: for each problem.
        seed: of all random numbers.
        settings: as plain data.
    """
    leaves = jax.tree_util.tree_leaves_with_path(problem)
    model = problem.dynamics.fingerprint()
    return {
        "chains": int(chains),
        "seed": int(seed),
        **_flat("settings", settings),
        **_flat("version", versions()),
        "code of mjx_drax": code(),
        "device": jax.devices()[0].device_kind,
        "horizon": problem.horizon,
        **{f"numbers in problem.{_name(path)}": digest(leaf) for path, leaf in leaves},
        **({"numbers in the MuJoCo model": digest(model)} if model else {}),
    }


def _name(path: Any) -> str:
    """The names on the way to a leaf, as in `at.state.damping`."""
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _flat(label: str, data: Any) -> dict[str, Any]:
    """Nested dictionaries as one, by paths."""
    if not isinstance(data, dict):
        return {label: data}
    return {
        k: v for name, inner in data.items() for k, v in _flat(f"{label}.{name}", inner).items()
    }


def read(path: Path) -> tuple[dict[str, np.ndarray] | None, dict[str, Any]]:
    """The arrays of a file and the question that it belongs to; None and {} without a file."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as content:
            arrays = dict(content)
        question = json.loads(str(arrays.pop("question")))
        written = question["format"]
    except FileNotFoundError:
        return None, {}
    except OSError as error:
        raise DraxError(
            f"cannot read {str(path)!r}: {error.strerror or error}. Choose another checkpoint."
        ) from error
    except Exception as error:  # numpy, zipfile and zlib have no exception in common
        raise DraxError(
            f"{str(path)!r} is damaged, or no checkpoint: {error or type(error).__name__}. Choose "
            "another file, or delete it."
        ) from error
    if written != FORMAT:
        raise DraxError(
            f"{str(path)!r} is a checkpoint of format {written}, and this version of mjx_drax "
            f"reads format {FORMAT}: choose another file, or delete it."
        )
    return arrays, question

"""Digests of numbers, texts and bytes, and the versions of what computes an answer."""

from __future__ import annotations

import hashlib
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_drax.base.version import __version__

DIGEST = "sha256:"


def digest(tree: Any) -> str:
    """Of bytes, of a text, or of all numbers in a tree with their shapes and types."""
    if isinstance(tree, bytes | str):
        content = tree if isinstance(tree, bytes) else tree.encode()
        return DIGEST + hashlib.sha256(content).hexdigest()
    whole = hashlib.sha256()
    for leaf in map(plain_array, jax.tree.leaves(tree)):
        whole.update(f"{leaf.dtype} {leaf.shape}".encode())
        whole.update(leaf.tobytes())
    return DIGEST + whole.hexdigest()


def plain_array(leaf: Any) -> np.ndarray:
    """A leaf as an array of numpy's, random keys as their numbers."""
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)


def code_files() -> list[Path]:
    """Of this package, in Python and in CUDA."""
    package = Path(__file__).parents[1]
    return sorted([*package.rglob("*.py"), *package.rglob("*.cu*")])


def code() -> str:
    """Of this package's own code."""
    return digest(b"".join(file.read_bytes() for file in code_files()))


def versions() -> dict[str, str]:
    """Of what computes an answer."""
    return {
        "python": sys.version.split()[0],
        "mjx-drax": __version__,
        **{name: version(name) for name in ("jax", "mujoco", "mujoco-mjx", "numpy")},
    }

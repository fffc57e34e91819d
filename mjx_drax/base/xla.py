"""A flag that XLA needs to be right on CPUs."""

from __future__ import annotations

import os
import sys
import warnings
from importlib.metadata import PackageNotFoundError, version

from mjx_drax.base.errors import DraxWarning

FLAG = "--xla_cpu_experimental_ynn_fusion_type"
"""Which operations XLA leaves to the library YNNPACK; none, if nothing follows the = sign."""

WRONG_FROM, RIGHT_FROM = (0, 10, 2), (0, 11, 2)
"""Versions of jaxlib. The first gives wrong sums without a word, in the Jacobian of a vector of
squares for example, as soon as there are some hundred numbers (jax-ml/jax issue 39103)."""


def avoid_wrong_sums() -> None:
    """Set the flag where it is needed, unless it is set: XLA reads it when it first computes.

    Warns if it has computed already, on a CPU.
    """
    given = os.environ.get("XLA_FLAGS", "")
    if FLAG in given or not WRONG_FROM <= _jaxlib() < RIGHT_FROM:
        return
    os.environ["XLA_FLAGS"] = f"{given} {FLAG}=".strip()
    bridge, jax = sys.modules.get("jax._src.xla_bridge"), sys.modules.get("jax")
    started = getattr(bridge, "backends_are_initialized", lambda: False)
    if jax is not None and started() and jax.default_backend() == "cpu":
        warnings.warn(
            "JAX computed before mjx_drax was imported, and this version gets some sums wrong on "
            f"CPUs: import mjx_drax first, or start Python with XLA_FLAGS={FLAG}=",
            DraxWarning,
            stacklevel=4,
        )


def _jaxlib() -> tuple[int, ...]:
    """The version of jaxlib; () where there is none, or it has another form."""
    try:
        return tuple(int(part) for part in version("jaxlib").split(".")[:3])
    except (PackageNotFoundError, ValueError):
        return ()

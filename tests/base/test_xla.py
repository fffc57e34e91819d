"""XLA's sums on CPUs are right: importing the package sets the flag that they need."""

import os
import subprocess
import sys

import pytest

from mjx_drax.base import xla

JACOBIAN = """
import jax, jax.numpy as jnp, numpy as np
I, J = np.triu_indices(8, 1)
X = np.random.default_rng(0).normal(size=(40, 16)).astype(np.float32)

def squares(x):
    q = x.reshape(8, 2)
    return jnp.sum((q[I] - q[J]) ** 2, axis=1)

found = jax.jit(jax.vmap(jax.jacfwd(squares)))(X).reshape(40, 28, 8, 2)
q, rows = X.reshape(40, 8, 2), np.arange(28)
right = np.zeros_like(found)
right[:, rows, I] = 2 * (q[:, I] - q[:, J])
right[:, rows, J] = -right[:, rows, I]
print(np.abs(found - right).max() < 1e-5)
"""


def said(program):
    """What a program says in a process of its own, compiled as users do."""
    unset = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    own = {name: value for name, value in os.environ.items() if name not in unset}
    done = subprocess.run(
        [sys.executable, "-c", program], env=own, capture_output=True, text=True, check=True
    )
    return done.stdout.split(), done.stderr


@pytest.mark.slow
def test_jacobians_of_sums_are_right_on_cpus_and_a_late_import_warns():
    right, warning = said("import mjx_drax\n" + JACOBIAN)
    assert right == ["True"]
    assert not warning
    _, warning = said(JACOBIAN + "import mjx_drax\n")
    assert "import mjx_drax first, or start Python with XLA_FLAGS=--xla_cpu" in warning


@pytest.mark.parametrize(
    ("installed", "flags", "then"),
    [
        ("0.10.2", None, f"{xla.FLAG}="),
        ("0.11.0", "--xla_a=1", f"--xla_a=1 {xla.FLAG}="),
        ("0.10.2", f"{xla.FLAG}=dot", f"{xla.FLAG}=dot"),
        ("0.10.1", None, None),
        ("0.11.2", None, None),
        ("0.12.0.dev3", None, None),
    ],
)
def test_the_flag_is_set_for_versions_that_need_it_and_know_it(monkeypatch, installed, flags, then):
    monkeypatch.setattr(xla, "version", lambda name: installed)
    monkeypatch.setattr(xla.sys, "modules", {})
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if flags is not None:
        monkeypatch.setenv("XLA_FLAGS", flags)
    xla.avoid_wrong_sums()
    assert os.environ.get("XLA_FLAGS") == then

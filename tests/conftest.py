"""Set-up of all tests: CPU by default, figures without a display, compilations kept on disk.

Environment variables, so that the programs which the tests start have the same settings.
"""

import gc
import importlib.util
import os
import sys
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")

_caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_caches / "mjx_drax" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

# Most of the default tests' time goes into compilation, which takes half as long without LLVM's
# optimizations and XLA's fusion emitters. The slow tests compute more than they compile, and are
# compiled as users do. Worker processes do not see the arguments, but what is decided here.
_slow = any("slow" in word and "not slow" not in word for word in sys.argv)
_quick = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "0" if _slow else "1") == "1"
if _quick and version("jaxlib").startswith("0.10."):  # later ones end at a flag they do not know
    _flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{_flags} --xla_cpu_use_fusion_emitters=false".strip()

gc.set_threshold(100_000, 20, 100)  # a twentieth of the time went into looking for garbage

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

from mjx_drax.kernels import kept  # noqa: E402

# Again as configuration, in case a plugin of pytest imported jax before the lines above.
for _option, _value in {
    "jax_compilation_cache_dir": os.environ["JAX_COMPILATION_CACHE_DIR"],
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": 0,
    "jax_disable_most_optimizations": _quick,
}.items():
    jax.config.update(_option, _value)


MAPS = Path("/proc/self/maps")
"""Of this process, a line each; Linux allows 65,530, and every compiled program takes some."""


@pytest.fixture(autouse=True, scope="session")
def nothing_kept():
    """Keep no programs: to write them pays off in a second process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kept, "folder", lambda: None)
        yield


@pytest.fixture
def keeps_programs(monkeypatch, tmp_path):
    """Keep programs, in a folder of this test."""
    monkeypatch.setattr(kept, "folder", lambda: tmp_path / "programs")
    return tmp_path / "programs"


@pytest.fixture(autouse=True, scope="module")
def few_programs():
    """Forget compiled programs before there are too many, which ends a process in compilers."""
    yield
    forget_programs()


@pytest.fixture(autouse=True)
def few_programs_of_slow_tests(request):
    """The same after each of these, which compile many."""
    yield
    if request.node.get_closest_marker("slow"):
        forget_programs()


def forget_programs():
    """Unless there are few."""
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > 40_000:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(autouse=True, scope="module")
def models_are_trusted(request):
    """`from_mjcf` compiles a step to compare it with the C engine's: here only in `physics`."""
    if "physics" in request.path.parts:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        _trust_models(patch)
        yield


@pytest.fixture
def trusted(monkeypatch):
    """The same for a test in `physics` that asks something else of its model."""
    _trust_models(monkeypatch)


def _trust_models(patch):
    from mjx_drax.physics.agreement.checks import Findings, StepErrors

    def nothing(*_):
        return Findings(StepErrors(np.zeros(1)), (), None)

    patch.setattr("mjx_drax.physics.mjcf.examine", nothing)


SLIDER = """
<mujoco model="slider">
  <compiler meshdir="meshes"/>
  <option timestep="0.01" integrator="Euler"><flag contact="disable"/></option>
  <asset>
    <mesh name="wedge" file="wedge.obj"/>
    <hfield name="hill" nrow="2" ncol="3" size="1 1 0.5 0.1" elevation="0 1 0  0 0.5 0"/>
    <texture name="checks" type="2d" builtin="checker" rgb1="1 0 0" width="8" height="8"/>
    <material name="checks" texture="checks"/>
  </asset>
  <worldbody>
    <geom type="plane" size="2 2 0.1" pos="0 0 -0.5"/>
    <geom type="hfield" hfield="hill" pos="0 3 -0.5"/>
    <body name="cart"><joint name="slide" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <geom type="box" size="0.2 0.1 0.05" mass="1" rgba="0 0.5 0.5 1"/>
      <geom type="cylinder" size="0.05 0.1" pos="0.2 0 0" mass="0.1" material="checks"/>
      <geom type="ellipsoid" size="0.05 0.1 0.15" pos="-0.2 0 0.1" mass="0.1"/>
      <geom type="mesh" mesh="wedge" pos="0 0 0.1" mass="0.1"/>
      <geom type="capsule" size="0.02 0.1" pos="0 0.2 0" mass="0.1"/>
      <geom type="sphere" size="0.05" pos="0 -0.2 0" mass="0.1"/>
      <geom type="sphere" size="0.5" mass="0.1" rgba="1 1 1 0"/>
      <site name="tip" pos="0 0 0.3" size="0.02"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="slide" gear="10" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator>
  <keyframe><key name="home" qpos="0.05"/></keyframe>
</mujoco>
"""

WEDGE = """
v 0 0 0
v 0.1 0 0
v 0 0.1 0
v 0 0 0.1
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
"""


@pytest.fixture(scope="session")
def slider(tmp_path_factory):
    """A solution from an MJCF file with all kinds of geoms: a cart comes to rest at 0.2."""
    from mjx_drax import Langevin, from_mjcf, solve

    folder = tmp_path_factory.mktemp("slider")
    (folder / "meshes").mkdir()
    (folder / "meshes" / "wedge.obj").write_text(WEDGE)
    (folder / "slider.xml").write_text(SLIDER)
    problem = from_mjcf(
        folder / "slider.xml",
        horizon=0.5,
        terminal_residual=_at_rest,
        running_residual=lambda data, u: 0.1 * u,
        goal=lambda data: abs(data.qpos[0] - 0.2) < 0.01 and abs(data.qvel[0]) < 0.1,
    )
    return solve(problem, chains=4, solver=Langevin(iterations=30, tail=20))


def _at_rest(data):
    return jnp.concatenate([20.0 * (data.qpos - 0.2), 5.0 * data.qvel])


@pytest.fixture
def without(monkeypatch):
    """without(package): as if it were not installed."""

    def hide(package):
        find = importlib.util.find_spec

        def found(name, *rest):
            return None if name == package else find(name, *rest)

        monkeypatch.setattr(importlib.util, "find_spec", found)

    return hide


@pytest.fixture
def nothing_iterates(monkeypatch):
    """A solve that takes a step has not complained in time."""
    from mjx_drax import Langevin

    def far(*_, **__):
        pytest.fail("it got as far as iterating")

    monkeypatch.setattr(Langevin, "step", far)

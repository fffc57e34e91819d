"""Options reach the compiler, those it does not know are left out; what is kept on disk."""

import gc
import os
import subprocess
import sys
import time

import jax
import pytest

from mjx_drax.base.errors import DraxError
from mjx_drax.kernels import compilation, kept
from mjx_drax.kernels.compilation import compiled


@pytest.fixture(autouse=True)
def _asked_anew():
    hurry = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", False)
    compilation.known_options.cache_clear()
    yield
    jax.config.update("jax_disable_most_optimizations", hurry)
    compilation.known_options.cache_clear()


def doubled(x, times=1):
    return x * 2**times


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_the_compiler_gets_options_that_it_knows(monkeypatch, backend):
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    options = compilation.OPTIONS[backend]
    assert compilation.known_options() == options
    given, plain = [], jax.jit
    monkeypatch.setattr(jax, "jit", lambda f, **rest: given.append(rest) or plain(f, **rest))
    program = compiled(doubled, static_argnames="times")
    assert not given
    assert program(3.0, times=2) == 12.0
    settings = {"compiler_options": options, "static_argnames": "times"}
    assert given == [settings]


def test_a_program_that_is_waited_for_becomes_a_graph_on_gpus(monkeypatch):
    assert compilation.known_options(graph=True) == compilation.OPTIONS["cpu"]
    compilation.known_options.cache_clear()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    options = compilation.OPTIONS["gpu"] | compilation.GRAPH
    assert compilation.known_options(graph=True) == options
    given, plain = [], jax.jit
    monkeypatch.setattr(jax, "jit", lambda f, **rest: given.append(rest) or plain(f, **rest))
    assert compiled(doubled, graph=True)(3.0) == 6.0
    assert given == [{"compiler_options": options}]
    compilation.known_options.cache_clear()
    monkeypatch.setitem(compilation.GRAPH, "xla_gpu_enable_command_buffer", "NO_SUCH_COMMAND")
    assert compilation.known_options(graph=True) == compilation.OPTIONS["gpu"]


def test_an_option_that_is_not_known_leaves_the_others(monkeypatch):
    usual = dict(compilation.OPTIONS["cpu"])
    monkeypatch.setitem(compilation.OPTIONS["cpu"], "xla_no_such_option", True)
    assert compilation.known_options() == usual
    compilation.known_options.cache_clear()
    monkeypatch.setitem(compilation.OPTIONS, "cpu", {"xla_no_such_option": True})
    assert compilation.known_options() is None


def test_garbage_is_looked_for_less_often_for_a_while():
    usual = gc.get_threshold()
    seen = []

    @compilation.rarely_collected()
    def fails():
        seen.append(gc.get_threshold()[0])
        raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert seen == [100 * usual[0]]
    assert gc.get_threshold() == usual
    one, other = compilation.rarely_collected(), compilation.rarely_collected()
    one.__enter__()  # as two threads may
    other.__enter__()
    one.__exit__(None, None, None)
    assert gc.get_threshold()[0] == 100 * usual[0]
    other.__exit__(None, None, None)
    assert gc.get_threshold() == usual


def test_there_are_no_options_where_jax_is_told_to_hurry():
    jax.config.update("jax_disable_most_optimizations", True)
    assert compilation.known_options() is None


def test_an_option_that_the_compiler_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setitem(compilation.OPTIONS, "cpu", {"xla_gpu_no_such_option": False})
    assert compilation.known_options() is None
    assert compiled(doubled)(3.0) == 6.0


def test_it_is_compiled_once_and_can_be_lowered():
    def tripled(x):
        return 3.0 * x

    program = compiled(tripled)
    assert (program(1.0), program(2.0)) == (3.0, 6.0)
    assert program._cache_size() == 1
    assert "multiply" in program.lower(1.0).as_text()
    assert program.__name__ == "tripled"


def test_the_call_that_compiles_leaves_lines_of_code_out():
    told = []

    def doubled(x):
        told.append(jax.config.values[kept.LOCATIONS])
        return 2 * x

    before, used = jax.config.values[kept.LOCATIONS], compiled(doubled)
    assert [used(1.0), used(2.0)] == [2.0, 4.0]
    assert told == [0]
    assert jax.config.values[kept.LOCATIONS] == before != 0


KEEPING = """
import jax
import jax.numpy as jnp
from mjx_drax.kernels.compilation import keep_programs

jax.jit(lambda x: x + 1)(1.0)  # settles for JAX whether it has a cache
keep_programs()
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones(3))
"""


def files_kept(tmp_path, **settings):
    """How many files a program leaves in the folder of caches."""
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    env |= {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu", **settings}
    subprocess.run([sys.executable, "-c", KEEPING], env=env, check=True)
    folder = tmp_path / "mjx_drax" / "jax"
    return len(list(folder.iterdir())) if folder.is_dir() else 0


@pytest.mark.slow
@pytest.mark.parametrize("key", [None, "one"])
def test_what_compiles_beside_a_gpus_program_waits_until_it_is_traced(tmp_path, monkeypatch, key):
    order = []

    def traced_slowly(x):
        time.sleep(0.2)
        order.append("traced")
        return x + 1

    monkeypatch.setattr(kept, "folder", lambda: tmp_path)
    monkeypatch.setattr(compilation, "on_gpu", lambda: True)
    program = compiled(traced_slowly, key=lambda **arguments: key)
    with compilation.while_compiling(lambda: order.append("beside"), lambda: order.append("too")):
        assert program(x=1.0) == 2.0
        assert order[0] == "traced"
    assert sorted(order) == ["beside", "too", "traced"]


def test_what_waits_for_a_program_comes_after_it_where_none_is_compiled_and_fails_as_it_would(
    monkeypatch,
):
    order = []
    monkeypatch.setattr(compilation, "on_gpu", lambda: True)
    with compilation.while_compiling(lambda: order.append("beside")):
        order.append("inside")
    assert order == ["inside", "beside"]
    with pytest.raises(ZeroDivisionError), compilation.while_compiling(lambda: 1 / 0):
        pass
    with pytest.raises(KeyError), compilation.while_compiling(lambda: order.append("never")):
        raise KeyError
    assert "never" not in order


def test_programs_are_kept_on_disk_although_some_were_compiled_before(tmp_path):
    assert files_kept(tmp_path) > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "value"),
    [("JAX_ENABLE_COMPILATION_CACHE", "0"), ("JAX_COMPILATION_CACHE_DIR", "{}/other")],
)
def test_what_the_user_says_about_the_cache_of_jax_holds(tmp_path, setting, value):
    assert files_kept(tmp_path, **{setting: value.format(tmp_path)}) == 0


@pytest.mark.slow
def test_a_folder_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "mjx_drax").touch()
    assert files_kept(tmp_path) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "given", "level"),
    [("", None, "3"), ("", "0", "0"), ("", "1", "1"), ("import jax\n", None, "3")],
)
def test_the_log_of_xla_is_off_unless_the_user_turns_it_on(before, given, level):
    name = "TF_CPP_MIN_LOG_LEVEL"
    env = {k: v for k, v in os.environ.items() if k != name} | ({name: given} if given else {})
    code = f"{before}import mjx_drax, os; print(os.environ[{name!r}])"
    done = subprocess.run([sys.executable, "-c", code], env=env, check=True, stdout=subprocess.PIPE)
    assert done.stdout.decode().strip() == level


def test_memory_that_is_short_is_said_in_a_sentence():
    with (
        pytest.raises(DraxError, match=r"run one step \(.*\): try with fewer contacts"),
        compilation.said_plainly("one step", "with fewer contacts"),
    ):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 185 GB.")

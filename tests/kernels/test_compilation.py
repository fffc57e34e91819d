"""Options for the compiler reach it, and one that it does not know is left out."""

import jax
import pytest

from mjx_drax.kernels import compilation
from mjx_drax.kernels.compilation import compiled


@pytest.fixture(autouse=True)
def _asked_anew():
    compilation._options.cache_clear()
    yield
    compilation._options.cache_clear()


def doubled(x, times=1):
    return x * 2**times


def test_on_a_gpu_the_compiler_gets_options_that_it_knows(monkeypatch):
    assert compilation._options() is None  # the tests' backend is the CPU
    compilation._options.cache_clear()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compilation._options() == compilation.GPU_OPTIONS
    given, plain = [], jax.jit
    monkeypatch.setattr(jax, "jit", lambda f, **rest: given.append(rest) or plain(f, **rest))
    program = compiled(doubled, static_argnames="times")
    assert not given
    assert program(3.0, times=2) == 12.0
    settings = {"compiler_options": compilation.GPU_OPTIONS, "static_argnames": "times"}
    assert given == [settings]


def test_an_option_that_the_compiler_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(compilation, "GPU_OPTIONS", {"xla_gpu_no_such_option": False})
    assert compilation._options() is None
    assert compiled(doubled)(3.0) == 6.0


def test_it_is_compiled_once_and_can_be_lowered():
    program = compiled(doubled)
    assert (program(1.0), program(2.0)) == (2.0, 4.0)
    assert program._cache_size() == 1
    assert "multiply" in program.lower(1.0).as_text()
    assert program.__name__ == "doubled"

"""Programs on disk are found without tracing, and only where they compute what is asked for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_drax.base import digests
from mjx_drax.kernels import kept
from mjx_drax.kernels.compilation import compiled
from mjx_drax.kernels.kept import folder

pytestmark = pytest.mark.usefixtures("keeps_programs")


def program(key="a", fails=False, times=2.0):
    """What a process has of a program: the function itself, or one that may not be traced."""

    def scaled(tree, by, square=False):
        assert not fails, "traced"
        values = times * tree["x"] * by
        return {"y": values**2 if square else values}

    return compiled(scaled, key=lambda **arguments: key, static_argnames="square")


X = {"x": jnp.arange(3.0)}


def test_a_second_process_does_not_trace():
    first = program()(X, 3)
    again = program(fails=True)
    np.testing.assert_array_equal(again(X, 3)["y"], [0.0, 6.0, 12.0])
    np.testing.assert_array_equal(again(X, 4)["y"], [0.0, 8.0, 16.0])  # and the usual way
    assert first.keys() == again(X, 3).keys()
    assert again._cache_size() == 1


def test_programs_have_their_place_while_another_one_compiles(tmp_path):
    names = kept.ENABLED, kept.FOLDER
    before = [jax.config.values[name] for name in names]
    try:
        jax.config.update(kept.ENABLED, True)
        jax.config.update(kept.FOLDER, str(tmp_path))
        with kept.unknown_to_jax():
            assert folder() == tmp_path / "programs"
        jax.config.update(kept.ENABLED, False)
        assert folder() is None
    finally:
        for name, value in zip(names, before, strict=True):
            jax.config.update(name, value)


@pytest.mark.parametrize(
    ("arguments", "more"),
    [
        (({"x": jnp.arange(4.0)}, 3), {}),
        (({"x": jnp.arange(3)}, 3), {}),
        (({"x": jnp.arange(3.0), "z": 1.0}, 3), {}),
        ((X, 3.0), {}),
        ((X, np.float32(3)), {}),
        ((X, 3), {"square": True}),
    ],
    ids=["shape", "type", "structure", "weak type", "array", "static"],
)
def test_other_arguments_are_another_program(arguments, more):
    program()(X, 3)
    with pytest.raises(AssertionError, match="traced"):
        program(fails=True)(*arguments, **more)
    plain = jax.jit(program(), static_argnames="square")
    used = program()
    used(X, 3)
    for way in (used, used, plain):
        found = way(*arguments, **more)["y"]
        expected = 2.0 * arguments[0]["x"] * arguments[1]
        np.testing.assert_array_equal(found, expected**2 if more else expected)


def test_another_key_or_other_surroundings_are_another_program(monkeypatch):
    program()(X, 3)
    with pytest.raises(AssertionError, match="traced"):
        program("b", fails=True)(X, 3)
    monkeypatch.setattr(kept, "surroundings", lambda: "another machine")
    with pytest.raises(AssertionError, match="traced"):
        program(fails=True)(X, 3)


def test_precision_and_settings_surround_a_program():
    here = kept.surroundings()
    assert kept.surroundings() == here
    with jax.enable_x64(not jax.config.jax_enable_x64):
        assert kept.surroundings() != here
    before = jax.config.values["jax_default_matmul_precision"]
    jax.config.update("jax_default_matmul_precision", "highest")
    try:
        assert kept.surroundings() != here
    finally:
        jax.config.update("jax_default_matmul_precision", before)


def test_the_code_of_this_package_surrounds_a_program(monkeypatch, tmp_path):
    machine = kept._machine.__wrapped__
    here, code = machine(), tmp_path / "other.py"
    monkeypatch.setattr(digests, "__file__", str(tmp_path / "base" / "digests.py"))
    monkeypatch.setattr(kept, "_LOADED", np.inf)
    found = []
    for content in ("x = 1\n", "x = 2\n"):
        code.write_text(content)
        found.append(machine())
    assert len({repr(m) for m in (here, *found)}) == 3


def test_nothing_is_kept_of_code_that_was_edited_since_it_was_loaded(monkeypatch, keeps_programs):
    kept._machine.cache_clear()
    monkeypatch.setattr(kept, "_LOADED", 0.0)
    try:
        assert program()(X, 3)["y"][2] == 12.0
    finally:
        kept._machine.cache_clear()
    assert not keeps_programs.exists()


@pytest.mark.parametrize("content", [b"", b"\x80", None])
def test_a_broken_file_is_written_anew(keeps_programs, content):
    program()(X, 3)
    [file] = keeps_programs.iterdir()
    file.write_bytes(file.read_bytes()[:-50] if content is None else content)
    with pytest.raises(AssertionError, match="traced"):
        program(fails=True)(X, 3)
    program()(X, 3)
    np.testing.assert_array_equal(program(fails=True)(X, 3)["y"], [0.0, 6.0, 12.0])


def test_nothing_is_kept_of_what_is_not_known(keeps_programs):
    assert program(None)(X, 3)["y"][2] == 12.0
    assert not keeps_programs.exists()


def test_what_cannot_be_written_is_left_to_jax(monkeypatch):
    calls = []

    def with_callback(x):
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        return x + jax.pure_callback(lambda y: calls.append(0) or np.float32(1), shape, x)

    assert compiled(with_callback, key=lambda x: "c")(jnp.float32(1)) == 2.0
    monkeypatch.delattr(kept, "unknown_to_jax")  # which would compile it anew in each process
    assert compiled(with_callback, key=lambda x: "c")(jnp.float32(1)) == 2.0
    assert len(calls) == 2


def test_nothing_is_kept_where_nothing_can_be_written(keeps_programs):
    keeps_programs.write_text("a file in the folder's place")
    assert program()(X, 3)["y"][2] == 12.0


def test_inside_of_other_programs_and_without_jit_it_is_the_function(keeps_programs):
    inside = jax.jit(lambda x: program()(x, 3)["y"])
    np.testing.assert_array_equal(inside(X), [0.0, 6.0, 12.0])
    with jax.disable_jit():
        np.testing.assert_array_equal(program()(X, 3)["y"], [0.0, 6.0, 12.0])
    assert not keeps_programs.exists()


def test_values_are_remembered():
    assert kept.recall("a") is None
    kept.remember("a", {"b": (1, "c")})
    assert kept.recall("a") == {"b": (1, "c")}
    kept.remember("d", lambda: 0)  # which no other process could read
    assert kept.recall("d") is None


def test_jax_keeps_its_own_cache_for_all_else():
    before = jax.config.values[kept.ENABLED]
    with kept.unknown_to_jax():
        with kept.unknown_to_jax():
            assert not jax.config.values[kept.ENABLED]
        assert not jax.config.values[kept.ENABLED]
    assert jax.config.values[kept.ENABLED] == before


def test_kept_programs_do_not_tell_the_lines_of_their_code():
    used = program()
    used(X, 3)
    (known,) = used._programs.values()
    assert "multiply" in known.as_text()
    assert "stack_frame_id" not in known.as_text()
    with kept.unknown_to_jax():  # whose cache may have one without, from another process
        assert "stack_frame_id" in used.lower(X, 3).compile().as_text()


def test_lines_of_code_are_told_again_once_nobody_leaves_them_out():
    before, surroundings = jax.config.values[kept.LOCATIONS], kept.surroundings()
    with kept.without_locations():
        with kept.without_locations():
            assert jax.config.values[kept.LOCATIONS] == 0 != before
        assert jax.config.values[kept.LOCATIONS] == 0
        assert kept.surroundings() == surroundings
    assert jax.config.values[kept.LOCATIONS] == before


def test_settings_that_a_context_changes_are_other_programs():
    draw = compiled(
        jax.random.normal, key=lambda key, **rest: "d", static_argnames=("shape", "dtype")
    )
    key, before = jax.random.key(0), jax.config.jax_threefry_partitionable
    first = draw(key, shape=(3,))
    try:
        jax.config.update("jax_threefry_partitionable", not before)
        np.testing.assert_array_equal(draw(key, shape=(3,)), jax.random.normal(key, (3,)))
        assert (draw(key, shape=(3,)) != first).any()
    finally:
        jax.config.update("jax_threefry_partitionable", before)
    np.testing.assert_array_equal(draw(key, shape=(3,)), first)


def test_programs_are_forgotten_with_those_of_jax():
    used = program()
    used(X, 3)
    assert used._cache_size() == 1
    jax.clear_caches()
    used({"x": jnp.arange(4.0)}, 3)
    assert used._cache_size() == 1

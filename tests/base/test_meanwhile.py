"""Changes that last while anyone is inside."""

import pytest

from mjx_drax.base.meanwhile import Meanwhile


def test_the_first_changes_it_and_the_last_restores_what_was_before():
    now = ["usual"]

    def change():
        before, now[0] = now[0], f"not {now[0]}"
        return before

    def restore(before):
        now[0] = before

    other = Meanwhile(change, restore)
    first, second = other(), other()
    first.__enter__()
    second.__enter__()
    assert (now, other.lasts) == (["not usual"], True)
    first.__exit__(None, None, None)  # the one that came first goes first
    assert (now, other.lasts) == (["not usual"], True)
    second.__exit__(None, None, None)
    assert (now, other.lasts) == (["usual"], False)

    @other()
    def fails():
        assert now == ["not usual"]
        raise ZeroDivisionError

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            fails()
        assert (now, other.lasts) == (["usual"], False)

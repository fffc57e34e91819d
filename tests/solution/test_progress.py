"""Progress is shown where somebody watches, and as the switch says."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from builders import point

from mjx_drax import Restarts, solve
from mjx_drax.solution import progress
from mjx_drax.solution.progress import Bar, Lines, reporting, watched

INFO = SimpleNamespace(
    max_defect=np.array([1.0, 0.0, np.nan, 1e-5]), cost=np.array([1.0, 5.0, 2.0, 7.0])
)


def test_a_terminal_and_a_notebook_are_watched_a_pipe_is_not(monkeypatch):
    assert not watched()
    with monkeypatch.context() as patch:
        patch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
        assert watched()
    for shell, notebook in ((SimpleNamespace(kernel=1), True), (SimpleNamespace(), False)):
        ipython = SimpleNamespace(get_ipython=lambda shell=shell: shell)
        monkeypatch.setitem(sys.modules, "IPython", ipython)
        assert watched() is notebook
    monkeypatch.setattr(sys, "stderr", None)  # as of a program without a console
    monkeypatch.delitem(sys.modules, "IPython")
    assert not watched()


@pytest.mark.parametrize(("somebody", "kind"), [(True, Bar), (False, Lines)])
def test_by_default_there_is_a_bar_if_somebody_watches(monkeypatch, capsys, somebody, kind):
    monkeypatch.setattr(progress, "watched", lambda: somebody)
    for given, shown in ((None, kind), (True, Bar), (False, type(None))):
        with reporting(given, "arm") as report:
            assert type(report) is shown
    with reporting(print, "arm") as report:
        assert report is print


def test_the_bar_tells_compiling_then_the_best_feasible_cost(monkeypatch, capsys):
    monkeypatch.setattr(progress, "watched", lambda: True)
    before = threading.active_count()
    with Bar("arm") as bar:
        assert capsys.readouterr().err.strip().startswith("arm: compiling")
        assert threading.active_count() > before
        bar(20, 100, INFO)
        assert not bar._clock.is_alive()
        bar(40, 100, INFO)
    shown = capsys.readouterr().err
    assert "best cost 5, feasible 50%" in shown
    last = shown.strip().split("\r")[-1]  # whether the 40 were enough or interrupted
    assert last.startswith("arm:  40%")
    assert "40 of at most 100 [" in last
    assert "<" not in last  # nothing remains to wait for


def test_a_further_attempt_raises_the_bound(capsys):
    with Bar("arm") as bar:
        bar(100, 100, INFO)
        bar(120, 200, INFO)
    assert "120 of at most 200" in capsys.readouterr().err


def test_an_error_while_it_compiles_ends_the_bar_and_its_clock(monkeypatch, capsys):
    monkeypatch.setattr(progress, "watched", lambda: True)
    with pytest.raises(ZeroDivisionError), Bar("arm") as bar:
        raise ZeroDivisionError
    assert not bar._clock.is_alive()


def test_a_batch_counts_problems(capsys):
    with Bar("problems") as bar:
        bar(3, 9)
        bar(9, 9)
    assert "100%|██████████| 9/9 [" in capsys.readouterr().err


def test_a_log_gets_lines_while_it_compiles_and_with_the_best_cost_after(monkeypatch, capsys):
    clock = SimpleNamespace(monotonic=lambda: 0.0)
    monkeypatch.setattr(progress, "time", clock)
    monkeypatch.setattr(progress, "EVERY", 0.01)

    def told(line):
        for _ in range(1000):
            time.sleep(0.01)
            if line in capsys.readouterr().err.splitlines():
                return True
        return False

    with Lines("arm") as report:
        assert told("arm: compiling, first iterations [0:00]")
        report(10, 100, SimpleNamespace(max_defect=np.ones(4), cost=INFO.cost))
        assert told("arm: iteration 10 of at most 100, no feasible chain yet [0:00]")
        clock.monotonic = lambda: 75.9
        report(20, 100, INFO)
        assert told("arm: iteration 20 of at most 100, best cost 5, feasible 50% [1:15]")
        report(3, 9)
        assert told("arm: 3/9 [1:15]")
    capsys.readouterr()
    time.sleep(0.05)
    assert capsys.readouterr().err == ""  # ended


@pytest.mark.slow
def test_solve_shows_a_bar_if_asked_and_a_short_one_is_silent_in_a_pipe(capsys):
    once = Restarts(descent=5, attempts=1)
    solve(point(), chains=2, solver=once)
    assert capsys.readouterr() == ("", "")
    solve(point(), chains=2, solver=once, progress=True)
    out, err = capsys.readouterr()
    assert out == ""
    assert "point: compiling" in err
    assert "best cost" in err

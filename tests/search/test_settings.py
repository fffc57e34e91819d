"""Settings by name: what can be set, and what is refused."""

import json
import sys
import types
from dataclasses import dataclass, replace

import pytest

from mjx_drax import (
    Constant,
    DraxError,
    Geometric,
    Identity,
    Langevin,
    Polish,
    Restarts,
    Rollouts,
    Smoothed,
    register_dataclass,
)
from mjx_drax.search.settings import changed, from_data, names, to_data


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("attempts", "3", 3),
        ("descent", "None", None),
        ("within", "2", 2.0),
        ("done_share", "0.5", 0.5),
        ("heated", "False", False),
        ("rollouts", "Rollouts(rounds=4)", Rollouts(rounds=4)),
        ("polish", "Polish(tolerance=1e-6)", Polish(1e-6)),
        ("polish", "None", None),
        ("flow.iterations", "20", 20),
        ("flow.adjusted", "True", True),
        ("flow.noise", "0.5", Constant(0.5)),
        ("flow.noise", "Geometric(3, 0.1)", Geometric(3.0, 0.1)),
        ("flow.noise", "3, 0.1, 0", Geometric(3.0, 0.1, 0.0)),
        ("flow.noise.start", "7", 7.0),
        ("flow.preconditioner", "Identity", Identity()),
        ("flow.preconditioner.derivatives", "Smoothed()", Smoothed()),
    ],
)
def test_one_setting_changes_and_no_other(name, text, value):
    new = changed(Restarts(), name, text)
    seen, old = new, Restarts()
    for part in name.split("."):
        seen, old = getattr(seen, part), getattr(old, part)
    assert (seen, type(seen)) == (value, type(value))
    here, before = ({n: repr(n) for n in names(s)} for s in (new, Restarts()))
    assert set(before) - set(here) <= {n for n in before if n.startswith(f"{name}.")}
    back = new
    if "." in name and name.count(".") == 1:
        back = replace(new, flow=replace(new.flow, **{name.split(".")[1]: old}))
        assert back == Restarts()


def test_an_end_that_was_final_stays_so():
    assert changed(Restarts(), "flow.noise.end", "0.1").flow.noise == Geometric(6.0, 0.1)
    assert changed(Restarts(), "flow.damping.end", "0.2").flow.damping.final == 0.03
    assert changed(Langevin(), "noise.end", "0.1").noise.final == 0.1


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        (
            "attempt",
            "3",
            r"there is no setting 'attempt': choose one of flow.iterations, .*attempts",
        ),
        ("flow", "3", "there is no setting 'flow'"),
        ("polish.iterations", "300", r"polish is None: give .* polish=Polish\(iterations=300\)"),
        ("attempts", "2.5", "attempts is '2.5': give a whole number; it was 5"),
        ("attempts", "True", "give a whole number"),
        ("attempts", "many", "give a whole number"),
        ("within", "nan", "give a number"),
        ("descent", "x", "give a whole number or None"),
        ("flow.adjusted", "1", "give True or False"),
        ("heated", "1", "give True or False or None"),
        ("done_share", "most", "give a number or None"),
        ("rollouts", "Identity", "rollouts is 'Identity': give one of Rollouts, or MODULE"),
        ("polish", "1e-6", "polish is '1e-6': give one of Polish, or MODULE"),
        ("flow.noise", "hot", r"give a number, Geometric\(start, end\)"),
        ("flow.noise.start", "hot", "give a number"),
        (
            "flow.preconditioner",
            "Newton",
            "give one of BFGS, Diagonal, GaussNewton, Identity, LBFGS",
        ),
    ],
)
def test_what_is_refused(name, text, words):
    with pytest.raises(DraxError, match=words):
        changed(Restarts(), name, text)


@pytest.mark.parametrize(
    "solver",
    [Restarts(polish=Polish(1e-6, 50)), Langevin(preconditioner=Identity(), noise=Constant(0.2))],
)
def test_there_and_back(solver):
    assert from_data(json.loads(json.dumps(to_data(solver)))) == solver


def test_what_is_no_dataclass_is_kept_as_text():
    data = to_data(Langevin(noise=len))
    assert data["noise"] == {"text": repr(len)}
    with pytest.raises(DraxError, match="settings hold <built-in function len>, which was no data"):
        from_data(data)


@register_dataclass
@dataclass(frozen=True)
class Step:
    """A schedule of a user's own."""

    height: float = 1.0

    def __call__(self, t):
        """The height until t = 1, then 0."""
        return self.height * (t < 1.0)


def test_classes_of_users_take_part(monkeypatch):
    here = types.ModuleType("users_own")
    here.Step = Step
    monkeypatch.setitem(sys.modules, "users_own", here)
    monkeypatch.setattr(Step, "__module__", "users_own")
    solver = changed(Restarts(), "flow.noise", "users_own:Step(height=2.0)")
    assert solver == replace(Restarts(), flow=replace(Restarts().flow, noise=Step(2.0)))
    assert changed(solver, "flow.noise.height", "3").flow.noise == Step(3.0)
    data = json.loads(json.dumps(to_data(solver)))
    assert data["flow"]["noise"] == {"part": "users_own:Step", "height": 2.0}
    assert from_data(data) == solver
    monkeypatch.delitem(sys.modules, "users_own")
    with pytest.raises(DraxError, match="import users_own before you load them"):
        from_data(data)
    with pytest.raises(DraxError, match=r"'users_own:Step' cannot be imported: .*No module named"):
        changed(Restarts(), "flow.noise", "users_own:Step()")

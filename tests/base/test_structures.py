"""Texts of structures are the same in every process, and refuse what has no lasting text."""

import os
import subprocess
import sys
from dataclasses import dataclass, field
from enum import Enum

import jax
import numpy as np
import pytest
from jax.tree_util import Partial

from mjx_drax.base import structures
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.base.structures import Unspelled, spelled
from mjx_drax.base.structures import _of_class as spelled_class
from mjx_drax.problem.trajectory import Box

TEXT = """
import jax
from mjx_drax import tasks
from mjx_drax.base.structures import spelled
from mjx_drax.problem.problem import Problem
problem = tasks.load("pendulum_swingup").make()
print(spelled(jax.tree.structure(problem), lambda kind: kind is Problem))
"""


def of(tree, **rest):
    return spelled(jax.tree.structure(tree), **rest)


def test_the_text_is_the_same_in_every_process():
    def text(seed):
        return subprocess.run(
            [sys.executable, "-c", TEXT],
            env=os.environ | {"PYTHONHASHSEED": str(seed)},
            capture_output=True,
            check=True,
        ).stdout

    one = text(1)
    assert len(one) > 1000
    assert one == text(2)


def test_other_structures_have_other_texts():
    trees = [1.0, None, (), (1.0,), [1.0], (1.0, 2.0), ((1.0,), 2.0), (1.0, (2.0,)), {"a": 1.0}]
    trees += [{"b": 1.0}, Box(*[None] * 6), Box(*[1.0] * 6)]
    assert len({of(tree) for tree in trees}) == len(trees)
    assert of({"a": 1.0}) == of({"a": 2.0})


class Colour(Enum):
    RED = 1
    BLUE = 2


@register_dataclass
@dataclass(frozen=True)
class Own:
    number: float
    kind: object = field(metadata=Static)


@pytest.fixture
def classes_are_known(monkeypatch):
    monkeypatch.setattr(structures, "_is_known", lambda kind: kind is not Users)


@pytest.mark.usefixtures("classes_are_known")
def test_static_parts_count():
    kinds = [1, 1.0, True, "1", b"1", None, (1,), (1, (2,)), Colour.RED, Colour.BLUE, Own, Box]
    kinds += [np.float32, np.float64(1), np.float32(1), (np.float32(2),)]
    assert len({of(Own(0.0, kind)) for kind in kinds}) == len(kinds)


class Users:
    pass


@pytest.mark.usefixtures("classes_are_known")
@pytest.mark.parametrize("kind", [lambda: 0, Users(), Users, object()])
def test_what_has_no_lasting_text_is_refused(kind):
    with pytest.raises(Unspelled):
        of(Own(0.0, kind))


def test_a_class_is_known_by_what_its_module_has_under_its_name():
    made = {}
    exec("class int: pass\nclass Point: pass", made)
    for kind in (*(made[name] for name in ("int", "Point")), Own):
        assert kind is Own or kind.__module__ == "builtins"
        with pytest.raises(Unspelled):
            spelled_class(kind)
    assert spelled_class(Box) == "mjx_drax.problem.trajectory.Box"
    Own.__module__ = "mjx_drax.own"
    with pytest.raises(Unspelled):
        spelled_class(Own)


@pytest.mark.usefixtures("classes_are_known")
def test_functions_need_no_text_where_they_are_explained():
    function = Partial(lambda x, y: x, 1.0)
    with pytest.raises(Unspelled):
        of(Own(function, None))
    inside = of(Own(function, None), explained=lambda kind: kind is Own)
    assert inside == of(Own(Partial(max, 2.0), None), explained=lambda kind: kind is Own)
    assert inside != of(Own(Partial(max, 2.0, 3.0), None), explained=lambda kind: kind is Own)
    with pytest.raises(Unspelled):  # beside what is explained
        of((Own(0.0, None), function), explained=lambda kind: kind is Own)

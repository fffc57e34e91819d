"""A problem from the user's own model and cost file, `solve --model XML --cost PY`."""

from __future__ import annotations

import difflib
import importlib.util
import sys
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import TYPE_CHECKING

from mjx_drax.base.errors import DraxError, reason

if TYPE_CHECKING:
    from mjx_drax.problem.problem import Problem
    from mjx_drax.search.restarts import Restarts

HELP = """\
A cost file is Python. It defines at least one of
  running_cost(data, u), terminal_cost(data)           scalars
  running_residual(data, u), terminal_residual(data)   vectors: adds half the squared norm
on mjx.Data (qpos, qvel, data.site("tip").xpos, data.sensor("touch").data, ...), where any
function may have one more parameter, `knot` (time, index, dt, data, parameters), and may define
  goal(data) -> bool       what a replay in MuJoCo must reach
  equality(data, u), terminal_equality(data)       vectors held at 0
  inequality(data, u), terminal_inequality(data)   vectors held <= 0
  horizon, dt              [s]; horizon = (least, most) with knots = K leaves it open
  x_init, x_init_bounds    [qpos, qvel, act], and how far it may be chosen
  x_bounds, u_bounds       (lower, upper)
  x_scatter, u_scatter     (lower, upper): where initial knots are drawn
  parameters               {name: (lower, upper)}, chosen once for the whole motion, and
  model_numbers(model, p)  fields of the model that depend on them
  rates, rate_bounds       1: functions read knot.rate, 2: knot.jerk; (lower, upper) of the rate
  u_init                   the control before the first knot
  data                     arrays with a row for each knot, or data(t); functions read knot.data
  guess(key) -> Trajectory initial knots of one chain
  contacts                 how many contact points the plan keeps, the nearest ones; False: none;
                           or the pairs that may touch, [("foot_*", "floor"), ...]
  stops                    joints that may lean on their limits: True, or ["knee_*"]; the ranges
                           of other driven joints are bounds
  actuators                for a model without: "torque", {"torque": limit} or {"position": kp}
  derivatives              of the dynamics: mjx_drax.Smoothed(); default exact
  solver                   a mjx_drax.Restarts or mjx_drax.Langevin
Other names are yours. One that is nearly one of these is refused, as a spelling mistake.
"""

FUNCTION_ALIKE, VALUE_ALIKE = 0.77, 0.9
"""How much of a name has to be that of a known one to be taken for a slip: `final_cost` is one,
the numbers `u_first` and `x_goal` are not."""


def load(model: str, cost: str, horizon: float | None) -> tuple[Problem, Restarts]:
    """The problem, over the file's horizon or one of so many seconds, and the settings to solve it.

    The file may define every argument of `from_mjcf` by its name.

    Raises:
        DraxError: the file is missing, fails, misses something, or defines what is nearly one of
            the known names; or the problem cannot be built.
    """
    from inspect import signature

    from mjx_drax.physics.mjcf import from_mjcf
    from mjx_drax.search.restarts import as_restarts

    module = _module(Path(cost))
    names = set(signature(from_mjcf).parameters) - {"model", "name"}
    _require_no_slips(module, {*names, "solver"}, cost)
    given = {name: value for name, value in vars(module).items() if name in names}
    if horizon is not None:
        given["horizon"] = horizon
    if "horizon" not in given:
        raise DraxError(f"no horizon: define it in {cost} or give --horizon SECONDS.")
    problem = from_mjcf(model, name=Path(model).stem, **given)
    return problem, as_restarts(getattr(module, "solver", None))


def _require_no_slips(module: ModuleType, known: set[str], cost: str) -> None:
    """Complain about a definition that would be ignored, and whose name is nearly a known one.

    What is imported does not count, nor what begins with an underscore, nor a name whose known one
    is defined as well: that is a helper's.
    """
    missing = sorted(known - set(vars(module)))
    for name, value in vars(module).items():
        defined = isinstance(value, FunctionType | BuiltinFunctionType | type)
        imported = defined and value.__module__ != module.__name__
        if name.startswith("_") or name in known or imported or isinstance(value, ModuleType):
            continue
        alike = FUNCTION_ALIKE if callable(value) else VALUE_ALIKE
        low = name.lower()
        near = [meant for meant in missing if sorted(meant) == sorted(low)]  # letters swapped
        for meant in near or difflib.get_close_matches(low, missing, 1, alike):
            raise DraxError(
                f"{cost} defines {name}, which is not a known name: rename it to {meant}, or to "
                f"_{name} if it is something else."
            )


def _module(path: Path) -> ModuleType:
    """The cost file as a module; it can import files beside it, also later, in its functions."""
    if not path.is_file():
        raise DraxError(f"there is no cost file {str(path)!r}: check the path.")
    spec = importlib.util.spec_from_file_location("mjx_drax_cost", path)
    if spec is None or spec.loader is None:
        raise DraxError(
            f"the cost file {str(path)!r} is not a Python file: its name must end in .py."
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look there
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.insert(0, folder)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise DraxError(
            f"the cost file {str(path)!r} failed: {reason(error)}. Correct it there."
        ) from error
    return module

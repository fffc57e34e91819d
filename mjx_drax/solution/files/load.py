"""Solutions from the files that `save` wrote.

A solution that is loaded without its problem gets a stand-in: with the sizes, times, bounds and,
for MJCF, the model of what was solved. Whatever needs a function of the problem raises a DraxError.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import warnings
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from mjx_drax.base.errors import (
    DraxError,
    DraxWarning,
    reason,
    require_positive,
    require_whole,
    shown,
)
from mjx_drax.base.files import file_path
from mjx_drax.base.pytrees import Static, register_dataclass
from mjx_drax.method.model import Multipliers
from mjx_drax.physics.dynamics import MjxDynamics
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.mjx_model import bounded_joints, put_model
from mjx_drax.physics.source import Source, from_binary
from mjx_drax.problem.cost import Constraint, Cost
from mjx_drax.problem.dynamics import Dynamics, FunctionDynamics
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.problem.trajectory import Box, Stagewise, Trajectory
from mjx_drax.search.restarts import Restarts
from mjx_drax.search.settings import from_data
from mjx_drax.search.units import CONSTRAINTS, with_units
from mjx_drax.solution.files.save import ARRAYS, CHAIN, FORMAT, SUMMARY, json_digest
from mjx_drax.solution.replay import Replays
from mjx_drax.solution.results import Results
from mjx_drax.solution.violations import KINDS, Tolerances, Violations

Arrays = dict[str, np.ndarray]
Loaded = TypeVar("Loaded", bound=Results)


def load(
    cls: type[Loaded], folder: str | os.PathLike[str], problem: Problem | None = None
) -> Loaded:
    """The solution in a folder; see `Solution.load`."""
    path = file_path(folder)
    summary, arrays = _read(path)
    try:
        if problem is None:
            double = arrays["problem.x_init"].dtype == np.float64
            with jax.enable_x64(True) if double else nullcontext():
                problem = _stand_in(summary, arrays)
        else:
            _require_same(problem, summary, arrays)
            problem = _as_solved(problem, arrays)
        units = [arrays.get(f"problem.{name}.unit") for name in CONSTRAINTS]
        with problem.arithmetic():
            own = None if units[0] is None else Stagewise(*map(jnp.asarray, units))
        solution = _solution(cls, with_units(problem, own), summary, arrays)
        _require_consistent(solution, summary)
        return solution
    except DraxError:
        raise
    except Exception as error:  # what damaged data run into is beyond counting
        raise DraxError(f"{shown(str(path))} is damaged: {reason(error)}. Solve again.") from error


def _read(folder: Path) -> tuple[dict[str, Any], Arrays]:
    """What the two files hold, if they belong together."""
    contents = []
    for name in (SUMMARY, ARRAYS):
        try:
            contents.append((folder / name).read_bytes())
        except OSError as error:
            raise DraxError(
                f"cannot read {str(folder / name)!r}: {error.strerror or error}. Give a folder "
                "that Solution.save or `mjx-drax solve` has written."
            ) from error
    try:
        summary = json.loads(contents[0])
        written = summary.get("format")
    except (ValueError, AttributeError, RecursionError) as error:
        raise DraxError(
            f"{str(folder / SUMMARY)!r} is damaged, it is no JSON object: {reason(error)}. Solve "
            "again."
        ) from error
    if written != FORMAT:
        which = "no format number" if written is None else f"format {written}"
        versions = summary.get("versions")
        version = versions.get("mjx-drax") if isinstance(versions, dict) else "an unknown one"
        raise DraxError(
            f"{str(folder / SUMMARY)!r} has {which} (mjx_drax {version} wrote it), and this "
            f"version reads format {FORMAT}: solve again, or use the version that wrote it."
        )
    if summary.get("json_sha256", json_digest(summary)) != json_digest(summary):
        raise DraxError(
            f"{str(folder / SUMMARY)!r} is damaged, or was changed after it had been written: undo "
            "that, remove its json_sha256, or solve again."
        )
    if hashlib.sha256(contents[1]).hexdigest() != summary.get("npz_sha256"):
        raise DraxError(
            f"{str(folder / ARRAYS)!r} does not belong to {SUMMARY} beside it: it is damaged, or "
            "saving was interrupted. Solve again."
        )
    try:
        with np.load(io.BytesIO(contents[1]), allow_pickle=False) as arrays:
            return summary, dict(arrays)
    except Exception as error:
        raise DraxError(
            f"{str(folder / ARRAYS)!r} is damaged: {reason(error)}. Solve again."
        ) from error


def _solution(
    cls: type[Loaded], problem: Problem, summary: dict[str, Any], arrays: Arrays
) -> Loaded:
    of_bounds: Any = None
    if "solution.multipliers.bounds.0.x" in arrays:
        sides = ("solution.multipliers.bounds.0", "solution.multipliers.bounds.1")
        of_bounds = tuple(_trajectory(side, arrays) for side in sides)
    multipliers = Multipliers(
        arrays["solution.multipliers.dynamics"],  # type: ignore[arg-type]
        _stagewise("solution.multipliers.constraints", arrays),
        of_bounds,
    )
    history = {k.removeprefix("history_"): v for k, v in arrays.items() if k.startswith("history_")}
    return cls(
        problem=problem,
        solver=from_data(summary["settings"]),
        seed=summary["seed"],
        trajectories=_trajectory("solution.trajectories", arrays),
        multipliers=multipliers,
        gains=arrays["solution.gains"],
        **{name: arrays[f"chain_{name}"] for name in CHAIN},  # type: ignore[arg-type]
        stalled=arrays.get("chain_stalled", np.zeros(len(arrays["chain_residual"]), bool)),
        tolerance=summary["tolerance"],
        interrupted=summary["interrupted"],
        plan=Violations(**_within("solution.plan.", arrays)),
        open_loop=_replays("solution.open_loop.", arrays),
        feedback=_replays("solution.feedback.", arrays),
        tolerances=from_data(summary["tolerances"]),
        history=history,
        iterations=summary["iterations"],
        compile_time=summary["compile_time_s"],
        solve_time=summary["solve_time_s"],
        engine=summary["certificate"]["engine"],
    )


def _require_consistent(solution: Results, summary: dict[str, Any]) -> None:
    """Complain about arrays that do not fit each other, and numbers of the wrong kind."""
    x, u = solution.trajectories.x, solution.trajectories.u
    dynamics = solution.problem.dynamics
    chains, K, nx, nu = *x.shape, u.shape[-1]
    shapes: dict[str, tuple[Any, tuple[int, ...]]] = {
        "x": (x, (chains, solution.problem.horizon, dynamics.nx)),
        "u": (u, (chains, K, dynamics.nu)),
        "gains": (solution.gains, (chains, K, nu, dynamics.ndx)),
        "multipliers": (solution.multipliers.dynamics, (chains, K, dynamics.ndx)),
    }
    for name in (*CHAIN, "stalled"):
        shapes[name] = getattr(solution, name), (chains,)
    for mode, violations in (
        ("plan", solution.plan),
        ("open_loop", solution.open_loop.violations),
        ("feedback", solution.feedback.violations),
    ):
        for name, array in vars(violations).items():
            shapes[f"violations of {mode}, {name}"] = array, (chains, len(KINDS))
    for mode in ("open_loop", "feedback"):
        replays = getattr(solution, mode)
        shapes[f"{mode}.states"] = replays.states, (chains, K + 1, nx)
        shapes[f"{mode}.controls"] = replays.controls, (chains, K, nu)
        for name in ("max_deviation", "final_deviation", "max_violation", "cost", "success"):
            shapes[f"{mode}.{name}"] = getattr(replays, name), (chains,)
    for name, (array, shape) in shapes.items():
        if array.shape != shape or array.dtype.kind not in "biuf":
            raise DraxError(
                f"the saved solution is damaged: {name} is {array.dtype} of shape {array.shape}, "
                f"not numbers of shape {shape}. Solve again."
            )
    require_whole("horizon of the saved solution", summary["horizon"])
    require_whole("seed of the saved solution", solution.seed, 0)
    require_positive("dt of the saved solution", float(dynamics.dt))
    require_positive("tolerance of the saved solution", solution.tolerance)
    for name, kind in (("solver", Restarts), ("tolerances", Tolerances), ("interrupted", bool)):
        value = getattr(solution, name)
        if not isinstance(value, kind):
            raise DraxError(
                f"the saved solution is damaged: its {name} is {shown(value)}. Solve again."
            )


def _within(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays whose names begin so, without it."""
    return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}


def _replays(label: str, arrays: Arrays) -> Replays:
    named = _within(label, arrays)
    own = {name: array for name, array in named.items() if "." not in name}
    return Replays(**own, violations=Violations(**_within("violations.", named)))


def _stagewise(label: str, arrays: Arrays) -> Any:
    return Stagewise(arrays[f"{label}.stage"], arrays[f"{label}.terminal"])  # type: ignore[arg-type]


def _trajectory(label: str, arrays: Arrays) -> Trajectory:
    slack = _stagewise(f"{label}.slack", arrays) if f"{label}.slack.stage" in arrays else None
    start: Any = arrays.get(f"{label}.start")
    return Trajectory(arrays[f"{label}.x"], arrays[f"{label}.u"], slack, start)  # type: ignore[arg-type]


def _box(label: str, arrays: Arrays) -> Box:
    ends: dict[str, Any] = {k: jnp.asarray(v) for k, v in _within(f"{label}.", arrays).items()}
    return Box(**ends)


# The problem


def _missing(what: str) -> Partial:
    """A function that was not saved."""

    def function(*_: Any) -> Any:
        raise DraxError(
            f"{what} is code, which is not saved: load the solution with its problem, "
            "Solution.load(folder, problem)."
        )

    return Partial(function)


@register_dataclass
@dataclass(frozen=True)
class _Manifold(FunctionDynamics):
    """Dynamics whose states are no vectors: how they differ was not saved."""

    ndx: int = field(default=0, metadata=Static)

    def difference(self, x: Array, y: Array) -> Array:
        """Complain."""
        return _missing("difference")()

    def integrate(self, x: Array, dx: Array) -> Array:
        """Complain."""
        return _missing("integrate")()


def _stand_in(summary: dict[str, Any], arrays: Arrays) -> Problem:
    """The problem as far as it was saved."""
    x_init = jnp.asarray(arrays["problem.x_init"])
    stage, terminal = (_constraint(part, arrays) for part in ("stage", "terminal"))
    cost = Cost(_missing("the cost"), None)
    return Problem(
        dynamics=_dynamics(summary, arrays),
        running=cost,
        terminal=cost,
        constraint=stage,
        terminal_constraint=terminal,
        x_init=x_init,
        bounds=_box("problem.bounds", arrays),
        scatter=_box("problem.scatter", arrays),
        horizon=summary["horizon"],
        free=tuple(tuple(places) for places in summary.get("free", ())),
        t_init=jnp.asarray(arrays.get("problem.t_init", 0.0), x_init.dtype),
        goal=_missing("the goal") if summary["has_goal"] else None,
        name=summary["task"],
    )


def _constraint(part: str, arrays: Arrays) -> Constraint:
    """With the rows that were saved; those of inequalities have slacks."""
    slack = arrays.get(f"solution.trajectories.slack.{part}")
    inequalities = 0 if slack is None else slack.shape[-1]
    equalities = arrays[f"solution.multipliers.constraints.{part}"].shape[-1] - inequalities
    missing = _missing("the constraint")
    return Constraint(
        missing if equalities else None,
        missing if inequalities else None,
        equalities,
        inequalities,
    )


def _dynamics(summary: dict[str, Any], arrays: Arrays) -> Dynamics:
    further = summary.get("extended")
    if not further:
        return _inner_dynamics(summary, arrays, 0)
    dtype = arrays["problem.x_init"].dtype
    nominal, u_init = (jnp.asarray(further[name], dtype) for name in ("nominal", "u_init"))
    added = len(nominal) + further["order"] * len(u_init)
    return Extended(
        inner=_inner_dynamics(summary, arrays, added),
        nominal=nominal,
        u_init=u_init,
        free=tuple(further["free"]),
        shapes=tuple((name, tuple(shape)) for name, shape in further["shapes"]),
        phases=tuple(further["phases"]),
        order=further["order"],
        starts_known=further["starts_known"],
    )


def _inner_dynamics(summary: dict[str, Any], arrays: Arrays, further: int) -> Dynamics:
    """The dynamics without so many further states."""
    dt = summary["dt"]
    if "model.binary" not in arrays:
        nx, nu = (arrays[f"solution.trajectories.{z}"].shape[-1] for z in "xu")
        names: Any = {name: tuple(given) for name, given in summary.get("names", {}).items()}
        sizes = _missing("f"), dt, nx - further, nu
        if summary.get("vector_states", True):
            return FunctionDynamics(*sizes, **names)
        ndx = arrays["solution.gains"].shape[-1] - further
        return _Manifold(*sizes, **names, ndx=ndx)
    mj_model, source = _model(summary, arrays)
    x_init = np.asarray(arrays["problem.x_init"], float)
    bounded = bounded_joints(mj_model, x_init[: mj_model.nq + mj_model.nv + mj_model.na])
    bounded[summary.get("stops", [])] = False
    planned = put_model(mj_model, summary["contacts"], bounded)
    substeps = round(dt / mj_model.opt.timestep)
    return MjxDynamics(planned, dt, mj_model, substeps, origin=source)


def _model(summary: dict[str, Any], arrays: Arrays) -> tuple[mujoco.MjModel, Source | None]:
    """The compiled model, from its MJCF if another version of MuJoCo compiled it, and its MJCF."""
    source, written = None, summary["versions"]["mujoco"]
    if "model.xml" in arrays:
        named = _within("model.files/", arrays)
        files = {_file_name(name): content.tobytes() for name, content in named.items()}
        source = Source(str(arrays["model.xml"]), files)
    if written == mujoco.__version__:
        return from_binary(arrays["model.binary"].tobytes()), source
    if source is None:
        raise DraxError(
            f"the model was saved by MuJoCo {written} without MJCF, which MuJoCo "
            f"{mujoco.__version__} cannot read: pip install mujoco=={written}, or load the "
            "solution with its problem, Solution.load(folder, problem)."
        )
    warnings.warn(
        f"the model was saved by MuJoCo {written} and is compiled anew by {mujoco.__version__}, "
        "from MJCF with six digits: it may move a little differently.",
        DraxWarning,
        stacklevel=4,
    )
    return source.compiled(), source


def _file_name(name: str) -> str:
    """The name of a model's file, if it leads to no other folder, as after somebody's tampering."""
    drive = len(name) > 1 and name[0].isalpha() and name[1] == ":"
    if drive or name in ("", ".", "..") or any(mark in name for mark in "/\\\0"):
        raise DraxError(
            f"{ARRAYS} names a file of the model {shown(name)}, which may lie in another folder: "
            "use results from where you trust, or solve again."
        )
    return name


def _require_same(problem: Problem, summary: dict[str, Any], arrays: Arrays) -> None:
    """Complain if the problem cannot be the one that was solved."""
    if not isinstance(problem, Problem):
        raise DraxError(f"the problem is {shown(problem)}: give the one that was solved.")
    x, u = arrays["solution.trajectories.x"], arrays["solution.trajectories.u"]
    dynamics = problem.dynamics
    for label, given, saved in (
        ("K", problem.horizon, x.shape[1]),
        ("nx", dynamics.nx, x.shape[2]),
        ("nu", dynamics.nu, u.shape[2]),
        ("dt", float(dynamics.dt), summary["dt"]),
    ):
        if given != saved:
            raise DraxError(
                f"the problem {problem.name} has {label} = {given}, the saved solution of "
                f"{summary['task']} has {saved}: give the problem that was solved."
            )
    start, solved = np.asarray(problem.x_init), arrays["problem.x_init"]
    digits = min(start.dtype, solved.dtype, key=lambda kind: kind.itemsize)  # those of both
    if not np.array_equal(start.astype(digits), solved.astype(digits)):
        raise DraxError(
            f"x_init of the problem {problem.name} is {np.asarray(problem.x_init).tolist()}, the "
            f"saved solution of {summary['task']} starts at {arrays['problem.x_init'].tolist()}: "
            "give the problem that was solved."
        )


def _as_solved(problem: Problem, arrays: Arrays) -> Problem:
    """The problem in the precision, and with the box of initial knots, in which it was solved."""
    saved = arrays["problem.x_init"]
    double = problem.precision != 64 and saved.dtype == np.float64
    problem = problem.in_float64() if double else problem
    with problem.arithmetic():
        x_init = jnp.asarray(saved) if double else problem.x_init
        return replace(problem, x_init=x_init, scatter=_box("problem.scatter", arrays))

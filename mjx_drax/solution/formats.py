"""Files for other programs: states and controls as CSV, keyframes as MJCF, trajectories as HDF5.

They hold what was replayed, not what was planned; a dataset holds both.
"""

from __future__ import annotations

import csv
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from mjx_drax import __version__
from mjx_drax.base.errors import DraxError, DraxWarning
from mjx_drax.base.files import complete, file_path, require
from mjx_drax.physics.c_engine.model_numbers import DERIVED
from mjx_drax.physics.dynamics import mjx_dynamics, mujoco_model
from mjx_drax.physics.engine import mujoco
from mjx_drax.physics.source import Source
from mjx_drax.problem.problem import Problem
from mjx_drax.solution.export import NothingToExport
from mjx_drax.solution.names import control_names, state_names
from mjx_drax.solution.replay import OPEN_LOOP, WITH_FEEDBACK
from mjx_drax.solution.solution import Solution, require_solution

DATASET_FORMAT = 1
"""Of HDF5 files; changes whenever what they hold is named or shaped otherwise."""


# CSV


def save_csv(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Write the best chain's replay as a table, one row a knot; returns its path.

    Columns: time [s], then `state_names` and `control_names`. Row k holds x_k and the control u_k
    that acts from there; the last row has no control.

    Args:
        solution: from `solve`.
        path: where to, ending in .csv.

    Raises:
        DraxError: the path cannot be written.
    """
    require_solution(solution)
    states, controls = solution.replayed
    dynamics = solution.problem.dynamics
    with (
        complete(path, (".csv",)) as partial,
        partial.open("w", newline="", encoding="utf-8") as file,
    ):
        table = csv.writer(file)
        table.writerow(["time", *state_names(dynamics), *control_names(dynamics)])
        for k, (time, x) in enumerate(zip(solution.times, states, strict=True)):
            u = controls[k] if k < len(controls) else [""] * dynamics.nu
            table.writerow([f"{time:.9g}", *x, *u])
    return file_path(path)


# Keyframes


def mjcf_of(problem: Problem) -> tuple[mujoco.MjModel, Source]:
    """A problem's model, and its MJCF with the files that it needs; complains if there is none."""
    dynamics = mjx_dynamics(problem.dynamics)
    if dynamics is None:
        raise DraxError(
            f"{problem.name} has no MuJoCo model to write keyframes of, its dynamics are a "
            "function: see --csv or save_csv."
        )
    return dynamics.mj_model, dynamics.source()


def export_keyframes(solution: Solution, path: str | os.PathLike[str]) -> Path:
    """Write the model with the replay as its keyframes, for any MuJoCo viewer; returns the path.

    Keyframe `replay_k` holds time, qpos, qvel, act and ctrl at knot k, after those that the model
    has; `replay2_k` if it has such already. Meshes, textures and height fields are copied into a
    folder beside the file, NAME_assets, so both can be moved together. Other numbers of the model
    are the file's, as MuJoCo writes them, with six digits: parameters of a problem do not change
    them.

    Args:
        solution: from `solve`, of a problem from an MJCF file or string.
        path: where to, ending in .xml.

    Raises:
        DraxError: there is no MJCF, it has changed since, or the path cannot be written.

    Warns:
        DraxWarning: the solution has chosen numbers of the model, or its timestep.
    """
    require_solution(solution)
    model, source = mjcf_of(solution.problem)
    if chosen := _chosen_numbers(solution, model):
        warnings.warn(
            f"{path} has the model of the file, where the solution has chosen {chosen}: set it "
            "there before you replay the keyframes.",
            DraxWarning,
            stacklevel=2,
        )
    target = file_path(path)
    folder = f"{target.stem}_assets"
    before, end, _ = source.in_folder(folder if source.assets else "").xml.rpartition("</mujoco>")
    keys = "\n".join(_keys(solution, model))
    with complete(target, (".xml",)) as partial:
        for name, content in source.assets.items():
            with complete(target.parent / folder / name) as file:
                file.write_bytes(content)
        text = f"{before}  <keyframe>\n{keys}\n  </keyframe>\n{end}\n"
        partial.write_text(text, encoding="utf-8")
    return target


def _chosen_numbers(solution: Solution, model: mujoco.MjModel) -> str:
    """Which numbers of the model the best chain has otherwise, in words; empty if none."""
    dynamics, plan = solution.problem.dynamics, solution.plans[solution.best_chain]
    inner, own = mjx_dynamics(dynamics), mujoco_model(dynamics, plan[0])
    assert inner is not None
    assert own is not None
    arrays = [n for n in dir(model) if isinstance(getattr(model, n, None), np.ndarray)]
    given = [name for name in arrays if name not in DERIVED]
    found = [n for n in given if not np.array_equal(getattr(model, n), getattr(own, n))]
    dt = float(solution.times[1] - solution.times[0]) / inner.substeps
    if not np.isclose(dt, model.opt.timestep, rtol=1e-5):
        found.append(f"timestep {dt:.6g} s")
    return " and ".join(found)


def _keys(solution: Solution, model: mujoco.MjModel) -> Iterator[str]:
    """One element a knot; the last one keeps the last control."""
    taken = [model.key(i).name for i in range(model.nkey)]
    prefixes = ("replay_", *(f"replay{n}_" for n in range(2, len(taken) + 3)))
    prefix = next(p for p in prefixes if not any(name.startswith(p) for name in taken))
    states, controls = solution.replayed
    ends = [model.nq, model.nq + model.nv]
    for k, (time, x) in enumerate(zip(solution.times, states, strict=True)):
        if not np.isfinite(x).all():
            break
        own = x[: ends[1] + model.na]  # without further states
        parts = dict(zip(("qpos", "qvel", "act"), np.split(own, ends), strict=True))
        parts["ctrl"] = controls[min(k, len(controls) - 1)]
        numbers = "".join(f" {n}={quoteattr(_numbers(v))}" for n, v in parts.items() if v.size)
        yield f'    <key name="{prefix}{k}" time="{time:.9g}"{numbers}/>'


def _numbers(values: npt.ArrayLike) -> str:
    return " ".join(f"{v:.17g}" for v in np.nan_to_num(np.asarray(values, float)))


# Datasets


def save_dataset(
    solutions: Solution | Sequence[Solution],
    path: str | os.PathLike[str],
    everything: bool = False,
) -> Path:
    """Write trajectories of many chains as HDF5, for learning from; returns the path.

    One group a solution, `000_NAME`, with n trajectories of K knots: times (K+1,), or (n, K+1)
    where durations are free; states (n, K+1, nx) and controls (n, K, nu) as replayed, float64;
    plan_states, plan_controls and gains (n, K, nu, ndx), in the solve's precision; mode (n,),
    `open loop` or `with feedback`, whichever succeeds and is cheaper; and of that replay
    max_deviation, final_deviation, max_violation, replay_cost and success, (n,) each; chain, cost,
    max_defect and residual of the plan, feasible, optimal. Attributes: problem, engine, seed, dt,
    state_names, control_names; of the file: format, mjx_drax.

    Args:
        solutions: one, or several, from `solve` or `Solution.load`.
        path: where to, ending in .h5 or .hdf5.
        everything: also chains that are not certified; otherwise only those that are feasible and
            whose replay in that mode succeeds.

    Raises:
        DraxError: h5py is not installed, nothing is certified, or the path cannot be written.
    """
    require("h5py", "dataset", "a dataset")
    import h5py

    solutions = list(solutions) if isinstance(solutions, Sequence) else [solutions]
    if not solutions:
        raise DraxError("there is no solution to write: give one, or a list of some.")
    for solution in solutions:
        require_solution(solution)
    tables = [_trajectories(solution, everything) for solution in solutions]
    if not sum(len(table["chain"]) for table in tables):
        raise NothingToExport(
            "no chain is certified, so the dataset would be empty: solve with more chains, or pass "
            "everything=True for what there is."
        )
    with complete(path, (".h5", ".hdf5")) as partial, h5py.File(partial, "w") as file:
        file.attrs["format"], file.attrs["mjx_drax"] = DATASET_FORMAT, __version__
        for i, (solution, table) in enumerate(zip(solutions, tables, strict=True)):
            problem = solution.problem
            group = file.create_group(f"{i:03d}_{problem.name.replace('/', '_')}")
            group.attrs["problem"], group.attrs["engine"] = problem.name, solution.engine
            dt = np.nan if problem.dynamics.phases else float(problem.dynamics.dt)
            group.attrs["seed"], group.attrs["dt"] = solution.seed, dt
            group.attrs["state_names"] = state_names(problem.dynamics)
            group.attrs["control_names"] = control_names(problem.dynamics)
            times = solution.times
            if problem.dynamics.phases:  # each has its own
                rows = [solution.times_of(int(chain)) for chain in table["chain"]]
                times = np.reshape(rows, (-1, len(times)))
            for name, values in {"times": times, **table}.items():
                group.create_dataset(name, data=values)
    return file_path(path)


def _trajectories(solution: Solution, everything: bool) -> dict[str, Any]:
    """The trajectories of one solution, cheapest first, replayed in their modes."""
    open_loop, feedback = solution.open_loop, solution.feedback
    order = np.argsort(solution.replay_cost, kind="stable")
    chains = order[solution.certified_chains[order] | everything]
    is_open = solution.open_loop_is_better[chains]

    def replayed(name: str) -> np.ndarray:
        one, other = (getattr(replays, name)[chains] for replays in (open_loop, feedback))
        return np.where(is_open.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    of_replays = (
        "states",
        "controls",
        "max_deviation",
        "final_deviation",
        "max_violation",
        "success",
    )
    of_plans = "gains", "cost", "max_defect", "residual", "feasible"
    return {
        **{name: replayed(name) for name in of_replays},
        **{name: getattr(solution, name)[chains] for name in of_plans},
        "plan_states": solution.plans[chains],
        "plan_controls": solution.trajectories.u[chains],
        "mode": [OPEN_LOOP if o else WITH_FEEDBACK for o in is_open],
        "replay_cost": replayed("cost"),
        "chain": chains,
        "optimal": solution.optimal_chains[chains],
    }

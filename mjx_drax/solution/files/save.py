"""Result files: `result.json` for reading, `result.npz` for computing, both to load again.

Functions are code and are not saved: a loaded solution has everything but costs, constraints, goal
and, without an MJCF, dynamics (see `load`).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_drax.base.digests import versions
from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import complete, file_path, json_data, require_room, write_json
from mjx_drax.physics.dynamics import mjx_dynamics
from mjx_drax.physics.source import binary
from mjx_drax.problem.dynamics import Dynamics
from mjx_drax.problem.extended import Extended
from mjx_drax.problem.problem import Problem
from mjx_drax.search.settings import to_data
from mjx_drax.solution.results import Optimum, Results

SUMMARY, ARRAYS = "result.json", "result.npz"

FORMAT = 3
"""Changes whenever files that were written before can no longer be loaded."""

WHOLE = ("trajectories", "multipliers", "gains", "plan", "open_loop", "feedback")
"""Attributes of a solution that are written for all chains, by their names."""

CHAIN = ("cost", "max_defect", "max_violation", "residual", "feasible_since", "died_at")
"""Numbers of every chain, by their names in a solution."""

PICTURES = 5_000_000
"""Bytes that pictures and videos may take."""

OPTIMA = 32
"""So many of the distinct optima, cheapest first, go into result files."""


def summary(solution: Results) -> dict[str, Any]:
    """What `result.json` holds: settings, the best chain's numbers, certificate, versions."""
    best, status, polished = solution.best_chain, solution.status, solution.polished
    dynamics = solution.problem.dynamics
    own = dynamics.inner if isinstance(dynamics, Extended) else dynamics
    of_vectors = type(own).difference is Dynamics.difference
    model = mjx_dynamics(dynamics)
    where = solution.where(best)
    whole: dict[str, Any] = {
        "format": FORMAT,
        "task": solution.problem.name,
        "seed": solution.seed,
        "chains": solution.chains,
        "iterations": solution.iterations,
        "horizon": solution.problem.horizon,
        "precision": solution.problem.precision,
        "dt": float(solution.problem.dynamics.dt),
        "has_goal": solution.problem.goal is not None,
        "contacts": None if model is None else model.contacts,
        "stops": [] if model is None else model.stops,
        "vector_states": dynamics.nx == dynamics.ndx and of_vectors,
        "names": {"x_names": own.x_names, "u_names": own.u_names},
        "free": solution.problem.free,
        "extended": extended_data(dynamics),
        "settings": to_data(solution.solver),
        "compile_time_s": solution.compile_time,
        "solve_time_s": solution.solve_time,
        "best_chain": best,
        "certified": solution.certified,
        "optimal": solution.optimal,
        "residual": solution.residual[best],
        "tolerance": solution.tolerance,
        "interrupted": solution.interrupted,
        "replay_mode": solution.replay_mode,
        "cost": solution.replay_cost[best],
        "plan_cost": solution.cost[best],
        "max_defect": solution.max_defect[best],
        "max_bound_violation": solution.max_violation[best],
        "infeasible_where": None if where is None else {"kind": where.kind, **where.data()},
        "success_rate": solution.success_rate,
        "optimal_rate": float(solution.optimal_chains.mean()),
        "status": {name: status.count(name) for name in sorted(set(status))},
        "polished": {name: polished.count(name) for name in sorted(set(polished))},
        "certificate": vars(solution.certificate),
        "tolerances": to_data(solution.tolerances),
        "optima_found": len(solution.optima),
        "optima": [_answer(optimum) for optimum in solution.optima[:OPTIMA]],
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
    }
    data: dict[str, Any] = json_data(whole)
    return data


def extended_data(dynamics: Dynamics) -> dict[str, Any] | None:
    """What a file says of further states; None if there are none."""
    if not isinstance(dynamics, Extended):
        return None
    names = "free", "shapes", "phases", "order"
    numbers = {name: np.asarray(getattr(dynamics, name)).tolist() for name in ("nominal", "u_init")}
    known = {"starts_known": bool(dynamics.starts_known)}
    return {**{name: getattr(dynamics, name) for name in names}, **known, **numbers}


def arrays(solution: Results) -> dict[str, np.ndarray]:
    """What `result.npz` holds: the best chain, its replay, and numbers of every chain.

    times (K+1,); states (K+1, nx), controls (K, nu), multipliers (K, ndx) and gains (K, nu, ndx) of
    the best chain's plan; replayed_states and replayed_controls; chain_* (chains,); history_*
    (records,) or (records, chains). Plans of the distinct optima in the order of `result.json`:
    optima_states (optima, K+1, nx), optima_controls (optima, K, nu); chain_optimum is the place in
    the order of all optima found, -1 for chains in none.

    The whole solution, by the names of its attributes: solution.trajectories.x (chains, K, nx),
    solution.gains, solution.open_loop.states, ..., problem.x_init, problem.bounds.u_lower, ... For
    MJCF, model.binary is the compiled model, which only the same version of MuJoCo reads, and
    model.xml its MJCF as MuJoCo writes it, with six digits; model.files/* are files it names.
    """
    best = solution.best_chain
    ways = np.array([optimum.chain for optimum in solution.optima[:OPTIMA]], int)
    optimum_of = np.full(solution.chains, -1)
    for place, optimum in enumerate(solution.optima):
        optimum_of[optimum.members] = place
    replayed_states, replayed_controls = solution.replayed
    return {
        **_whole(solution),
        "times": solution.times,
        "states": solution.plans[best],
        "controls": np.asarray(solution.best.u),
        "multipliers": solution.multipliers.dynamics[best],
        "constraint_multipliers": solution.multipliers.constraints.stage[best],
        "terminal_multipliers": solution.multipliers.constraints.terminal[best],
        "gains": solution.gains[best],
        "replayed_states": replayed_states,
        "replayed_controls": replayed_controls,
        "optima_states": solution.plans[ways],
        "optima_controls": solution.trajectories.u[ways],
        "chain_optimum": optimum_of,
        **{f"chain_{name}": getattr(solution, name) for name in CHAIN},
        "chain_stalled": solution.stalled,
        "chain_success": solution.success,
        "chain_status": np.array(solution.status),
        "chain_replay_cost": solution.replay_cost,
        **{f"history_{name}": values for name, values in solution.history.items()},
    }


def _answer(optimum: Optimum) -> dict[str, Any]:
    """One of the optima in `result.json`; share is of all chains."""
    names = "chain", "cost", "plan_cost", "max_defect", "residual", "optimal", "share"
    own = {name: getattr(optimum, name) for name in names}
    certificate = optimum.certificate
    ways = {"open_loop": certificate.open_loop, "feedback": certificate.feedback}
    return {**own, "members": len(optimum.members), **ways}


def _whole(solution: Results) -> dict[str, np.ndarray]:
    """All that a solution holds, but what `arrays` names besides."""
    problem = solution.problem
    parts = {
        **{f"solution.{name}": getattr(solution, name) for name in WHOLE},
        "problem.x_init": problem.x_init,
        "problem.t_init": problem.t_init,
        "problem.bounds": problem.bounds,
        "problem.scatter": problem.scatter,
        "problem.constraint.unit": problem.constraint.unit,
        "problem.terminal_constraint.unit": problem.terminal_constraint.unit,
    }
    found = {name: value for label, part in parts.items() for name, value in _flat(label, part)}
    dynamics = mjx_dynamics(problem.dynamics)
    if dynamics is not None:
        found["model.binary"] = np.frombuffer(binary(dynamics.mj_model), np.uint8)
        with contextlib.suppress(DraxError):  # without, only the same version can load it
            source = dynamics.source()
            found["model.xml"] = np.array(source.xml)
            for name, content in source.assets.items():
                found[f"model.files/{name}"] = np.frombuffer(content, np.uint8)
    return found


def _flat(label: str, part: Any) -> Iterator[tuple[str, np.ndarray]]:
    """The arrays of nested dataclasses and tuples, named by their paths; None has none."""
    if is_dataclass(part):
        for f in fields(part):
            yield from _flat(f"{label}.{f.name}", getattr(part, f.name))
    elif isinstance(part, tuple):
        for i, item in enumerate(part):
            yield from _flat(f"{label}.{i}", item)
    elif part is not None:
        yield label, np.asarray(part)


def save(solution: Results, folder: str | os.PathLike[str]) -> Path:
    """Write result.json and result.npz into a folder, each at once or not at all.

    `Solution.load` reads them again. result.json knows its own digest, and that of the result.npz
    that belongs to it.

    Raises:
        DraxError: the folder cannot be written to.
    """
    folder = writable(folder)
    with complete(folder / ARRAYS) as partial:
        np.savez_compressed(partial, **arrays(solution))  # type: ignore[arg-type]
        digest = hashlib.sha256(partial.read_bytes()).hexdigest()
    whole = {**summary(solution), "npz_sha256": digest}
    write_json(folder / SUMMARY, {**whole, "json_sha256": json_digest(whole)})
    return folder


def json_digest(summary: dict[str, Any]) -> str:
    """The digest of what `result.json` says, however it is laid out."""
    said = {name: value for name, value in summary.items() if name != "json_sha256"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def writable(folder: str | os.PathLike[str], size: int = 1, file: str = ARRAYS) -> Path:
    """The folder, made if need be, with room for a file of `size` bytes.

    To be called before long computations.
    """
    path = file_path(folder)
    try:
        require_room(path / file, size)
    except DraxError as error:
        raise DraxError(f"{error} In the shell: --out DIR.") from error
    return path


def expected_size(problem: Problem, chains: int) -> int:
    """Bytes that the result files of a solve and its pictures may take, a rough estimate."""
    dynamics, constraint = problem.dynamics, problem.constraint
    knot, rows = dynamics.nx + dynamics.nu, constraint.equalities + constraint.inequalities
    plan = 3 * knot + 2 * rows + dynamics.ndx * (1 + dynamics.nu)  # with multipliers and gains
    replays = 2 * knot * np.dtype(float).itemsize
    each = plan * problem.x_init.dtype.itemsize + replays
    return PICTURES + chains * problem.horizon * each

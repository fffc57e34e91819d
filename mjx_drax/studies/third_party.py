"""Models that others wrote, as they are installed, or as they lie in a folder.

    python -m mjx_drax.studies.third_party [NAME ...] [--path DIR] [--chains N] [--seed S]
                                           [--timeout S] [--jobs N] [--out DIR]

Each is either solved (`postures.reach`, default settings) or refused with a reason; a Markdown
table says which, and another one counts the reasons. With `--chains 0` nothing is solved: the table
says which models are usable, because their steps are those of the C engine. Models without
actuators get motors. Models come from `pip install "mjx-drax[third-party]"`, from other packages of
`FOLDERS`, or from any folder, such as a checkout of MuJoCo Menagerie; only their files are read,
and nothing of the packages is imported. Every model gets a process of its own, with a time limit;
what needs JAX is imported there.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import write_json
from mjx_drax.problem.problem import Problem

Row = dict[str, Any]

FOLDERS = {"dm_control": "suite", "gymnasium": "envs/mujoco/assets"}
"""Where the packages keep their models, one beside the other."""

TREES = {
    "gymnasium_robotics": "envs/assets",
    "metaworld": "assets",
    "mjlab": "asset_zoo",
    "mujoco_playground": "_src",
    "robosuite": "models/assets",
}
"""Where packages keep models in folders of folders, together with parts of models."""

CAUSES = {
    "cannot collide geoms": "pairs of geoms that MJX cannot collide",
    "differs from MuJoCo's C engine": "one step differs too much",
    "MJX does not support": "elements that MJX does not support",
    "ranges of its joints": "it leaves the ranges of its joints",
    "has no joints": "no joints",
    "no hinge or slide": "no hinge or slide that a motor could drive",
    "not done after": "out of time",
}
"""Words of refusals, and what they are counted as."""

HEADER = (
    "| model | nq/nv/nu | constraint rows | K | refused because, or failed | compile [s] "
    "| solve [s] | success | max\\|h\\| | replay deviation |\n" + "|---" * 10 + "|"
)


def models(folder: Path | None = None) -> dict[str, Path]:
    """Files of the models that are installed, by names like `gymnasium/hopper`; or of a folder."""
    found: dict[str, Path] = {}
    if folder is not None:
        return complete_models(folder, folder.resolve().name)
    for package, inside in {**FOLDERS, **TREES}.items():
        spec = importlib.util.find_spec(package)
        for place in (spec.submodule_search_locations or []) if spec else []:
            if package in TREES:
                found |= complete_models(Path(place) / inside, package)
                continue
            for path in sorted((Path(place) / inside).glob("*.xml")):
                found[f"{package}/{path.stem}"] = path
    return found


def complete_models(folder: Path, name: str) -> dict[str, Path]:
    """Files under a folder that MuJoCo compiles and in which something can move."""
    from mjx_drax.physics.source import load

    found = {}
    for path in sorted([*folder.rglob("*.xml"), *folder.rglob("*.urdf")]):
        with contextlib.suppress(DraxError):
            if load(path).nv:
                inside = path.relative_to(folder)
                short = f"{name}/{inside.with_suffix('')}"
                found[f"{name}/{inside}" if short in found else short] = path
    return found


def measure(name: str, path: Path, chains: int = 16, seed: int = 0) -> Row:
    """Reach a posture with one model, as a row of the table; `seed` is that of both."""
    from mjx_drax.kernels.compilation import keep_none
    from mjx_drax.modelling.postures import reach
    from mjx_drax.physics.source import load

    keep_none()
    row: Row = {"model": name}
    try:
        host = load(path)
        if host.nv and not host.nu:
            host = load(path, "torque")
        row |= {"nq": host.nq, "nv": host.nv, "nu": host.nu}
        problem = reach(host, seed, name=name)
        return row | (solved(problem, chains, seed) if chains else {"usable": True})
    except DraxError as error:
        return row | {"refused": str(error)}


def solved(problem: Problem, chains: int, seed: int) -> Row:
    """Solve the problem of a model with default settings: what the columns of the table show."""
    from mjx_drax.physics.dynamics import MjxDynamics
    from mjx_drax.physics.mjx_model import constraint_rows
    from mjx_drax.solution.solve import solve

    assert isinstance(problem.dynamics, MjxDynamics)
    host = problem.dynamics.mj_model
    solution = solve(problem, chains, seed, progress=False)
    best, certificate = solution.best_chain, solution.certificate
    return {
        "nq": host.nq,
        "nv": host.nv,
        "nu": host.nu,
        "rows": constraint_rows(problem.dynamics.model),
        "knots": problem.horizon,
        "certified": solution.certified,
        "success_rate": solution.success_rate,
        "cost": float(solution.cost[best]),
        "max_defect": float(solution.max_defect[best]),
        "deviation": min(
            certificate.open_loop["max_deviation"], certificate.feedback["max_deviation"]
        ),
        "compile_time_s": solution.compile_time,
        "solve_time_s": solution.solve_time,
    }


def measure_apart(
    name: str, path: Path, chains: int = 16, seed: int = 0, timeout: float = 600.0
) -> Row:
    """`measure` in a process of its own, which is ended after `timeout` [s]."""
    command = [sys.executable, "-m", "mjx_drax.studies.third_party", name, "--here", str(path)]
    command += ["--chains", str(chains), "--seed", str(seed)]
    try:
        result = subprocess.run(command, stdout=subprocess.PIPE, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        return {"model": name, "failed": f"not done after {timeout:g} s"}
    lines = result.stdout.decode().splitlines()
    if result.returncode or not lines:
        return {"model": name, "failed": f"ended with status {result.returncode}"}
    row: Row = json.loads(lines[-1])
    return row


def line(row: Row) -> str:
    """A row of the table, in Markdown."""

    def cell(key: str, form: str = "") -> str:
        return format(row[key], form) if key in row else "-"

    sizes = "/".join(cell(key) for key in ("nq", "nv", "nu"))
    reason = row.get("refused") or row.get("failed")
    if reason is None:
        reason = "" if row.get("usable") or row["certified"] else "not certified"
    words = " ".join(reason.replace("|", "\\|").split())
    return (
        f"| {row['model']} | {sizes} | {cell('rows')} | {cell('knots')} | {words} "
        f"| {cell('compile_time_s', '.1f')} | {cell('solve_time_s', '.2f')} "
        f"| {cell('success_rate', '.0%')} | {cell('max_defect', '.0e')} "
        f"| {cell('deviation', '.0e')} |"
    )


def causes(rows: Sequence[Row]) -> str:
    """A table of how many models were refused or failed for which cause, in Markdown."""
    counts: dict[str, list[str]] = {}
    for row in rows:
        words = row.get("refused") or row.get("failed")
        if words:
            known = (cause for part, cause in CAUSES.items() if part in words)
            counts.setdefault(next(known, "other"), []).append(row["model"])
    order = sorted(counts.items(), key=lambda entry: -len(entry[1]))
    order.insert(0, ("none: usable", [row["model"] for row in rows if _is_usable(row)]))
    lines = [f"| {cause} | {len(names)} | {names[0]} |" for cause, names in order if names]
    return "\n".join(["| cause | models | such as |\n|---|---|---|", *lines])


def _is_usable(row: Row) -> bool:
    return not (row.get("refused") or row.get("failed"))


def told(measured: Iterable[Row], out: Path | None) -> list[Row]:
    """Print the table row by row; write all rows after each, because a run takes long."""
    rows = []
    print(HEADER, flush=True)
    for row in measured:
        print(line(row), flush=True)
        rows.append(row)
        if out:
            write_json(out, rows)
    return rows


def fine(row: Row) -> bool:
    """Whether the model was solved, or refused with a reason."""
    return bool(row.get("certified") or row.get("usable") or row.get("refused"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, write `third_party.json`; 0 if every row is fine."""
    parser = argparse.ArgumentParser(
        prog="python -m mjx_drax.studies.third_party", description=__doc__
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that are installed")
    parser.add_argument("--path", type=Path, metavar="DIR", help="models of a folder instead")
    parser.add_argument("--chains", type=int, default=16, help="0: only look which are usable")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("--jobs", type=int, default=1, help="models at the same time (1)")
    parser.add_argument("--out", metavar="DIR", help="where third_party.json goes")
    parser.add_argument("--here", type=Path, metavar="FILE", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs is {options.jobs}: give a whole number of at least 1")
    if options.here:
        row = measure(options.names[0], options.here, options.chains, options.seed)
        print(json.dumps(row), flush=True)
        return 0
    known = models(options.path)
    unknown = [name for name in options.names if name not in known]
    if unknown or not known:
        names = ", ".join(known) or 'none: pip install "mjx-drax[third-party]"'
        print(f"there is no model {', '.join(unknown)}: there is {names}.", file=sys.stderr)
        return 2

    def row_of(name: str) -> Row:
        rest = options.chains, options.seed, options.timeout
        return measure_apart(name, known[name], *rest)

    with ThreadPoolExecutor(options.jobs) as jobs:
        measured = jobs.map(row_of, options.names or known)
        rows = told(measured, options.out and Path(options.out) / "third_party.json")
    print(f"\n{causes(rows)}", flush=True)
    return 0 if all(map(fine, rows)) else 1


if __name__ == "__main__":
    sys.exit(main())

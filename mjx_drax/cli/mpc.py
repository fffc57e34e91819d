"""Model predictive control: plan again and again while MuJoCo's C engine runs.

A model, a task's or your own, is driven several times, with random pushes. Plans per second,
latency, cost and the share of runs that end in the goal are printed; mpc.json is written. The exit
status is 0 if all runs end in the goal, or there is none.

"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mjx_drax.base.errors import require_not_negative
from mjx_drax.base.files import write_json
from mjx_drax.cli import cost_file, pictures
from mjx_drax.cli.common import at_least_1, say, say_nothing
from mjx_drax.cli.problem import add_problem, asked, require_known

__doc__ += cost_file.HELP

NUMBERS: dict[str, tuple[Any, Any, str]] = {
    "chains": (at_least_1, 8, "number of chains; default 8"),
    "explorers": (
        int,
        None,
        "how many of them start again from the best plan, with noise; default half",
    ),
    "iterations": (at_least_1, 2, "iterations of every chain for a plan; default 2"),
    "every": (at_least_1, 1, "control steps between two plans; default 1"),
    "hold": (float, 0.1, "weight of the terminal cost along the horizon [1/s]; default 0.1"),
    "horizon": (float, None, "duration of a plan [s]; default the problem's"),
    "duration": (float, None, "duration of a run [s]; default the horizon and 8 more"),
    "runs": (at_least_1, 10, "number of runs; default 10"),
    "pushes": (int, 2, "number of pushes in every run; default 2"),
    "push": (float, 1.0, "velocity that a push gives to the body it pushes [m/s]; default 1"),
    "mass": (float, 1.0, "factor on the masses of the simulated model; default 1"),
    "noise": (float, 0.0, "standard deviation of measured states; default 0"),
    "shaking": (
        float,
        0.0,
        "standard deviation of random changes of velocities in a second; default 0",
    ),
    "seed": (int, 0, "of the random numbers; default 0"),
}
"""Type, default and help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The problem, numbers, and what to write."""
    add_problem(parser)
    for name, (kind, default, words) in NUMBERS.items():
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=words)
    parser.add_argument(
        "--async",
        dest="realtime",
        action="store_true",
        help="the simulation runs in real time and applies the newest plan",
    )
    parser.add_argument("--video", action="store_true", help="film the first run: mpc.mp4")
    pictures.add_look(parser)
    parser.add_argument("--out", metavar="DIR", help="default out/mpc_TASK")
    parser.add_argument("--json", action="store_true", help="print mpc.json, and nothing else")


def run(options: argparse.Namespace) -> int:
    """Drive the model, and report; what cannot work is refused before anything compiles."""
    require_known(options)
    from mjx_drax.control import trials as runs
    from mjx_drax.control.mpc import MPC
    from mjx_drax.control.plant import Plant
    from mjx_drax.solution.files.save import writable
    from mjx_drax.view.video import check as require_drawing

    given = asked(options)
    problem = given.problem
    names = ("chains", "explorers", "iterations", "every", "hold", "seed")
    numbers = {name: getattr(options, name) for name in names}
    policy = MPC(problem, solver=given.solver, **numbers)
    usual = float(problem.times[-1]) + 8.0
    duration = usual if options.duration is None else options.duration
    require_not_negative("push", options.push)
    trials = runs.Trials(policy, duration, options.realtime)
    trials.check(options.runs, options.pushes)
    errors = {name: getattr(options, name) for name in ("mass", "noise", "shaking")}
    Plant(problem, **errors)  # refuses numbers that make no sense
    look = pictures.look_of(options)
    if look or options.video:
        require_drawing(problem, **pictures.without_caption(look))
    folder = writable(options.out or Path("out") / f"mpc_{problem.name}", file="mpc.json")
    tell = say_nothing if options.json else say
    tell(f"{problem.name}: K = {problem.horizon} knots, {options.chains} chains; compiling ...")
    policy.reset(problem.x_init)
    tell(f"first solve and compilation took {policy.first_solve:.1f} s")

    def report(number: int, motion: runs.Motion) -> None:
        verdict = {True: "ends in the goal", False: "misses the goal", None: "done"}
        tell(f"run {number}: {verdict[motion.reached]} after {len(motion.pushes)} pushes")

    trials.run(options.runs, options.pushes, options.push, options.seed, report, **errors)
    summary = {**trials.summary(), "push": options.push, "hold": options.hold, **errors}
    written = [write_json(folder / "mpc.json", summary).name]
    if options.video:
        film = runs.film(problem, trials.motions[0], folder / "mpc.mp4", **look)
        written.append(film.name)
    for line in runs.lines(summary):
        tell(line)
    tell(f"written to {folder}/: {', '.join(written)}")
    if options.json:
        print((folder / "mpc.json").read_text(encoding="utf-8"), end="", flush=True)
    return 0 if summary["success_rate"] in (None, 1.0) else 1

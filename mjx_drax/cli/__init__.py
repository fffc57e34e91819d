"""The command `mjx-drax`. Heavy modules are imported where they are needed: --help is instant."""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_drax.base.errors import DraxError, reason, require_not_negative

if TYPE_CHECKING:
    from types import ModuleType

    from tqdm import tqdm

    from mjx_drax.method.langevin import Info, Langevin
    from mjx_drax.problem.problem import Problem
    from mjx_drax.search.restarts import Restarts
    from mjx_drax.solution.solution import Solution

COST_FILE = """\
A cost file is Python. It defines at least one of
  running_cost(data, u), terminal_cost(data)           scalars
  running_residual(data, u), terminal_residual(data)   vectors: adds half the squared norm
on mjx.Data (qpos, qvel, site_xpos, sensordata, ...), and may define
  goal(data) -> bool       what a replay in MuJoCo must reach
  equality(data, u), terminal_equality(data)       vectors held at 0
  inequality(data, u), terminal_inequality(data)   vectors held <= 0
  horizon, dt              [s]
  x_init                   [qpos, qvel, act]
  x_bounds, u_bounds       (lower, upper)
  x_scatter, u_scatter     (lower, upper): where initial knots are drawn
  guess(key) -> Trajectory initial knots of one chain
  contacts                 how many contact points the plan keeps, the nearest ones; False: none
  derivatives              of the dynamics: mjx_drax.Smoothed(); default exact
  solver                   a mjx_drax.Restarts or mjx_drax.Langevin
"""
_PROBLEM_NAMES = (
    "running_cost",
    "terminal_cost",
    "running_residual",
    "terminal_residual",
    "equality",
    "inequality",
    "terminal_equality",
    "terminal_inequality",
    "goal",
    "horizon",
    "dt",
    "x_init",
    "x_bounds",
    "u_bounds",
    "x_scatter",
    "u_scatter",
    "guess",
    "contacts",
    "derivatives",
)

if TYPE_CHECKING:
    Asked = tuple[Problem, Langevin | Restarts, int, Callable[..., Any] | None]

EXPORTS = {
    "html": ("replay.html", 'the replay for any browser, one file; pip install "mjx-drax[html]"'),
    "csv": ("replay.csv", "times, states and controls of the replay as a table"),
    "keyframes": ("keyframes.xml", "the model with the replay as keyframes, for MuJoCo's viewers"),
    "dataset": ("dataset.h5", 'all certified chains as HDF5; pip install "mjx-drax[dataset]"'),
}
"""Files that are written if asked for: flags, names and what they hold."""

PICTURES = ("plot.png", "multipliers.png", "phase.png", "optima.png")
MOTIONS = ("video.mp4", "timelapse.png", "film.mp4")

OPTIMA = 5
"""So many distinct optima are printed."""

SUITES = ("cpu", "gpu", "devices", "peers")
from mjx_drax.studies.reproduce import NAMES as REPRODUCIBLE  # noqa: E402


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; the exit status is 0 if it did what was asked for, 1 or 2 if not."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
        sys.stdout.flush()
        return status
    except DraxError as error:
        print(f"mjx-drax: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mjx-drax: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # who reads, such as head, has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mjx-drax",
        description="Trajectories for MuJoCo models by equality-constrained diffusion.",
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    listing = commands.add_parser("list", help="list the tasks")
    listing.set_defaults(run=_list)

    checking = commands.add_parser(
        "check",
        help="what becomes of a model of your own, and whether MJX computes it as MuJoCo does",
        description="Say what becomes of a model's joints, actuators and contacts, and how far one "
        "step of MJX and its derivatives are from MuJoCo's C engine. The exit status is 0 if the "
        "model can be used.",
    )
    checking.add_argument("model", metavar="XML", help="MJCF file")
    checking.add_argument("--json", action="store_true", help="the same as JSON")
    checking.set_defaults(run=_check)

    solving = commands.add_parser(
        "solve",
        help="solve a task, or a model and cost of your own",
        description="Solve a task, or a model and cost of your own; replay it; film it.",
        epilog=COST_FILE + "\nThe exit status is 0 only if the best trajectory is certified.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    solving.add_argument("task", nargs="?", help="a name from `mjx-drax list`")
    solving.add_argument("--model", metavar="XML", help="MJCF file of your own, with --cost")
    solving.add_argument("--cost", metavar="PY", help="Python file with the cost (see below)")
    solving.add_argument("--chains", type=_positive, metavar="N", help="number of chains")
    solving.add_argument(
        "--iterations",
        type=_positive,
        metavar="K",
        help="iterations with noise of an attempt; those without keep their share",
    )
    solving.add_argument("--seed", type=int, default=0, metavar="S", help="default 0")
    solving.add_argument("--horizon", type=float, metavar="SECONDS", help="duration of the motion")
    solving.add_argument("--out", metavar="DIR", help="default out/TASK")
    solving.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="written every half minute; where it is there, the solve goes on from it",
    )
    solving.add_argument(
        "--no-video", action="store_true", help="leave out video.mp4 and timelapse.png"
    )
    solving.add_argument(
        "--film",
        nargs="?",
        const="",
        metavar="FILE",
        help="also film how the knots condense into the motion: .mp4, .gif or .webp; "
        "default DIR/film.mp4",
    )
    solving.add_argument(
        "--camera",
        metavar="NAME",
        help="a camera of the model, or free: one that frames the whole motion",
    )
    solving.add_argument(
        "--size", type=_size, metavar="WIDTHxHEIGHT", help="of videos and films [pixels]"
    )
    solving.add_argument("--fps", type=float, metavar="N", help="frames per second")
    solving.add_argument(
        "--speed", type=float, metavar="S", help="of the motion; 0.5 is slow motion"
    )
    _add_exports(solving)
    solving.add_argument(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the solver, as in attempts=3, flow.tail=100 or "
        "flow.noise=Geometric(3,0.001); again for more; a wrong name lists them all",
    )
    solving.add_argument("--quiet", action="store_true", help="print nothing but errors")
    solving.add_argument(
        "--json", action="store_true", help="print result.json, and nothing else, to stdout"
    )
    solving.set_defaults(run=_solve)

    _add_mpc(commands)

    exporting = commands.add_parser(
        "export",
        help="more files from a result that `solve` has written",
        description="Write more files into a folder that `mjx-drax solve` or Solution.save wrote.",
    )
    exporting.add_argument("folder", metavar="DIR", help="such as out/cartpole_swingup")
    _add_exports(exporting)
    exporting.set_defaults(run=_export)

    measuring = commands.add_parser(
        "benchmark",
        help="measure success and time, alone or beside other methods",
        description="Solve tasks for several seeds; print a table; write benchmark.json (a list of "
        "rows) and benchmark.png (success against time). cpu: every task, and one pendulum on one "
        "thread beside IPOPT. gpu: more chains, and 16,384 random pendulums. devices: one solve on "
        "1, 2, 4, ... devices. peers: ablations, "
        'IPOPT, MPPI, CEM and model-based diffusion; IPOPT needs pip install "mjx-drax[peers]".',
    )
    measuring.add_argument("tasks", nargs="*", metavar="TASK", help="default: all of them")
    measuring.add_argument(
        "--suite", choices=SUITES, help="default: this solver alone, as each task sets it"
    )
    measuring.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], metavar="S")
    measuring.add_argument(
        "--chains", type=_positive, metavar="N", help="default: each task's, or the suite's"
    )
    measuring.add_argument("--out", metavar="DIR", default="out/benchmark")
    measuring.set_defaults(run=_benchmark)

    reproducing = commands.add_parser(
        "reproduce",
        help="a figure or table of the paper",
        description="Redo a figure or table of the paper: writes NAME.png and NAME.json.",
    )
    reproducing.add_argument(
        "name", metavar="NAME", choices=REPRODUCIBLE, help=", ".join(REPRODUCIBLE)
    )
    reproducing.add_argument("--out", metavar="DIR", default="out/reproduce")
    reproducing.add_argument(
        "--chains", type=_positive, metavar="N", help="number of chains; at most so many problems"
    )
    reproducing.add_argument(
        "--iterations", type=_positive, metavar="K", help="instead of the published or usual number"
    )
    reproducing.set_defaults(run=_reproduce)
    return parser


def _add_mpc(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "mpc",
        help="model predictive control: plan again and again while MuJoCo's C engine runs",
        description="Drive a task's model by model predictive control, several times, with random "
        "pushes; print plans per second, latency, cost and the share of runs that end in the goal; "
        "write mpc.json. The exit status is 0 if all do.",
    )
    parser.add_argument("task", help="a name from `mjx-drax list`")
    numbers: dict[str, tuple[Any, Any, str]] = {
        "chains": (_positive, 8, "number of chains; default 8"),
        "explorers": (int, None, "how many of them explore; default half"),
        "iterations": (_positive, 2, "of every chain for a plan; default 2"),
        "every": (_positive, 1, "control steps between two plans; default 1"),
        "hold": (float, 0.1, "weight of the terminal cost along the horizon [1/s]; default 0.1"),
        "horizon": (float, None, "of a plan [s]; default the task's"),
        "duration": (float, None, "of a run [s]; default the horizon and 8 more"),
        "runs": (_positive, 10, "default 10"),
        "pushes": (int, 2, "in every run; default 2"),
        "push": (float, 1.0, "size of a push, as a velocity of the body pushed [m/s]; default 1"),
        "mass": (float, 1.0, "factor on the plant's masses; default 1"),
        "noise": (float, 0.0, "standard deviation of measured states; default 0"),
        "shaking": (float, 0.0, "random changes of velocities in a second; default 0"),
        "seed": (int, 0, "default 0"),
    }
    for name, (kind, default, words) in numbers.items():
        parser.add_argument(f"--{name}", type=kind, default=default, metavar="N", help=words)
    parser.add_argument(
        "--async",
        dest="realtime",
        action="store_true",
        help="the simulation runs in real time and applies the newest plan",
    )
    parser.add_argument("--video", action="store_true", help="film the first run: mpc.mp4")
    parser.add_argument("--out", metavar="DIR", help="default out/mpc_TASK")
    parser.add_argument("--json", action="store_true", help="print mpc.json, and nothing else")
    parser.set_defaults(run=_mpc)


def _add_exports(parser: argparse.ArgumentParser) -> None:
    for name, (file, what) in EXPORTS.items():
        parser.add_argument(f"--{name}", action="store_true", help=f"write {file}: {what}")


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number of at least 1")
    return int(text)


def _size(text: str) -> tuple[int, int]:
    """WIDTHxHEIGHT as (height, width)."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r}: give WIDTHxHEIGHT, such as 640x480")
    return int(height), int(width)


def _list(options: argparse.Namespace) -> int:
    from mjx_drax import tasks

    width = max(map(len, tasks.names()))
    for name in tasks.names():
        print(f"{name:{width}}  {tasks.summary(name)}")
    return 0


def _check(options: argparse.Namespace) -> int:
    import json

    from mjx_drax.physics import check

    _cache_compilations()

    def progress(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    report = check.check(options.model, progress)
    say(json.dumps(report, indent=1) if options.json else check.text(report))
    return 0 if report["obstacle"] is None else 1


def _solve(options: argparse.Namespace) -> int:
    problem, solver, chains, draw = (
        _own_problem(options) if options.task is None else _task(options)
    )
    from mjx_drax.search import settings
    from mjx_drax.search.restarts import as_restarts, with_iterations
    from mjx_drax.solution import save as results
    from mjx_drax.solution.solution import solve

    if options.iterations is not None:
        solver = with_iterations(solver, options.iterations)
    for name, value in map(_assignment, options.settings):
        solver = settings.changed(solver, name, value)
    chains = options.chains or chains
    as_restarts(problem, chains, options.seed, solver)  # complains now
    exports = _exports(options)
    _require_exports(problem, exports)
    room = results.expected_size(problem, chains)
    folder = results.writable(options.out or Path("out") / problem.name, room)
    look = {n: getattr(options, n) for n in ("camera", "size", "fps", "speed")}
    look = {name: value for name, value in look.items() if value is not None}
    film = _film(options, folder, problem, draw, look)
    _cache_compilations()
    tell = _silent if options.quiet or options.json else say

    if options.checkpoint is not None and Path(options.checkpoint).expanduser().exists():
        tell(f"going on from {options.checkpoint}")
    tell(f"{problem.name}: K = {problem.horizon} knots, {chains} chains; compiling ...")
    with _Bar() as bar:
        solution = solve(
            problem,
            chains,
            options.seed,
            solver,
            progress=None if options.quiet else bar,
            record=1 if film else None,
            checkpoint=options.checkpoint,
        )
    results.save(solution, folder)
    written = ["result.json", "result.npz", *_pictures(solution, folder, draw)]
    if not options.no_video:
        written += _video(solution, folder, draw, look)
    if film is not None:
        from mjx_drax.view.film import render_diffusion

        render_diffusion(solution, film, draw=draw, **look)
    written += _write_exports(solution, folder, exports, tell)
    for line in _report(solution):
        tell(line)
    tell(f"written to {folder}/: {', '.join(written)}")
    if film is not None:
        tell(f"film written to {film}")
        written += [film.name] * (film.resolve().parent == folder.resolve())
    older = _older(folder, written)
    if older:
        tell(f"there from an earlier solve: {', '.join(older)}")
    if options.json and not options.quiet:
        print((folder / results.SUMMARY).read_text(encoding="utf-8"), end="", flush=True)
    return 0 if solution.certified else 1


def _older(folder: Path, written: Sequence[str]) -> list[str]:
    """Names of a solve's files in the folder that this one has not written."""
    names = [*PICTURES, *MOTIONS, *(file for file, _ in EXPORTS.values())]
    return [name for name in names if name not in written and (folder / name).exists()]


def _mpc(options: argparse.Namespace) -> int:
    from mjx_drax import tasks
    from mjx_drax.control import trials as loop
    from mjx_drax.control.mpc import MPC
    from mjx_drax.control.plant import Plant
    from mjx_drax.solution import save as results
    from mjx_drax.view import rendering

    problem = _made(tasks.load(options.task), options.horizon)
    names = ("chains", "explorers", "iterations", "every", "hold", "seed")
    policy = MPC(problem, **{name: getattr(options, name) for name in names})
    usual = float(problem.times[-1]) + 8.0
    duration = usual if options.duration is None else options.duration
    require_not_negative("push", options.push)
    trials = loop.Trials(policy, duration, options.realtime)
    trials.check(options.runs, options.pushes)
    errors = {name: getattr(options, name) for name in ("mass", "noise", "shaking")}
    Plant(problem, **errors)  # complains now
    if options.video:
        rendering.check(problem)
    folder = results.writable(options.out or Path("out") / f"mpc_{problem.name}")
    tell = _silent if options.json else say
    _cache_compilations()
    tell(f"{problem.name}: K = {problem.horizon} knots, {options.chains} chains; compiling ...")
    policy.reset(problem.x_init)
    tell(f"first solve and compilation took {policy.first_solve:.1f} s")

    def report(run: int, motion: loop.Motion) -> None:
        verdict = {True: "ends in the goal", False: "misses the goal", None: "done"}
        tell(f"run {run}: {verdict[motion.reached]} after {len(motion.pushes)} pushes")

    trials.run(options.runs, options.pushes, options.push, options.seed, report, **errors)
    numbers = {**trials.summary(), "push": options.push, "hold": options.hold, **errors}
    written = [loop.save(numbers, folder).name]
    if options.video:
        written.append(loop.film(problem, trials.motions[0], folder / "mpc.mp4").name)
    for line in loop.lines(numbers):
        tell(line)
    tell(f"written to {folder}/: {', '.join(written)}")
    if options.json:
        print((folder / "mpc.json").read_text(encoding="utf-8"), end="", flush=True)
    return 0 if numbers["success_rate"] in (None, 1.0) else 1


def _film(
    options: argparse.Namespace, folder: Path, problem: Problem, draw: Any, look: dict[str, Any]
) -> Path | None:
    """Where the film goes, if one is asked for; what cannot be filmed is refused before solving."""
    from mjx_drax.base.files import require_room
    from mjx_drax.view import rendering
    from mjx_drax.view import video as movie

    if options.film is not None or look:
        rendering.check(problem, draw=draw, **look)
    if options.film is None:
        return None
    film = movie.film_path(options.film or folder / "film.mp4")
    require_room(film)
    return film


def _pictures(solution: Solution, folder: Path, draw: Any) -> list[str]:
    """Plots of a solution; returns the files' names."""
    from mjx_drax.view.plotting import plot_optima, plot_solution
    from mjx_drax.view.portraits import has_phases, plot_multipliers, plot_phase

    plot_solution(solution, folder / "plot.png", draw=draw)
    plot_multipliers(solution, folder / "multipliers.png")
    written = ["plot.png", "multipliers.png"]
    if has_phases(solution.problem.dynamics):
        plot_phase(solution, folder / "phase.png")
        written.append("phase.png")
    if len(solution.optima) > 1:
        plot_optima(solution, folder / "optima.png", draw=draw)
        written.append("optima.png")
    return written


def _video(solution: Solution, folder: Path, draw: Any, look: dict[str, Any]) -> list[str]:
    """The motion as a video, and in one picture; returns the files' names."""
    from mjx_drax.view.rendering import render

    has_model = hasattr(solution.problem.dynamics, "mj_model")
    if not has_model and draw is None:
        return []
    render(solution, folder / "video.mp4", draw=draw, **look)
    if not has_model:
        return ["video.mp4"]
    from mjx_drax.view.timelapse import render_timelapse

    still = {name: look[name] for name in ("camera", "size") if name in look}
    render_timelapse(solution, folder / "timelapse.png", **still)
    return ["video.mp4", "timelapse.png"]


def _assignment(text: str) -> tuple[str, str]:
    """NAME=VALUE in two."""
    name, equals, value = text.partition("=")
    if not (name.strip() and equals and value.strip()):
        raise DraxError(f"--set {text!r}: give NAME=VALUE, such as attempts=3.")
    return name.strip(), value.strip()


def _export(options: argparse.Namespace) -> int:
    exports = _exports(options)
    if not exports:
        flags = ", ".join(f"--{name}" for name in EXPORTS)
        raise DraxError(f"nothing to write: give at least one of {flags}.")
    from mjx_drax.solution import save as results
    from mjx_drax.solution.solution import Solution

    solution = Solution.load(options.folder)
    _require_exports(solution.problem, exports)
    folder = results.writable(options.folder)
    written = _write_exports(solution, folder, exports, say)
    say(f"written to {folder}/: {', '.join(written)}")
    return 0


def _exports(options: argparse.Namespace) -> list[str]:
    """Names of the files that are asked for."""
    return [name for name in EXPORTS if getattr(options, name)]


def _require_exports(problem: Problem, exports: list[str]) -> None:
    """Complain now about what could not be written later."""
    from mjx_drax.base import files
    from mjx_drax.solution import export
    from mjx_drax.view import browser

    checks: dict[str, Callable[[], None]] = {
        "html": lambda: browser.require_viewer(problem),
        "keyframes": lambda: export.require_mjcf(problem),
        "dataset": lambda: files.require("h5py", "dataset", "a dataset"),
    }
    for name in exports:
        checks.get(name, lambda: None)()


def _write_exports(
    solution: Solution, folder: Path, exports: list[str], tell: Callable[[str], None]
) -> list[str]:
    """Write the files that are asked for; returns their names."""
    from mjx_drax.solution import export
    from mjx_drax.view import browser

    writers: dict[str, Callable[[Solution, Path], Path]] = {
        "html": browser.save_html,
        "csv": export.save_csv,
        "keyframes": export.export_keyframes,
        "dataset": export.save_dataset,
    }
    written = []
    for name in exports:
        if name == "dataset" and not solution.certified_chains.any():
            tell("no chain is certified: dataset.h5 is left out")
            continue
        writers[name](solution, folder / EXPORTS[name][0])
        written.append(EXPORTS[name][0])
    return written


def _benchmark(options: argparse.Namespace) -> int:
    from mjx_drax import tasks
    from mjx_drax.solution import save as results

    for name in options.tasks:
        tasks.load(name)
    folder = results.writable(options.out)
    from mjx_drax.studies import benchmark

    say(benchmark.HEADER)
    rows = benchmark.run(
        options.tasks,
        options.seeds,
        options.chains,
        options.suite,
        report=lambda row: say(benchmark.line(row)),
    )
    if options.suite in ("cpu", "gpu") and not benchmark.has_casadi():
        say('IPOPT is left out: it needs pip install "mjx-drax[peers]".')
    say(f"written to {', '.join(map(str, benchmark.save(rows, folder)))}")
    return 0 if benchmark.certified(rows) else 1


def _reproduce(options: argparse.Namespace) -> int:
    from mjx_drax.studies import reproduce

    _cache_compilations()
    numbers = reproduce.run(options.name, options.out, options.chains, options.iterations)
    from mjx_drax.studies.reproduce.output import table

    say(table(numbers))
    say(f"written to {options.out}/: {options.name}.png, {options.name}.json")
    return 0


def _task(options: argparse.Namespace) -> Asked:
    """Problem, settings, number of chains and drawing function of a named task."""
    from mjx_drax import Restarts, tasks

    if options.model or options.cost:
        raise DraxError(
            f"both the task {options.task!r} and --model or --cost are given: choose one."
        )
    task = tasks.load(options.task)
    problem = _made(task, options.horizon)
    return problem, Restarts(), getattr(task, "CHAINS", 64), getattr(task, "draw", None)


def _made(task: ModuleType, horizon: float | None) -> Problem:
    """A task's problem, over its own horizon or one of so many seconds."""
    problem: Problem = task.make() if horizon is None else task.make(horizon=horizon)
    return problem


def _own_problem(options: argparse.Namespace) -> Asked:
    """The same for the user's own model and cost file."""
    if not (options.model and options.cost):
        raise DraxError("give a task (see `mjx-drax list`), or both --model XML and --cost PY.")
    from mjx_drax import Langevin, Restarts, from_mjcf

    module = _load_cost_file(Path(options.cost))
    given = {n: getattr(module, n) for n in _PROBLEM_NAMES if hasattr(module, n)}
    if options.horizon is not None:
        given["horizon"] = options.horizon
    if "horizon" not in given:
        raise DraxError(f"no horizon: define it in {options.cost} or give --horizon SECONDS.")
    problem = from_mjcf(options.model, name=Path(options.model).stem, **given)
    solver = getattr(module, "solver", None) or Restarts()
    if not isinstance(solver, Langevin | Restarts):
        raise DraxError(f"solver in {options.cost} is {solver!r}: give a mjx_drax.Restarts.")
    return problem, solver, 64, None


def _load_cost_file(path: Path) -> Any:
    """The cost file as a module; files beside it can be imported by it."""
    if not path.is_file():
        raise DraxError(f"there is no cost file {str(path)!r}: check the path.")
    spec = importlib.util.spec_from_file_location("mjx_drax_cost", path)
    if spec is None or spec.loader is None:
        raise DraxError(
            f"the cost file {str(path)!r} is not a Python file: its name must end in .py."
        )
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise DraxError(
            f"the cost file {str(path)!r} failed: {reason(error)}. Correct it there."
        ) from error
    finally:
        sys.path.pop(0)
    return module


def _cache_compilations() -> None:
    """Keep compiled programs between runs, so that a second run starts at once."""
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "mjx_drax" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # dozens of small ones


class _Bar:
    """A progress bar with the two numbers that matter: best feasible cost, share feasible."""

    _FORMAT = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}{postfix}]"

    def __init__(self) -> None:
        self._bar: tqdm | None = None
        self._best = float("inf")

    def __enter__(self) -> _Bar:
        return self

    def __call__(self, done: int, total: int, info: Info) -> None:
        import numpy as np
        from tqdm import tqdm

        from mjx_drax.method.langevin import FEASIBLE

        if self._bar is None:  # only now: before, it would count compilation as progress
            self._bar = tqdm(total=total, initial=done, file=sys.stderr, bar_format=self._FORMAT)
        feasible = np.asarray(info.max_defect) < FEASIBLE
        self._best = np.asarray(info.cost)[feasible].min(initial=self._best)
        numbers = f"best cost {self._best:.4g}, feasible {feasible.mean():.0%}"
        self._bar.set_postfix_str(numbers, False)
        self._bar.update(done - self._bar.n)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.total = self._bar.n  # fewer iterations than expected were enough
            self._bar.refresh()
            self._bar.close()


def _report(solution: Solution) -> list[str]:
    """The summary for a person, by lines."""
    from mjx_drax.solution.solution import OPEN_LOOP, WITH_FEEDBACK

    best, status = solution.best_chain, solution.status
    counts = ", ".join(f"{status.count(name)} {name}" for name in sorted(set(status)))
    rate = f"{solution.success_rate:.1%} succeed when replayed"
    times = f"compile {solution.compile_time:.1f} s, solve {solution.solve_time:.1f} s"
    return [
        f"chains         {solution.chains}: {counts}; {rate}",
        f"best           cost {solution.cost[best]:.5g}, max|h| {solution.max_defect[best]:.1e}, "
        f"bound violation {solution.max_violation[best]:.1e}",
        *(f"{mode:14} {solution.outcome(mode)}" for mode in (OPEN_LOOP, WITH_FEEDBACK)),
        *_optima(solution),
        f"engine         {solution.certificate.engine}",
        f"time           {times}",
        "CERTIFIED" if solution.certified else "NOT CERTIFIED: " + _advice(solution),
    ]


def _optima(solution: Solution) -> list[str]:
    """The cheapest of the distinct optima as a table, by lines; none if no chain is certified."""
    found = solution.optima
    if len(found) < 2:
        return ["optima         one: certified chains agree on the motion"] if found else []
    words = ("misses goal", "reaches goal")
    if solution.problem.goal is None:
        words = ("leaves plan", "keeps to plan")
    lines = [f"optima         rank {'cost':>9}  chains  {'open loop':13}  with feedback"]
    for rank, optimum in enumerate(found[:OPTIMA], 1):
        replays = optimum.certificate.open_loop, optimum.certificate.feedback
        open_loop, feedback = (words[replay["success"]] for replay in replays)
        lines.append(
            f"{rank:19} {optimum.cost:9.5g}  {optimum.share:6.1%}  {open_loop:13}  {feedback}"
        )
    if len(found) > OPTIMA:
        lines.append(f"{'':14} and {len(found) - OPTIMA} more")
    return lines


def _advice(solution: Solution) -> str:
    """What to try when no chain could be certified."""
    if not solution.feasible.any():
        return "no chain satisfies the dynamics. Try more --iterations, or a longer --horizon."
    return (
        "feasible chains miss the goal when replayed. Try more --chains, a higher weight on the "
        "terminal cost, or a longer --horizon."
    )


def _silent(line: str) -> None:
    """Keep a line from the user."""


def say(line: str) -> None:
    """One line for the user, at once."""
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())

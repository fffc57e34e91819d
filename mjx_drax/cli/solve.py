"""Solve a task, or a model and cost of your own; replay the answer and film it.

The exit status is 0 only if the best trajectory is certified: its replay reaches the goal and keeps
all bounds and constraints. It is also optimal if its residual is below a tolerance.

"""

from __future__ import annotations

import argparse
from contextlib import ExitStack, suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_drax.base.errors import DraxError
from mjx_drax.cli import cost_file, export, pictures
from mjx_drax.cli.common import at_least_1, say, say_aside, say_nothing
from mjx_drax.cli.problem import Asked, add_problem, asked, require_known

if TYPE_CHECKING:
    from mjx_drax.solution.violations import Tolerances

__doc__ += cost_file.HELP


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to solve, how, and what to write."""
    add = parser.add_argument
    add_problem(parser)
    add(
        "--chains",
        type=at_least_1,
        metavar="N",
        help="runs of the method, side by side; default 64 or the task's",
    )
    add(
        "--iterations",
        type=at_least_1,
        metavar="N",
        help="iterations with noise of an attempt; those of the first attempt and of the tail "
        "change in proportion, those of the polish do not",
    )
    add("--seed", type=int, default=0, metavar="S", help="of the random numbers; default 0")
    add("--horizon", type=float, metavar="SECONDS", help="duration of the motion")
    add("--out", metavar="DIR", help="default out/TASK")
    add(
        "--checkpoint",
        metavar="FILE",
        help="save the state of the solve every half minute; if the file exists, go on from it",
    )
    add("--no-video", action="store_true", help="leave out videos and timelapse.png")
    add(
        "--film",
        nargs="?",
        const="",
        metavar="FILE",
        help="also film how the knots of all chains become a motion: .mp4, .gif or .webp; "
        "default DIR/film.mp4",
    )
    pictures.add_look(parser)
    add(
        "--side-by-side",
        action="store_true",
        help="also film plan and replay beside each other, of a model: comparison.mp4",
    )
    add(
        "--live",
        nargs="?",
        type=int,
        const=8080,
        metavar="PORT",
        help="show the knots in a browser while the solve runs, then the answer until Ctrl-C; "
        'default port 8080; needs pip install "mjx-drax[view]"',
    )
    export.add_flags(parser)
    add(
        "--set",
        dest="settings",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the solver, as in attempts=3, flow.tail=100 or "
        "flow.noise=Geometric(3,0.001); may be repeated; a wrong name lists all settings",
    )
    add(
        "--tolerance",
        dest="tolerances",
        action="append",
        default=[],
        metavar="KIND=VALUE",
        help="how large a violation of a replay may be, in your units: inequality=0.01 or "
        "state_bounds=1e-3,1e-2; relative=0.005 is for all other kinds, a share of a scale that is "
        "measured; may be repeated; a wrong name lists all kinds",
    )
    add(
        "--residual",
        type=float,
        metavar="R",
        help="a chain with a smaller residual is optimal and stops (Python: tolerance=); "
        "default 1e-4, in float64 1e-8",
    )
    add(
        "--max-iterations",
        type=at_least_1,
        metavar="N",
        help="most iterations of the polish, Newton steps at the end, in an attempt; default 200, "
        "and up to 1,000 in the end, until a chain at the best cost has converged or stalled",
    )
    add(
        "--max-seconds",
        type=float,
        metavar="S",
        help="end the solve after so many seconds, without compilation, and keep what there is",
    )
    add(
        "--precision",
        type=int,
        choices=(32, 64),
        help="bits of numbers: 64 makes and solves the problem in float64; default 32",
    )
    add(
        "--log",
        action="store_true",
        help="also print cost, max|h| and residual by iteration, which plot.png draws, and the "
        "worst violations by name and knot",
    )
    add("--quiet", action="store_true", help="no report and no bar; errors, and what --json prints")
    add("--json", action="store_true", help="print result.json, and nothing else, to stdout")


def run(options: argparse.Namespace) -> int:
    """Solve, save and draw; what cannot work is refused before anything compiles."""
    require_known(options)
    import jax

    with ExitStack() as stack:
        if options.precision == 64:
            stack.enter_context(jax.enable_x64(True))
        return _run(options, stack)


def _run(options: argparse.Namespace, stack: ExitStack) -> int:
    """The same, in the precision that JAX has now; `stack` closes what it opens."""
    problem, solver, chains, draw = _asked(options)
    from mjx_drax.search.restarts import settled
    from mjx_drax.solution.files import save as results
    from mjx_drax.solution.solve import solve
    from mjx_drax.view.video import check as require_drawing

    ends = {
        "tolerance": options.residual,
        "max_iterations": options.max_iterations,
        "max_seconds": options.max_seconds,
    }
    settled(problem, chains, options.seed, solver, **ends)  # refuses what cannot work
    tolerances = _tolerances(options.tolerances)
    tolerances.of(problem)
    wanted = export.chosen(options)
    for each in wanted:
        each.check(problem)
    room = results.expected_size(problem, chains)
    folder = results.writable(options.out or Path("out") / problem.name, room)
    look = pictures.look_of(options)
    if look or options.film is not None or options.side_by_side:
        seen = pictures.without_caption(look)
        require_drawing(problem, draw=draw, compared=options.side_by_side, **seen)
    film = None if options.film is None else pictures.film_path(options.film, folder)
    tell = say_nothing if options.quiet or options.json else say
    record: Any = 1 if film else None
    if options.live is not None:
        from mjx_drax.view.browser.viewer import live_page

        page = live_page(problem, port=options.live, every=record or 5, told=say_aside)
        record = stack.enter_context(page)

    if options.checkpoint is not None and Path(options.checkpoint).expanduser().exists():
        tell(f"going on from {options.checkpoint}")
    tell(f"{problem.name}: K = {problem.horizon} knots, {chains} chains")
    solution = solve(
        problem,
        chains,
        options.seed,
        solver,
        progress=False if options.quiet else None,
        record=record,
        checkpoint=options.checkpoint,
        tolerances=tolerances,
        **ends,
        precision=options.precision,
    )
    results.save(solution, folder)
    written = ["result.json", "result.npz", *pictures.write_plots(solution, folder, draw)]
    if not options.no_video:
        written += pictures.write_video(solution, folder, draw, look)
    if options.side_by_side:
        from mjx_drax.view.video import render_comparison

        written.append(render_comparison(solution, folder / "comparison.mp4", **look).name)
    if film is not None:
        from mjx_drax.view.diffusion import render_diffusion

        render_diffusion(solution, film, draw=draw, **look)
    written += export.write(solution, folder, wanted, tell)
    if options.log:
        tell(solution.log())
        tell(solution.worst())
    tell(str(solution))
    tell(f"written to {folder}/: {', '.join(written)}")
    if film is not None:
        tell(f"film written to {film}")
        written += [film.name] * (film.resolve().parent == folder.resolve())
    names = (*pictures.NAMES, *(each.file for each in export.exporters().values()))
    older = [name for name in names if name not in written and (folder / name).exists()]
    if older:
        tell(f"there from an earlier solve: {', '.join(older)}")
    if options.json:
        print((folder / results.SUMMARY).read_text(encoding="utf-8"), end="", flush=True)
    if options.live is not None:
        tell("the page shows the answer; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            record.play(solution)
    return 0 if solution.certified else 1


def _tolerances(texts: list[str]) -> Tolerances:
    """The tolerances that KIND=VALUE says, the default ones for other kinds."""
    from mjx_drax.solution.violations import Tolerances

    given = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        known = [field.name for field in fields(Tolerances)]
        if not equals or name not in known:
            raise DraxError(
                f"--tolerance {text!r}: give KIND=VALUE, KIND one of {', '.join(known)}."
            )
        try:
            numbers = [float(number) for number in value.split(",")]
        except ValueError as error:
            raise DraxError(
                f"--tolerance {text!r}: give a number, or one for each entry as in 1e-3,1e-2."
            ) from error
        given[name] = numbers[0] if len(numbers) == 1 else numbers
    return Tolerances(**given)  # type: ignore[arg-type]


def _asked(options: argparse.Namespace) -> Asked:
    """What is asked for, with the settings that the options change."""
    from mjx_drax.search import settings

    given = asked(options)
    solver = given.solver
    if options.iterations is not None:
        solver = solver.with_iterations(options.iterations)
    for text in options.settings:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not (name and equals and value):
            raise DraxError(f"--set {text!r}: give NAME=VALUE, such as attempts=3.")
        solver = settings.changed(solver, name, value)
    return given._replace(solver=solver, chains=options.chains or given.chains)

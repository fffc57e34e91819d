"""The paper's figures and table, and answers to its open questions: one file each.

Each has `make`, which returns numbers (`rows` of a table, `settings`, and more) and a figure; sizes
are its arguments. `run` makes one by name and writes both. No number in these files is a result:
there are settings, and the times that the paper published. A chain counts as feasible when
max|h| < 1e-3. A goal counts as reached when the float64 rollout of the chain's controls, open loop,
reaches it.

Modules are imported where they are needed: the command line takes `NAMES` for its help.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

NAMES = {
    "phase-portrait": "figure 2: random knots become a swing-up",
    "convergence": "figure 3: |h|^2 for several penalties",
    "bug-trap": "figure 4: gradient descent, quasi-Newton and diffusion",
    "parallel-table": "table I: many pendulums at once",
    "multipliers": "|h|^2 with and without multipliers",
    "theorem-2": "mu*, stable steps, and the energy of the proof",
    "direct-against-shooting": "pendulums from random states",
    "open-questions": "metrics, annealing, sampled gradients",
}
"""What each shows."""


def run(
    name: str,
    folder: str | os.PathLike[str],
    chains: int | None = None,
    iterations: int | None = None,
    full: bool = False,
) -> dict[str, Any]:
    """Make one of `NAMES`; write NAME.png and NAME.json into a folder, and return its numbers.

    Default sizes take at most some ten minutes on two CPU cores; `full` takes those of the paper.
    """
    from mjx_drax.base.files import write_json
    from mjx_drax.search.settings import to_data
    from mjx_drax.solution.files.save import writable
    from mjx_drax.studies.measurements import machine
    from mjx_drax.view.plotting import save_figure

    target = writable(folder)
    sizes = {"chains": chains, "iterations": iterations}
    given = {key: value for key, value in sizes.items() if value is not None}
    module = import_module(f"{__name__}.{name.replace('-', '_')}")
    whole = getattr(module, "FULL", {}) if full else {}
    numbers, figure = module.make(**{**whole, **given})
    settings = {label: to_data(solver) for label, solver in numbers["settings"].items()}
    numbers = {"name": name, **numbers, "settings": settings, **machine()}
    save_figure(figure, target / f"{name}.png")
    write_json(target / f"{name}.json", numbers)
    return numbers

"""The table of what default settings answer."""

from dataclasses import replace

import numpy as np
from builders import made_up

from mjx_drax import tasks
from mjx_drax.studies import answers


def test_a_row_has_what_its_heading_names():
    solution = made_up(tasks.load("pendulum").make(), chains=2)
    solution = replace(solution, cost=solution.cost + 7.0)  # of the plans, which are not shown
    columns = answers.HEADER.splitlines()[0].count("|")
    row = answers.line(solution)
    assert row.count("|") == columns
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:2] == ["pendulum", "2"]
    assert cells[3] == f"{np.mean(solution.success):.2%}"
    assert float(cells[4]) == np.float32(solution.replay_cost[solution.best_chain])

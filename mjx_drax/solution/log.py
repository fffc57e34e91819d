"""How the chains got there: their numbers at every report, as arrays and as a table to print."""

from __future__ import annotations

import numpy as np

from mjx_drax.search.engine import Found
from mjx_drax.search.iterate import ranking

HEADERS = (
    f"{'':18}  {'best chain':^28}  {'median of chains':^28}".rstrip(),
    f"attempt  iteration  {'cost':>10}  max|h|  residual  {'cost':>10}  max|h|  residual"
    "  feasible  optimal",
)


def history_of(found: Found) -> dict[str, np.ndarray]:
    """What `Results.history` holds."""
    infos = [info for _, info in found.records]
    return {
        "iteration": np.array([done for done, _ in found.records]),
        "cost": np.stack([np.asarray(info.cost) for info in infos]),
        "max_defect": np.stack([np.asarray(info.max_defect) for info in infos]),
        "residual": np.stack([np.asarray(info.residual) for info in infos]),
        "began": np.array([began for began, _ in found.began]),
        "noise_ends": np.array([end for _, end in found.began]),
    }


def residuals(history: dict[str, np.ndarray]) -> np.ndarray:
    """Residuals (records, chains), NaN where there was no polish yet, or none was kept."""
    known = history.get("residual", np.full_like(history["cost"], np.nan))
    return np.where(np.isfinite(known), known, np.nan)


def table(history: dict[str, np.ndarray], tolerance: float) -> str:
    """A line for each report in a `Results.history`.

    The best chain is the cheapest feasible one, or the least infeasible. Medians are over chains
    whose number is finite. Feasible and optimal are numbers of plans, before any replay: max|h|
    below 1e-3, and the residual below the tolerance too. Later attempts are of chains that were
    not done.
    """
    lines = list(HEADERS)
    rows = zip(
        history["iteration"],
        history["cost"],
        history["max_defect"],
        residuals(history),
        strict=True,
    )
    for iteration, cost, defect, residual in rows:
        attempt = max(1, int((history["began"] < iteration).sum()))
        infeasible, value = ranking(cost, defect)
        best = np.lexsort((value, infeasible))[0]
        feasible = ~infeasible
        optimal = feasible & (residual < tolerance)
        lines.append(
            f"{attempt:7}  {iteration:9}  {_numbers(cost[best], defect[best], residual[best])}  "
            f"{_numbers(*map(_median, (cost, defect, residual)))}  "
            f"{feasible.sum():8}  {optimal.sum():7}"
        )
    return "\n".join(lines)


def _median(values: np.ndarray) -> float:
    """Of those that are finite."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else np.nan


def _numbers(cost: float, defect: float, residual: float) -> str:
    """Cost, max|h| and residual; a dash for what is not known."""
    texts = f"{cost:.6g}", f"{defect:.0e}", f"{residual:.1e}"
    known = np.isfinite((cost, defect, residual))
    cells = (t if k else "-" for t, k in zip(texts, known, strict=True))
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, (10, 6, 8), strict=True))

"""Writes docs/api.md from the docstrings: python docs/make_api.py.

tests/test_docs.py fails while the file is not what this gives.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mjx_drax
from mjx_drax import guesses
from mjx_drax.physics import check
from mjx_drax.search import settings
from mjx_drax.solution import optima, program, solution
from mjx_drax.view import plotting, portraits

PAGE = Path(__file__).with_name("api.md")

GROUPS: dict[str, list[Any]] = {
    "Problems": [
        mjx_drax.from_mjcf,
        mjx_drax.from_function,
        mjx_drax.Problem,
        mjx_drax.Trajectory,
        check.check,
    ],
    "Terms": [mjx_drax.Terms],
    "Guesses": [
        guesses.waypoints,
        guesses.keyframes,
        guesses.path,
        guesses.still,
        guesses.spread,
    ],
    "Solving": [mjx_drax.solve, mjx_drax.solve_batch, mjx_drax.Restarts, mjx_drax.Langevin],
    "Model predictive control": [
        mjx_drax.MPC,
        mjx_drax.Background,
        mjx_drax.Plant,
        mjx_drax.Push,
    ],
    "Parts of the solver": [
        mjx_drax.Geometric,
        mjx_drax.Constant,
        mjx_drax.GaussNewton,
        mjx_drax.Diagonal,
        mjx_drax.Identity,
        mjx_drax.LBFGS,
        mjx_drax.LogBarrier,
        mjx_drax.Reflection,
        mjx_drax.Projection,
        mjx_drax.Autodiff,
        mjx_drax.Smoothed,
        settings.names,
        settings.changed,
    ],
    "Solutions": [
        mjx_drax.Solution,
        mjx_drax.BatchSolution,
        solution.Replays,
        solution.Certificate,
        optima.Optimum,
        optima.distinct,
    ],
    "Pictures": [
        mjx_drax.render,
        mjx_drax.render_timelapse,
        mjx_drax.render_diffusion,
        plotting.plot_solution,
        plotting.plot_optima,
        portraits.plot_phase,
        portraits.plot_multipliers,
    ],
    "Export": [
        mjx_drax.save_html,
        mjx_drax.save_csv,
        mjx_drax.export_keyframes,
        mjx_drax.save_dataset,
    ],
    "Nonlinear programs": [mjx_drax.from_program, mjx_drax.minimize, program.Minimum],
    "Errors": [mjx_drax.DraxError],
}
"""What is documented, in this order."""

METHODS: dict[str, str] = {
    "Problem": "times cost defects constraints max_defect with_x_init replay draw",
    "Terms": "posture velocity control sensor site body upright centre_of_mass clearance",
    "Solution": "chains feasible success success_rate status certified certified_chains tracked "
    "best_chain best certificate optima outcome replay_mode replayed save load certify",
    "BatchSolution": "cost max_defect feasible certified replay_modes",
    "MPC": "latest reset rewind plan control due",
    "Plant": "time state measured step",
    "Certificate": "success",
    "Minimum": "best_chain best",
}
"""Methods and properties that users need."""

MADE_FOR_USERS = (
    "Problem",
    "Solution",
    "BatchSolution",
    "Replays",
    "Certificate",
    "Optimum",
    "Minimum",
)
"""Classes that users get and do not make."""

_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Warns):$")
_ITEM = re.compile(r"^(\w[\w, ]*): (.*)$", re.DOTALL)


def page() -> str:
    """The whole of api.md."""
    lines = [
        "# Reference",
        "",
        "Written from the docstrings by `python docs/make_api.py`. Words and symbols are explained "
        "in [concepts.md](concepts.md).",
        "",
        *(f"- [{name}](#{name.lower().replace(' ', '-')})" for name in GROUPS),
        "",
    ]
    for name, members in GROUPS.items():
        lines += [f"## {name}", ""]
        for member in members:
            lines += entry(member)
    return "\n".join(lines).rstrip() + "\n"


def entry(member: Any) -> Iterator[str]:
    """A function, or a class with its `METHODS`."""
    name = member.__name__
    public = name in mjx_drax.__all__
    full = f"mjx_drax.{name}" if public else f"{member.__module__}.{name}"
    yield f"### `{full}`"
    yield ""
    if name not in MADE_FOR_USERS and member is not mjx_drax.DraxError:
        yield from ["```python", signature(name, member), "```", ""]
    yield from text(member)
    if inspect.isclass(member):
        for key in METHODS.get(name, "").split():
            yield from method(name, key, vars(member)[key])


def method(owner: str, key: str, value: Any) -> Iterator[str]:
    """A method or a property of a class."""
    if isinstance(value, staticmethod):
        value = value.__func__
    if inspect.isfunction(value):
        yield from [f"#### `{signature(f'{owner}.{key}', value, short=True)}`", ""]
        yield from text(value)
    elif isinstance(value, property) or hasattr(value, "func"):
        yield from [f"#### `{owner}.{key}`", ""]
        yield from text(getattr(value, "func", value))


def signature(name: str, member: Any, short: bool = False) -> str:
    """The signature, on one line or one argument a line; without types where it is to be short."""
    defaults = {}
    if dataclasses.is_dataclass(member):
        defaults = {f.name: _made(f) for f in dataclasses.fields(member)}
    arguments, keyword = [], False
    for argument in inspect.signature(member).parameters.values():
        if argument.name == "self":
            continue
        if argument.kind is argument.KEYWORD_ONLY and not keyword:
            keyword = True
            arguments.append("*")
        written = argument.name
        if not short and argument.annotation is not argument.empty:
            written += f": {argument.annotation}"
        if argument.default is not argument.empty:
            value = defaults.get(argument.name) or repr(argument.default)
            value = "..." if inspect.isfunction(argument.default) else value
            written += f" = {value}" if ":" in written else f"={value}"
        arguments.append(written)
    line = f"{name}({', '.join(arguments)})"
    if short or len(line) <= 90:
        return line
    return f"{name}(\n    " + ",\n    ".join(arguments) + ",\n)"


def _made(field: dataclasses.Field[Any]) -> str | None:
    """The default of a field that is made for each object, without its own defaults."""
    if field.default_factory is dataclasses.MISSING:
        return None
    made = field.default_factory()
    changed = [
        f"{f.name}={getattr(made, f.name)!r}"
        for f in dataclasses.fields(made)
        if f.default is dataclasses.MISSING or getattr(made, f.name) != f.default
        if f.default_factory is dataclasses.MISSING
    ]
    return f"{type(made).__name__}({', '.join(changed)})"


def text(member: Any) -> Iterator[str]:
    """The docstring as Markdown: prose, equations as blocks, sections as lists."""
    blocks = (inspect.getdoc(member) or "").split("\n\n")
    for block in blocks:
        lines = block.split("\n")
        heading = _SECTION.match(lines[0])
        if heading:
            yield from [f"**{heading[1]}**", ""]
            body = "\n".join(lines[1:])
            yield from [prose(textwrap.dedent(body))] if heading[1] == "Returns" else items(body)
        elif all(line.startswith("    ") for line in lines):
            yield from ["```text", textwrap.dedent(block), "```"]
        else:
            yield prose(block)
        yield ""


def items(block: str) -> Iterator[str]:
    """The entries of a section as a list."""
    for item in re.split(r"\n(?=\S)", textwrap.dedent(block)):
        words = " ".join(item.split())
        named = _ITEM.match(words)
        yield f"- `{named[1]}`: {prose(named[2])}" if named else f"- {prose(words)}"


def prose(words: str) -> str:
    """Text in which Markdown sees no markup but code: what it would take for some is escaped."""
    parts = re.split(r"(`[^`]*`)", words)
    return "".join(
        part if part.startswith("`") else re.sub(r"\*|<(?=\w)", r"\\\g<0>", part) for part in parts
    )


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"written to {PAGE}")

"""Say whether a model of your own can be used, and how it is understood.

The report has joints, actuators and contacts, and how far one step of MJX and its derivatives are
from MuJoCo's C engine. The exit status is 0 if the model can be used.
"""

from __future__ import annotations

import argparse
import json

from mjx_drax.base.files import json_data
from mjx_drax.cli.common import say, say_aside


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The model, and the form of the report."""
    parser.add_argument("model", metavar="XML", help="MJCF file")
    parser.add_argument(
        "--contacts",
        metavar="A:B",
        action="append",
        type=_pair,
        help='geoms or bodies that may touch, such as "foot_*:floor"; may be given again',
    )
    parser.add_argument(
        "--actuators",
        metavar="KIND[=NUMBER]",
        type=_actuators,
        help="for a model without actuators: torque, torque=LIMIT or position=KP",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(options: argparse.Namespace) -> int:
    """Check the model; progress goes to standard error."""
    from mjx_drax.kernels.compilation import keep_programs
    from mjx_drax.physics.report import check, text

    keep_programs()
    report = check(
        options.model,
        say_aside,
        options.contacts or True,
        options.actuators,
    )
    say(json.dumps(json_data(report), indent=1) if options.json else text(report))
    return 0 if report["obstacle"] is None else 1


def _pair(text: str) -> tuple[str, str]:
    """Two patterns."""
    one, colon, other = text.partition(":")
    if not (one and colon and other):
        raise argparse.ArgumentTypeError(f"{text!r}: give two names and a colon, foot_*:floor")
    return one, other


def _actuators(text: str) -> str | dict[str, float]:
    """What `from_mjcf` takes as actuators."""
    kind, equals, number = text.partition("=")
    try:
        return {kind: float(number)} if equals else kind
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{number!r} is no number: give {kind}=10") from error

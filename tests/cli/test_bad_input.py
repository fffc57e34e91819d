"""Bad commands give one line that says what to do, and status 2."""

import pytest
from builders import At, arm, assert_complains, cases, cut_short

from mjx_drax import cli, tasks

pytestmark = pytest.mark.usefixtures("nothing_iterates")

GOOD_COST = (
    "import jax.numpy as jnp\nhorizon = 0.1\ndef terminal_residual(data):\n    return data.qpos\n"
)


def own(at, cost=GOOD_COST, model=None, *more):
    """A solve of one's own model and cost file."""
    files = at.file("arm.xml", arm() if model is None else model), at.file("cost.py", cost)
    return ["solve", "--model", *map(str, files[:1]), "--cost", str(files[1]), *more]


def task(*more):
    """A solve of a task with some options."""
    return lambda at: ["solve", "pendulum", "--out", str(at.folder), *more]


# fmt: off
TASKS = [
    ("task-unknown", lambda at: tasks.load("cartpoel"), "cartpoel", "cartpole_swingup"),
    ("task-ambiguous", lambda at: tasks.load("car"), "several tasks begin with 'car'", "choose"),
    ("task-number", lambda at: tasks.load(3), "no task 3", "choose"),
]
# fmt: on

# fmt: off
COMMANDS = [
    ("unknown", lambda at: ["sovle"], "sovle"),
    ("option", lambda at: ["solve", "pendulum", "--chain-count", "3"], "--chain-count"),
    ("nothing-to-solve", lambda at: ["solve"], "give a task"),
    ("task", lambda at: ["solve", "pendulumm"], "pendulumm", "pendulum_swingup"),
    ("model-as-task", lambda at: ["solve", "a.xml", "--cost", "c.py"], "--model a.xml"),
    ("task-and-model", task("--model", "a.xml"), "choose one"),
    ("chains-0", task("--chains", "0"), "--chains", "'0'", "whole number"),
    ("chains-text", task("--chains", "many"), "--chains", "'many'"),
    ("iterations-negative", task("--iterations", "-5"), "--iterations"),
    ("seed-text", task("--seed", "lucky"), "--seed", "'lucky'"),
    ("seed-negative", task("--seed", "-1", "--no-video"), "seed is -1"),
    ("horizon-text", task("--horizon", "long"), "--horizon", "'long'"),
    ("horizon-nan", task("--horizon", "nan"), "horizon is nan"),
    ("horizon-negative", task("--horizon", "-1"), "horizon is -1.0"),
    ("set-without-value", task("--set", "attempts"), "NAME=VALUE"),
    ("set-unknown", task("--set", "attempt=1"), "no setting 'attempt'", "choose one of"),
    ("set-text", task("--set", "attempts=many"), "attempts is 'many'"),
    ("set-0", task("--set", "attempts=0"), "attempts is 0"),
    ("set-nan", task("--set", "flow.noise=nan"), "flow.noise is 'nan'"),
    ("set-negative", task("--set", "flow.noise=-1"), "noise.value is -1.0"),
    ("set-part", task("--set", "flow.bounds=Wall"), "flow.bounds is 'Wall'", "Projection"),
    ("size", task("--size", "640"), "--size", "640x480"),
    ("size-0", lambda at: ["solve", "cartpole_swingup", "--size", "0x0"], "size is (0, 0)"),
    ("fps", task("--fps", "fast"), "--fps"),
    ("fps-nan", lambda at: ["solve", "cartpole_swingup", "--fps", "nan"], "fps is nan"),
    ("speed-0", lambda at: ["solve", "cartpole_swingup", "--speed", "0"], "speed is 0.0"),
    ("camera", lambda at: ["solve", "cartpole_swingup", "--camera", "x"], "no camera 'x'"),
    ("tolerance-kind", task("--tolerance", "grip=1"), "grip=1", "terminal_inequality"),
    ("tolerance-text", task("--tolerance", "equality=tight"), "equality=tight", "1e-3,1e-2"),
    ("tolerance-negative", task("--tolerance", "relative=-1"), "relative", "-1.0"),
    ("tolerance-entries", task("--tolerance", "control_bounds=1,2"), "2 numbers", "give 1"),
    ("residual-text", task("--residual", "small"), "--residual", "'small'"),
    ("residual-0", task("--residual", "0"), "tolerance is 0.0"),
    ("residual-no-polish", task("--residual", "1e-3", "--set", "polish=Polish(iterations=0)"),
     "tolerance is 0.001", "leave tolerance out"),
    ("max-seconds-0", task("--max-seconds", "0"), "max_seconds is 0.0"),
    ("max-iterations", task("--max-iterations", "0"), "--max-iterations", "whole number"),
    ("precision", task("--precision", "16"), "--precision", "16", "32", "64"),
    ("film-suffix", lambda at: ["solve", "bug_trap", "--film", "a.avi", "--out", str(at.folder)],
     "a.avi", ".gif"),
    ("side-by-side-no-model", task("--side-by-side"), "no MuJoCo model", "models only"),
    ("html-no-model", task("--html"), "no MuJoCo model"),
    ("keyframes-no-model", task("--keyframes"), "no MuJoCo model"),
    ("out-under-file", lambda at: ["solve", "pendulum", "--out", str(at.file("f") / "out")],
     "cannot write", "--out"),
    ("model-missing",
     lambda at: ["solve", "--model", "gone.xml", "--cost", str(at.file("cost.py", GOOD_COST))],
     "gone.xml"),
    ("model-alone", lambda at: ["solve", "--model", "gone.xml"], "--cost"),
    ("model-broken", lambda at: own(at, model="<mujoco"), "cannot compile"),
    ("model-empty", lambda at: own(at, model=""), "arm.xml"),
    ("cost-missing",
     lambda at: ["solve", "--model", str(at.file("arm.xml", arm())), "--cost", "gone.py"],
     "gone.py"),
    ("cost-no-python",
     lambda at: [
         "solve",
         "--model",
         str(at.file("arm.xml", arm())),
         "--cost",
         str(at.file("cost.txt", "hi")),
     ],
     "cost.txt", ".py"),
    ("cost-syntax", lambda at: own(at, "def cost(:"), "cost.py", "SyntaxError"),
    ("cost-binary", lambda at: own(at, bytes(range(256))), "cost.py", "Correct"),
    ("cost-raises", lambda at: own(at, "1 / 0"), "ZeroDivisionError"),
    ("cost-exits", lambda at: own(at, "raise SystemExit(0)"), "SystemExit"),
    ("cost-import", lambda at: own(at, "import no_such_module"), "no_such_module"),
    ("cost-empty", lambda at: own(at, "horizon = 0.1"), "no cost"),
    ("cost-no-horizon", lambda at: own(at, "def terminal_cost(data):\n    return data.qpos[0]"),
     "--horizon"),
    ("cost-vector",
     lambda at: own(at, "horizon = 0.1\ndef terminal_cost(data):\n    return data.qpos"),
     "terminal_cost", "scalar"),
    ("cost-no-function", lambda at: own(at, "horizon = 0.1\nterminal_cost = 3"),
     "terminal_cost is 3"),
    ("cost-solver", lambda at: own(at, GOOD_COST + "solver = 'fast'"), "'fast'", "Restarts"),
    ("cost-x_init", lambda at: own(at, GOOD_COST + "x_init = [1, 2, 3]"), "x_init has 3"),
    ("cost-slip", lambda at: own(at, GOOD_COST + "def terminal_inequalty(data):\n    return 1"),
     "defines terminal_inequalty", "terminal_inequality"),
    ("cost-slip-swapped", lambda at: own(at, GOOD_COST + "def gaol(data):\n    return True"),
     "defines gaol", "rename it to goal"),
    ("cost-slip-camel", lambda at: own(at, GOOD_COST + "def runningCost(data, u):\n    return 1"),
     "defines runningCost", "running_cost"),
    ("cost-slip-term", lambda at: own(at, GOOD_COST + "import mjx_drax\nrunning_residul = "
     f"mjx_drax.Terms({str(at.file('a.xml', arm()))!r}).control()"), "running_residual"),
    ("cost-slip-value", lambda at: own(at, GOOD_COST + "x_int = [0.0]"), "x_int", "x_init"),
    ("export-missing", lambda at: ["export", str(at.folder / "gone"), "--csv"], "gone"),
    ("export-nothing", lambda at: ["export", str(at.folder)], "--csv", "at least one"),
    ("export-damaged",
     lambda at: (
         cut_short(at.saved() / "result.npz"),
         ["export", str(at.folder / "result"), "--csv"],
     )[1],
     "does not belong"),
    ("export-no-model", lambda at: ["export", str(at.saved("point_answer")), "--keyframes"],
     "no MuJoCo model"),
    ("check-missing", lambda at: ["check", "gone.xml"], "gone.xml"),
    ("check-binary", lambda at: ["check", str(at.file("a.xml", b"\0\1"))], "a.xml"),
    ("benchmark-task", lambda at: ["benchmark", "tetris"], "tetris"),
    ("benchmark-suite", lambda at: ["benchmark", "--suite", "tpu"], "tpu"),
    ("benchmark-convergence",
     lambda at: ["benchmark", "--suite", "convergence", "--chains", "3"], "leave --seeds"),
    ("benchmark-seed", lambda at: ["benchmark", "pendulum", "--seeds", "x"], "--seeds"),
    ("reproduce", lambda at: ["reproduce", "figure-9"], "figure-9"),
    ("mpc-task", lambda at: ["mpc", "tetris"], "tetris"),
    ("mpc-function", lambda at: ["mpc", "pendulum", "--out", str(at.folder)], "no model",
     "mjx-drax list"),
    ("mpc-chains", lambda at: ["mpc", "cartpole", "--chains", "0"], "--chains"),
    ("mpc-explorers", lambda at: ["mpc", "cartpole", "--explorers", "9"], "explorers is 9"),
    ("mpc-mass", lambda at: ["mpc", "cartpole", "--mass", "nan"], "mass is nan"),
    ("mpc-noise", lambda at: ["mpc", "cartpole", "--noise", "-1"], "noise is -1.0"),
    ("mpc-pushes", lambda at: ["mpc", "cartpole", "--pushes", "-1"], "pushes is -1"),
    ("mpc-push", lambda at: ["mpc", "cartpole", "--push", "nan"], "push is nan"),
    ("mpc-duration", lambda at: ["mpc", "cartpole", "--duration", "nan"], "duration is nan"),
    ("mpc-duration-short",
     lambda at: ["mpc", "cartpole", "--duration", "1", "--out", str(at.folder)],
     "leaves no time for pushes"),
    ("mpc-hold", lambda at: ["mpc", "cartpole", "--hold", "inf"], "hold is inf"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(argument=TASKS))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)


@pytest.mark.parametrize(("arguments", "words"), cases(command=COMMANDS))
def test_bad_commands_give_one_line(arguments, words, tmp_path, capsys):
    given = arguments(At(tmp_path))
    capsys.readouterr()
    try:
        status = cli.main(given)
    except SystemExit as stop:  # of argparse
        status = stop.code
    printed = capsys.readouterr()
    assert status == 2, printed
    assert "Traceback" not in printed.err
    (line,) = printed.err.strip().splitlines()  # and no usage
    assert line.startswith("mjx-drax"), line
    for word in words:
        assert word in line, line
    assert printed.out == ""

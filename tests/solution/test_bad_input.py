"""Bad programs, batches, saved files and exports give one clear error.

A file that changes while it is read cannot be found out, and so is not here.
"""

import hashlib
import json
import pickle
import zipfile
from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from builders import (
    INF,
    NAN,
    At,
    arm,
    assert_complains,
    cases,
    cut_short,
    made_up,
    parts,
    point,
    robot,
)

from mjx_drax import Solution, from_program, minimize, save_csv, save_dataset, solve, solve_batch
from mjx_drax.solution.formats import export_keyframes
from mjx_drax.solution.results import distinct

pytestmark = pytest.mark.usefixtures("nothing_iterates")


def fails(*_):
    raise KeyError("no such sensor")


MOVED = np.linspace(-0.1, 0.1, 6).reshape(3, 2).astype(np.float32)


def moved(x):
    """The good problem, from elsewhere."""
    return replace(parts()["point"], x_init=x)


def bounded(x):
    """A problem with bounds that x may leave."""
    return replace(parts()["bounded"], x_init=x)


def family(make=moved, values=MOVED, **arguments):
    """A solve of several problems."""
    return solve_batch(make, values, **{"chains": 2, **arguments})


def repacked(at, change):
    """A folder whose arrays somebody has changed, with a digest that fits."""
    path = at.saved() / "result.npz"
    change(path)
    said = json.loads((path.parent / "result.json").read_text())
    said["npz_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    said.pop("json_sha256", None)
    (path.parent / "result.json").write_text(json.dumps(said))
    return path.parent


def with_arrays(at, **arrays):
    """A folder in which some arrays are others; None leaves them out."""

    def change(path):
        with np.load(path) as old:
            new = {**old, **{k.replace("__", "."): v for k, v in arrays.items()}}
        np.savez(path, **{k: v for k, v in new.items() if v is not None})

    return repacked(at, change)


def without_members(path):
    with zipfile.ZipFile(path, "w"):
        pass


def with_pickle(path):
    with np.load(path) as old:
        arrays = {**old, "chain_cost": np.array([{}, {}], object)}
    np.savez(path, **arrays)


def garbled_member(path):
    """The bytes of one array are not those of an array."""
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w") as new:
        for name, content in members.items():
            new.writestr(name, b"junk" if name == "solution.gains.npy" else content)


# fmt: off
PROGRAMS = [
    ("program-size", lambda at: from_program(0, cost=lambda x: 0.0), "size is 0"),
    ("program-text", lambda at: from_program("2", cost=lambda x: 0.0), "size is '2'"),
    ("program-no-cost", lambda at: from_program(2), "program has no cost"),
    ("program-cost", lambda at: from_program(2, cost=7), "cost is 7"),
    ("program-vector", lambda at: from_program(2, cost=lambda x: x), "shape (2,)", "residual"),
    ("program-solved", lambda at: solve(at.program), "use mjx_drax.minimize"),
    ("program-trajectory", lambda at: minimize(at.point), "use mjx_drax.solve"),
    ("program-guess", lambda at: minimize(at.program, 2, guess=[1.0, 2.0, 3.0]),
     "guess has shape (3,)"),
    ("program-guess-text", lambda at: minimize(at.program, 2, guess="origin"), "guess is 'origin'"),
    ("program-nan", lambda at: minimize(from_program(2, cost=lambda x: x @ x / 0), 2),
     "value of cost"),
]
# fmt: on

# fmt: off
BATCHES = [
    ("make-none", lambda at: family(None), "make is None"),
    ("make-raises", lambda at: family(fails), "make failed for value 0", "no such sensor"),
    ("make-returns-none", lambda at: family(lambda x: None), "the problem is None"),
    ("make-horizons",
     lambda at: solve_batch(
         lambda n: replace(at.point, horizon=5 + int(n)), np.arange(2), chains=2
     ), "problems of 5 and 6 knots: all of a batch have one horizon"),
    ("make-constant", lambda at: family(lambda x: at.point), "same problem for every value"),
    ("make-checks-traced", lambda at: family(lambda x: point(x_init=x)),
     "make failed when it was traced", "with_x_init"),
    ("make-branches", lambda at: family(lambda x: moved(x if x[0] > 0 else -x)),
     "make failed when it was traced"),
    ("make-other-model", lambda at: family(lambda g: robot(arm(option=f'gravity="0 0 {g[0]}"'))),
     "make failed when it was traced", "takes numbers"),
    ("values-none", lambda at: family(values=None), "values", "first axis"),
    ("values-empty", lambda at: family(values=np.zeros((0, 2))), "values", "stack"),
    ("values-number", lambda at: family(values=1.0), "values", "stack"),
    ("values-texts", lambda at: family(values=["a", "b"]), "values are ['a', 'b']"),
    ("values-unequal", lambda at: family(lambda v: moved(v[0]), (MOVED, np.zeros(2))),
     "(2,), (3,)"),
    ("values-nan", lambda at: family(values=np.where(MOVED > 0, MOVED, NAN)), "x_init is", "nan"),
    ("values-one-nan", lambda at: family(values=np.array([[0, 0], [0, NAN], [1, 1.0]], "f")),
     "problem 1 of 3"),
    ("values-infinite", lambda at: family(values=np.array([[0, 0], [INF, 0]], "f")),
     "problem 1 of 2", "finite"),
    ("values-outside", lambda at: family(bounded, 9 * np.eye(2, dtype="f")[[1, 1]] * [[0], [1]]),
     "problem 1 of 2", "outside"),
    ("values-crossed",
     lambda at: family(
         lambda b: replace(
             at.point,
             bounds=replace(at.point.bounds, x_upper=b + jnp.zeros(2), x_lower=jnp.zeros(2) - 1),
         ),
         np.array([1.0, -2.0], "f"),
     ),
     "problem 1 of 2", "cross"),
    ("values-shape", lambda at: family(values=np.zeros((3, 5), "f")), "x_init has shape (5,)", "2"),
    ("chunk-0", lambda at: family(chunk=0), "chunk is 0"),
    ("chunk-text", lambda at: family(chunk="all"), "chunk is 'all'"),
    ("batch-chains", lambda at: family(chains=-1), "chains is -1"),
    ("batch-seed", lambda at: family(seed=0.5), "seed is 0.5"),
    ("batch-solver", lambda at: family(solver="fast"), "solver is 'fast'"),
    ("batch-devices", lambda at: family(devices=7), "devices is 7"),
    ("batch-progress", lambda at: family(progress="bar"), "progress is 'bar'"),
]
# fmt: on

# fmt: off
FILES = [
    ("load-missing", lambda at: Solution.load(at.folder / "gone"), "gone", "result.json", "Give"),
    ("load-none", lambda at: Solution.load(None), "path is None"),
    ("load-number", lambda at: Solution.load(3), "path is 3"),
    ("load-null", lambda at: Solution.load("a\0b"), "null character"),
    ("load-file", lambda at: Solution.load(at.file("result.json", "{}")),
     "result.json", "cannot read"),
    ("load-empty-folder", lambda at: Solution.load(at.folder), "result.json", "Give a folder"),
    ("load-no-arrays",
     lambda at: ((at.saved() / "result.npz").unlink(), Solution.load(at.folder / "result")),
     "result.npz", "cannot read"),
    ("load-folder-as-file",
     lambda at: (
         (at.saved() / "result.npz").unlink(),
         (at.folder / "result/result.npz").mkdir(),
         Solution.load(at.folder / "result"),
     ),
     "result.npz"),
    ("json-empty",
     lambda at: (at.file("result.json"), at.file("result.npz"), Solution.load(at.folder)),
     "no JSON object"),
    ("json-list",
     lambda at: (at.file("result.json", "[1]"), at.file("result.npz"), Solution.load(at.folder)),
     "no JSON object"),
    ("json-binary",
     lambda at: (
         at.file("result.json", b"\xff\xfe\0"),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "damaged"),
    ("json-other",
     lambda at: (
         at.file("result.json", '{"a": 1}'),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "no format number"),
    ("json-deep",
     lambda at: (
         at.file("result.json", "[" * 99999),
         at.file("result.npz"),
         Solution.load(at.folder),
     ),
     "damaged"),
    ("json-versions", lambda at: Solution.load(at.saved(format=98, versions=[])), "format 98"),
    ("json-future", lambda at: Solution.load(at.saved(format=99)), "format 99", "solve again"),
    ("json-edited",
     lambda at: (
         at.saved(),
         (at.folder / "result/result.json").write_text(
             (at.folder / "result/result.json").read_text().replace('"seed": 0', '"seed": 1')
         ),
         Solution.load(at.folder / "result"),
     ),
     "changed after", "json_sha256"),
    ("json-horizon", lambda at: Solution.load(at.saved(horizon="five")), "damaged"),
    ("json-horizon-other", lambda at: Solution.load(at.saved(horizon=7)), "damaged", "(2, 7, 2)"),
    ("json-dt", lambda at: Solution.load(at.saved("point_answer", dt=-1.0)),
     "dt of the saved solution is -1.0"),
    ("json-dt-text", lambda at: Solution.load(at.saved(dt=None)), "damaged"),
    ("json-seed", lambda at: Solution.load(at.saved(seed="lucky")), "seed", "'lucky'"),
    ("json-solver", lambda at: Solution.load(at.saved(settings={"part": "GaussNewton"})),
     "solver", "GaussNewton"),
    ("json-settings", lambda at: Solution.load(at.saved(settings={"part": "Langevin", "speed": 9})),
     "speed"),
    ("json-no-certificate", lambda at: Solution.load(at.saved(certificate={})),
     "damaged", "'engine'"),
    ("json-mujoco", lambda at: Solution.load(at.saved("answer", versions={})), "damaged", "mujoco"),
    ("npz-digest",
     lambda at: (cut_short(at.saved() / "result.npz"), Solution.load(at.folder / "result")),
     "does not belong"),
    ("npz-cut-short", lambda at: Solution.load(repacked(at, cut_short)), "result.npz", "damaged"),
    ("npz-empty", lambda at: Solution.load(repacked(at, lambda path: path.write_bytes(b""))),
     "damaged"),
    ("npz-text", lambda at: Solution.load(repacked(at, lambda path: path.write_text("x = 3"))),
     "damaged"),
    ("npz-is-a-pickle",
     lambda at: Solution.load(repacked(at, lambda path: path.write_bytes(pickle.dumps({"x": 1})))),
     "damaged", "pickle"),
    ("npz-holds-a-pickle", lambda at: Solution.load(repacked(at, with_pickle)),
     "damaged", "allow_pickle"),
    ("npz-no-members", lambda at: Solution.load(repacked(at, without_members)),
     "damaged", "Solve again"),
    ("npz-garbled", lambda at: Solution.load(repacked(at, garbled_member)), "damaged"),
    ("npz-npy",
     lambda at: Solution.load(repacked(at, lambda path: np.save(path.open("wb"), np.zeros(3)))),
     "damaged"),
    ("npz-no-gains", lambda at: Solution.load(with_arrays(at, solution__gains=None)),
     "damaged", "solution.gains"),
    ("npz-fewer-costs", lambda at: Solution.load(with_arrays(at, chain_cost=np.zeros(1))),
     "cost", "(2,)"),
    ("npz-texts", lambda at: Solution.load(with_arrays(at, chain_cost=np.array(["a", "b"]))),
     "cost is <U1"),
    ("npz-flat", lambda at: Solution.load(with_arrays(at, solution__trajectories__x=np.zeros(3))),
     "damaged"),
    ("npz-controls",
     lambda at: Solution.load(with_arrays(at, solution__trajectories__u=np.zeros((2, 5, 9)))),
     "damaged"),
    ("npz-replay",
     lambda at: Solution.load(with_arrays(at, solution__feedback__states=np.zeros((2, 1, 2)))),
     "feedback.states"),
    ("npz-replay-extra",
     lambda at: Solution.load(with_arrays(at, solution__feedback__colour=np.zeros(2))),
     "damaged", "colour"),
    ("npz-model", lambda at: Solution.load(with_arrays(at, model__binary=np.zeros(99, np.uint8))),
     "damaged", "mj_loadModel"),
    ("load-problem", lambda at: Solution.load(at.saved(), at.point), "K = 10", "has 5"),
    ("load-problem-text", lambda at: Solution.load(at.saved(), arm()), "the problem is"),
    ("save-none", lambda at: at.answer.save(None), "path is None"),
    ("save-under-file", lambda at: at.answer.save(at.file("f") / "out"), "cannot write", "Choose"),
    ("save-on-file", lambda at: at.answer.save(at.file("f")), "cannot write", "/f/"),
    ("certify-loaded", lambda at: Solution.load(at.saved("point_answer")).certify(),
     "not saved", "Solution.load(folder, problem)"),
    ("solve-loaded", lambda at: solve(Solution.load(at.saved()).problem, 1),
     "is code, which is not saved"),
]
# fmt: on

# fmt: off
ANSWERS = [
    ("tolerance", lambda at: distinct(at.answer, 0), "tolerance is 0"),
    ("tolerance-nan", lambda at: distinct(at.answer, NAN), "tolerance is nan"),
    ("csv-suffix", lambda at: save_csv(at.answer, at.folder / "a.txt"), "a.txt", ".csv", "rename"),
    ("csv-folder",
     lambda at: ((at.folder / "a.csv").mkdir(), save_csv(at.answer, at.folder / "a.csv")),
     "it is a folder"),
    ("csv-of-a-problem", lambda at: save_csv(at.robot, at.folder / "a.csv"),
     "the solution is <Problem"),
    ("keyframes-of-none", lambda at: export_keyframes(None, at.folder / "a.xml"),
     "the solution is None"),
    ("dataset-of-none", lambda at: save_dataset(None, at.folder / "a.h5"), "the solution is None"),
    ("dataset-of-nothing", lambda at: save_dataset([], at.folder / "a.h5"), "no solution to write"),
    ("where-chain", lambda at: at.answer.where(99), "chain is 99"),
    ("dataset-of-some", lambda at: save_dataset([at.answer, 3], at.folder / "a.h5"),
     "the solution is 3"),
    ("csv-none", lambda at: save_csv(at.answer, None), "path is None"),
    ("keyframes-function", lambda at: export_keyframes(at.point_answer, at.folder / "a.xml"),
     "no MuJoCo model", "save_csv"),
    ("keyframes-model",
     lambda at: export_keyframes(
         made_up(robot(mujoco.MjModel.from_xml_string(arm()))), at.folder / "a.xml"
     ),
     "cannot be written", "give"),
    ("keyframes-suffix", lambda at: export_keyframes(at.answer, at.folder / "a.mjb"),
     "a.mjb", ".xml"),
    ("dataset-suffix", lambda at: save_dataset(at.answer, at.folder / "a.csv"), "a.csv", ".h5"),
    ("dataset-uncertified", lambda at: save_dataset(at.uncertified, at.folder / "a.h5"),
     "no chain is certified", "everything=True"),
]
# fmt: on


@pytest.mark.parametrize(
    ("call", "words"), cases(function=PROGRAMS, batch=BATCHES, file=FILES, answer=ANSWERS)
)
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)

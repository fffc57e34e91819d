"""The command line, in this process; the heavy commands with the smallest sizes that still work."""

import argparse
import errno
import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from inspect import signature
from types import SimpleNamespace

import numpy as np
import pytest
from builders import At

from mjx_drax import DraxError, Geometric, Solution, __version__, from_mjcf, tasks
from mjx_drax.cli import cost_file, main, mpc, pictures
from mjx_drax.control import trials
from mjx_drax.physics.report import text
from mjx_drax.search.engine import REPORT_EVERY
from mjx_drax.studies import benchmark

COST = """
import jax.numpy as jnp

horizon = 0.5

def terminal_residual(data):
    return jnp.concatenate([20.0 * (data.qpos - 0.2), 5.0 * data.qvel])

def running_residual(data, u):
    return 0.1 * u

def goal(data):
    return abs(data.qpos[0] - 0.2) < 0.01 and abs(data.qvel[0]) < 0.1
"""

SLIDER = """
<mujoco model="slider">
  <option timestep="0.01" integrator="Euler"><flag contact="disable"/></option>
  <worldbody><body>
    <joint name="slide" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
    <geom size="0.05" mass="1"/>
  </body></worldbody>
  <actuator><motor joint="slide" gear="10" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""

OWN_EXPORTER = """
import numpy as np
from mjx_drax import Exporter

class Costs(Exporter):
    file = "costs.txt"

    def write(self, solution, path):
        np.savetxt(path, solution.cost)
"""


@pytest.fixture
def own(tmp_path):
    (tmp_path / "slider.xml").write_text(SLIDER)
    (tmp_path / "mycost.py").write_text(COST)
    return tmp_path


def error_of(capsys, *arguments):
    assert main(arguments) == 2
    return capsys.readouterr().err


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom mjx_drax.cli import main\n"
        "try:\n    main(['solve', '--help'])\nexcept SystemExit:\n    pass\n"
        "main(['list'])\n"
        "assert not {'jax', 'mujoco', 'numpy', 'matplotlib'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_a_reader_may_stop_reading():
    code = "import sys; from mjx_drax.cli import main; sys.exit(main(['list']))"
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, "-c", code], stdout=writing, stderr=subprocess.PIPE)
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, b"")


def test_without_a_command_the_help_is_printed(capsys):
    assert main([]) == 0
    assert "usage: mjx-drax" in capsys.readouterr().out


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"mjx-drax {__version__}\n"


def test_an_unknown_task_is_refused_before_anything_heavy_is_imported():
    code = (
        "import sys; from mjx_drax.cli import main; "
        "status = main(['solve', 'cartpole_swingpu']); "
        "sys.exit(status + 10 * ('jax' in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert "choose cartpole_swingup, or another of" in done.stderr


def test_list_names_every_task(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    for name in (
        "pendulum",
        "bug_trap",
        "deep_trap",
        "pendulum_swingup",
        "cartpole_swingup",
        "acrobot_swingup",
    ):
        assert name in out
        assert name in tasks.names()


def test_own_model_is_certified_and_written(own, capsys, monkeypatch):
    looks = []
    monkeypatch.setattr(
        "mjx_drax.view.video.render_comparison", lambda _, to, **look: looks.append(look) or to
    )
    status = main(
        f"solve --model {own}/slider.xml --cost {own}/mycost.py --chains 4 --iterations 30 "
        f"--seed 3 --out {own}/out --film {own}/film.gif --fps 5 --size 160x120 --no-caption "
        "--side-by-side".split()
    )
    assert looks == [{"fps": 5.0, "size": (160, 120), "caption": False}]
    assert status == 0
    out = capsys.readouterr().out
    assert "CERTIFIED" in out
    assert "NOT CERTIFIED" not in out
    result = json.loads((own / "out" / "result.json").read_text())
    assert result["task"] == "slider"
    assert (result["chains"], result["seed"]) == (4, 3)
    assert 20 < result["iterations"] < 60  # 20 to descend, and then as many as the polish needs
    assert result["residual"] < result["tolerance"] == 1e-4
    assert result["max_defect"] < 1e-3
    assert result["max_bound_violation"] == 0
    assert result["success_rate"] == 1.0
    assert "MuJoCo" in result["certificate"]["engine"]
    for replay in ("open_loop", "feedback"):
        assert set(result["certificate"][replay]) == {
            "max_violation",
            "violations",
            "max_deviation",
            "final_deviation",
            "cost",
            "success",
        }
    arrays = np.load(own / "out" / "result.npz")
    assert arrays["times"].shape == (26,)
    assert arrays["states"].shape == (26, 2)
    assert arrays["gains"].shape == (25, 1, 2)
    assert arrays["chain_cost"].shape == (4,)
    np.testing.assert_allclose(arrays["replayed_states"][-1, 0], 0.2, atol=0.01)
    assert (own / "out" / "video.mp4").stat().st_size > 1000
    for name in ("plot.png", "phase.png", "multipliers.png", "timelapse.png"):
        assert (own / "out" / name).stat().st_size > 1000
    assert (own / "film.gif").read_bytes().startswith(b"GIF")


@pytest.mark.slow
def test_status_is_1_when_not_certified(tmp_path, capsys):
    short = "solve pendulum --horizon 0.5 --chains 2 --iterations 4 --no-video"
    (tmp_path / "replay.csv").touch()
    status = main([*short.split(), "--out", str(tmp_path)])
    assert status == 1
    out = capsys.readouterr().out
    assert "NOT CERTIFIED" in out
    assert "constraints    largest violations: control bounds 0.0e+00 (tolerated: 1.0e-02)" in out
    assert re.search(r"optimality     residual [\d.e-]+, below 0.0001", out)
    assert "there from an earlier solve: replay.csv\n" in out
    assert not json.loads((tmp_path / "result.json").read_text())["certified"]
    assert not (tmp_path / "video.mp4").exists()


@pytest.mark.slow
def test_the_plan_is_filmed_too_if_nothing_is_certified(slider, tmp_path, monkeypatch):
    films = []
    monkeypatch.setattr(
        "mjx_drax.view.video.render", lambda _, path, **how: films.append((path.name, how))
    )
    monkeypatch.setattr("mjx_drax.view.timelapse.render_timelapse", lambda *_, **__: None)
    names = pictures.write_video(slider, tmp_path, None, {"fps": 5})
    assert names == ["video.mp4", "timelapse.png"]
    failed = replace(slider, max_defect=np.ones_like(slider.max_defect))
    names = pictures.write_video(failed, tmp_path, None, {"fps": 5})
    assert names == ["video.mp4", "plan.mp4", "timelapse.png"]
    assert films[-1] == ("plan.mp4", {"draw": None, "plan": True, "fps": 5})
    assert set(names) < set(pictures.NAMES)


@pytest.mark.slow
def test_ctrl_c_saves_the_best_so_far(tmp_path, capsys, monkeypatch):
    def interrupt(self, done, total, info):
        raise KeyboardInterrupt

    monkeypatch.setattr("mjx_drax.solution.progress.Lines.__call__", interrupt)
    arguments = "solve pendulum --horizon 0.5 --chains 2 --iterations 400 --no-video"
    assert main([*arguments.split(), "--out", str(tmp_path)]) == 1
    assert "written to" in capsys.readouterr().out
    assert Solution.load(tmp_path).iterations == REPORT_EVERY


def test_ctrl_c_before_there_is_anything_to_save(monkeypatch, capsys):
    def interrupt(options):
        raise KeyboardInterrupt

    monkeypatch.setattr("mjx_drax.cli.list_tasks.run", interrupt)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == "mjx-drax: interrupted\n"


@pytest.mark.slow
def test_settings_are_set_by_name(tmp_path, capsys):
    short = "solve pendulum --horizon 0.5 --chains 2 --iterations 4 --no-video --quiet"
    flags = ["--set", "attempts=1", "--set", "flow.noise=Geometric(3, 0.1)"]
    main([*short.split(), *flags, "--out", str(tmp_path)])
    assert capsys.readouterr() == ("", "")
    solver = Solution.load(tmp_path).solver
    assert (solver.attempts, solver.flow.noise) == (1, Geometric(3.0, 0.1))
    assert "attempts, within" in error_of(capsys, *short.split(), "--set", "attempt=1")
    assert "give NAME=VALUE" in error_of(capsys, *short.split(), "--set", "attempts")
    assert "at least 1" in error_of(capsys, *short.split(), "--set", "attempts=0")


@pytest.mark.slow
def test_the_log_is_printed(slider, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mjx_drax.solution.solve.solve", lambda *_, **__: slider)
    words = f"solve pendulum --no-video --log --out {tmp_path}".split()
    assert main(words) == 0
    assert slider.log() in capsys.readouterr().out
    assert main([*words, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert main([*words, "--json"]) == 0
    json.loads(capsys.readouterr().out)


def test_json_is_all_that_is_printed(slider, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("mjx_drax.solution.solve.solve", lambda *_, **__: slider)
    for quiet in ("", " --quiet"):
        assert main(f"solve pendulum --no-video --json --out {tmp_path}{quiet}".split()) == 0
        printed = json.loads(capsys.readouterr().out)
        assert printed["task"] == "slider"
        assert printed == json.loads((tmp_path / "result.json").read_text())


def test_export_writes_what_is_asked_for(slider, tmp_path, capsys):
    slider.save(tmp_path)
    assert main(["export", str(tmp_path), "--csv", "--keyframes"]) == 0
    assert "replay.csv, keyframes.xml" in capsys.readouterr().out
    assert (tmp_path / "replay.csv").stat().st_size > 1000
    assert (tmp_path / "keyframes.xml").stat().st_size > 1000
    assert "--dataset" in error_of(capsys, "export", str(tmp_path))
    assert "nowhere" in error_of(capsys, "export", str(tmp_path / "nowhere"), "--csv")


def test_view_shows_the_pictures_of_a_problem_without_a_model(tmp_path, capsys, monkeypatch):
    folder = At(tmp_path).saved("point_answer")
    assert "no pictures beside its result" in error_of(capsys, "view", str(folder))
    for name in ("plot.png", "video.mp4", "other.png"):
        (folder / name).touch()
    seen = []
    monkeypatch.setattr(
        "mjx_drax.view.browser.pictures.show_pictures", lambda _, files, **__: seen.extend(files)
    )
    assert main(["view", str(folder)]) == 0
    assert [path.name for path in seen] == ["video.mp4", "plot.png"]


def test_a_run_of_mpc_is_filmed_as_asked_for(slider, tmp_path, monkeypatch):
    motion = SimpleNamespace(times=np.linspace(0, 1, 11), states=np.zeros((11, 2)), pushes=())
    films = []
    monkeypatch.setattr("mjx_drax.view.video.render_motion", lambda *_, **look: films.append(look))
    parser = argparse.ArgumentParser()
    mpc.add_arguments(parser)
    for words in ("", "--fps 5 --size 160x120 --camera free --speed 2 --no-caption"):
        look = pictures.look_of(parser.parse_args(["cartpole", *words.split()]))
        trials.film(slider.problem, motion, tmp_path / "mpc.mp4", **look)
    usual, asked = films
    assert usual.pop("overlay")[0] == "slider, model predictive control"
    assert asked.pop("overlay") == []
    assert set(usual) == {"arrows"}
    del asked["arrows"]
    assert asked == {"fps": 5, "size": (160, 120), "camera": "free", "speed": 2}
    with pytest.raises(SystemExit):
        main(["mpc", "cartpole", "--size", "640"])


def test_an_exporter_of_your_own_is_given_by_its_name(slider, tmp_path, capsys, monkeypatch):
    (tmp_path / "mine.py").write_text(OWN_EXPORTER)
    monkeypatch.chdir(tmp_path)
    slider.save(tmp_path / "out")
    assert main(["export", "out", "--csv", "--export", "mine:Costs", "--export", "mine:Costs"]) == 0
    assert "written to out/: replay.csv, costs.txt\n" in capsys.readouterr().out
    written = np.loadtxt(tmp_path / "out" / "costs.txt")
    np.testing.assert_allclose(written, slider.cost)
    assert "cannot be imported" in error_of(capsys, "export", "out", "--export", "mine:Cost")


def test_exports_that_cannot_be_written_are_refused_before_the_solve(capsys, monkeypatch, without):
    monkeypatch.setattr(
        "mjx_drax.solution.solve.solve", lambda *_, **__: pytest.fail("it was solved")
    )
    assert "no MuJoCo model" in error_of(capsys, "solve", "bug_trap", "--html")
    assert "no MuJoCo model" in error_of(capsys, "solve", "bug_trap", "--keyframes")
    without("h5py")
    assert "mjx-drax[dataset]" in error_of(capsys, "solve", "bug_trap", "--dataset")


def test_places_that_cannot_be_written_are_refused_before_the_solve(own, capsys, monkeypatch):
    monkeypatch.setattr(
        "mjx_drax.search.engine.Search.run", lambda *_: pytest.fail("it was solved")
    )
    (own / "file").touch()
    short, inside = (
        ["solve", "pendulum_swingup", "--out", str(own / "out")],
        str(own / "file" / "x"),
    )
    assert "cannot read" in error_of(capsys, *short, "--checkpoint", inside)
    assert "cannot write" in error_of(capsys, *short, "--film", f"{inside}.gif")
    sizes = []
    monkeypatch.setattr(os, "posix_fallocate", lambda *where: sizes.append(where[-1]) or full())
    assert "No space left on device" in error_of(capsys, *short)
    assert 5e6 < sizes[0] < 1e8


def full():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.slow
def test_a_checkpoint_is_gone_on_from(tmp_path, capsys, monkeypatch):
    file = tmp_path / "run.ckpt"
    short = "solve pendulum --horizon 0.5 --chains 2 --iterations 4 --no-video"
    arguments = [*short.split(), "--out", str(tmp_path), "--checkpoint", str(file)]
    main(arguments)
    assert "going on" not in capsys.readouterr().out
    first = Solution.load(tmp_path)
    monkeypatch.setattr("mjx_drax.search.engine.split_over", lambda *_: None)  # nothing can iterate
    main(arguments)
    assert f"going on from {file}\n" in capsys.readouterr().out
    np.testing.assert_array_equal(Solution.load(tmp_path).trajectories.u, first.trajectories.u)
    assert "seed 0, and this solve has seed 1" in error_of(capsys, *arguments, "--seed", "1")


def test_a_dataset_without_certified_chains_is_left_out(slider, tmp_path, capsys):
    replace(slider, max_defect=np.ones(4)).save(tmp_path)
    if importlib.util.find_spec("h5py") is None:
        pytest.skip("no h5py")
    assert main(["export", str(tmp_path), "--csv", "--dataset"]) == 0
    assert "dataset.h5 is left out: no chain is certified" in capsys.readouterr().out
    assert not (tmp_path / "dataset.h5").exists()


def test_tasks_go_by_their_beginnings():
    assert tasks.load("cartp") is tasks.load("cartpole_swingup")
    assert tasks.load("pendulum").__name__.endswith(".pendulum")
    with pytest.raises(DraxError, match=r"several tasks begin with 'pend': .*pendulum_swingup"):
        tasks.load("pend")


def test_help_names_all_that_a_cost_file_may_define(capsys):
    with pytest.raises(SystemExit):
        main(["solve", "--help"])
    out = capsys.readouterr().out
    for name in set(signature(from_mjcf).parameters) - {"model", "name"}:
        assert re.search(rf"\b{name}\b", out), name


def test_a_cost_file_has_names_of_its_own(own):
    """Helpers, imports, and what a known name beside it shows to be meant."""
    (own / "mycost.py").write_text(
        COST + "import jax.numpy as guesses\nfrom math import cos as horizons\n"
        "u_first = x_goal = q_goal = 1.0\nu_bound = 2.0\nu_bounds = (-u_bound, u_bound)\n"
        "def terminal(data):\n    return data.qpos\ndef _goall(data):\n    return True\n"
    )
    problem, _ = cost_file.load(str(own / "slider.xml"), str(own / "mycost.py"), None)
    assert float(problem.bounds.u_upper[0]) <= 2.0


def test_export_writes_what_it_can(tmp_path, capsys):
    folder = At(tmp_path).saved("point_answer")  # without a model: no keyframes
    assert main(["export", str(folder), "--csv", "--keyframes"]) == 1
    out = capsys.readouterr().out
    assert "left out: keyframes.xml: point has no MuJoCo model" in out
    assert (folder / "replay.csv").exists()


def test_errors_name_cause_and_fix(own, capsys, monkeypatch):
    model, cost = str(own / "slider.xml"), str(own / "mycost.py")
    assert "pendulum_swingup" in error_of(capsys, "solve", "pendulumm")
    assert "--cost" in error_of(capsys, "solve", "--model", model)
    assert "choose one" in error_of(capsys, "solve", "pendulum", "--model", model)
    assert "no.xml" in error_of(capsys, "solve", "--model", "no.xml", "--cost", cost)
    assert "no.py" in error_of(capsys, "solve", "--model", model, "--cost", "no.py")
    (own / "mycost.py").write_text("1 / 0")
    assert "ZeroDivisionError" in error_of(capsys, "solve", "--model", model, "--cost", cost)
    (own / "mycost.py").write_text("def terminal_cost(data):\n    return data.qpos\nhorizon = 1")
    assert "scalar" in error_of(capsys, "solve", "--model", model, "--cost", cost)
    (own / "mycost.py").write_text("def terminal_cost(data):\n    return data.qpos[0]")
    assert "--horizon" in error_of(capsys, "solve", "--model", model, "--cost", cost)
    at = ["--out", str(own / "out")]
    monkeypatch.delattr(tasks.load("pendulum"), "draw")
    assert "draw=" in error_of(capsys, "solve", "pendulum", "--film", *at)
    assert ".gif" in error_of(capsys, "solve", "bug_trap", "--film", "film.avi", *at)
    assert "speed" in error_of(capsys, "solve", "bug_trap", "--speed", "0", *at)
    assert "main" in error_of(capsys, "solve", "cartpole_swingup", "--camera", "side", *at)
    (own / "file").write_text("")
    assert "--out" in error_of(capsys, "solve", "pendulum", "--out", str(own / "file"))


def test_benchmark_takes_the_beginnings_of_names(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(benchmark, "run", lambda names, *rest, report: asked.extend(names) or [])
    monkeypatch.setattr(benchmark, "save", lambda rows, folder: [])
    assert main(["benchmark", "cartp", "double", "--out", str(tmp_path)]) == 0
    assert asked == ["cartpole_swingup", "double_pendulum_swingup"]


@pytest.mark.slow
def test_benchmark_prints_and_saves_rows(tmp_path, capsys):
    main(["benchmark", "pendulum", "--seeds", "0", "--chains", "4", "--out", str(tmp_path)])
    rows = json.loads((tmp_path / "benchmark.json").read_text())
    assert [(row["problem"], row["chains"]) for row in rows] == [("pendulum", 4)]
    assert f"{rows[0]['success_rate']:.1%}" in capsys.readouterr().out


def test_check_says_what_becomes_of_a_model(own, capsys):
    assert main(["check", str(own / "slider.xml")]) == 0
    seen = capsys.readouterr()
    for words in (
        "nq 1, nv 1, nu 1, na 0, ndx 2",
        "0 rows, 0 pairs",
        "0 points, all of them in a plan",
        "timestep 0.01 s, dt 0.02 s, integrator EULER",
        "slide: slide, range -1 to 1 is a bound on knots, driven by actuator 0",
        "actuator 0: motor on joint slide, control -1 to 1",
    ):
        assert words in seen.out
    assert seen.out.endswith("CAN BE USED\n")
    assert "compiling" in seen.err
    assert main(["check", str(own / "slider.xml"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["agreement"]["velocity_error"] < 1e-12
    assert report["agreement"]["jacobian_error_at_x_init"] < 1e-8
    assert report["obstacle"] is None
    assert report["contact_points"] == {"all": 0, "kept": 0, "nearest": None}
    report["contact_points"] = {"all": 177, "kept": 64, "nearest": 32}
    assert "177 points, a plan keeps 64, the nearest 32 of each condim" in text(report)


def test_check_says_what_stands_in_the_way(own, capsys):
    model = own / "slider.xml"
    model.write_text(SLIDER.replace('gear="10"', 'gear="10" armature="1"'))
    assert main(["check", str(model)]) == 1
    out = capsys.readouterr().out
    assert "may differ   actuators' own damping" in out
    assert "CANNOT BE USED: one step of MJX differs" in out
    model.write_text(SLIDER.split("<actuator>")[0] + "</mujoco>")
    assert main(["check", str(model)]) == 1
    assert "CANNOT BE USED: slider has no actuators" in capsys.readouterr().out
    assert main(["check", str(model), "--actuators", "torque=1", "--contacts", "foot:cart"]) == 1
    out = capsys.readouterr().out
    assert "actuator     slide: motor on joint slide, control -1 to 1" in out
    assert "CANNOT BE USED: contacts names 'foot'" in out
    assert "no.xml" in error_of(capsys, "check", "no.xml")


def test_a_cost_file_may_define_dataclasses(own):
    (own / "mycost.py").write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        + COST
        + "@dataclass\nclass _Weights:\n    speed: float = 1.0\n"
    )
    cost_file.load(str(own / "slider.xml"), str(own / "mycost.py"), None)


def test_what_diverges_is_null_in_json(own, capsys, monkeypatch):
    report = {"agreement": {"velocity_error": float("nan")}, "obstacle": None}
    monkeypatch.setattr("mjx_drax.physics.report.check", lambda *_: report)
    assert main(["check", str(own / "slider.xml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["agreement"] == {
        "velocity_error": None
    }


def test_a_log_gets_lines_and_no_bar(slider, tmp_path, capsys, monkeypatch):
    chosen = []

    def remember(problem, *_, progress, **__):
        chosen.append(progress)
        raise DraxError("that is all")

    monkeypatch.setattr("mjx_drax.solution.solve.solve", remember)
    for more in ([], ["--quiet"]):
        assert main(["solve", "pendulum", "--out", str(tmp_path), *more]) == 2
    assert chosen == [None, False]

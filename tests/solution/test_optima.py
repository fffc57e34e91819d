"""The distinct optima of a solution: known clusters, whatever their units, and what is shown."""

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from mjx_drax import DraxError, Langevin, from_function
from mjx_drax.base.pytrees import register_dataclass
from mjx_drax.cli import main
from mjx_drax.problem.cost import as_partial
from mjx_drax.problem.dynamics import FunctionDynamics
from mjx_drax.solution import optima
from mjx_drax.solution.files import save as results
from mjx_drax.solution.optima import TOLERANCE, cluster
from mjx_drax.solution.report import optima_lines
from mjx_drax.solution.results import distinct
from mjx_drax.solution.solve import solve
from mjx_drax.view import plotting
from mjx_drax.view.plotting import plot_optima

K = 40
PHASE = np.linspace(0, np.pi, K)
FLAT = FunctionDynamics(as_partial(lambda x, u: x), 0.1, 2, 1)


def detour(side):
    """From (0, 0) to (4, 0), passing the middle at a height of `side`, (..., K, 2)."""
    height = np.asarray(side)[..., None] * np.sin(PHASE)
    return np.stack([np.broadcast_to(2 - 2 * np.cos(PHASE), height.shape), height], axis=-1)


def unconverged(sides, jitter, seed=0):
    """Detours with smooth random deviations, as of chains that have not fully converged."""
    waves = np.random.default_rng(seed).normal(size=(len(sides), 3, 2)) * jitter
    modes = np.sin(PHASE[:, None] * np.arange(1, 4))  # (K, 3)
    return detour(sides) + modes @ waves


# Clustering.


@pytest.mark.parametrize("jitter", [0.0, 0.01, 0.1])
def test_two_ways_round_are_two_and_jitter_makes_no_more(jitter):
    sides = np.tile([1.0, -1.0, 1.0], 20)
    np.testing.assert_array_equal(cluster(FLAT, unconverged(sides, jitter)), np.tile([0, 1, 0], 20))


@pytest.mark.parametrize("jitter", [0.0, 1e-5, 0.03])
def test_where_all_agree_there_is_one(jitter):
    assert not cluster(FLAT, unconverged(np.ones(50), jitter)).any()


@pytest.mark.parametrize("units", [[1.0, 1.0], [1e3, 1.0], [1.0, 0.02], [180 / np.pi, 1e3]])
def test_units_do_not_matter(units):
    motions = unconverged(np.repeat([1.0, 0.3, -0.3, -1.0], 15), 0.15)
    np.testing.assert_array_equal(cluster(FLAT, motions * units), cluster(FLAT, motions))
    assert cluster(FLAT, motions).max() > 0


def test_a_coordinate_that_stands_still_does_not_tell_ways_apart():
    motions = unconverged(np.ones(50), 0.01)
    motions[..., 1] = 1e-5 * np.random.default_rng(0).normal(size=motions.shape[:2])
    assert not cluster(FLAT, motions).any()


def test_how_little_is_still_has_the_units_of_the_states():
    motions = 1e-4 * detour([1.0, -1.0])
    assert not cluster(FLAT, motions).any()
    assert cluster(FLAT, motions, still=1e-7).any()


def test_a_bridge_over_a_ridge_does_not_join_two_optima():
    sides = np.linspace(1.0, 0.05, 30)  # the farther from both optima, the costlier
    motions = detour(np.ravel(np.stack([sides, -sides], axis=1)))
    group = cluster(FLAT, motions)
    np.testing.assert_array_equal(group, np.tile([0, 1], 30))


def test_a_slope_from_one_way_to_the_other_is_one_optimum():
    assert not cluster(FLAT, detour(np.linspace(1.0, -1.0, 60))).any()
    assert cluster(FLAT, detour([1.0, -1.0])).any()


def test_a_chain_stays_with_a_cheaper_one_when_a_costlier_one_is_nearer():
    places = np.array([0.0, 0.5, 1.2, 0.65])  # in tolerances; the last one belongs to the third
    states = np.stack([places, places], axis=-1)[:, None]
    np.testing.assert_array_equal(cluster(FLAT, states, 1 / places.std()), [0, 0, 1, 1])


@pytest.mark.parametrize("count", [1, 2])
def test_few_chains(count):
    np.testing.assert_array_equal(cluster(FLAT, detour([1.0, -1.0][:count])), range(count))


def test_tolerance_is_a_distance_in_standard_deviations():
    x = np.full((2, 1, 2), 1.0)
    x[1] = -1.0  # standard deviation 1 in both coordinates: distance 2
    assert cluster(FLAT, x, 1.99).max() == 1
    assert cluster(FLAT, x, 2.01).max() == 0


def test_landmarks_are_bounded_and_chains_far_from_all_are_in_none(monkeypatch):
    monkeypatch.setattr(optima, "LANDMARKS", 3)
    group = cluster(FLAT, detour([8.0, 4.0, -4.0, -8.0, 4.0, -8.0]))
    np.testing.assert_array_equal(group, [0, 1, 2, -1, 1, -1])


def test_differences_are_those_of_the_dynamics():
    class Circle(FunctionDynamics):
        def difference(self, x, y):
            return jnp.mod(x - y + np.pi, 2 * np.pi) - np.pi

    circle = register_dataclass(Circle)(as_partial(lambda x, u: x), 0.1, 2, 1)
    turns = detour([1.0, 1.0]) + np.array([0.0, 2 * np.pi])[:, None, None]
    assert cluster(FLAT, turns).any()
    assert not cluster(circle, turns).any()


# Solutions.


def point_mass(goal=lambda x: np.linalg.norm(x[:2] - np.array([2.0, 0.0])) < 0.2):
    """A planar double integrator, past a round hill half way, which both sides pass alike."""
    dt = 0.1

    def running(x, u):
        hill = 6 * jnp.exp(-4 * jnp.sum((x[:2] - jnp.array([1.0, 0.0])) ** 2))
        return jnp.append(0.1 * u, hill)

    return from_function(
        lambda x, u: x + dt * jnp.concatenate([x[2:], u]),
        x_init=np.zeros(4),
        nu=2,
        dt=dt,
        horizon=2.0,
        running_residual=running,
        terminal_residual=lambda x: 20 * (x - jnp.array([2.0, 0.0, 0.0, 0.0])),
        x_bounds=(-5.0, 5.0),
        u_bounds=(-10.0, 10.0),
        x_scatter=(-2.0, 2.0),
        goal=goal,
        name="hill",
    )


@pytest.fixture(scope="module")
def hill():
    return solve(point_mass(), chains=16, solver=Langevin(iterations=50, tail=50))


def failed(solution, chains):
    """The same solution, but both replays of these chains miss the goal."""
    lost = np.isin(np.arange(solution.chains), chains)
    return replace(
        solution,
        **{
            name: replace(replays, success=replays.success & ~lost)
            for name in ("open_loop", "feedback")
            for replays in [getattr(solution, name)]
        },
    )


@pytest.mark.slow
def test_mirror_images_are_two_optima_of_one_cost(hill):
    assert len(hill.optima) == 2
    first, second = hill.optima
    assert first.chain == hill.best_chain
    assert first.cost <= second.cost == pytest.approx(first.cost, rel=1e-4)
    assert [o.cost for o in hill.optima] == [hill.replay_cost[o.chain] for o in hill.optima]
    heights = [optimum.trajectory.x[K // 4, 1] for optimum in hill.optima]
    assert heights[0] * heights[1] < -0.01
    for optimum, height in zip(hill.optima, heights, strict=True):
        same_side = hill.trajectories.x[:, K // 4, 1] * height > 0
        assert same_side[optimum.members].all()
        assert optimum.members[0] == optimum.chain
        assert (np.diff(hill.replay_cost[optimum.members]) >= 0).all()
        assert optimum.share == len(optimum.members) / hill.chains
    members = np.concatenate([optimum.members for optimum in hill.optima])
    np.testing.assert_array_equal(np.sort(members), np.flatnonzero(hill.success))


def test_every_optimum_has_its_own_certificate(hill):
    for optimum in hill.optima:
        assert optimum.certificate.success
        assert optimum.certificate.open_loop == hill.open_loop.summary(optimum.chain)
        assert optimum.certificate.feedback == hill.feedback.summary(optimum.chain)
        assert optimum.max_defect == hill.max_defect[optimum.chain] < 1e-3
        states, controls = optimum.replayed
        np.testing.assert_array_equal(states, hill.open_loop.states[optimum.chain])
        np.testing.assert_array_equal(controls, hill.open_loop.controls[optimum.chain])
        np.testing.assert_array_equal(optimum.trajectory.u, hill.trajectories.u[optimum.chain])


def test_chains_that_fail_do_not_count(hill):
    first, second = hill.optima
    lost = failed(hill, first.members)
    assert [o.chain for o in lost.optima] == [second.chain]
    led = failed(hill, first.members[:1])
    assert first.members[1] in [o.chain for o in led.optima]
    infeasible = replace(hill, max_defect=np.where(np.arange(16) == first.chain, 1.0, 1e-6))
    assert first.chain not in np.concatenate([o.members for o in infeasible.optima])


def test_success_with_feedback_alone_counts_and_is_what_was_replayed(hill):
    lost = replace(hill.open_loop, success=np.zeros(hill.chains, bool))
    best = replace(hill, open_loop=lost).optima[0]
    chain = best.chain  # of several whose costs differ by rounding
    assert best.cost == pytest.approx(hill.optima[0].cost, rel=1e-4)
    assert not best.certificate.open_loop["success"]
    assert best.certificate.feedback["success"]
    np.testing.assert_array_equal(best.replayed[0], hill.feedback.states[chain])


def test_none_certified_none_found(hill, tmp_path):
    none = failed(hill, range(hill.chains))
    assert none.optima == ()
    assert optima_lines(none) == []
    assert results.summary(none)["optima"] == []
    arrays = results.arrays(none)
    assert arrays["optima_states"].shape == (0, 21, 4)
    assert (arrays["chain_optimum"] == -1).all()
    with pytest.raises(DraxError, match="no chain is certified"):
        plot_optima(none, tmp_path / "optima.png")


@pytest.mark.parametrize("tolerance", [0.0, -1.0, np.nan, "0.1"])
def test_tolerances_that_are_refused(hill, tolerance):
    with pytest.raises(DraxError, match=r"tolerance is .*: give a positive number"):
        distinct(hill, tolerance)


def test_a_smaller_tolerance_finds_more(hill):
    assert len(distinct(hill, 1e-6)) > len(distinct(hill, TOLERANCE)) > len(distinct(hill, 99.0))


# What is written and shown.


def test_result_files_hold_the_optima(hill):
    summary, arrays = results.summary(hill), results.arrays(hill)
    assert summary["optima_found"] == 2
    assert json.loads(json.dumps(summary)) == summary
    for i, (row, optimum) in enumerate(zip(summary["optima"], hill.optima, strict=True)):
        assert (row["chain"], row["cost"]) == (optimum.chain, optimum.cost)
        assert (row["members"], row["share"]) == (len(optimum.members), optimum.share)
        assert row["open_loop"] == optimum.certificate.open_loop
        np.testing.assert_array_equal(arrays["optima_states"][i, 1:], optimum.trajectory.x)
        np.testing.assert_array_equal(arrays["optima_states"][i, 0], np.zeros(4))
        np.testing.assert_array_equal(arrays["optima_controls"][i], optimum.trajectory.u)
        np.testing.assert_array_equal(
            np.flatnonzero(arrays["chain_optimum"] == i), np.sort(optimum.members)
        )


def test_result_files_and_tables_are_bounded(hill, monkeypatch):
    monkeypatch.setattr(results, "OPTIMA", 3)
    many = replace(hill)
    many.__dict__["optima"] = distinct(hill, 1e-8)
    found = len(many.optima)
    assert found > 3
    summary = results.summary(many)
    assert (summary["optima_found"], len(summary["optima"])) == (found, 3)
    assert results.arrays(many)["optima_states"].shape == (3, 21, 4)
    monkeypatch.setattr("mjx_drax.solution.report.OPTIMA", 3)
    lines = optima_lines(many)
    assert len(lines) == 5  # a heading, three rows, how many more
    assert lines[-1].split() == ["and", str(found - 3), "more"]


def test_table_tells_cost_share_replays_and_what_differs(hill):
    heading, *rows = (line.split() for line in optima_lines(hill))
    assert " ".join(heading) == "motions rank cost chains replays residual differs from the first"
    for rank, row in enumerate(rows, 1):
        optimum = hill.optima[rank - 1]
        assert row[:3] == [str(rank), f"{optimum.cost:.5g}", f"{optimum.share:.1%}"]
        assert row[3:5] == ["both", "-"]
    x, y = (optimum.trajectory.x for optimum in hill.optima)
    name, by, size, *_, knot = rows[1][5:]
    there = int(knot) - 1, int(name.removeprefix("x"))
    assert (by, size) == ("by", f"{y[there] - x[there]:+.3g}")
    assert abs(y[there] - x[there]) == pytest.approx(np.abs(y - x).max(axis=0)[there[1]])
    assert rows[0][5:] == []
    lost = replace(hill, open_loop=replace(hill.open_loop, success=np.zeros(16, bool)))
    assert optima_lines(lost)[1].split()[3] == "feedback"


def test_what_moves_by_rounding_only_is_not_what_differs(hill):
    def with_last(optimum, value):
        x = np.array(optimum.trajectory.x)
        x[:, 3] = value
        return replace(optimum, trajectory=replace(optimum.trajectory, x=x))

    still = replace(hill)
    first, second = hill.optima[:2]
    still.__dict__["optima"] = [with_last(first, 0.0), with_last(second, 1e-8)]
    assert " x3 by " not in optima_lines(still)[-1]
    still.__dict__["optima"] = [with_last(first, 0.0), with_last(second, 1e4)]
    assert " x3 by +1e+04 " in optima_lines(still)[-1]


@pytest.mark.slow
def test_pictures_side_by_side_and_over_each_other(hill, tmp_path, monkeypatch):
    seen = []

    def draw(axes, states):
        seen.append(states)
        axes.plot(states[:, 0], states[:, 1])

    with Image.open(plot_optima(hill, tmp_path / "map.png", draw)) as image:
        assert image.size == (900, 600)
    for states, optimum in zip(seen, hill.optima, strict=True):
        np.testing.assert_array_equal(states, optimum.replayed[0])
    with Image.open(plot_optima(hill, tmp_path / "curves.png")) as image:
        assert image.size == (1200, 900)
    many = replace(hill)
    many.__dict__["optima"] = distinct(hill, 1e-8)
    seen.clear()
    plot_optima(many, tmp_path / "many.png", draw)
    assert len(seen) == min(len(many.optima), plotting.MAPS)
    plot_optima(many, tmp_path / "many.png")


@pytest.mark.slow
def test_the_command_writes_a_picture_only_of_several(tmp_path, capsys, monkeypatch, hill):
    monkeypatch.setattr("mjx_drax.solution.solve.solve", lambda *_, **__: hill)
    arguments = f"solve pendulum --no-video --out {tmp_path}".split()
    assert main(arguments) == 0
    out = capsys.readouterr().out
    assert "optima.png" in out
    assert "motions        rank" in out
    assert (tmp_path / "optima.png").stat().st_size > 1000
    (tmp_path / "optima.png").unlink()
    one = failed(hill, hill.optima[1].members)
    monkeypatch.setattr("mjx_drax.solution.solve.solve", lambda *_, **__: one)
    assert main(arguments) == 0
    assert "motions        one" in capsys.readouterr().out
    assert not (tmp_path / "optima.png").exists()

"""A solution in a browser that is served, a solve that is watched, and contact forces."""

import shutil
import threading
import time

import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, solve, tasks
from mjx_drax.view.browser.scene import contact_forces
from mjx_drax.view.browser.viewer import live_page, show, show_natively

BALL = """
<mujoco><worldbody>
  <geom name="floor" type="plane" size="1 1 1"/>
  <body pos="0 0 0.1"><freejoint/><geom name="ball" type="sphere" size="0.1" mass="2"/></body>
</worldbody></mujoco>
"""


def test_a_ball_at_rest_is_carried_by_the_floor():
    model = mujoco.MjModel.from_xml_string(BALL)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    states = np.concatenate([data.qpos, data.qvel])[None]
    forces = contact_forces(model, states, np.zeros((1, 0)))[0]
    total = sum(force for _, force in forces)
    np.testing.assert_allclose(total, [0, 0, 2 * 9.81], atol=1e-3)
    np.testing.assert_allclose(forces[0][0], [0, 0, 0], atol=1e-2)


def test_the_page_is_served_until_it_ends(cartpole):
    pytest.importorskip("viser")
    told, until = [], threading.Event()
    page = threading.Thread(
        target=show, args=(cartpole,), kwargs={"port": 0, "told": told.append, "until": until}
    )
    page.start()
    time.sleep(1.0)
    until.set()
    page.join(10.0)
    assert not page.is_alive()
    assert "http://127.0.0.1:" in told[0]


def test_what_is_refused(cartpole, monkeypatch):
    pytest.importorskip("viser")
    with pytest.raises(DraxError, match="port is -1: give a whole number"):
        show(cartpole, port=-1)
    with pytest.raises(DraxError, match="port is 70000"):
        show(cartpole, port=70000)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(DraxError, match="MuJoCo's viewer needs a display"):
        show_natively(cartpole)


@pytest.mark.slow
def test_a_browser_shows_a_solve_and_then_its_answer():
    pytest.importorskip("viser")
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium")
    problem = tasks.load("cartpole_swingup").make(horizon=1.0)
    told, until, solved = [], threading.Event(), threading.Event()

    def run():
        with live_page(problem, port=0, told=told.append) as live:
            solution = solve(problem, 4, record=live)
            solved.set()
            live.play(solution, until)

    worker = threading.Thread(target=run)
    worker.start()
    while not told:
        time.sleep(0.1)
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        tab = browser.new_page(viewport={"width": 900, "height": 600})
        tab.goto(told[0].split()[1])
        tab.get_by_text("max|h|").wait_for(timeout=120_000)  # an iteration has been shown
        solved.wait(200)
        for part in ("replay", "plan", "poses", "path"):
            tab.get_by_text(part, exact=True).first.wait_for(timeout=60_000)
        tab.get_by_text("reaches the goal").or_(tab.get_by_text("misses the goal")).first.wait_for()
        tab.wait_for_timeout(2000)
        one = tab.screenshot(clip={"x": 0, "y": 100, "width": 500, "height": 450})
        tab.wait_for_timeout(1000)
        other = tab.screenshot(clip={"x": 0, "y": 100, "width": 500, "height": 450})
        browser.close()
    until.set()
    worker.join(20)
    assert one != other  # time goes on

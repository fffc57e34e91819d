"""The replay as one HTML file: what the recording holds, and that a browser shows it."""

import base64
import re
import shutil
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from mjx_drax import DraxError, save_html
from mjx_drax.physics.c_engine.states import set_state
from mjx_drax.physics.dynamics import mujoco_model
from mjx_drax.tasks import load
from mjx_drax.view.exporters import Html


@pytest.fixture(scope="module")
def page(slider, tmp_path_factory):
    pytest.importorskip("viser")
    return save_html(slider, tmp_path_factory.mktemp("page") / "replay.html", poses=5)


@pytest.fixture(scope="module")
def recording(page):
    """What viser's page plays: duration [s], and messages with their times."""
    msgspec, zstandard = pytest.importorskip("msgspec"), pytest.importorskip("zstandard")
    data = re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page.read_text())[1]
    inner = zstandard.ZstdDecompressor().decompressobj().decompress(base64.b64decode(data)[8:])
    size = int.from_bytes(inner[:8], "little")
    return msgspec.msgpack.decode(inner[8 : 8 + size])


def names(recording, kind):
    return [m["name"] for _, m in recording["messages"] if m["type"] == kind]


def test_every_kind_of_geom_is_there(recording):
    meshes = names(recording, "MeshMessage")
    for part in ("replay", "plan"):  # six geoms and a site; what is invisible is left out
        assert sum(name.startswith(f"/{part}/1/") for name in meshes) == 7
    assert sum(name.startswith("/world/") for name in meshes) == 1  # the height field
    assert len(names(recording, "GridMessage")) == 1  # the floor
    assert sum(n.startswith("/poses/") for n in names(recording, "BatchedMeshesMessage")) == 7
    assert "/path" in names(recording, "LineSegmentsMessage")


def test_bodies_move_as_the_engine_replayed_them(slider, recording):
    model = mujoco_model(slider.problem.dynamics)
    data = mujoco.MjData(model)
    moves = [
        (time, message["position"])
        for time, message in recording["messages"]
        if message["type"] == "SetPositionMessage" and message["name"] == "/replay/1"
    ]
    states, _ = slider.replayed
    dt = slider.problem.dynamics.dt
    assert recording["durationSeconds"] == pytest.approx(dt * len(states))
    for time, position in moves:
        set_state(model, data, states[round(time / dt)])
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(position, data.body("cart").xpos, atol=1e-6)
    assert len(moves) > 20


def test_the_page_says_how_good_the_answer_is(slider, page, tmp_path):
    text = page.read_text()
    assert "<title>slider, replayed</title>" in text
    assert "reaches the goal" in text
    assert "NOT CERTIFIED" not in text
    assert not re.search(r'(src|href)="https?:', text)  # nothing is fetched
    bad = replace(slider, max_defect=np.ones(4))
    assert "NOT CERTIFIED" in save_html(bad, tmp_path / "bad.html").read_text()


def test_a_replay_that_turns_nan_is_shown_up_to_there(slider, tmp_path):
    pytest.importorskip("viser")
    states = slider.open_loop.states.copy()
    states[:, 10:] = np.nan
    lost = replace(slider, open_loop=replace(slider.open_loop, states=states))
    assert save_html(lost, tmp_path / "lost.html", poses=0).stat().st_size > 10_000


def test_what_is_refused(slider, tmp_path, without, monkeypatch):
    with pytest.raises(DraxError, match="bug_trap has no MuJoCo model to show in a browser"):
        Html().check(load("bug_trap").make())
    without("viser")
    with pytest.raises(DraxError, match=r'needs viser.*pip install "mjx-drax\[view\]"'):
        save_html(slider, tmp_path / "replay.html")
    monkeypatch.undo()
    pytest.importorskip("viser")
    with pytest.raises(DraxError, match="poses is -1"):
        save_html(slider, tmp_path / "replay.html", poses=-1)
    with pytest.raises(DraxError, match=r"'replay.txt' does not end in .html"):
        save_html(slider, tmp_path / "replay.txt")


@pytest.mark.slow
def test_a_browser_shows_it_and_scrubs(page):
    sync_api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium")
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    problems = []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        tab = browser.new_page(viewport={"width": 640, "height": 480})
        tab.on("console", lambda m: problems.append(m.text) if m.type == "error" else None)
        tab.on("pageerror", lambda error: problems.append(str(error)))
        tab.goto(page.as_uri())
        tab.wait_for_selector("[role=slider]", state="attached")
        bar = tab.query_selector(".mantine-Slider-root").bounding_box()

        def seen(share, differs_from=()):
            """What is drawn at that place of the bar, once it is drawn."""
            tab.mouse.click(bar["x"] + share * bar["width"], bar["y"] + bar["height"] / 2)
            shots = [b"", b" "]
            while len(shots) < 40 and (shots[-1] != shots[-2] or shots[-1] in differs_from):
                tab.wait_for_timeout(500)
                shots.append(tab.screenshot(clip={"x": 0, "y": 150, "width": 640, "height": 280}))
            return shots[-1]

        nothing = tab.screenshot(clip={"x": 0, "y": 150, "width": 640, "height": 280})
        middle = seen(0.5, [nothing])  # a page plays by itself until it is clicked
        start = seen(0.02, [nothing, middle])
        end = seen(0.98, [nothing, start])
        shown = float(tab.get_attribute("[role=slider]", "aria-valuenow"))
        assert "reaches the goal" in tab.inner_text("#drax")
        tab.click('[aria-label="Show scene tree"]')
        tab.wait_for_timeout(500)
        tree = "".join(tab.inner_text("body").split())
        for part in ("world", "replay", "plan", "poses", "path"):
            assert f"/{part}" in tree
        browser.close()
    assert len({nothing, start, end}) == 3
    assert shown > 0.4
    assert not problems

"""Public names are documented, links lead somewhere, and the examples run."""

import inspect
import re
import runpy
import shutil
from pathlib import Path

import pytest

import mjx_drax
from mjx_drax import tasks

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("name", mjx_drax.__all__)
def test_every_public_name_is_documented(name):
    text = inspect.getdoc(getattr(mjx_drax, name))
    assert text
    assert not text.startswith(f"{name}(")  # what dataclasses write by themselves


def test_the_site_has_every_public_name_and_task(tmp_path):
    site = runpy.run_path(str(ROOT / "docs" / "make_site.py"))
    site["write"](tmp_path)
    reference = (tmp_path / "reference.md").read_text(encoding="utf-8")
    for name in mjx_drax.__all__:
        if callable(getattr(mjx_drax, name)):
            assert f".{name}\n" in reference
    gallery = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    for name in tasks.names():
        assert f"## {name}\n" in gallery
        assert f"(posters/{name}.webp)" in gallery
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in tmp_path.glob("*.md"):
        assert page.name in menu
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (tmp_path / target).exists(), (page.name, target)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            there = page.parent / target if target else page
            assert there.exists(), target
            assert not anchor or anchor in anchors(there), f"{target}#{anchor}"


def anchors(page):
    """What a link to a heading of the page may say after #."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_the_code_that_the_paper_page_names_exists():
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    pairs = re.findall(r"`([a-z_/]+\.py)`: (`\w[\w.]*`(?:, `\w[\w.]*`)*)", text)
    assert len(pairs) > 10
    for file, names in pairs:
        source = (ROOT / "mjx_drax" / file).read_text(encoding="utf-8")
        for name in re.findall(r"(\w+)`", names):
            assert re.search(rf"(def|class) {name}\b", source), (file, name)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_examples_run(tmp_path, monkeypatch):
    shutil.copy(ROOT / "models" / "cartpole.xml", tmp_path / "robot.xml")
    monkeypatch.chdir(tmp_path)
    names = {}
    for page in ("open_problems.md", "your_problem.md", "tuning.md"):  # the last two are one
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(block, page, "exec"), names)
    assert names["solution"].certified

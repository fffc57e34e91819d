"""Public names are documented, links lead somewhere, and the examples run."""

import inspect
import re
import runpy
import shutil
import tomllib
from pathlib import Path

import pytest

import mjx_drax
from mjx_drax import tasks

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
WITH_ADDRESS = [
    "README.md",
    "CHANGELOG.md",
    "docs/install.md",
    *(f"notebooks/{n.name}" for n in NOTEBOOKS),
]


@pytest.mark.parametrize("name", mjx_drax.__all__)
def test_every_public_name_is_documented(name):
    text = inspect.getdoc(getattr(mjx_drax, name))
    assert text
    assert not text.startswith(f"{name}(")  # what dataclasses write by themselves


@pytest.mark.parametrize("file", WITH_ADDRESS)
def test_the_repository_has_one_address(file):
    """`./drax address URL` writes it everywhere."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    text = (ROOT / file).read_text(encoding="utf-8")
    places = r"(?:git clone |@ git\+|^\[.+\]: )([^\s\\\"]+?)(?:/compare/.*|/releases/.*|[\s\\\"])"
    assert set(re.findall(places, text, re.MULTILINE)) == {project["urls"]["Repository"]}


def test_the_site_has_every_public_name_and_task(tmp_path):
    site = runpy.run_path(str(ROOT / "docs" / "make_site.py"))
    site["write"](tmp_path)
    reference = (tmp_path / "reference.md").read_text(encoding="utf-8")
    for name in mjx_drax.__all__:
        if callable(getattr(mjx_drax, name)):
            assert f".{name}\n" in reference
    for path in [*PAGES, *NOTEBOOKS]:
        found = re.findall(r"from (mjx_drax\.view\S*) import ([\w, ]+)", path.read_text("utf-8"))
        for module, names in found:
            for name in names.split(", "):
                assert f"::: {module}.{name}\n" in reference
    gallery = (tmp_path / "gallery.md").read_text(encoding="utf-8")
    for name in tasks.names():
        assert f"## {name}\n" in gallery
        assert f"({name}.webp)" in gallery  # the film; see docs/make_films.py
        assert f"(posters/{name}.webp)" in gallery
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in tmp_path.rglob("*.md"):
        assert str(page.relative_to(tmp_path)) in menu
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            known = re.match(r"https?:|data:", target) or (page.parent / target).exists()
            assert known, (page.name, target)


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
    pages = "controller.md", "open_problems.md", "your_problem.md", "tuning.md"
    for page in pages:  # the last two are one
        text = (ROOT / "docs" / page).read_text(encoding="utf-8")
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
            exec(compile(block, page, "exec"), names)
    assert names["solution"].certified

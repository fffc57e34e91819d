"""Tasks and models are found in a checkout and in an installed package, and nothing else beside."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = """
import importlib, sys, mjx_drax
assert "mjx_drax.view" not in sys.modules
assert mjx_drax.view is sys.modules["mjx_drax.view"]
assert "mjx_drax.view.plotting" not in sys.modules
assert mjx_drax.view.plotting is sys.modules["mjx_drax.view.plotting"]
assert not hasattr(mjx_drax.view, "nothing")
assert not hasattr(mjx_drax, "nothing")
assert not hasattr(mjx_drax, "__main__")
from mjx_drax import models, tasks
assert "cartpole_swingup" in tasks.names()
assert models.path("cartpole").is_file()
for name in ("mjx_drax", "tests", "docs", "notebooks"):
    try:
        importlib.import_module(f"mjx_drax.{name}")
    except ModuleNotFoundError:
        continue
    raise AssertionError(f"mjx_drax.{name} can be imported")
for name in ("tasks", "models"):
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        continue
    raise AssertionError(f"{name} can be imported by itself")
print(mjx_drax.__file__)
"""


def run(folder, path):
    command = [sys.executable, "-c", PROGRAM]
    return subprocess.run(
        command, cwd=folder, env={"PYTHONPATH": str(path)}, capture_output=True, text=True
    )


def test_a_checkout_has_its_tasks_and_models_and_no_other_folder(tmp_path):
    found = run(tmp_path, "")  # installed for development
    assert found.returncode == 0, found.stderr
    assert Path(found.stdout.strip()).parent == ROOT / "mjx_drax"


def test_every_folder_of_the_library_is_installed():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    files = (ROOT / "mjx_drax").rglob("*.py")
    folders = {".".join(file.parent.relative_to(ROOT).parts) for file in files}
    assert folders | {"mjx_drax.tasks", "mjx_drax.models"} == set(settings["packages"])


@pytest.mark.slow
def test_an_installed_package_has_them_too(tmp_path):
    site = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site)]
    subprocess.run([*pip, str(ROOT)], check=True)
    found = run(tmp_path, site)
    assert found.returncode == 0, found.stderr
    assert Path(found.stdout.strip()).parent == site / "mjx_drax"
    assert (site / "mjx_drax" / "__init__.pyi").is_file()
    assert (site / "mjx_drax" / "models" / "cartpole.xml").is_file()
    assert not (site / "tasks").exists()

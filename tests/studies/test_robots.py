"""Tasks for robots of other packages: their files, and names that are unknown."""

import pytest

from mjx_drax import DraxError
from mjx_drax.studies.robots import main, model_file


def test_a_file_is_found_below_a_folder_or_refused(tmp_path):
    inside = "hydrax/models/walker/scene.xml"
    with pytest.raises(DraxError, match=rf"no {inside} below .*pip install hydrax"):
        model_file(inside, tmp_path)
    path = tmp_path / "wheels" / inside
    path.parent.mkdir(parents=True)
    path.touch()
    assert model_file(inside, tmp_path) == path


@pytest.mark.parametrize("wrong", ["--attempts 0", "--chains 0", "--seeds 0", "--seconds 0"])
def test_numbers_that_make_no_sense_are_refused_in_one_line(wrong, capsys):
    assert main(wrong.split()) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"{wrong.split()[0]} is 0")
    assert printed.err.count("\n") == 1
    assert printed.out == ""


def test_an_unknown_task_is_refused_with_those_that_there_are(capsys):
    assert main(["walkre"]) == 2
    assert "double_cart_pole" in capsys.readouterr().err

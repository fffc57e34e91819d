"""Files appear once they are complete."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from mjx_drax import DraxError
from mjx_drax.base.files import complete, require_room, write_json


def test_json_has_null_for_what_is_no_number(tmp_path):
    data = {"a": [1.5, float("nan"), np.float32(np.inf)], "b": np.array([[1, 2]]), "c": (True, "²")}
    path = write_json(tmp_path / "new" / "data.json", data)
    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == {"a": [1.5, None, None], "b": [[1, 2]], "c": [True, "²"]}
    assert "²" in text


def test_room_is_asked_for_where_files_cannot_be_allocated(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate")  # as on macOS
    require_room(tmp_path / "file.npz", 10)
    with pytest.raises(DraxError, match="No space left"):
        require_room(tmp_path / "file.npz", 10**18)
    assert not list(tmp_path.iterdir())


def test_json_keeps_names_that_utf_8_cannot_hold(tmp_path):
    path = write_json(tmp_path / "data.json", {"name": "\udcff"})
    assert json.loads(path.read_text(encoding="utf-8")) == {"name": "\udcff"}


@pytest.mark.parametrize("name", ["result.npz", "a*b.[x].npz"])
def test_only_what_dead_processes_left_is_removed(tmp_path, name):
    target = tmp_path / name
    with complete(target) as partial:
        left = partial.name
        partial.touch()
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    theirs, elsewhere = (
        tmp_path / left.replace(f"-{os.getpid()}.", end)
        for end in (f"-{process.pid}.", f"-another-host-{process.pid}.")
    )
    theirs.touch()
    elsewhere.touch()
    with complete(target) as ours:
        ours.touch()
        require_room(tmp_path / "else.npz")  # another file
        assert ours.exists()
    require_room(target)
    assert theirs.exists()  # it is still written
    process.communicate(b"\n")
    require_room(target)
    assert not theirs.exists()
    assert elsewhere.exists()  # nobody here knows of processes there
    assert target.exists()

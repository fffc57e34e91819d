"""Files appear once they are complete."""

import json

import numpy as np

from mjx_drax.base.files import write_json


def test_json_has_null_for_what_is_no_number(tmp_path):
    data = {"a": [1.5, float("nan"), np.float32(np.inf)], "b": np.array([[1, 2]]), "c": (True, "²")}
    path = write_json(tmp_path / "new" / "data.json", data)
    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == {"a": [1.5, None, None], "b": [[1, 2]], "c": [True, "²"]}
    assert "²" in text


def test_json_keeps_names_that_utf_8_cannot_hold(tmp_path):
    path = write_json(tmp_path / "data.json", {"name": "\udcff"})
    assert json.loads(path.read_text(encoding="utf-8")) == {"name": "\udcff"}

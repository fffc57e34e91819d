"""The page of a problem without a model: its words, and the pictures and films that there are."""

import base64
import threading
import urllib.request

import pytest
from builders import made_up, point

from mjx_drax import DraxError
from mjx_drax.view.browser.pictures import show_pictures


def test_all_is_on_one_page(tmp_path):
    files = [tmp_path / "video.mp4", tmp_path / "plot.png"]
    for path in files:
        path.write_bytes(path.name.encode())
    told, there, until = [], threading.Event(), threading.Event()

    def tell(line):
        told.append(line)
        there.set()

    look = {"port": 0, "told": tell, "until": until}
    solution = made_up(point(name="a < b"))
    page = threading.Thread(target=show_pictures, args=(solution, files), kwargs=look)
    page.start()
    assert there.wait(10.0)
    with urllib.request.urlopen(told[0].split()[1], timeout=10.0) as answer:
        text = answer.read().decode()
    until.set()
    page.join(10.0)
    assert not page.is_alive()
    film, picture = (base64.b64encode(path.name.encode()).decode() for path in files)
    assert f'<video controls loop muted autoplay src="data:video/mp4;base64,{film}">' in text
    assert f'<img src="data:image/png;base64,{picture}"' in text
    assert text.index(film) < text.index(picture)
    assert "<h1>a &lt; b</h1>" in text
    assert "max|h| 0" in text
    assert "t = " not in text


def test_what_is_refused(tmp_path):
    solution = made_up(point())
    with pytest.raises(DraxError, match="point has no MuJoCo model to show, and there are no pict"):
        show_pictures(solution, [])
    with pytest.raises(DraxError, match="cannot read"):
        show_pictures(solution, [tmp_path / "gone.png"])
    (tmp_path / "plot.png").touch()
    with pytest.raises(DraxError, match="port is -1"):
        show_pictures(solution, [tmp_path / "plot.png"], port=-1)

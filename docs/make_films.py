"""Films of the gallery, from answers that are saved: python docs/make_films.py FOLDER...

    mjx-drax solve TASK --no-video --out FOLDER

writes a folder; its film is docs/TASK.webp. Those of bug_trap and cartpole_swingup show how knots
become a motion, and are of a solve: mjx-drax solve TASK --film docs/TASK.webp --size 640x480.
"""

import sys
from collections.abc import Generator
from pathlib import Path

import numpy as np
from PIL import Image

from mjx_drax import DraxError, Solution, tasks
from mjx_drax.view.frames import Frame, write
from mjx_drax.view.video import frames_of

DOCS = Path(__file__).parent
WIDTH, HEIGHT, FPS = 480, 360, 20
SECONDS = 3.0, 6.0  # a film takes, at least and at most, without the end that is held


def film(folder: str, docs: Path = DOCS) -> Path:
    """The best chain's replay as a film, in slow motion if it is short, and faster if it is long.

    Raises:
        DraxError: the folder holds no solution, or one that is not certified.
    """
    solution = Solution.load(folder)
    name = solution.problem.name
    if not solution.certified:
        raise DraxError(f"{folder} is not certified: solve {name} with more chains or iterations.")
    duration = float(solution.times[-1])
    frames = frames_of(
        solution,
        fps=FPS,
        size=(2 * WIDTH, 2 * HEIGHT),
        speed=duration / np.clip(duration, *SECONDS),
        draw=getattr(tasks.load(name), "draw", None),
    )
    return write(docs / f"{name}.webp", halved(frames), FPS)


def halved(frames: Generator[Frame, None, None]) -> Generator[Frame, None, None]:
    """Frames of half the size: smooth edges, also without a GPU."""
    for frame in frames:
        small = Image.fromarray(frame).resize((WIDTH, HEIGHT), Image.Resampling.BOX)
        yield np.asarray(small)


if __name__ == "__main__":
    for folder in sys.argv[1:]:
        path = film(folder)
        print(f"{path} {path.stat().st_size / 1000:.0f} kB", flush=True)

"""Frames with text on them, and files made of frames: .mp4, or .gif and .webp for web pages."""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Generator, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.files import complete, file_path

if TYPE_CHECKING:
    from PIL import Image
    from PIL.ImageFont import FreeTypeFont as Font

Frame = npt.NDArray[np.uint8]
"""A picture (height, width, 3)."""

UNCERTIFIED = "NOT CERTIFIED"
"""These words in a caption turn it red."""

DARK = (20, 25, 33)
"""Color of the strip under a frame, and of what stands between two of them."""

SUFFIXES = (".mp4", ".gif", ".webp")

_CLOCK = "00.00 s"  # where the time will stand
_LETTERS = 30  # letters of a caption are this share of the height
_LONG = 40  # a longer text of a caption may be broken [characters]
_CRF = 28  # H.264 quality: a quarter of the default's size, without visible loss
_WEBP_QUALITY = 60


def write(path: str | os.PathLike[str], frames: Generator[Frame, None, None], fps: float) -> Path:
    """Write frames into a file, all of one size, which `even_size` gives; returns its path.

    The ending of the name says how: .mp4 (H.264, which browsers play), .gif or .webp (which
    repeat). The file appears once it is complete.

    Raises:
      DraxError: before any frame is drawn, another ending or a folder that cannot be written to.
    """
    target = video_path(path)
    with contextlib.closing(frames), complete(target) as partial:
        partial.touch()  # complains before the first frame
        if target.suffix.lower() == ".mp4":
            _encode(partial, frames, fps)
        else:
            _animate(partial, frames, fps)
    return target


def video_path(path: str | os.PathLike[str]) -> Path:
    """The path of a video, which must have one of `SUFFIXES`; call it before a long computation."""
    target = file_path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise DraxError(f"{target.name!r} does not end in {' or '.join(SUFFIXES)}: rename it.")
    return target


def _encode(path: Path, frames: Iterator[Frame], fps: float) -> None:
    import imageio_ffmpeg
    import mediapy

    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())  # so that pip alone is enough
    first = next(frames)
    with mediapy.VideoWriter(
        path, first.shape[:2], fps=fps, crf=_CRF, ffmpeg_args=("-movflags", "+faststart")
    ) as writer:
        for frame in chain([first], frames):
            writer.add_image(frame)


def _animate(path: Path, frames: Iterable[Frame], fps: float) -> None:
    from PIL import Image

    images: list[Image.Image] = [Image.fromarray(frame) for frame in frames]
    gif = path.suffix.lower() == ".gif"
    unit = 10 if gif else 1  # [ms] what the format counts time in
    ends = [unit * round(1000 * i / (fps * unit)) for i in range(len(images) + 1)]
    durations = [max(unit, b - a) for a, b in pairwise(ends)]
    options: dict[str, Any] = {"quality": _WEBP_QUALITY, "method": 4}
    if gif:
        images, options = _with_palette(images), {"optimize": False, "disposal": 1}
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, **options
    )


def _with_palette(images: list[Image.Image]) -> list[Image.Image]:
    """The images, all with the same 256 colors, so that what does not move does not flicker."""
    from PIL import Image

    few = images[:: max(1, len(images) // 8)]
    width, height = images[0].size
    sheet = Image.new("RGB", (width, height * len(few)))
    for row, image in enumerate(few):
        sheet.paste(image, (0, row * height))
    palette = sheet.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    return [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]


def even_size(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height), within 16 and 8192, rounded up to even numbers, as H.264 needs them."""
    try:
        width, height = (int(side) for side in size)
    except (TypeError, ValueError, OverflowError):
        width = height = 0
    if isinstance(size, str) or not (16 <= width <= 8192 and 16 <= height <= 8192):
        raise DraxError(
            f"size is {shown(size)}: give (width, height), both within 16 and 8192 pixels."
        )
    return width + width % 2, height + height % 2


def captioned(frame: Frame, lines: Sequence[str], time: float, below: int) -> Frame:
    """The frame, and under it a strip of `below` rows with text; see `caption_height`.

    The strip is red if the text says `UNCERTIFIED`.
    """
    if not below:
        return frame
    from PIL import Image, ImageDraw

    height, width = len(frame) + below, frame.shape[1]
    font, rows = _fitted(tuple(lines), height, below, width)
    red = any(UNCERTIFIED in line for line in lines)
    image = Image.new("RGB", (width, below), (120, 22, 22) if red else DARK)
    text = "\n".join(rows).replace(_CLOCK, f"{time:.2f} s")
    gap = font.size // 2
    ImageDraw.Draw(image).multiline_text((gap, gap), text, (240, 243, 247), font, spacing=gap // 2)
    return np.concatenate([frame, np.asarray(image)])


def caption_height(captions: Iterable[Sequence[str]], height: int, width: int) -> int:
    """Rows of pixels, an even number, that hold any of these captions; 0 if all are empty.

    Args:
      captions: each a list of short texts, in which `{time}` becomes the frame's time.
      height, width: of a frame with its strip [pixels].
    """
    most = 0
    for lines in set(map(tuple, captions)):
        if lines:
            font = _font(max(9, height // _LETTERS))
            rows = _rows(lines, font, width)
            gap = font.size // 2
            most = max(most, int(2 * gap + len(rows) * (sum(font.getmetrics()) + gap // 2)))
    return min(2 * (-(-most // 2)), 2 * (height // 4))


@lru_cache(maxsize=64)
def _fitted(lines: tuple[str, ...], height: int, below: int, width: int) -> tuple[Font, list[str]]:
    """The largest font, up to the usual one, with which the texts fit into a strip; its rows."""
    for size in range(max(9, height // _LETTERS), 8, -1):
        font = _font(size)
        rows, gap = _rows(lines, font, width), size // 2
        if 2 * gap + len(rows) * (sum(font.getmetrics()) + gap // 2) <= below:
            break
    return font, rows


def _rows(lines: Sequence[str], font: Font, width: int) -> list[str]:
    """Texts one after the other, in rows that fit the width; only long texts are broken."""
    words = []
    for line in lines:
        line = line.replace("{time}", _CLOCK)
        parts = line.split(" ") if len(line) > _LONG else [line]
        words += [*parts[:-1], parts[-1] + "  "]
    rows = [""]
    for word in words:
        longer = f"{rows[-1]} {word}".lstrip()
        if font.getlength(longer.rstrip()) <= width - font.size or not rows[-1]:
            rows[-1] = longer
        else:
            rows.append(word)
    return rows


def _font(size: int) -> Font:
    """DejaVu Sans (it has mathematical signs), which matplotlib brings; else Pillow's own."""
    from PIL import ImageFont

    found = importlib.util.find_spec("matplotlib")  # located, not imported: that takes a second
    if found is not None and found.origin is not None:
        path = Path(found.origin).parent / "mpl-data/fonts/ttf/DejaVuSans.ttf"
        if path.exists():
            return ImageFont.truetype(str(path), size)
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font

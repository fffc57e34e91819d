"""Maps of obstacles, on the host: dark pixels, distances to them, and splines through these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mjx_drax.base.errors import DraxError, shown
from mjx_drax.base.numbers import numbers


def coefficients(values: np.ndarray) -> np.ndarray:
    """Of the natural cubic B-splines through values (n, ...), one more at each end of each axis.

    (c_{i-1} + 4 c_i + c_{i+1}) / 6 = v_i, and no second derivative at the ends.
    """
    for axis in range(values.ndim):
        v = np.moveaxis(values, axis, 0)
        c, ratio = v.copy(), np.zeros(len(v))
        for i in range(1, len(v) - 1):  # elimination downwards, then upwards
            ratio[i] = 1 / (4 - ratio[i - 1])
            c[i] = (6 * v[i] - c[i - 1]) * ratio[i]
        for i in range(len(v) - 2, 0, -1):
            c[i] -= ratio[i] * c[i + 1]
        ends = (2 * c[:1] - c[1:2], c, 2 * c[-1:] - c[-2:-1])
        values = np.moveaxis(np.concatenate(ends), 0, axis)
    return values


def to_squares(there: np.ndarray) -> np.ndarray:
    """From centres of the pixels (n, m) to the nearest pixel that is there, in pixels.

    Distances along the columns first; their squares and those along the rows add up.
    """
    n, m = there.shape
    index = np.arange(n)[:, None]
    before = np.maximum.accumulate(np.where(there, index, -np.inf), axis=0)
    after = np.minimum.accumulate(np.where(there, index, np.inf)[::-1], axis=0)[::-1]
    column = np.square(np.maximum(np.minimum(index - before, after - index) - 0.5, 0.0))
    least = column.copy()
    for k in range(1, m):
        more = (k - 0.5) ** 2
        if more >= least.max():
            break
        least[:, k:] = np.minimum(least[:, k:], column[:, :-k] + more)
        least[:, :-k] = np.minimum(least[:, :-k], column[:, k:] + more)
    return np.sqrt(least)


def dark_pixels(picture: str | Path | ArrayLike, threshold: float) -> np.ndarray:
    """Which pixels are obstacles."""
    if isinstance(picture, (str, Path)):
        from PIL import Image

        try:
            with Image.open(picture) as opened:
                if opened.mode.startswith("I"):  # 16 bits, which "L" would cut off at 255
                    picture = np.asarray(opened).astype(np.uint16)
                else:
                    picture = np.asarray(opened.convert("L"))
        except (OSError, ValueError) as error:
            raise DraxError(
                f"the image {shown(str(picture))} cannot be read: give a file such as map.png."
            ) from error
    try:
        pixels = np.asarray(picture)
        if pixels.dtype == bool:
            return pixels
        deep = pixels.dtype == np.uint16
        white = 65535.0 if deep else 255.0 if pixels.dtype.kind in "iu" else 1.0
        return numbers(pixels) < threshold * white
    except (TypeError, ValueError) as error:
        raise DraxError(f"the image is {shown(picture)}: give a file, or numbers.") from error

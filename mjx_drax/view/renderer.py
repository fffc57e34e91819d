"""Draws MuJoCo scenes without a display: with OpenGL where the machine has it, else with numpy.

Importing this module touches neither OpenGL nor the environment. The first frame that is ever drawn
decides how frames are drawn from then on: EGL (a GPU, or Mesa's llvmpipe), then OSMesa, then
`software_renderer` with one warning that names the missing packages. `MUJOCO_GL=egl` or `osmesa`
restricts the choice to that one, `MUJOCO_GL=off` to the software renderer.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import platform
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from mjx_drax.physics.engine import APT_EGL, mujoco
from mjx_drax.view.frames import Frame

_GL_OFF = ("off", "0", "false", "disable", "disabled")


class Renderer(Protocol):
    """Draws scenes of one model at one frame size."""

    def render(self, scene: mujoco.MjvScene) -> Frame:
        """The scene as its camera sees it."""


@contextlib.contextmanager
def open_renderer(model: mujoco.MjModel, height: int, width: int) -> Iterator[Renderer]:
    """A renderer with OpenGL if this machine has it, else the software renderer."""
    context = gl_context()
    if context is None:
        from mjx_drax.view.software_renderer import SoftwareRenderer  # imports Pillow

        yield SoftwareRenderer(model, height, width)
        return
    with contextlib.closing(_OpenGLRenderer(context, model, height, width)) as renderer:
        yield renderer


class _OpenGLRenderer:
    """An offscreen OpenGL buffer of any size; `mujoco.Renderer` picks its platform at import."""

    def __init__(
        self, context: Callable[[int, int], Any], model: mujoco.MjModel, height: int, width: int
    ) -> None:
        self._gl = context(width, height)
        self._gl.make_current()
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._cheap = _is_software()
        skies = model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX.value
        self._sky = None if skies.any() else _sky(height)
        samples = int(model.vis.quality.offsamples)
        try:
            if self._cheap:  # multisampling doubles a frame's time on a CPU
                model.vis.quality.offsamples = 0
            self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        finally:
            model.vis.quality.offsamples = samples
        mujoco.mjr_resizeOffscreen(width, height, self._mjr)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)

    def render(self, scene: mujoco.MjvScene) -> Frame:
        self._gl.make_current()  # another renderer may have been in between
        if self._cheap:
            scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        frame = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, scene, self._mjr)
        if self._sky is None:
            mujoco.mjr_readPixels(frame, None, self._rect, self._mjr)
            return frame[::-1]  # OpenGL counts rows from below
        empty = self._read(frame)
        found = np.where(empty, self._sky, frame[::-1])
        clear = [geom for geom in scene.geoms[: scene.ngeom] if 0.0 < geom.rgba[3] < 1.0]
        if not clear:
            return found
        # What is translucent leaves no depth: where it is in front of nothing, its share of the
        # colour is that of the same picture with all of it opaque
        alpha = [float(geom.rgba[3]) for geom in clear]
        for geom in clear:
            geom.rgba[3] = 1.0
        mujoco.mjr_render(self._rect, scene, self._mjr)
        solid = np.empty_like(frame)
        glass = empty & ~self._read(solid)
        for geom, before in zip(clear, alpha, strict=True):
            geom.rgba[3] = before
        seen, whole = (a[::-1].sum(axis=2, keepdims=True, dtype=float) for a in (frame, solid))
        share = np.clip(seen / np.maximum(whole, 1.0), 0.0, 1.0)
        mixed = np.clip(frame[::-1] + (1.0 - share) * self._sky, 0.0, 255.0).astype(np.uint8)
        return np.where(glass, mixed, found)

    def _read(self, frame: Frame) -> np.ndarray:
        """Read the picture, rows from below; where nothing is, (h, w, 1), rows from above."""
        depth = np.empty(frame.shape[:2], np.float32)
        mujoco.mjr_readPixels(frame, depth, self._rect, self._mjr)
        empty = (depth <= 0.0) | (depth >= 1.0)  # MuJoCo may turn the direction of depths
        return empty[::-1, :, None]

    def close(self) -> None:
        self._gl.make_current()
        self._mjr.free()
        self._gl.free()


def _sky(height: int) -> Frame:
    """A background for models that bring no sky, (height, 1, 3): blue above, nearly white below."""
    share = np.linspace(0.0, 1.0, height)[:, None, None]
    above, below = np.array([120.0, 160.0, 205.0]), np.array([232.0, 238.0, 244.0])
    return np.asarray((1.0 - share) * above + share * below, np.uint8)


def _is_software() -> bool:
    """Whether the current OpenGL context draws on the CPU."""
    from OpenGL import GL

    name = GL.glGetString(GL.GL_RENDERER) or b""
    return any(word in name.lower() for word in (b"llvmpipe", b"softpipe", b"swrast"))


@lru_cache(maxsize=1)
def gl_context() -> Callable[[int, int], Any] | None:
    """The first kind of OpenGL context that works here; None, with one warning, if none does."""
    failures = []
    for platform_name in _gl_platforms():
        try:
            return _tried_context(platform_name)
        except Exception as error:  # missing libraries raise whatever the bindings tripped over
            failures.append(f"{platform_name}: {error}")
    reason = "; ".join(failures) or f"MUJOCO_GL={os.environ.get('MUJOCO_GL')}"
    warnings.warn(
        f"no OpenGL ({reason}): frames are drawn by a simple software renderer. On Debian or "
        f"Ubuntu, `{APT_EGL}` gives better ones.",
        RuntimeWarning,
        stacklevel=2,
    )
    return None


def _gl_platforms() -> tuple[str, ...]:
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in _GL_OFF:
        return ()
    if wanted in ("egl", "osmesa"):
        return (wanted,)
    return {"Darwin": ("cgl",), "Windows": ("glfw",)}.get(platform.system(), ("egl", "osmesa"))


def _tried_context(platform_name: str) -> Callable[[int, int], Any]:
    """A kind of context, once one has been made and used; a failure leaves nothing behind."""
    modules = set(sys.modules)
    variable = os.environ.get("PYOPENGL_PLATFORM")
    try:
        context = importlib.import_module(f"mujoco.{platform_name}").GLContext
        _OpenGLRenderer(context, mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception:
        # PyOpenGL settles on a platform when it is imported: forget it, for the next attempt.
        for name in set(sys.modules) - modules:
            if name.split(".")[0] == "OpenGL" or name.startswith(f"mujoco.{platform_name}"):
                del sys.modules[name]
        raise
    finally:  # mujoco's module sets the variable and does not need it any more
        os.environ.pop("PYOPENGL_PLATFORM", None)
        if variable is not None:
            os.environ["PYOPENGL_PLATFORM"] = variable
    return context

"""Kernels in CUDA C++: compiled when they are first needed, and called from JAX.

NVRTC, which comes with JAX for CUDA, compiles a kernel for the sizes it is asked for. JAX launches
it as it launches kernels of Pallas: by the target `triton_kernel_call_ffi` of its CUDA plugin.
"""

from __future__ import annotations

import ctypes
import importlib.util
import zlib
from collections.abc import Mapping, Sequence
from ctypes import byref, c_char_p, c_size_t, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import jax
from jax import Array

from mjx_drax.base.errors import DraxError

TARGET = "triton_kernel_call_ffi"

OLDEST = 80
"""Compute capability from which on GPUs copy to shared memory while they do other work."""

SHARED_MEMORY = {80: 163, 87: 163, 90: 227, 100: 227, 103: 227, 110: 227}
"""KiB that a block of threads may have, by compute capability; 99 on other GPUs."""


WARP = 32
"""Threads that run in step."""


def tile(n: int) -> int:
    """Rows of a tile: large ones are fewer, and leave threads idle where there are few anyway."""
    return 2 if n <= 16 else 4


def triangle(n: int) -> int:
    """Entries of a lower triangle."""
    return n * (n + 1) // 2


def shared_memory() -> int:
    """Bytes that a block of threads may have; 0 if kernels cannot be compiled or launched here."""
    capability = _capability()
    if capability is None or capability < OLDEST or _launcher() is None or _nvrtc() is None:
        return 0
    return 1024 * SHARED_MEMORY.get(capability, 99)


def call(
    source: Path,
    kernel: str,
    sizes: Mapping[str, int | str],
    blocks: int,
    warps: int,
    shared: int,
    arrays: Sequence[Array],
    shapes: Sequence[tuple[int, ...]],
    numbers: Sequence[int],
) -> list[Array]:
    """The results of a kernel.

    Args:
        source: the file; it may include the headers that lie beside it.
        kernel: its name in there.
        sizes: macros.
        blocks: of threads.
        warps: of 32 threads in a block.
        shared: bytes of shared memory of a block.
        arrays: that are read, the first arguments of the kernel; all of one type.
        shapes: of the arrays that are written, of that type too, the next arguments.
        numbers: integers, the last arguments.
    """
    launcher, capability = _launcher(), _capability()
    assert launcher is not None
    assert capability is not None
    ptx = compiled(source, tuple(f"-D{k}={v}" for k, v in sizes.items()))
    program = launcher.TritonKernel(kernel, warps, 1, shared, ptx, "", capability)
    pointers = [launcher.create_array_parameter(0, 16)] * (len(arrays) + len(shapes))
    scalars = [launcher.create_scalar_parameter(n, "i32") for n in numbers]
    made = launcher.TritonKernelCall(program, blocks, 1, 1, [*pointers, *scalars])
    out = [jax.ShapeDtypeStruct(shape, arrays[0].dtype) for shape in shapes]
    launch = jax.ffi.ffi_call(TARGET, out)
    opaque = zlib.compress(made.to_proto(kernel, b""))
    return list(launch(*arrays, name=kernel, opaque=opaque))


@cache
def compiled(source: Path, macros: tuple[str, ...]) -> str:
    """PTX of a kernel for the GPU of this machine."""
    nvrtc, capability = _nvrtc(), _capability()
    assert nvrtc is not None
    assert capability is not None
    program, size, text = c_void_p(), c_size_t(), source.read_bytes()
    headers = sorted(source.parent.glob("*.cuh"))
    texts, names = (
        (c_char_p * len(headers))(*each)
        for each in ([h.read_bytes() for h in headers], [h.name.encode() for h in headers])
    )
    nvrtc.nvrtcCreateProgram(byref(program), text, b"kernel.cu", len(headers), texts, names)
    architecture = f"--gpu-architecture=compute_{_architecture(nvrtc, capability)}"
    options = [architecture, "--std=c++17", "--ftz=true", *macros]
    given = (c_char_p * len(options))(*(option.encode() for option in options))
    failed = nvrtc.nvrtcCompileProgram(program, len(options), given)
    if failed:
        nvrtc.nvrtcGetProgramLogSize(program, byref(size))
        log = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetProgramLog(program, log)
        raise DraxError(f"NVRTC cannot compile a kernel ({macros}):\n{log.value.decode()}")
    nvrtc.nvrtcGetPTXSize(program, byref(size))
    ptx = ctypes.create_string_buffer(size.value)
    nvrtc.nvrtcGetPTX(program, ptx)
    nvrtc.nvrtcDestroyProgram(byref(program))
    return ptx.value.decode()


def _architecture(nvrtc: Any, capability: int) -> int:
    """The newest that NVRTC knows, up to the GPU's own."""
    count = ctypes.c_int()
    nvrtc.nvrtcGetNumSupportedArchs(byref(count))
    known = (ctypes.c_int * count.value)()
    nvrtc.nvrtcGetSupportedArchs(known)
    return max(a for a in known if a <= capability)


@cache
def _capability() -> int | None:
    """Compute capability of the first GPU, such as 90; None without one of NVIDIA's."""
    try:
        version = str(jax.local_devices(backend="cuda")[0].compute_capability)
    except RuntimeError:
        return None
    return int(version.replace(".", ""))


@cache
def _launcher() -> Any:
    """JAX's module that makes calls of kernels, or None."""
    try:
        from jaxlib import gpu_triton

        plugin = gpu_triton._cuda_triton
        return gpu_triton if plugin and TARGET in plugin.registrations() else None
    except (ImportError, AttributeError):
        return None


@cache
def _nvrtc() -> Any:
    """NVIDIA's runtime compiler, of a Python package or of the system; or None."""
    spec = importlib.util.find_spec("nvidia")
    folders = map(Path, spec.submodule_search_locations or ()) if spec else ()
    packaged = [file for f in folders for file in sorted(f.glob("*/lib/libnvrtc.so.*"))]
    for name in [*map(str, packaged), "libnvrtc.so.13", "libnvrtc.so.12"]:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None

"""CUDA kernels of the package, compiled for a CPU and run there."""

import ctypes
import subprocess
from pathlib import Path

import numpy as np

PROGRAM = """
#include "cuda_on_cpu.h"
#include "{source}"
extern "C" int shared() {{ return BLOCK_SIZE / THREADS * SHARED; }}
extern "C" void run(int blocks, REAL** p, int* n) {{
  launch(blocks, BLOCK_SIZE, shared(), [=] {{ {kernel}({arguments}); }});
}}
extern "C" int constant() {{ return {constant}; }}
"""


def caller(folder, calls, constant="SHARED"):
    """What takes the place of `cuda.call`; appends the macros of each kernel to `calls`.

    With the value of a constant of the kernel beside them, by its name.
    """

    def call(source, kernel, sizes, blocks, warps, shared, arrays, shapes, numbers):
        results = [np.full(shape, np.nan, arrays[0].dtype) for shape in shapes]
        given = [*(np.ascontiguousarray(a) for a in arrays), *results]
        arguments = [f"p[{i}]" for i in range(len(given))]
        arguments += [f"n[{i}]" for i in range(len(numbers))]
        program = folder / f"{len(calls)}.cpp"
        words = {"source": source.name, "kernel": kernel, "constant": constant}
        program.write_text(PROGRAM.format(arguments=", ".join(arguments), **words))
        # -Bsymbolic: its sync() is not that of the C library
        compiler = ["g++", "-std=c++20", "-shared", "-fPIC", "-pthread", "-Wl,-Bsymbolic"]
        folders = [f"-I{Path(__file__).parent}", f"-I{source.parent}"]
        macros = [f"-D{name}={value}" for name, value in sizes.items()]
        library = program.with_suffix(".so")
        subprocess.run([*compiler, *folders, *macros, "-o", library, program], check=True)
        compiled = ctypes.CDLL(str(library))
        assert shared == compiled.shared() * arrays[0].dtype.itemsize
        assert warps == max(sizes["THREADS"] // 32, 1)
        pointers = (ctypes.c_void_p * len(given))(*(a.ctypes.data for a in given))
        compiled.run(blocks, pointers, (ctypes.c_int * len(numbers))(*numbers))
        calls.append({**sizes, constant: compiled.constant()})
        return results

    return call

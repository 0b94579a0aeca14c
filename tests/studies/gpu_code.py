"""What the compiler makes of the CUDA kernels, held without a GPU.

Each kernel is compiled to PTX and assembled for compute capability 9.0; registers and local
memory are what ptxas reports, loops are found in the machine code itself (backward branches),
where instructions, loads and double precision are counted. In an environment of its own,
because numba's package for CUDA wants an older numpy:

    python -m venv out/gpu-code
    out/gpu-code/bin/pip install "numba-cuda[cu12]" nvidia-cuda-nvcc-cu12 "numpy<2.5"
    out/gpu-code/bin/python tests/studies/gpu_code.py

Ends with status 1 where a kernel is beyond its budget, 3 where a package is missing.
"""

from __future__ import annotations

import importlib.util
import re
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

REGISTERS = 64
"""Most registers a thread: 32 warps of 64 have room on one multiprocessor."""
LOADS = 12
"""Least loads in the forward kernel's unrolled body."""
A_SLAB = {"project_slabs": 40, "project_columns": 28}
"""Most instructions for a slab in that body."""
UNROLLED = 4
LOAD, BRANCH = 0x181, 0x147
LOCAL = {0x183: "LDL", 0x187: "STL"}
PUT_ASIDE = {"project_columns": 64}
"""Most bytes of local memory of kernels that put numbers aside outside of their inner loops."""
DOUBLE = {0x028: "DMUL", 0x029: "DADD", 0x02A: "DSETP", 0x02B: "DFMA"}
PACKAGE = Path(__file__).parents[2] / "twin"


@dataclass(frozen=True)
class Code:
    """A kernel as it was compiled: its loops as lists of operation codes."""

    registers: int
    local_bytes: int
    loops: list[list[int]]

    @property
    def local_in_loops(self) -> int:
        """Loads and stores of local memory in inner loops."""
        return sum(op in LOCAL for loop in self.loops for op in loop)

    @property
    def busiest(self) -> list[int]:
        """The innermost loop with most loads."""
        return max(self.loops, key=lambda loop: (loop.count(LOAD), -len(loop)))


def load_kernels(name: str) -> Any:
    """A module of kernels by its path in twin/; it imports nothing of flexdt."""
    file = PACKAGE / name
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module


def compiled(kernel: Any, signature: tuple[Any, ...], ptxas: Path) -> Code:
    """Compile and assemble a kernel for compute capability 9.0.

    Args:
        kernel: numba's.
        signature: types of its arguments.
        ptxas: the assembler.

    Raises:
        subprocess.CalledProcessError: it is not assembled.
    """
    from numba import cuda

    ptx, _ = cuda.compile_ptx(kernel.py_func, signature, cc=(9, 0))
    with tempfile.TemporaryDirectory() as folder:
        source, binary = Path(folder) / "kernel.ptx", Path(folder) / "kernel.cubin"
        source.write_text(ptx)
        limit = getattr(kernel, "targetoptions", {}).get("max_registers")
        limits = [f"-maxrregcount={limit}"] if limit else []
        done = subprocess.run(
            [ptxas, "-v", "-arch=sm_90", *limits, source, "-o", binary],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        words = text_section(binary.read_bytes())
    (registers,) = re.findall(r"Used (\d+) registers", done.stderr)
    (frame,) = re.findall(r"(\d+) bytes stack frame", done.stderr)
    return Code(int(registers), int(frame), innermost_loops(words))


def text_section(elf: bytes) -> list[tuple[int, int]]:
    """The machine code of an ELF file with one kernel: (low, high) words of each
    instruction.

    Raises:
        ValueError: there is none.
    """
    (table,) = struct.unpack_from("<Q", elf, 40)
    size, count, names = struct.unpack_from("<3H", elf, 58)
    sections = [
        struct.unpack_from("<IIQQQQ", elf, table + i * size) for i in range(count)
    ]
    strings = sections[names][4]
    for name, _, _, _, offset, length in sections:
        if elf[strings + name :].startswith(b".text."):
            return list(struct.iter_unpack("<QQ", elf[offset : offset + length]))
    raise ValueError("no machine code in this file")


def innermost_loops(words: list[tuple[int, int]]) -> list[list[int]]:
    """Operation codes of every loop that holds no other: from a backward branch's target to
    it."""
    codes = [low & 0x1FF for low, _ in words]
    spans = []
    for i, (low, _) in enumerate(words):
        if codes[i] == BRANCH:
            # Words of 4 bytes from the next instruction on: 8 bits at 16, the rest from 34 on.
            (rest,) = struct.unpack("<i", struct.pack("<I", low >> 32))
            jump = ((rest >> 2) * 256 + (low >> 16 & 0xFF)) // 4
            if -i - 1 <= jump < -1:  # -1 is the branch to itself at a kernel's end
                spans.append((i + 1 + jump, i))
    inner = [
        (a, b)
        for a, b in spans
        if not any((c, d) != (a, b) and a <= c and d <= b for c, d in spans)
    ]
    return [codes[a : b + 1] for a, b in inner]


def all_kernels() -> dict[str, tuple[Any, tuple[Any, ...]]]:
    """Every kernel by name, with the types of its arguments."""
    from numba import boolean, float32, float64, int32, int64, types

    project = load_kernels("projection/kernels/gpu_kernels.py")
    fdk = load_kernels("reconstruction/kernels/gpu_reconstruction_kernels.py")
    table, images, flat2 = float64[:, ::1], float32[:, :, ::1], float32[:, ::1]
    flat, counts, edges = (
        float32[::1],
        types.UniTuple(int64, 3),
        types.UniTuple(float32, 3),
    )

    def walk(voxel: Any) -> tuple[Any, ...]:
        """The types of a walking kernel's arguments, for voxels of one type."""
        return (
            voxel[::1], *[int64] * 6, *[float64] * 3, table, int64, int64, float32[::1],
            *[int64] * 4, float64,
        )  # fmt: skip

    sizes, tables, shares = (
        (int64, int64, int64),
        (flat2, flat2, flat2, images),
        (flat,) * 6,
    )
    rows_of_two = (images, *sizes, *tables, int32[::1], *shares, int64, images)
    return {
        "project_slabs": (project.project_slabs, walk(float32)),
        "spread_slabs": (project.spread_slabs, walk(float32)),
        "spread_slabs, deterministic": (project.spread_slabs, walk(int64)),
        "project_columns": (project.project_columns, walk(float32)),
        "spread_columns": (project.spread_columns, walk(float32)),
        "project_rays": (project.project_rays, walk(float32)),
        "spread_rays": (project.spread_rays, walk(float32)),
        "spread_rays, deterministic": (project.spread_rays, walk(int64)),
        "clear": (project.clear, (float32[::1],)),
        "unscale": (project.unscale, (int64[::1], float64, float32[::1])),
        "weigh": (fdk.weigh, (images, int64, flat2, flat2, flat2, images)),
        "filter_rows": (fdk.filter_rows, rows_of_two),
        "convolve": (fdk.convolve, (images, float32[::1], int64, images)),
        "backproject": (
            fdk.backproject,
            (float32[::1], int64, int64, table, float64[::1], float64[::1], images),
        ),
        "combine": (
            project.combine,
            (int64, float32[::1], float32[::1], float32, boolean, float32[::1]),
        ),
        "lengths": (fdk.lengths, (flat, counts, int64, edges, flat)),
        "primal_step": (
            fdk.primal_step,
            (flat, flat, float32, counts, int64, edges, float32, flat, flat),
        ),
        "dual_step": (
            fdk.dual_step,
            (flat, flat, flat, float32, float32, counts, int64, edges),
        ),
        "fold": (project.fold, (int64, float32[::1], float32[::1], float64[::1])),
    }


def faults(name: str, code: Code) -> list[str]:
    """What of a kernel's code is beyond the budget, a text for each; empty if nothing is."""
    loop = code.busiest if code.loops else []
    found = []
    if code.registers > REGISTERS:
        found.append(f"{code.registers} registers, allowed {REGISTERS}")
    if code.local_bytes > PUT_ASIDE.get(name, 0) or code.local_in_loops:
        found.append(
            f"{code.local_bytes} bytes of local memory, {code.local_in_loops} in loops"
        )
    if any(set(some) & set(DOUBLE) for some in code.loops):
        found.append("double precision in an inner loop")
    if name in A_SLAB:
        if loop.count(LOAD) < LOADS:
            found.append(f"{loop.count(LOAD)} loads in the unrolled body, wanted {LOADS}")
        if len(loop) > A_SLAB[name] * UNROLLED:
            found.append(
                f"{len(loop) / UNROLLED} instructions a slab, allowed {A_SLAB[name]}"
            )
    return found


def main() -> int:
    """Report on all kernels."""
    try:
        import numba_cuda  # noqa: F401
        from nvidia import cuda_nvcc
    except ImportError as error:
        print(f"not compiled: {error}; see the head of this file")
        return 3
    ptxas = Path(next(iter(cuda_nvcc.__path__))) / "bin" / "ptxas"
    status = 0
    for name, (kernel, signature) in all_kernels().items():
        code = compiled(kernel, signature, ptxas)
        loop = code.busiest if code.loops else []
        doubles = sum(op in DOUBLE for some in code.loops for op in some)
        wrong = faults(name, code)
        print(
            f"{name:28} {code.registers:3} registers, {code.local_bytes} B local, busiest loop "
            f"{len(loop)} instructions with {loop.count(LOAD)} loads, {doubles} in double "
            f"precision in inner loops{': ' if wrong else ''}{'; '.join(wrong)}",
            flush=True,
        )
        status = max(status, int(bool(wrong)))
    return status


if __name__ == "__main__":
    sys.exit(main())

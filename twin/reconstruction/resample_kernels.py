"""Adding a detector column, resampled with constant step, to a column of voxels.

Sixteen voxels at a time by register permutation where the processor has AVX-512, one by one
elsewhere; the results differ by rounding only.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils, config
from numba.extending import intrinsic

from flexdt.twin.projection.kernels.compiling import kernel

LANES = 16
STEEPEST = 1.9
"""Largest step [samples a voxel] for which sixteen voxels lie within 32 samples."""
MARGIN = 32
"""Samples after the end of a line that may be read but do not count."""

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


def _spread(builder: Any, value: Any) -> Any:
    none = ir.Constant(_FLOATS, ir.Undefined)
    one = builder.insert_element(none, value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, none, ir.Constant(_INTS, [0] * LANES))


@intrinsic
def resample_lanes(
    typingctx: Any, acc: Any, k: Any, line: Any, at: Any, v: Any, step: Any, weight: Any
) -> Any:
    """acc[k + i] += weight * line at (at + v + i step), linear, 0 <= i < 16; AVX-512 only.

    Needs 0 <= v + i step < 31; reads line[at : at + 32].
    """

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        to = context.make_array(signature.args[0])(context, b, args[0]).data
        source = context.make_array(signature.args[2])(context, b, args[2]).data
        target = b.bitcast(b.gep(to, [args[1]]), _FLOATS.as_pointer())
        begin = b.gep(source, [args[3]])
        # line[at : at + 32] in two registers, between whose samples the permutation picks.
        halves = []
        for offset in (0, LANES):
            address = b.gep(begin, [ir.IntType(64)(offset)])
            half = b.load(b.bitcast(address, _FLOATS.as_pointer()))
            half.align = 4
            halves.append(half)
        # place[i] = v + i step; index and share are its whole part and its rest.
        ramp = ir.Constant(_FLOATS, [float(i) for i in range(LANES)])
        place = b.fadd(b.fmul(ramp, _spread(b, args[5])), _spread(b, args[4]))
        index = b.fptosi(place, _INTS)
        share = b.fsub(place, b.sitofp(index, _FLOATS))
        pick = cgutils.get_or_insert_function(
            b.module,
            ir.FunctionType(_FLOATS, [_FLOATS, _INTS, _FLOATS]),
            "llvm.x86.avx512.vpermi2var.ps.512",
        )
        # acc[k + i] += weight * (low + share * (high - low)), low and high being neighbours.
        low = b.call(pick, [halves[0], index, halves[1]])
        following = b.add(index, ir.Constant(_INTS, [1] * LANES))
        high = b.call(pick, [halves[0], following, halves[1]])
        value = b.fadd(low, b.fmul(share, b.fsub(high, low)))
        before = b.load(target)
        before.align = 4
        after = b.store(b.fadd(before, b.fmul(_spread(b, args[6]), value)), target)
        after.align = 4
        return context.get_dummy_value()

    return types.void(acc, k, line, at, v, step, weight), codegen


def has_wide_permute() -> bool:
    """Whether numba compiles for a processor with AVX-512."""
    if config.CPU_NAME or config.CPU_FEATURES:
        return False
    return bool(binding.get_host_cpu_features().get("avx512f", False))


@kernel
def add_line(acc, line, first, count, start, step, weight):
    """acc[first + k] += weight * line at (start + k step), linear; 0 <= k < count, all inside."""
    for k in range(count):
        at = start + k * step
        i = np.uint64(at)
        value = line[i]
        share = np.float32(at - i)
        acc[first + k] += weight * (value + share * (line[i + np.uint64(1)] - value))


@kernel
def add_line_wide(acc, line, first, count, start, step, weight):
    """`add_line`, sixteen at a time while that fits; line needs MARGIN samples after its end."""
    k = 0
    if abs(step) < STEEPEST:
        narrow = np.float32(step)
        down = min(0.0, (LANES - 1) * step)
        while k + LANES <= count:
            at = start + k * step
            # The lowest sample needed; the rounding of sixteen steps must not fall below it.
            base = max(math.floor(at + down - 1e-3), 0)
            resample_lanes(acc, first + k, line, base, np.float32(at - base), narrow, weight)
            k += LANES
    add_line(acc, line, first + k, count - k, start + k * step, step, weight)

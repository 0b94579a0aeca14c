"""Adding a detector column, resampled with constant step, to a column of voxels.

Sixteen voxels at a time by register permutation where the processor has AVX-512, eight where it has
AVX2, one by one elsewhere; the results differ by rounding only. Registers begin at multiples of
their length, so that a slab of a volume that begins at one is the whole volume's, bit by bit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from flexdt.twin.projection.kernels.compiling import kernel


def lanes() -> int:
    """Voxels to a register of the processor that numba compiles for: 16, 8 or 1."""
    asked = config.CPU_FEATURES
    features = (get_host_cpu_features() if asked is None else asked).split(",")
    return 16 if "+avx512f" in features else 8 if "+avx2" in features else 1


LANES = lanes()
STEEPEST = 1.9
"""Largest step [samples a voxel] for which LANES voxels lie within 2 LANES samples."""
MARGIN = 32
"""Samples after the end of a line that may be read but do not count."""

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


def _spread(builder: Any, value: Any) -> Any:
    none = ir.Constant(_FLOATS, ir.Undefined)
    one = builder.insert_element(none, value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, none, ir.Constant(_INTS, [0] * LANES))


def _pick(builder: Any, low: Any, high: Any, index: Any) -> Any:
    """Samples of two registers, one after the other, by their index."""

    def permute(name: str, *args: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [arg.type for arg in args])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    if LANES == 16:
        return permute("llvm.x86.avx512.vpermi2var.ps.512", low, index, high)
    # AVX2 permutes one register; of an index only the last three bits count.
    beyond = builder.icmp_signed(">=", index, ir.Constant(_INTS, [LANES] * LANES))
    low, high = (permute("llvm.x86.avx2.permps", half, index) for half in (low, high))
    return builder.select(beyond, high, low)


@intrinsic
def resample_lanes(
    typingctx: Any, acc: Any, k: Any, line: Any, at: Any, v: Any, step: Any, weight: Any
) -> Any:
    """acc[k + i] += weight * line at (at + v + i step), linear, 0 <= i < LANES; not for 1 lane.

    Needs 0 <= v + i step < 2 LANES - 1; reads line[at : at + 2 LANES].
    """

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        to = context.make_array(signature.args[0])(context, b, args[0]).data
        source = context.make_array(signature.args[2])(context, b, args[2]).data
        target = b.bitcast(b.gep(to, [args[1]]), _FLOATS.as_pointer())
        begin = b.gep(source, [args[3]])
        # line[at : at + 2 LANES] in two registers, between whose samples the permutation picks.
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
        # acc[k + i] += weight * (low + share * (high - low)), low and high being neighbours.
        low = _pick(b, halves[0], halves[1], index)
        high = _pick(b, halves[0], halves[1], b.add(index, ir.Constant(_INTS, [1] * LANES)))
        value = b.fadd(low, b.fmul(share, b.fsub(high, low)))
        before = b.load(target)
        before.align = 4
        after = b.store(b.fadd(before, b.fmul(_spread(b, args[6]), value)), target)
        after.align = 4
        return context.get_dummy_value()

    return types.void(acc, k, line, at, v, step, weight), codegen


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
    """`add_line`, LANES at a time while that fits; line needs MARGIN samples after its end."""
    k = 0
    if abs(step) < STEEPEST:
        narrow = np.float32(step)
        down = min(0.0, (LANES - 1) * step)
        k = min(-first % LANES, count)
        add_line(acc, line, first, k, start, step, weight)
        while k + LANES <= count:
            at = start + k * step
            # The lowest sample needed; the rounding of so many steps must not fall below it.
            base = max(math.floor(at + down - 1e-3), 0)
            resample_lanes(acc, first + k, line, base, np.float32(at - base), narrow, weight)
            k += LANES
    add_line(acc, line, first + k, count - k, start + k * step, step, weight)


# Chosen here, not in a kernel: an instruction that the processor lacks must not even be compiled.
add_column = add_line if LANES == 1 else add_line_wide

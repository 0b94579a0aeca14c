"""Two columns of an image mixed, and the result, resampled with constant step, added to a column
of voxels.

Sixteen voxels at a time by register permutation where the processor has AVX-512, eight where it has
AVX2, one by one elsewhere; the results differ by rounding only. Registers begin at multiples of
their length, so that a slab of a volume that begins at one is the whole volume's, bit by bit.

Places on a line are integers with 44 bits behind the point: from register to register they are
added to, and their whole part is a shift, where in floating point half the time went.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from flexdt.twin.projection.kernels.compiling import fused, kernel


def lanes() -> int:
    """Voxels to a register of the processor that numba compiles for: 16, 8 or 1."""
    asked = config.CPU_FEATURES
    features = (get_host_cpu_features() if asked is None else asked).split(",")
    if "+fma" not in features:
        return 1
    return 16 if "+avx512f" in features else 8 if "+avx2" in features else 1


LANES = lanes()
STEEPEST = 1.9
"""Largest step [samples a voxel] for which LANES voxels lie within 2 LANES samples."""
MARGIN = 32
"""Samples after the end of a line that may be read or written, but do not count."""
POINT = 44
"""Bits behind the point of a place on a line."""

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


def _at(context: Any, builder: Any, signature: Any, args: Any, array: int, index: Any) -> Any:
    """Where LANES values of the argument number `array` begin."""
    data = context.make_array(signature.args[array])(context, builder, args[array]).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


def _load(builder: Any, address: Any) -> Any:
    value = builder.load(address)
    value.align = 4
    return value


def _fma(builder: Any, *args: Any) -> Any:
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
    name = f"llvm.fma.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)


@intrinsic
def mix_lanes(
    typingctx: Any, out: Any, r: Any, left: Any, right: Any, at: Any, one: Any, other: Any
) -> Any:
    """out[r + i] = one * left[at + i] + other * right[at + i], 0 <= i < LANES; not for 1 lane."""

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        left = _load(b, _at(context, b, signature, args, 2, args[4]))
        right = _load(b, _at(context, b, signature, args, 3, args[4]))
        mixed = _fma(b, left, _spread(b, args[5]), b.fmul(right, _spread(b, args[6])))
        b.store(mixed, _at(context, b, signature, args, 0, args[1])).align = 4
        return context.get_dummy_value()

    return types.void(out, r, left, right, at, one, other), codegen


@intrinsic
def resample_lanes(typingctx: Any, acc: Any, k: Any, line: Any, at: Any, v: Any, step: Any) -> Any:
    """acc[k + i] += line at (at + v / 2^POINT + i step), linear, 0 <= i < LANES; not for 1 lane.

    Needs 0 <= v / 2^POINT + i step < 2 LANES - 1; reads line[at : at + 2 LANES].
    """

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        target = _at(context, b, signature, args, 0, args[1])
        # line[at : at + 2 LANES] in two registers, between whose samples the permutation picks.
        second = b.add(args[3], ir.IntType(64)(LANES))
        first, second = (
            _load(b, _at(context, b, signature, args, 2, i)) for i in (args[3], second)
        )
        # place[i] = v / 2^POINT + i step; index and share are its whole part and its rest.
        ramp = ir.Constant(_FLOATS, [float(i) for i in range(LANES)])
        steps = b.fmul(ramp, _spread(b, args[5]))
        unit = ir.Constant(_FLOATS, [2.0**-POINT] * LANES)
        place = _fma(b, _spread(b, b.sitofp(args[4], ir.FloatType())), unit, steps)
        index = b.fptosi(place, _INTS)
        share = b.fsub(place, b.sitofp(index, _FLOATS))
        # acc[k + i] += low + share * (high - low), low and high being neighbours.
        low = _pick(b, first, second, index)
        high = _pick(b, first, second, b.add(index, ir.Constant(_INTS, [1] * LANES)))
        after = _fma(b, share, b.fsub(high, low), b.fadd(_load(b, target), low))
        b.store(after, target).align = 4
        return context.get_dummy_value()

    return types.void(acc, k, line, at, v, step), codegen


@fused
def mix_one_by_one(out, left, right, first, count, one, other):
    """out[r] = one * left[first + r] + other * right[first + r], 0 <= r < count."""
    for r in range(count):
        out[r] = one * left[first + r] + other * right[first + r]


@kernel
def mix_wide(out, left, right, first, count, one, other):
    """`mix_one_by_one`, LANES at a time; all need up to LANES - 1 values after their end."""
    for r in range(0, count, LANES):
        mix_lanes(out, r, left, right, first + r, one, other)


@kernel
def add_line(acc, line, first, count, start, step):
    """acc[first + k] += line at (start + k step), linear; 0 <= k < count, all inside."""
    for k in range(count):
        at = start + k * step
        i = np.uint64(at)
        value = line[i]
        acc[first + k] += value + np.float32(at - i) * (line[i + np.uint64(1)] - value)


@kernel
def add_line_wide(acc, line, first, count, start, step):
    """`add_line`, LANES at a time while that fits; line needs MARGIN samples after its end."""
    k = np.int64(0)
    if abs(step) < STEEPEST:
        narrow = np.float32(step)
        k = np.int64(min(-first % LANES, count))
        if k > 0:
            add_line(acc, line, first, k, start, step)
        place = np.int64((start + k * step) * 2.0**POINT)
        on = np.int64(LANES * step * 2.0**POINT)
        # From the first voxel of a register to the one with the lowest place.
        down = np.int64(min(0.0, (LANES - 1) * step) * 2.0**POINT)
        while k + LANES <= count:
            # Rounding may put the lowest a little below the line's beginning.
            base = max((place + down) >> POINT, 0)
            resample_lanes(acc, first + k, line, base, place - (base << POINT), narrow)
            place += on
            k += LANES
    if k < count:
        add_line(acc, line, first + k, count - k, start + k * step, step)


# Chosen here, not in a kernel: an instruction that the processor lacks must not even be compiled.
add_column = add_line if LANES == 1 else add_line_wide
mix_columns = mix_one_by_one if LANES == 1 else mix_wide

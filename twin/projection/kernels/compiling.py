"""How all kernels are compiled, two processor instructions that numba has no name for, and a key
that keeps numba's disk cache honest.

A voxel column starts on a new page as often as not, where the hardware's own prefetchers start
from nothing: prefetching a few steps ahead doubled the projector's speed on one core. numba deals
out the iterations of a parallel loop beforehand; workers that fetch their next job from a counter
do not wait for the slowest.
"""

from __future__ import annotations

import inspect
import zlib
from functools import partial
from types import ModuleType
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

# No reference counting: in loops of 100 ns it would cost as much as the work. Such functions may
# slice arrays, but not make new ones.
# Only entry points (`parallel`) go to the disk cache: a cached inner function would not notice
# that a function it calls has changed.
kernel = partial(njit, error_model="numpy", _nrt=False)
inline = partial(kernel, forceinline=True)
fused = partial(kernel, fastmath={"contract", "nsz"})
maker = partial(njit, error_model="numpy")
parallel = partial(njit, cache=True, error_model="numpy", parallel=True, nogil=True)


def sources(*modules: ModuleType) -> int:
    """A number that changes with the text of modules.

    numba's disk cache of a function watches the function's own file only. An entry point that calls
    kernels of other files refers to this number as a free variable, which is part of the cache's
    key; otherwise an edited kernel would go on running in its old form.
    """
    text = "".join(inspect.getsource(module) for module in modules)
    return zlib.crc32(text.encode())


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """prefetch(array, index): fetch array[index]'s cache line for reading; any index is safe."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args)
        byte = builder.bitcast(address, ir.IntType(8).as_pointer())
        word = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte.type, word, word, word])
        call = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        # For reading, into all caches, data.
        builder.call(call, [byte, word(0), word(3), word(1)])
        return context.get_dummy_value()

    return types.void(array, index), codegen


@intrinsic
def fetch_next(typingctx: Any, counter: Any) -> Any:
    """fetch_next(counter): counter[0] before one is added to it, atomically; counter is int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.IntType(64)
        address = _address(context, builder, signature.args[0], args[0], word(0))
        return builder.atomic_rmw("add", address, word(1), "monotonic")

    return types.int64(counter), codegen

"""How all kernels are compiled, two processor instructions that numba has no name for, and a key
that keeps numba's disk cache honest.

A voxel column starts on a new page as often as not, where the hardware's own prefetchers start
from nothing: prefetching a few steps ahead doubled the projector's speed on one core. numba deals
out the iterations of a parallel loop beforehand; workers that fetch their next job from a counter
do not wait for the slowest.

numba optimises and assembles each function that it compiles, with all that it calls, and again as
part of each function that calls it: a kernel four calls deep in a parallel loop eight times. Here
only an entry point (`parallel`, `serial`) is, at the end, with all that was linked into it; results
are the same to the last bit, and compiling takes less than half the time.
"""

from __future__ import annotations

import ctypes
import inspect
import logging
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import ModuleType
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.extending import intrinsic

from flexdt.twin import long_work

LOG = logging.getLogger("flexdt.kernels")
"""To standard error, unless the program has set up logging."""
SLOW = "flexdt: compiling %s (once on this machine; some seconds, and perhaps other kernels)"
"""What a process says when it first compiles, instead of loading from the disk cache."""


class _LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code to be linked into that of callers, as it is."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int | None:
        # Only Python would call this; it raises TypeError, as arguments are no attribute's name.
        self._ensure_finalized()
        return ctypes.cast(ctypes.pythonapi.PyObject_GenericGetAttr, ctypes.c_void_p).value


@contextmanager
def _linking(codegen: Any) -> Iterator[None]:
    """Until the end, under numba's compiler lock, all libraries but those that exist are linked."""
    if "_library_class" in vars(codegen):
        yield
        return

    def set_env(name: str, env: object) -> None:
        if codegen._engine.get_global_value_address(name):
            type(codegen).set_env(codegen, name, env)

    codegen._library_class, codegen.set_env = _LinkedLibrary, set_env
    try:
        yield
    finally:
        del codegen._library_class, codegen.set_env


class _Linked(Compiler):  # type: ignore[misc]
    def _compile_core(self) -> Any:
        with _linking(self.state.targetctx.codegen()):
            return super()._compile_core()


class _EntryPoint(_Linked):
    silent = False

    def _compile_core(self) -> Any:
        name = self.state.func_id.func_name
        if not _EntryPoint.silent:
            LOG.warning(SLOW, name)
            _EntryPoint.silent = True
        library = JITCodeLibrary(self.state.targetctx.codegen(), name)
        library.enable_object_caching()
        self.state.library = library
        with long_work.during(f"compiling {name}"):
            return super()._compile_core()


# Only entry points go to the disk cache: a cached inner function would not notice that a function
# it calls has changed. They call no other entry points.
parallel = partial(
    njit, cache=True, error_model="numpy", parallel=True, nogil=True, pipeline_class=_EntryPoint
)
serial = partial(njit, cache=True, nogil=True, pipeline_class=_EntryPoint)
linked = partial(njit, pipeline_class=_Linked, no_cpython_wrapper=True, no_cfunc_wrapper=True)
maker = partial(linked, error_model="numpy")
# No reference counting: in loops of 100 ns it would cost as much as the work. Such functions may
# slice arrays, but not make new ones.
kernel = partial(maker, _nrt=False)
inline = partial(kernel, forceinline=True)
fused = partial(kernel, fastmath={"contract", "nsz"})


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

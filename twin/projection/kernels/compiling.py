"""How all kernels are compiled and kept, and two processor instructions that numba has no name for.

A voxel column starts on a new page as often as not, where the hardware's own prefetchers start
from nothing: prefetching a few steps ahead doubled the projector's speed on one core. numba
deals out the iterations of a parallel loop beforehand; workers that fetch their next job from a
counter do not wait for the slowest.

numba optimizes and assembles each function that it compiles, with all that it calls, and again
as part of each function that calls it: a kernel four calls deep in a parallel loop eight times.
Here only an entry point (`parallel`, `serial`) is, at the end, with all that was linked into
it; results are the same to the last bit, and compiling takes less than half the time.

Each parallel loop looks at `kernel_threads.ALONE` first: where it is set, the loop runs in the
calling thread and numba's threading layer is not called. That is so in a forked child, which
has none of its parent's threads. The look is part of the compiled code: one kernel serves both.
"""

from __future__ import annotations

import ctypes
import gc
import hashlib
import inspect
import logging
import pickle
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, cached_property, partial
from types import ModuleType
from typing import Any

import numba
from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.core.caching import FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult, Flags
from numba.core.serialize import dumps
from numba.core.targetconfig import TargetConfig
from numba.extending import intrinsic

from flexdt.twin import kernel_store, kernel_threads, long_work

LOG = logging.getLogger("flexdt.kernels")
"""Logger of the kernels, to standard error unless the program has set up logging."""
SLOW_MESSAGE = (
    "flexdt: compiling %s (once on this machine; some seconds, and perhaps other kernels)"
)
"""Message of a process that compiles for the first time instead of loading the disk
cache."""


LAYER = "numba_parallel_for"
"""Name of the function of numba's threading layer that parallel loops call."""
ALONE = "flexdt_alone"
"""`kernel_threads.ALONE` for the linker."""
binding.add_symbol(ALONE, ctypes.addressof(kernel_threads.ALONE))


def _choose(module: ir.Module) -> None:
    """Change a module in place so that its parallel loops call the threading layer only
    where the global `ALONE` is 0; otherwise they run in the calling thread.

    A module without parallel loops stays as it is.
    """
    layer = module.globals.get(LAYER)
    if layer is None:
        return
    calls = [
        each
        for function in module.functions
        for block in function.blocks
        for each in block.instructions
        if isinstance(each, ir.CallInstr) and each.callee is layer
    ]
    chosen = ir.Function(module, layer.function_type, "flexdt_parallel_for")
    chosen.linkage = "internal"
    for call in calls:
        call.replace_callee(chosen)
    builder = ir.IRBuilder(chosen.append_basic_block())
    alone = ir.GlobalVariable(module, ir.IntType(64), ALONE)
    here = builder.icmp_signed("!=", builder.load(alone), ir.IntType(64)(0))
    with builder.if_else(here) as (then, otherwise):
        with then:
            # A loop's body takes all iterations that its dimensions say, one after the other.
            loop, args, sizes, steps, data = chosen.args[:5]
            word = ir.IntType(
                64 if "i64" in str(chosen.args[5].type) else 32
            ).as_pointer()
            kinds = [args.type.as_pointer(), word, word, data.type]
            body = ir.FunctionType(ir.VoidType(), kinds).as_pointer()
            given = zip((args, sizes, steps, data), kinds, strict=True)
            builder.call(
                builder.bitcast(loop, body),
                [builder.bitcast(each, kind) for each, kind in given],
            )
        with otherwise:
            builder.call(layer, chosen.args)
    builder.ret_void()


class _LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code to be linked into that of callers, as it is."""

    def add_ir_module(self, ir_module: ir.Module) -> None:
        """Add a module as numba does, with `_choose`."""
        _choose(ir_module)
        super().add_ir_module(ir_module)

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int | None:
        """Return the address of a function that raises TypeError, whatever the name: only
        Python would call it.
        """
        # Only Python would call this; it raises TypeError, as arguments are no attribute's
        # name.
        self._ensure_finalized()
        return ctypes.cast(
            ctypes.pythonapi.PyObject_GenericGetAttr, ctypes.c_void_p
        ).value


def _same_flags(one: Flags, other: object) -> object:
    """Compare as numba does, but only the options that either has set."""
    if not isinstance(other, Flags):
        return NotImplemented
    set_here, set_there = one._values, other._values
    return bool(set_here == set_there) or all(
        getattr(one, name) == getattr(other, name) for name in {*set_here, *set_there}
    )


FLAGS_HASH = hash(tuple(sorted(Flags.options)))
"""What numba computes as the hash of any flags, anew each time."""


@contextmanager
def _quick_flags() -> Iterator[None]:
    """Compare and hash flags quickly within the context, with numba's own results: a tenth of
    the time that kernels compile goes there, as the caches of types ask.
    """
    numbas = TargetConfig.__eq__, TargetConfig.__hash__
    Flags.__eq__ = _same_flags
    Flags.__hash__ = lambda flags: FLAGS_HASH
    try:
        yield
    finally:
        Flags.__eq__, Flags.__hash__ = numbas


@contextmanager
def _uncollected() -> Iterator[None]:
    """Collect no cycles within the context: among millions of objects that live until the
    kernel is compiled there are none worth the time.
    """
    collected = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collected:
            gc.enable()


@contextmanager
def _linking(context: Any) -> Iterator[None]:
    """Link all libraries made within the context to one another; within another such
    context this one changes nothing.

    The global of an environment is set only where the engine has it already. Functions that are
    linked get no wrapper for callers in C.

    Args:
        context: numba's target.
    """
    codegen = context.codegen()
    if "_library_class" in vars(codegen):
        yield
        return

    def set_env(name: str, env: object) -> None:
        if codegen._engine.get_global_value_address(name):
            type(codegen).set_env(codegen, name, env)

    codegen._library_class = _LinkedLibrary
    codegen.set_env = set_env
    context.create_cfunc_wrapper = lambda *args: None
    try:
        with _quick_flags(), _uncollected():
            yield
    finally:
        del codegen._library_class, codegen.set_env, context.create_cfunc_wrapper


class _Linked(Compiler):  # type: ignore[misc]
    def _compile_core(self) -> Any:
        with _linking(self.state.targetctx):
            return super()._compile_core()


class _EntryPoint(_Linked):
    silent = False

    def _compile_core(self) -> Any:
        """Compile the function into a cacheable library of its own, with a progress line;
        returns its compiled result. Before the first one of this process a warning is
        logged that it takes long."""
        name = self.state.func_id.func_name
        if not _EntryPoint.silent:
            LOG.warning(SLOW_MESSAGE, name)
            _EntryPoint.silent = True
        library = JITCodeLibrary(self.state.targetctx.codegen(), name)
        library.enable_object_caching()
        self.state.library = library
        with long_work.during(f"compiling {name}"):
            return super()._compile_core()


def _short_hash(*parts: object) -> str:
    """Return 16 hexadecimal digits that change with any of the parts' texts."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


class KeptCode(FunctionCache):  # type: ignore[misc]
    """One entry point's machine code in the process's `kernel_store`, an item for each signature.

    An item's name says all that the code depends on: source and free variables, this module,
    numba, Python and the processor. Items of several versions, users and machines lie side by
    side in one folder, and none is ever changed.
    """

    def __init__(
        self, function: Callable[..., Any], options: Mapping[str, object]
    ) -> None:
        """Keep the code of a function that is compiled with these options; nothing is read
        yet."""
        self._py_func = function
        self._options = sorted(
            (name, sorted(value) if isinstance(value, set) else value)
            for name, value in options.items()
        )
        self.enable()

    @property
    def cache_path(self) -> str:
        """Name for numba's statistics."""
        return repr(kernel_store.store())

    @cached_property
    def beginning(self) -> str | None:
        """Beginning of the names of all this function's items that suit this process; None
        where its source cannot be read, as of a notebook's cell: nothing is kept then."""
        function = self._py_func
        source = _text(inspect.getfile(function))
        if source is None:
            return None
        codegen = numba.core.registry.cpu_target.target_context.codegen()
        _, processor, code = self._index_key((), codegen)
        version = (numba.__version__, sys.version_info[:2], sys.implementation.name)
        known = _short_hash(source, code, self._options, processor, version, COMPILING)
        return f"{function.__module__.rpartition('.')[2]}.{function.__name__}-{known}-"

    def is_kept(self) -> bool:
        """Return whether code that this process can use is kept, for any signature."""
        return self.beginning is not None and kernel_store.store().holds(self.beginning)

    def _name(self, signature: Any) -> str | None:
        if self.beginning is None:
            return None
        return self.beginning + _short_hash(str(signature))

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        name = self._name(sig)
        data = None if name is None else kernel_store.store().load(name)
        if data is None:
            return None
        return CompileResult._rebuild(target_context, *pickle.loads(data))

    def _save_overload(self, sig: Any, data: Any) -> None:
        name = self._name(sig)
        if name is not None and not data.library.has_dynamic_globals:
            kernel_store.store().save(name, dumps(data._reduce()))

    def flush(self) -> None:
        """Do nothing: what is kept stays right."""


ENTRY_POINT = {"nogil": True, "pipeline_class": _EntryPoint}


def _entry_point(
    function: Callable[..., Any] | None = None, *, keep: bool = True, **options: Any
) -> Any:
    """Compile a function that Python calls, and keep its code between processes; without a
    function returns the decorator with these options.

    The options are `ENTRY_POINT`'s, replaced by those given.
    """
    if function is None:
        return partial(_entry_point, keep=keep, **options)
    chosen = {**ENTRY_POINT, **options}
    made = njit(function, **chosen)
    if keep:
        made._cache = KeptCode(function, chosen)
    return made


# Only entry points are kept: a kept inner function would not notice that a
# function it calls has changed. They call no other entry points.
parallel = partial(_entry_point, error_model="numpy", parallel=True)
serial = _entry_point
linked = partial(
    njit, pipeline_class=_Linked, no_cpython_wrapper=True, no_cfunc_wrapper=True
)
maker = partial(linked, error_model="numpy")
# No reference counting: in loops of 100 ns it would cost as much as the work. Such functions
# may slice arrays, but not make new ones.
kernel = partial(maker, _nrt=False)
inline = partial(kernel, forceinline=True)
fused = partial(kernel, fastmath={"contract", "nsz"})


def sources(*modules: ModuleType) -> int:
    """Compute a number that changes with the text of modules.

    The name under which a function's code is kept follows from the function's own file. An
    entry point that calls kernels of other files refers to this number as a free variable,
    which is part of the name, too; otherwise the old form of an edited kernel would stay in use."""
    text = "".join(inspect.getsource(module) for module in modules)
    return zlib.crc32(text.encode())


@cache
def _text(file: str) -> str | None:
    try:
        with open(file, encoding="utf-8") as opened:
            return opened.read()
    except OSError:
        return None


COMPILING = sources(sys.modules[__name__])
"""This module's own number."""


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    return builder.gep(context.make_array(kind)(context, builder, array).data, [index])


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Compile to a fetch of array[index]'s cache line, for reading, into all caches; it
    returns nothing, and any index is safe, even outside the array.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        """Emit LLVM's prefetch of the element's cache line, for reading, into all caches."""
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
    """Compile to: return counter[0] and add one to it, atomically; counter is int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        word = ir.IntType(64)
        address = _address(context, builder, signature.args[0], args[0], word(0))
        return builder.atomic_rmw("add", address, word(1), "monotonic")

    return types.int64(counter), codegen


@intrinsic
def count_one(typingctx: Any, counters: Any, index: Any) -> Any:
    """Compile to: add one to counters[index], an int64, atomically, after all earlier
    writes of this thread."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args)
        builder.atomic_rmw("add", address, ir.IntType(64)(1), "release")
        return context.get_dummy_value()

    return types.void(counters, index), codegen


@intrinsic
def _look(typingctx: Any, counters: Any, index: Any) -> Any:
    """Compile to: return counters[index]; all that was written before it was counted is
    visible.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args)
        return builder.load_atomic(address, "acquire", 8)

    return types.int64(counters, index), codegen


_sleep, _SLEEP = (
    (ctypes.WinDLL("kernel32").Sleep, 1)  # type: ignore[attr-defined]
    if sys.platform == "win32"
    else (ctypes.CDLL(None).usleep, 50)
)
"""The system's sleep, and the shortest useful: 1 ms of Windows, 50 microseconds elsewhere."""
SLEEP = "flexdt_sleep"
binding.add_symbol(SLEEP, ctypes.cast(_sleep, ctypes.c_void_p).value)
_rest = types.ExternalFunction(SLEEP, types.int32(types.uint32))
MAX_LOOKS = 2000
"""Polls before a thread sleeps: some 20 microseconds, the time that a sleep takes."""


@kernel
def wait_until(counters, index, count):
    """Wait until counters[index] has reached count; after `MAX_LOOKS` looks the thread
    sleeps between them, as the thread that is waited for may need its core.
    """
    looks = 0
    while _look(counters, index) < count:
        looks += 1
        if looks > MAX_LOOKS:
            _rest(_SLEEP)

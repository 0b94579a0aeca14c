"""flexdt: the digital twin of the FleX-ray laboratory X-ray CT scanner, as a library.

    import flexdt as fx

Every public name is here, and each is found on first use: `import flexdt` itself loads
none of the heavy libraries. To add a name, write it in `_HOMES` and among the imports for
type checkers; a test compares the two and checks each name for a docstring with an
example. All other names begin with an underscore, so that completers show only the public
ones.
"""

import typing as _typing

if _typing.TYPE_CHECKING:
    from flexdt import phantoms as phantoms
    from flexdt.clients import AsyncTwinClient as AsyncTwinClient
    from flexdt.clients import TwinClient as TwinClient
    from flexdt.clients.launch.processes import LocalTwin as LocalTwin
    from flexdt.library.analysis import align as align
    from flexdt.library.analysis import calibrate as calibrate
    from flexdt.library.analysis import reconstruct as reconstruct
    from flexdt.library.data_set import DataSet as DataSet
    from flexdt.library.expose import expose as expose
    from flexdt.library.reading.folders import load_dataset
    from flexdt.library.reading.folders import read_tiffs as read_tiffs
    from flexdt.library.reconstruction.convention import (
        find_convention as find_convention,
    )
    from flexdt.library.scripts import machine as machine
    from flexdt.library.scripts import plan as plan
    from flexdt.library.simulate import project as project
    from flexdt.library.simulate import simulate as simulate
    from flexdt.twin.errors import NotBuiltError as NotBuiltError
    from flexdt.twin.errors import TwinError as TwinError
    from flexdt.twin.geometry.cone_vec import ConeVec as ConeVec
    from flexdt.twin.geometry.rigid import Rigid as Rigid
    from flexdt.twin.physics.detector import Detector as Detector
    from flexdt.twin.physics.tube import Tube as Tube
    from flexdt.twin.projection.linear_operator import Operator as Operator
    from flexdt.twin.projection.operators import back as back
    from flexdt.twin.projection.operators import forward as forward
    from flexdt.twin.projection.volume import Grid as Grid
    from flexdt.twin.projection.volume import Volume as Volume
    from flexdt.twin.reconstruction.checked_fdk import fdk as fdk
    from flexdt.twin.reconstruction.iterative import cgls as cgls
    from flexdt.twin.reconstruction.iterative import sirt as sirt
    from flexdt.twin.reconstruction.total_variation import tv as tv

    open = load_dataset
    __version__: str

from flexdt.runtime import process_threads as _process_threads
from flexdt.twin import kernel_store as _kernel_store
from flexdt.twin import long_work as _long_work


def _show_work(
    what: str, progress: _long_work.Progress = None
) -> _typing.ContextManager[_long_work.Report]:
    """Show the work inside the context, from when it takes seconds, as a line with a bar.

    `progress`: a function of the fraction done; None shows the line, False nothing.
    """
    # Here, because logging and threads take a third of the import of flexdt.
    from flexdt.runtime.progress import shown_work

    return shown_work(what, progress)


def _open_kernel_store() -> _kernel_store.KernelStore:
    """Open the folders in which compiled kernels are kept."""
    from flexdt.runtime.kernels import kernel_files

    return kernel_files.opened()


_long_work.during = _show_work
_kernel_store.opened_by = _open_kernel_store
_process_threads.watch()

_HOMES: _typing.Final = {
    "AsyncTwinClient": "flexdt.clients",
    "ConeVec": "flexdt.twin.geometry.cone_vec",
    "DataSet": "flexdt.library.data_set",
    "Detector": "flexdt.twin.physics.detector",
    "Grid": "flexdt.twin.projection.volume",
    "LocalTwin": "flexdt.clients.launch.processes",
    "NotBuiltError": "flexdt.twin.errors",
    "Operator": "flexdt.twin.projection.linear_operator",
    "Rigid": "flexdt.twin.geometry.rigid",
    "Tube": "flexdt.twin.physics.tube",
    "TwinClient": "flexdt.clients",
    "TwinError": "flexdt.twin.errors",
    "Volume": "flexdt.twin.projection.volume",
    "align": "flexdt.library.analysis",
    "back": "flexdt.twin.projection.operators",
    "calibrate": "flexdt.library.analysis",
    "cgls": "flexdt.twin.reconstruction.iterative",
    "expose": "flexdt.library.expose",
    "fdk": "flexdt.twin.reconstruction.checked_fdk",
    "find_convention": "flexdt.library.reconstruction.convention",
    "forward": "flexdt.twin.projection.operators",
    "machine": "flexdt.library.scripts",
    "open": "flexdt.library.reading.folders:load_dataset",
    "phantoms": "flexdt.phantoms:",
    "plan": "flexdt.library.scripts",
    "project": "flexdt.library.simulate",
    "read_tiffs": "flexdt.library.reading.folders",
    "reconstruct": "flexdt.library.analysis",
    "simulate": "flexdt.library.simulate",
    "sirt": "flexdt.twin.reconstruction.iterative",
    "tv": "flexdt.twin.reconstruction.total_variation",
}
"""Name -> module, or MODULE:ATTRIBUTE where the names differ; a module itself ends with a
colon."""

__all__ = sorted(["__version__", *_HOMES])


if (
    not _typing.TYPE_CHECKING
):  # with a `__getattr__`, type checkers would take any name for one of ours

    def __getattr__(name: str) -> _typing.Any:
        """Import a public name at its first use and keep it in the module.

        `__version__` is read from the installed package each time and not kept.

        Args:
            name: of `_HOMES`, or `__version__`.

        Returns:
            The module's attribute, or the module itself where the entry ends with a
            colon.

        Raises:
            AttributeError: an unknown name; names the nearest known one, if any.
        """
        if name == "__version__":
            from importlib.metadata import version  # 10 ms that few imports need

            return version("flexdt")
        if name not in _HOMES:
            from flexdt.twin.errors import nearest_name

            near = nearest_name(name, list(_HOMES))
            hint = "" if near is None else f"; did you mean {near!r}?"
            raise AttributeError(f"module 'flexdt' has no attribute {name!r}{hint}")
        from importlib import import_module

        module, colon, attribute = _HOMES[name].partition(":")
        home = import_module(module)
        value = home if colon and not attribute else getattr(home, attribute or name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return list(__all__)

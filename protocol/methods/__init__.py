"""The twin server's methods, a module a topic: parameters, results, and the methods themselves.

`METHODS` is the one table from which handlers, clients and the OpenRPC document follow;
`openrpc_document` makes that document from the pydantic models of a method table.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from flexdt.protocol.method import PROTOCOL, AnyMethod, Method
from flexdt.protocol.methods import calibration_messages as calibration
from flexdt.protocol.methods import document_messages as documents
from flexdt.protocol.methods import image_messages as images
from flexdt.protocol.methods import job_messages as jobs
from flexdt.protocol.methods import scanner_messages as scanner
from flexdt.protocol.methods import session_messages as session
from flexdt.protocol.rpc_errors import Code, method_not_found

TOPICS: Final = (session, scanner, images, jobs, calibration, documents)

METHODS: Final[Mapping[str, AnyMethod]] = {
    found.name: found
    for topic in TOPICS
    for found in vars(topic).values()
    if isinstance(found, Method)
}
"""Every method of the twin server, by name."""


def find(name: str, methods: Mapping[str, AnyMethod] = METHODS) -> AnyMethod:
    """Look up the method called `name`.

    Raises RpcError: -32601, listing the methods."""
    if name not in methods:
        raise method_not_found(name, methods)
    return methods[name]


def openrpc_document(
    methods: Mapping[str, AnyMethod] = METHODS, *, title: str = "flexdt twin server"
) -> dict[str, Any]:
    """Make the OpenRPC document of a server as plain data (https://spec.open-rpc.org,
    version 1.3).

    Schemas of parameters and results are in components, once each, with all errors of
    `Code` by name (code and message). Line breaks in descriptions of fields become
    spaces.

    Args:
        methods: method table of the server.
        title: title of the document.

    Returns:
        A dict with the keys openrpc, info, methods (a list, in the order of the table)
        and components.
    """
    models: list[type[BaseModel]] = [m.params for m in methods.values()]
    models += [m.result for m in methods.values()]
    refs, definitions = models_json_schema(
        [(model, "validation") for model in dict.fromkeys(models)],
        ref_template="#/components/schemas/{model}",
    )
    schemas = definitions.get("$defs", {})
    for field in (
        f for schema in schemas.values() for f in schema.get("properties", {}).values()
    ):
        if "description" in field:  # a docstring, which may have several lines
            field["description"] = " ".join(field["description"].split())
    return {
        "openrpc": "1.3.2",
        "info": {
            "title": title,
            "version": PROTOCOL,
            "description": "JSON-RPC 2.0 over TCP; JSON lines or length-prefixed MessagePack.",
            "license": {"name": "Apache-2.0"},
        },
        "methods": [
            _method(m, schemas, refs[m.result, "validation"]["$ref"])
            for m in methods.values()
        ],
        "components": {
            "schemas": schemas,
            "errors": {c.name: {"code": int(c), "message": c.meaning} for c in Code},
        },
    }


def _method(method: AnyMethod, schemas: Mapping[str, Any], result: str) -> dict[str, Any]:
    """Describe one method as OpenRPC does.

    Parameters are a list in the order of the model's fields, each a dict with the keys
    name, required, schema and, where the field has one, description.

    Args:
        method: the method.
        schemas: model's name -> its JSON schema.
        result: reference to the schema of the result.

    Returns:
        A dict with the keys name, summary, paramStructure, params, result, x-control,
        x-safe, x-urgent and, where it has limits, x-limits.
    """
    schema = schemas[method.params.__name__]
    required = schema.get("required", [])
    params = []
    for name, field in schema.get("properties", {}).items():
        entry = {"name": name, "required": name in required, "schema": field}
        if "description" in field:
            entry["description"] = field["description"]
        params.append(entry)
    if method.limits:
        limits = {"x-limits": dict(method.limits)}
    else:
        limits = {}
    return {
        "name": method.name,
        "summary": method.summary,
        "paramStructure": "either",
        "params": params,
        "result": {"name": "result", "schema": {"$ref": result}},
        "x-control": method.control,
        "x-safe": method.safe,
        "x-urgent": method.urgent,
        **limits,
    }

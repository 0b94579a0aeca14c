"""The OpenRPC document of a method table, generated from the pydantic models.

See https://spec.open-rpc.org, version 1.3.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from flexdt.protocol.method import PROTOCOL, AnyMethod
from flexdt.protocol.methods import METHODS
from flexdt.protocol.rpc_errors import Code


def document(
    methods: Mapping[str, AnyMethod] = METHODS,
    *,
    title: str = "flexdt twin server",
    version: str = PROTOCOL,
) -> dict[str, Any]:
    """The OpenRPC document of a server as plain data.

    Args:
        methods: its method table.
        title: its name.
        version: of its protocol.
    """
    models: list[type[BaseModel]] = [m.params for m in methods.values()]
    models += [m.result for m in methods.values()]
    refs, definitions = models_json_schema(
        [(model, "validation") for model in dict.fromkeys(models)],
        ref_template="#/components/schemas/{model}",
    )
    schemas = definitions.get("$defs", {})
    return {
        "openrpc": "1.3.2",
        "info": {
            "title": title,
            "version": version,
            "description": "JSON-RPC 2.0 over TCP; JSON lines or length-prefixed MessagePack.",
            "license": {"name": "Apache-2.0"},
        },
        "methods": [
            _method(m, schemas, refs[m.result, "validation"]["$ref"]) for m in methods.values()
        ],
        "components": {
            "schemas": schemas,
            "errors": {c.name: {"code": int(c), "message": c.meaning} for c in Code},
        },
    }


def _method(method: AnyMethod, schemas: Mapping[str, Any], result: str) -> dict[str, Any]:
    schema = schemas[method.params.__name__]
    required = schema.get("required", [])
    params = []
    for name, field in schema.get("properties", {}).items():
        entry = {"name": name, "required": name in required, "schema": field}
        if "description" in field:
            entry["description"] = field["description"]
        params.append(entry)
    limits = {"x-limits": dict(method.limits)} if method.limits else {}
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

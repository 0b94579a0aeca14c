"""scene.* and rpc.discover: the whole state, and the wire itself, as documents."""

from __future__ import annotations

from pydantic import JsonValue

from flexdt.protocol.fields import Empty, Name, Params, Result
from flexdt.protocol.method import by_hand, read
from flexdt.protocol.scene_document import Scene
from flexdt.protocol.state_model import State


class SceneSave(Params):
    """Name and comment for the document."""

    name: Name | None = None


class SceneLoad(Params):
    """A document made by `scene.save`."""

    document: Scene


class SceneResult(Result):
    """The whole state as one versioned document."""

    document: dict[str, JsonValue]


class Discovery(Result):
    """An OpenRPC document."""

    openrpc: str
    info: dict[str, JsonValue]
    methods: list[dict[str, JsonValue]]


SCENE_SAVE = read("scene.save", SceneSave, SceneResult, "whole state as one versioned document")
SCENE_LOAD = by_hand("scene.load", SceneLoad, State, "restore such a document")
RPC_DISCOVER = read("rpc.discover", Empty, Discovery, "this table as an OpenRPC document")

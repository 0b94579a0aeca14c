"""Parameter and result models, images and the OpenRPC document."""

from __future__ import annotations

import base64
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal

from flexdt.protocol import (
    METHODS,
    PROTOCOL,
    Codec,
    Connection,
    Response,
    RpcError,
    find,
    image,
    parse_params,
    parse_result,
)
from flexdt.protocol.field_checks import require_extent
from flexdt.protocol.method import compatible
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.methods.scanner_messages import MoveResult, SampleUpload
from flexdt.protocol.projector import PROJECTOR_METHODS
from flexdt.protocol.rpc_errors import Code, clip, internal, invalid_params

BAD: list[tuple[str, object, str]] = [
    ("state.get", {"x": 1}, "x"),
    ("state.get", [1], "takes 0"),
    ("axes.move", {}, "targets"),
    ("axes.move", {"targets": {}}, "targets"),
    ("axes.move", {"targets": {"mag_obj": "600"}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"mag_obj": True}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"mag_obj": float("nan")}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"mag_obj": float("inf")}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"mag_obj": 10**400}}, "targets.mag_obj"),
    ("axes.move", {"targets": {"a" * 100: 1}}, "targets"),
    ("axes.move", {"targets": {f"a{i}": 1 for i in range(100)}}, "targets"),
    ("axes.move", {"targets": {"mag_obj": 1}, "wait": 1}, "wait"),
    ("axes.jog", {"axis": "mag_obj", "velocity": 1, "lease_s": 0}, "lease_s"),
    ("axes.jog", {"axis": "mag_obj", "velocity": 1, "lease_s": 3600}, "lease_s"),
    ("axes.set", {"axis": "mag_obj", "speed": -1}, "speed"),
    ("clock.set", {"speed_up": 0}, "speed_up"),
    ("clock.set", {"speed_up": "fast"}, "speed_up"),
    ("camera.set", {"roi": [1, 2, 3]}, "roi"),
    ("camera.set", {"roi": [1, 2, 3, 4.5]}, "roi"),
    ("camera.set", {"averages": 0}, "averages"),
    ("sample.set", {}, "name or file"),
    ("sample.set", {"name": "a", "file": "b"}, "name or file"),
    ("sample.set", {"name": "../../etc/passwd"}, "name"),
    ("sample.set", {"name": "a\x00b"}, "name"),
    ("sample.set", {"name": ""}, "name"),
    ("sample.upload", {"name": "a", "format": "stl", "total": 1, "data": "!!"}, "base64"),
    (
        "sample.upload",
        {"name": "a", "format": "stl", "total": 1, "data": "QUJD"},
        "total",
    ),
    (
        "sample.upload",
        {"name": "a", "format": "pickle", "total": 9, "data": ""},
        "format",
    ),
    (
        "sample.upload",
        {"name": "a", "format": "raw", "total": 9, "data": ""},
        "format raw",
    ),
    ("script.submit", {}, "text or data_base64"),
    ("script.submit", {"text": "a", "data_base64": "b"}, "text or data_base64"),
    ("script.submit", {"text": "a", "name": "C:\\x"}, "name"),
    ("trajectory.submit", {"poses": []}, "poses"),
    ("trajectory.submit", {"poses": [{}]}, "poses"),
    ("state.subscribe", {"topics": ["everything"]}, "topics"),
    ("state.subscribe", {"topics": ["state"], "max_rate_hz": 0}, "max_rate_hz"),
    ("projection.get", {"binning": 0}, "binning"),
    ("projection.get", {"kind": "counts "}, "kind"),
    ("session.hello", {"protocol": "1.0", "client": "x", "token": 5}, "token"),
    ("session.hello", {"protocol": None, "client": "x"}, "protocol"),
]


@pytest.mark.parametrize(("method", "params", "where"), BAD)
def test_params_that_do_not_fit(method: str, params: Any, where: str) -> None:
    with pytest.raises(RpcError) as caught:
        parse_params(METHODS[method], params)
    assert caught.value.code == Code.INVALID_PARAMS
    assert where in str(caught.value.message) + str(caught.value.data)
    assert method in caught.value.message
    for codec in Codec:  # the error itself can travel, whatever was asked
        assert Connection(codec).send(Response(1, caught.value.data))


def test_whole_numbers_are_numbers_and_positions_count() -> None:
    move = parse_params(METHODS["axes.move"], [{"mag_obj": 600}, True])
    assert move.targets == {"mag_obj": 600.0}  # type: ignore[attr-defined]
    assert move.relative is True  # type: ignore[attr-defined]
    hello = parse_params(METHODS["session.hello"], {"protocol": 1.0, "client": "nc"})
    assert hello.protocol == "1.0"  # type: ignore[attr-defined]
    assert parse_params(METHODS["state.get"], None) == parse_params(
        METHODS["state.get"], []
    )


def test_bytes_and_base64_are_the_same_upload() -> None:
    base = {"name": "a", "format": "stl", "total": 3}
    raw = SampleUpload.model_validate({**base, "data": b"ABC"})
    text = SampleUpload.model_validate(
        {**base, "data": base64.b64encode(b"ABC").decode()}
    )
    assert raw == text
    assert raw.data == b"ABC"


def test_an_unknown_method_lists_the_known() -> None:
    with pytest.raises(RpcError) as caught:
        find("axes.fly")
    assert caught.value.code == -32601
    assert "axes.move" in caught.value.data["allowed"]  # type: ignore[index]


def test_results_may_grow_and_wrong_ones_are_noticed() -> None:
    grown = parse_result(MoveResult, {"duration_s": 1, "warnings": [], "colour": "red"})
    assert grown.model_dump()["colour"] == "red"
    with pytest.raises(RpcError, match="MoveResult"):
        parse_result(MoveResult, {"warnings": []})


@pytest.mark.parametrize(
    ("spoken", "served"),
    [("1.0", True), ("1", True), ("1.9", True), ("2.0", False), ("", False)],
)
def test_versions(spoken: str, served: bool) -> None:
    assert PROTOCOL.startswith("1.")
    assert compatible(spoken) is served


def test_interface_methods_are_all_there() -> None:
    fixed = """session.hello session.control state.get state.subscribe state.unsubscribe axes.move
        axes.jog axes.set axes.stop safety.estop safety.reset clock.set tube.set camera.set
        sample.set sample.list sample.upload projection.get geometry.get script.check script.submit
        trajectory.check trajectory.submit job.status job.pause job.resume job.step job.abort
        job.list calibration.apply calibration.get calibration.list calibration.revert scene.save
        scene.load rpc.discover"""
    assert set(fixed.split()) <= set(METHODS)
    anybody = {"axes.stop", "safety.estop", "job.abort"}
    assert not any(METHODS[name].control for name in anybody)
    assert all(METHODS[name].urgent for name in anybody)
    assert METHODS["axes.move"].control
    assert not METHODS["axes.move"].safe


@given(
    hnp.arrays(
        st.sampled_from(image.DTYPES).map(np.dtype),
        hnp.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6),
    ),
    st.sampled_from(Codec),
)
def test_arrays_survive_the_wire(array: np.ndarray[Any, Any], codec: Codec) -> None:
    sent = Connection(codec).send(Response(1, image.encode(array)))
    [message] = Connection(codec).receive_data(sent)
    assert isinstance(message, Response)
    got = image.decode(message.result)  # type: ignore[arg-type]
    assert_array_equal(got, array)
    assert got.dtype == array.dtype
    assert not got.flags.writeable


def test_big_endian_and_strided_arrays_travel_as_little_endian_c_order() -> None:
    array = np.arange(12, dtype=">f4").reshape(3, 4)[::-1, ::2]
    value = image.encode(array)
    assert value["dtype"] == "float32"
    assert bytes(value["data"]) == np.ascontiguousarray(array).astype("<f4").tobytes()  # type: ignore[call-overload]


@pytest.mark.parametrize(
    "value",
    [
        {},
        {"dtype": "object", "shape": [1], "data": b"x" * 8},
        {"dtype": "float32", "shape": [2], "data": b"x" * 4},
        {"dtype": "float32", "shape": [-1], "data": b""},
        {"dtype": "float32", "shape": [2**40, 2**40], "data": b""},
        {"dtype": "float32", "shape": "1", "data": b"xxxx"},
        {"dtype": "float32", "shape": [True], "data": b"xxxx"},
        {"dtype": "float32", "shape": [1], "data": "not base64!"},
        {"dtype": "float32", "shape": [1], "data": 7},
        {"dtype": ["float32"], "shape": [1], "data": b"xxxx"},
    ],
)
def test_images_that_do_not_hold(value: dict[str, Any]) -> None:
    with pytest.raises(RpcError) as caught:
        image.decode(value)
    assert caught.value.code == -32602


def test_dtypes_that_cannot_travel() -> None:
    for array in (np.zeros(1, complex), np.array([object()]), np.array(["x"])):
        with pytest.raises(ValueError, match="cannot travel"):
            image.encode(array)


@pytest.mark.parametrize("table", [METHODS, PROJECTOR_METHODS], ids=["twin", "projector"])
def test_the_openrpc_document_describes_every_method(table: Any) -> None:
    document = openrpc_document(table)
    assert {m["name"] for m in document["methods"]} == set(table)
    schemas = document["components"]["schemas"]

    def references(node: Any) -> set[str]:
        if isinstance(node, dict):
            own = {node["$ref"]} if "$ref" in node else set()
            return own.union(*(references(v) for v in node.values()))
        if isinstance(node, list):
            return set().union(*(references(v) for v in node))
        return set()

    for reference in references(document):
        assert reference.removeprefix("#/components/schemas/") in schemas
    codes = {e["code"] for e in document["components"]["errors"].values()}
    assert codes == {int(c) for c in Code}
    for codec in Codec:  # it is an answer of rpc.discover
        assert Connection(codec).send(Response(1, document))


def test_the_document_gives_types_units_and_defaults() -> None:
    methods = {m["name"]: m for m in openrpc_document()["methods"]}
    params = {p["name"]: p for p in methods["axes.move"]["params"]}
    assert params["targets"]["required"]
    assert params["wait"]["schema"]["type"] == "boolean"
    assert params["wait"]["schema"]["default"] is False
    version = {p["name"]: p for p in methods["session.hello"]["params"]}["protocol"][
        "schema"
    ]
    assert [kind["type"] for kind in version["anyOf"]] == ["string", "number"]
    assert "mm or deg" in params["targets"]["description"]
    assert methods["axes.stop"]["x-urgent"]


def test_a_clipped_mapping_is_read_only_as_far_as_its_text_can_show() -> None:
    read = 0

    class Endless(dict[str, int]):
        def items(self) -> Any:
            nonlocal read
            for read in range(1, 10_000):
                yield str(read), read

    shown = clip(Endless(a=1), 40)
    assert read <= 20 + 1
    assert len(shown) <= 40 + len("...")


@pytest.mark.parametrize(
    ("voxel_mm", "fits"), [((1.0, 1.0, 100.0), True), ((1.0, 1.0, 100.1), False)]
)
def test_a_grid_s_longest_side_has_a_limit(
    voxel_mm: tuple[float, float, float], fits: bool
) -> None:
    """100 slices of 100 mm are exactly the 10 m allowed; x, y, z are columns, rows, slices."""
    if fits:
        require_extent((100, 2, 3), voxel_mm)
    else:
        with pytest.raises(ValueError, match="a side of 10010 mm; at most 10000 mm"):
            require_extent((100, 2, 3), voxel_mm)


@pytest.mark.parametrize("allowed", [None, [], 0, ["a"]])
def test_what_is_allowed_instead_is_said_where_that_is_known(allowed: object) -> None:
    data = invalid_params("no", [], allowed).data
    assert data == {"problems": []} | ({} if allowed is None else {"allowed": allowed})


@pytest.mark.parametrize("wrong", [1, 50, 51, 64])
def test_at_most_fifty_problems_of_a_request_are_listed(wrong: int) -> None:
    """The message counts all of them."""
    targets = {f"axis_{i}": "far" for i in range(wrong)}
    with pytest.raises(RpcError) as caught:
        parse_params(find("axes.move"), {"targets": targets})
    assert len(caught.value.data["problems"]) == min(wrong, 50)  # type: ignore[index]


def test_a_scene_has_the_keys_of_the_description_and_no_others() -> None:
    with pytest.raises(RpcError) as caught:
        parse_params(find("scene.load"), {"document": {"schema_version": 1}})
    paths = {p["path"] for p in caught.value.data["problems"]}  # type: ignore[index]
    assert {"document.schema", "document.schema_version"} <= paths


def test_methods_with_the_same_parameters_take_as_much_of_them() -> None:
    """What may be checked may be submitted."""
    sizes: dict[type, set[bool]] = {}
    for method in METHODS.values():
        sizes.setdefault(method.params, set()).add(method.bulky)
    assert [model for model, bulky in sizes.items() if len(bulky) > 1] == []
    assert find("trajectory.submit").bulky
    binary = [
        method for method in METHODS.values()
        if any(field.annotation is bytes for field in method.params.model_fields.values())
    ]  # fmt: skip
    assert find("sample.upload") in binary
    assert all(method.bulky for method in binary)


def test_a_projection_has_places_within_10_km_and_pixels() -> None:
    def asked(number: float, *detector: object) -> Any:
        row = [0.0, -600.0, 0.0, 0.0, number, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0]
        params = {"volume": "v", "cone_vec": [row, row], "detector": list(detector)}
        return parse_params(PROJECTOR_METHODS["project"], params)

    for number in (0.0, -1e7, 1e7):
        found = asked(number, 1, 1)
        assert found.cone_vec.shape == (2, 12)
        assert found.cone_vec[1, 4] == number
        assert tuple(found.detector) == (1, 1)
    for number in (1.001e7, -1.001e7, float("inf"), float("nan")):
        with pytest.raises(RpcError, match="row 0 is not finite and within 1e"):
            asked(number, 1, 1)
    for detector in ((0, 1), (1, 0), (-1, 5), (1,), (1, 1, 1), (1.5, 1), (2**31, 1)):
        with pytest.raises(RpcError, match="detector"):
            asked(0.0, *detector)


NC = {"client": "nc"}
UPLOAD = {"name": "a", "format": "stl", "total": 3, "data": b"ABC"}
ROW = [0.0, -600.0, 0.0, 0.0, 500.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, -1.0]
VIEWS = {"volume": "v", "detector": [2, 3]}
GRID = {"shape": [1, 2, 3], "voxel_mm": [1.0, 1.0, 1.0]}
STACK = np.zeros((2, 3, 4), np.float32)
MESH = {"vertices": 4, "triangles": 4}


def stack(array: np.ndarray[Any, Any]) -> dict[str, Any]:
    return {"cone_vec": [ROW] * 2, "grid": GRID, "projections": image.encode(array)}


@pytest.mark.parametrize(
    ("method", "good", "bad", "says"),
    [
        ("session.hello", {**NC, "protocol": "x" * 40}, {**NC, "protocol": "x" * 41}, "40"),
        ("session.hello", {**NC, "protocol": 999}, {**NC, "protocol": 1000}, "protocol"),
        ("session.hello", {**NC, "protocol": -999.5}, {**NC, "protocol": -1e3}, "protocol"),
        ("axes.move", {"targets": {f"a{i}": 1.0 for i in range(64)}},
         {"targets": {f"a{i}": 1.0 for i in range(65)}}, "65 members; at most 64"),
        ("sample.upload", {**UPLOAD, "name": "é" * 16 + "abcd"},
         {**UPLOAD, "name": "é" * 16 + "abcde"}, "101 bytes percent-encoded"),
        ("sample.upload", {**UPLOAD, "name": "." * 33 + "a"}, {**UPLOAD, "name": "." * 34},
         "102 bytes percent-encoded"),
        ("project", {**VIEWS, "cone_vec": [ROW]}, {**VIEWS, "cone_vec": []}, "cone_vec"),
        ("project", {**VIEWS, "cone_vec": np.full((100_000, 12), 1.0)},
         {**VIEWS, "cone_vec": np.full((100_001, 12), 1.0)}, "100001 rows.*1 to 100000"),
        ("project", {**VIEWS, "cone_vec": [ROW] * 2}, {**VIEWS, "cone_vec": [ROW[:11]] * 2},
         r"shape \[2, 11\]"),
        ("project", {**VIEWS, "cone_vec": [ROW]}, {**VIEWS, "cone_vec": ROW}, r"shape \[12\]"),
        ("project", {**VIEWS, "cone_vec": [ROW]}, {**VIEWS, "cone_vec": [[*ROW[:11], True]]},
         "truth value"),
        ("project", {**VIEWS, "cone_vec": [ROW]}, {**VIEWS, "cone_vec": [["a"] * 12]}, "cone_vec"),
        ("backproject", stack(STACK), stack(STACK.astype(np.float64)), "float32"),
        ("backproject", stack(STACK), stack(STACK[0]), "float32 of shape"),
        ("backproject", stack(STACK), stack(STACK[:, :0]), "float32 of shape"),
        ("volume.put", {"name": "v", "grid": GRID, "data": b"abcd"}, {"name": "v", "grid": GRID},
         "data goes with"),
        ("volume.put", {"name": "v", "scene": {}}, {"name": "v", "scene": {}, "data": b"a"},
         "data goes with"),
        ("volume.put", {"name": "v", "mesh": MESH, "data": b"a"},
         {"name": "v", "mesh": MESH, "grid": GRID, "data": b"a"}, "one of scene, grid, mesh"),
        ("volume.put", {"name": "v", "mesh": MESH, "data": b"a"}, {"name": "v", "data": b"a"},
         "one of scene, grid, mesh"),
        *(("volume.put", {"name": "v", "mesh": {**MESH, key: good}, "data": b"a"},
           {"name": "v", "mesh": {**MESH, key: bad}, "data": b"a"}, key)
          for key in MESH for good, bad in ((4, 3), (2**27, 2**27 + 1))),
        ("volume.put", {"name": "v" * 300, "scene": {}}, {"name": "v" * 301, "scene": {}}, "name"),
        ("project", {**VIEWS, "cone_vec": [ROW], "key": "k" * 300},
         {**VIEWS, "cone_vec": [ROW], "key": "k" * 301}, "key"),
        ("cancel", {"request": 2**64 - 1}, {"request": 2**64}, "request"),
        ("cancel", {"request": "x" * 1000}, {"request": "x" * 1001}, "request"),
        ("cancel", {"request": ""}, {"request": -1}, "request"),
        ("state.get", {}, {str(i): 1 for i in range(51)}, "51 members; allowed: none"),
    ],
)  # fmt: skip
def test_the_last_that_fits_and_the_first_that_does_not(
    method: str, good: Any, bad: Any, says: str
) -> None:
    def encoded(params: dict[str, Any]) -> dict[str, Any]:
        return {
            k: image.encode(v) if isinstance(v, np.ndarray) else v
            for k, v in params.items()
        }

    table = METHODS if method in METHODS else PROJECTOR_METHODS
    assert parse_params(table[method], encoded(good))
    with pytest.raises(RpcError) as caught:
        parse_params(table[method], encoded(bad))
    assert caught.value.code == -32602
    assert re.search(says, f"{caught.value.message} {caught.value.data}")


def test_with_50_members_too_many_the_first_of_them_is_named() -> None:
    with pytest.raises(RpcError, match="0") as caught:
        parse_params(METHODS["state.get"], {str(i): 1 for i in range(50)})
    assert "members;" not in caught.value.message


def test_the_bytes_of_voxels_and_of_a_mesh_and_what_is_left_out() -> None:
    """Voxels are float32; corners three float64 and triangles three int32."""
    put = PROJECTOR_METHODS["volume.put"]
    grid = {"shape": [3, 5, 7], "voxel_mm": [0.1, 0.2, 0.3]}
    voxels: Any = parse_params(put, {"name": "v", "grid": grid, "data": b"abcd"})
    assert voxels.grid.nbytes == np.zeros((3, 5, 7), np.float32).nbytes
    assert voxels.grid.center_mm == (0.0, 0.0, 0.0)
    assert (voxels.start, bytes(voxels.data), voxels.mesh) == (0, b"abcd", None)
    mesh: Any = parse_params(
        put, {"name": "m", "mesh": {"vertices": 5, "triangles": 6}, "data": b""}
    )
    assert mesh.mesh.nbytes == np.zeros((5, 3)).nbytes + np.zeros((6, 3), np.int32).nbytes


@pytest.mark.parametrize("limit", [4, 5, 40, 200])
def test_a_clipped_text_is_the_text_as_far_as_it_goes(limit: int) -> None:
    for length in range(limit - 2, limit + 3):
        text = "abcdefghij" * 30
        cut = text[:limit] + "..." if length > limit else text[:length]
        assert clip(text[:length], limit) == cut
        assert clip(["x"] * length, limit).startswith("['x'"[:limit])
    some = limit // 2
    for count in (some - 1, some, some + 1):
        whole = (
            "["
            + ", ".join(["1"] * min(count, some))
            + (", ...]" if count > some else "]")
        )
        assert clip([1] * count, limit) == (
            whole if len(whole) <= limit else whole[:limit] + "..."
        )
        pairs = ", ".join(f"{i}: 1" for i in range(min(count, some)))
        whole = "{" + pairs + (", ...}" if count > some else "}")
        shown = clip(dict.fromkeys(range(count), 1), limit)
        assert shown == (whole if len(whole) <= limit else whole[:limit] + "...")
    for count in (24, 25, 26):  # inside another value, of a quarter of the length
        more = ", ..." if count > 25 else ""
        ones, pairs = ["1"] * min(count, 25), [f"{i}: 1" for i in range(min(count, 25))]
        assert clip([[1] * count]) == f"[[{', '.join(ones)}{more}]]"
        assert clip([dict.fromkeys(range(count), 1)]) == f"[{{{', '.join(pairs)}{more}}}]"
    assert clip(2**4095) == str(2**4095)[:200] + "..."
    assert clip(2**4096) == "a whole number of 4097 bits"


def test_codes_and_what_may_be_called_when_are_what_they_were() -> None:
    """The wire's own: peers of other versions know them by number."""
    codes = {c.name: int(c) for c in Code}
    assert codes == {
        "PARSE": -32700, "INVALID_REQUEST": -32600, "METHOD_NOT_FOUND": -32601,
        "INVALID_PARAMS": -32602, "INTERNAL": -32603, "LIMIT": -32001, "COLLISION": -32002,
        "BUSY": -32003, "NOT_AUTHORISED": -32004, "SCRIPT_INVALID": -32005,
        "PROJECTOR_UNAVAILABLE": -32006, "NOT_IDENTIFIABLE": -32007, "TOO_LARGE": -32008,
        "SUPERSEDED": -32009, "CANCELLED": -32010, "LINK_DOWN": -32011,
    }  # fmt: skip
    unsafe = {name for name, m in PROJECTOR_METHODS.items() if not m.safe}
    assert unsafe == {"backproject"}
    assert not any(m.control or m.urgent or m.limits for m in PROJECTOR_METHODS.values())


def test_an_internal_error_names_its_trace_where_there_is_one() -> None:
    assert internal("job-1/3").data == {"trace": "job-1/3"}
    assert internal().data is None
    assert {internal("a").code, internal().code} == {-32603}


@pytest.mark.parametrize("method", ["calibration.fit", "calibration.apply"])
@pytest.mark.parametrize("value", [float("inf"), float("nan"), -float("inf")])
def test_no_number_of_a_request_is_infinite(method: str, value: float) -> None:
    key = {"calibration.fit": "priors", "calibration.apply": "parameters"}[method]
    with pytest.raises(RpcError) as caught:
        parse_params(METHODS[method], {key: {"dO_x": value}})
    problems = caught.value.data["problems"]  # type: ignore[index]
    assert f"{key}.dO_x" in {p["path"] for p in problems}


def test_images_have_up_to_four_sizes() -> None:
    for sizes in ((), (2,), (2, 1, 3), (1, 2, 1, 3)):
        array = np.arange(np.prod(sizes, dtype=int), dtype=np.float32).reshape(sizes)
        assert_array_equal(image.decode(image.encode(array)), array)
    five = {**image.encode(np.zeros((1, 2, 1, 3), np.float32)), "shape": [1, 2, 1, 3, 1]}
    with pytest.raises(RpcError, match="up to four sizes"):
        image.decode(five)

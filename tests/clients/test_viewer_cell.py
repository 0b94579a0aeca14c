"""A notebook's cell with the viewer."""

from __future__ import annotations

import pytest

import flexdt as fx
from flexdt.clients.launch.processes import Servers, ViewerCell


def cell(monkeypatch: pytest.MonkeyPatch, ready: dict[str, object]) -> ViewerCell:
    servers = Servers({}, None)  # type: ignore[arg-type]
    servers.ready = ready
    lab = fx.LocalTwin(viewer=True)
    monkeypatch.setattr(lab, "_now", lambda: (None, servers, None, None))
    return lab.viewer(500)


READY: dict[str, object] = {"viewer": {"port": 8081, "url": 'http://localhost:8081/"<'}}


def test_in_a_hub_it_is_the_page_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ann/")
    shown = cell(monkeypatch, READY)._repr_html_()
    assert 'src="/user/ann/proxy/8081/"' in shown
    assert "height:500px" in shown


def test_elsewhere_it_is_a_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JUPYTERHUB_SERVICE_PREFIX", raising=False)
    shown = cell(monkeypatch, READY)._repr_html_()
    assert 'href="http://localhost:8081/&quot;&lt;"' in shown
    assert "iframe" not in shown


def test_without_a_viewer_the_error_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(RuntimeError, match="viewer=True"):
        cell(monkeypatch, {})

"""The volume in three dimensions where the browser's graphics stop, or refuse its program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytestmark = pytest.mark.browser
START = """
async () => {
  const { raycast } = await import('/raycast.js');
  const made = [], make = document.createElement.bind(document);
  document.createElement = (name, ...more) => {
    const one = make(name, ...more);
    if (name === 'canvas') made.push(one);
    return one;
  };
  const canvas = make('canvas');
  canvas.style.cssText = 'position: fixed; inset: 0 auto auto 0; width: 120px; height: 120px';
  document.body.append(canvas);
  const frames = async (count = 3) => {
    for (let k = 0; k < count; k++) await new Promise(requestAnimationFrame);
  };
  const picture = async () => {
    await frames();
    return canvas.toDataURL();
  };
  const codes = new Uint16Array(16 ** 3).fill(60000);
  const box = { shape: [16, 16, 16], factor: 1, low: 0, high: 1, window: [0, 0.9], codes };
  const block = { ...box, voxel_mm: 0.1 };
  window.drawing = { raycast, made, canvas, block, picture };
}
"""
STOPS = """
async () => {
  const { raycast, made, canvas, block, picture } = window.drawing;
  raycast(canvas).show(block);
  const before = await picture();
  const glass = made.find((one) => one.getContext('webgl2'));
  const graphics = glass.getContext('webgl2').getExtension('WEBGL_lose_context');
  const heard = (name) => new Promise((done) => glass.addEventListener(name, done));
  const gone = heard('webglcontextlost'), back = heard('webglcontextrestored');
  graphics.loseContext();
  await gone;
  const without = await picture(), says = canvas.title;
  graphics.restoreContext();
  await back;
  return { before, without, says, after: await picture(), then: canvas.title };
}
"""
REFUSES = """
(times) => {
  const { raycast, canvas } = window.drawing, all = WebGL2RenderingContext.prototype;
  const asked = all.getProgramParameter, words = all.getProgramInfoLog;
  let left = times;
  all.getProgramParameter = function (...what) {
    return left-- > 0 ? false : asked.apply(this, what);
  };
  all.getProgramInfoLog = () => 'Fragment shader is not compiled.';
  const found = raycast(canvas);
  all.getProgramParameter = asked;
  all.getProgramInfoLog = words;
  return typeof found === 'string' ? found : 'draws';
}
"""


@pytest.fixture(scope="module")
def drawing(open_page: Callable[..., Any]) -> Any:
    page = open_page()
    page.evaluate(START)
    return page


def test_graphics_that_stop_are_named_and_the_volume_comes_back(drawing: Any) -> None:
    seen = drawing.evaluate(STOPS)
    assert "graphics stopped" in seen["says"]
    assert "Slices work" in seen["says"]
    assert seen["without"] != seen["before"]
    assert seen["after"] == seen["before"]
    assert seen["then"] == ""


def test_a_program_that_is_refused_once_is_tried_again(drawing: Any) -> None:
    assert drawing.evaluate(REFUSES, 1) == "draws"


def test_a_program_that_is_refused_for_good_is_said_in_plain_words(drawing: Any) -> None:
    said = drawing.evaluate(REFUSES, 99)
    assert "Slices" in said
    assert "reload" in said
    assert "shader" not in said.lower()

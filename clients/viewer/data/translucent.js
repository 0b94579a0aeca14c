// Runs in each viser frame, and in exported scenes, before viser. What is drawn translucent
// writes no depth: viser (1.1) gives images and translucent meshes materials that do,
// three.js draws them in the order of their nodes' origins, and a sheet of the beam that is
// drawn first then hides the sample behind it.
"use strict";
(() => {
  const gl = WebGL2RenderingContext.prototype;
  /** @type {WeakSet<WebGL2RenderingContext>} */
  const blending = new WeakSet();
  /** @type {WeakSet<WebGL2RenderingContext>} */
  const depthless = new WeakSet();
  /* eslint-disable @typescript-eslint/unbound-method -- they are called with their context below */
  const { enable, disable, depthMask } = gl;
  const { drawElements, drawArrays, drawElementsInstanced, drawArraysInstanced } = gl;
  /* eslint-enable @typescript-eslint/unbound-method */
  gl.enable = function (what) {
    if (what === this.BLEND) blending.add(this);
    enable.call(this, what);
  };
  gl.disable = function (what) {
    if (what === this.BLEND) blending.delete(this);
    disable.call(this, what);
  };
  gl.depthMask = function (on) {
    if (on) depthless.delete(this);
    else depthless.add(this);
    depthMask.call(this, on);
  };

  /**
   * @param {WebGL2RenderingContext} context
   * @param {() => void} draw
   */
  function withoutDepth(context, draw) {
    if (!blending.has(context) || depthless.has(context)) {
      draw();
      return;
    }
    depthMask.call(context, false);
    draw();
    depthMask.call(context, true);
  }
  gl.drawElements = function (...all) {
    withoutDepth(this, () => {
      drawElements.apply(this, all);
    });
  };
  gl.drawArrays = function (...all) {
    withoutDepth(this, () => {
      drawArrays.apply(this, all);
    });
  };
  gl.drawElementsInstanced = function (...all) {
    withoutDepth(this, () => {
      drawElementsInstanced.apply(this, all);
    });
  };
  gl.drawArraysInstanced = function (...all) {
    withoutDepth(this, () => {
      drawArraysInstanced.apply(this, all);
    });
  };
})();

// A geometry that the story made wrong by hand stays in force for everybody, over reloads and
// restarts: each page says so while it does, with the way back.
import { $, clicks, fixed, setText } from "./dom.js";
import { command, on } from "./link.js";
import { MEANS, unit } from "./belief.js";
import { BY_HAND } from "./story_steps.js";

on("state", ({ correction }) => {
  const wrong = correction?.comment === BY_HAND ? correction : null;
  $("#by-hand").hidden = wrong === null;
  if (!wrong) return;
  const words = Object.entries(wrong.parameters)
    .filter(([name, value]) => value !== (name === "angle_scale" ? 1 : 0))
    .map(([name, value]) => `${MEANS[name] ?? name} ${fixed(value, 2)} ${unit(name)}`.trim());
  setText($("#by-hand-what"), words.join(", ") || "nothing is displaced");
});
clicks({ "by-hand-undo": () => command("calibration.revert", {}, "It stays misaligned") });

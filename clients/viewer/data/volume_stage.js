// Whether a volume is of what stands on the stage: only then it is drawn there, else as a ghost
// that is asked for.
import { $, $input, setText } from "./dom.js";
import { samplesApart } from "./data.js";
import { differences, listed, ofVolume, sampleOf } from "./fingerprint.js";
import { call, on, store } from "./link.js";
/** @import { VolumeMessage } from "../web/viewer.d.ts" */

const row = $("#volume-stage");
const ghost = $input("#volume-ghost");
/** @type {VolumeMessage["made"] | null} */
let made = null;

/**
 * The volume that the page follows now; null for none.
 * @param {VolumeMessage | null} volume
 */
export function follow(volume) {
  if (!volume) ghost.checked = false;
  made = (volume?.size && volume.made) ?? null; // before that nothing stands anywhere
  draw();
}

/** @returns {string} */
function words() {
  if (!made?.offset)
    return "not on the stage: its data set does not say where the sample stood";
  const of = ofVolume(made);
  const differ = differences(of, store.now ?? {});
  if (samplesApart()) return "not on the stage: the open scan’s sample is not there";
  if (!differ.length) return "stands on the stage";
  const what = listed(differ).replace("sample", `sample (${sampleOf(of)})`);
  return `not on the stage: of another ${what}`;
}

function draw() {
  row.hidden = made === null;
  if (made === null) return;
  const said = words();
  setText($("#volume-stands"), said);
  row.toggleAttribute("data-apart", said.startsWith("not"));
}
on("state", draw);
on("recorded", draw);
ghost.addEventListener("change", () => {
  void call("viewer.ghost", { shown: ghost.checked }).catch(() => null);
});

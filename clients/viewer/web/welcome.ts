// A first visit: the LEGO phantom from nothing to a volume in three clicks. Dismissed for good, or done, it does not
// come back in this browser.
import { $, $button, $input, $select, keep, setText } from "./dom.js";
import { emit, on, store } from "./link.js";
import { folder } from "./data.js";

const KEY = "flexdt-welcome", card = $("#welcome"), go = $button("#welcome-go");
const STEPS: Array<[button: string, what: string, act: () => boolean | Promise<boolean>]> = [
  ["1  Write a scan", "", write],
  ["2  Run it", "The script is below, and its dry run says whether it may run. As fast as this machine computes.", run],
  ["3  Make the volume", "Its slices appear beside the radiograph when the scan is done.", reconstruct],
];
let step = 0, before: string | undefined;

function write() {
  emit("show-tab", "scan");
  $select("#wish-kind").value = "fly"; $input("#wish-frames").value = "91"; $button("#compose").click();
  return true;
}
function run() { before = store.job?.job; $select("#speed-up").value = "max"; $button("#run").click(); return true; }
function reconstruct() { emit("reconstruct", folder(store.job)); end(); return true; }
const stands = () => store.state?.sample.name ?? "";
const READY = [() => stands() !== "", () => !$button("#run").disabled && document.querySelector("#report .verdict.ok") !== null, () => store.job?.job !== before && store.job?.state === "done"];
// What stands on the stage, whatever a visitor has put there.
function standing(): string {
  const name = stands();
  if (!name) return store.state ? "Nothing stands on the stage: choose a sample in Setup." : "";
  const words = store.state?.sample.description ?? "";
  return `On the stage: ${name}${words ? ` (${words})` : ""}. Turn it once, 91 images.`;
}
function show() {
  if (card.hidden) return;
  const [button, what] = STEPS[step];
  setText(go, button);
  setText($("#welcome-what"), what || standing());
  setText($("#welcome-title"), stands() ? `Scan ${stands()} in three clicks` : "Scan a sample in three clicks");
  go.disabled = !READY[step]();
}
function end() { card.hidden = true; keep(KEY, "seen"); }
async function next() { if ((await STEPS[step][2]()) && step < STEPS.length - 1) step++; show(); }
go.addEventListener("click", () => void next());
$button("#welcome-no").addEventListener("click", end);
card.hidden = localStorage.getItem(KEY) === "seen";
on("age", show); show();

// A first visit: the LEGO phantom from nothing to a volume in three clicks. Dismissed for good, or done, it does not
// come back in this browser.
import { $, $button, $input, $select, keep, setText } from "./dom.js";
import { command, emit, on, store } from "./link.js";
import { folder } from "./data.js";
const KEY = "flexdt-welcome", card = $("#welcome"), go = $button("#welcome-go");
const STEPS = [
    ["1  Write a scan", "LEGO bricks with steel beads stand on the stage: turn them once, 91 images.", write],
    ["2  Run it", "The script is below, and its dry run says whether it may run. As fast as this machine computes.", run],
    ["3  Make the volume", "Its slices appear beside the radiograph when the scan is done.", reconstruct],
];
let step = 0, before;
async function write() {
    emit("show-tab", "scan");
    if (store.state?.sample.name !== "lego" && !(await command("sample.set", { name: "lego" }, "The sample stays")))
        return false;
    $select("#wish-kind").value = "fly";
    $input("#wish-frames").value = "91";
    $button("#compose").click();
    return true;
}
function run() { before = store.job?.job; $select("#speed-up").value = "max"; $button("#run").click(); return true; }
function reconstruct() { emit("reconstruct", folder(store.job)); end(); return true; }
const READY = [() => store.state !== null, () => !$button("#run").disabled && document.querySelector("#report .verdict.ok") !== null, () => store.job?.job !== before && store.job?.state === "done"];
function show() {
    if (card.hidden)
        return;
    const [button, what] = STEPS[step];
    setText(go, button);
    setText($("#welcome-what"), what);
    go.disabled = !READY[step]();
}
function end() { card.hidden = true; keep(KEY, "seen"); }
async function next() { if ((await STEPS[step][2]()) && step < STEPS.length - 1)
    step++; show(); }
go.addEventListener("click", () => void next());
$button("#welcome-no").addEventListener("click", end);
card.hidden = localStorage.getItem(KEY) === "seen";
on("age", show);
show();

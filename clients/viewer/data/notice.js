// A scan that ends is told in the page's title until somebody looks, and by the browser where that
// was asked for.
import { $button } from "./dom.js";
import { isOver, progress } from "./job_words.js";
import { on, store } from "./link.js";

const TITLE = document.title;
const button = $button("#job-notify");
let last = "";
let wanted = false;

/** @param {string} words */
const title = (words) => {
  document.title = words ? `${words} · ${TITLE}` : TITLE;
};

on("scan", () => {
  const job = store.job;
  button.hidden = !job || isOver(job) || !("Notification" in window);
  if (!job) {
    title("");
    return;
  }
  const now = `${job.job} ${job.state}`;
  if (!isOver(job)) title(`${(100 * progress(job)).toFixed(0)} %`);
  if (now === last) return;
  const news = last.startsWith(`${job.job} `);
  last = now;
  if (!isOver(job)) return;
  const words = job.state === "done" ? "scan done" : `scan ${job.state}`;
  title(news && !document.hasFocus() ? words : "");
  if (news && wanted) new Notification(`${job.name || job.job}: ${words}`);
});
window.addEventListener("focus", () => {
  if (!store.job || isOver(store.job)) title("");
});
async function toggle() {
  wanted = !wanted && (await Notification.requestPermission()) === "granted";
  button.setAttribute("aria-pressed", String(wanted));
}
button.addEventListener("click", () => void toggle());

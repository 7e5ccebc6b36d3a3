// The console: which page is shown, how the server is, keys and the key.

import { ApiError, getJson, key, postJson } from "./api.js";
import { setText } from "./charts.js";
import { HealthPage } from "./health_page.js";
import { describeKeys, listenToKeys } from "./keys.js";
import { ScenePage } from "./scene_page.js";
import { ScenesPage } from "./scenes_page.js";

const $ = (id) => document.getElementById(id);
const onAlive = () => setLink({ kind: "open", text: "Connected" });
const pages = {
  scenes: new ScenesPage({ onError: (error) => onError(error, "scenes"), onAlive }),
  health: new HealthPage({ onError: (error) => onError(error, "health"), onAlive }),
  scene: new ScenePage({ link: setLink }),
};
let shown = "";
let retryTimer = 0;

// ---- pages ----

function route() {
  const [, page, ...rest] = location.hash.split("/");
  const sceneId = decodeURIComponent(rest.join("/"));
  const next = page === "scene" && sceneId ? "scene" : page === "health" ? "health" : "scenes";
  if (shown) pages[shown].hide();
  shown = next;
  for (const name of Object.keys(pages)) $(`page-${name}`).hidden = name !== next;
  for (const name of ["scenes", "health"]) {
    if (name === next) $(`nav-${name}`).setAttribute("aria-current", "page");
    else $(`nav-${name}`).removeAttribute("aria-current");
    const note = $(`${name}-note`);
    note.hidden = true;
  }
  document.body.dataset.page = next;
  setLink({ kind: "connecting", text: "Connecting …" });
  pages[next].show(sceneId);
}

// ---- how the server is ----

function setLink(link) {
  const chip = $("link");
  const before = chip.dataset.kind;
  chip.dataset.kind = link.kind;
  clearInterval(retryTimer);
  const say = () => {
    const left = link.retryAt ? Math.max(Math.ceil((link.retryAt - performance.now()) / 1000), 0) : null;
    setText($("link-text"), left === null ? link.text : `${link.text} Next try in ${left} s.`);
  };
  say();
  if (link.retryAt) retryTimer = setInterval(say, 500);
  $("retry").hidden = link.kind !== "gone" || shown !== "scene";
  if (link.kind === "unauthorised") askForKey(link.text);
  if (link.kind === "open") {
    for (const name of ["scenes", "health"]) $(`${name}-note`).hidden = true;
    if (before !== "open") greet();
  }
}

function onError(error, page) {
  const note = $(`${page}-note`);
  if (!(error instanceof ApiError)) throw error;
  if (error.status === 401) {
    setLink({ kind: "unauthorised", text: "The server asks for an API key." });
    return;
  }
  const words = {
    0: "The server does not answer. This page asks again by itself.",
    403: page === "health" ? `This key may not read the metrics (scope metrics): ${error.message}` : `This key may not read scenes (scope read): ${error.message}`,
  };
  note.hidden = false;
  setText(note, words[error.status] ?? error.message);
  setLink({ kind: error.gone ? "gone" : "refused", text: error.gone ? "The server does not answer." : "Refused." });
}

/** Learn what the server is, once it answers. */
async function greet() {
  try {
    const { version, revision } = await getJson("v1/version");
    setText($("server"), `v${version}${revision ? ` (${revision.slice(0, 8)})` : ""}`);
    if (key.get()) pages.scene.setMayPredict(await mayPredict());
  } catch {
    // The page that is shown says what is wrong.
  }
}

/** Find out whether the key has the scope predict: a request without a time is refused in one way or the other. */
async function mayPredict() {
  try {
    await postJson("v1/predict", {});
  } catch (error) {
    return error.status !== 403;
  }
  return true;
}

// ---- the key ----

function askForKey(reason) {
  $("enter-key").hidden = false;
  const dialog = $("key-dialog");
  if (dialog.open) return;
  const wrong = key.get() !== "";
  setText($("key-reason"), wrong ? "The server does not accept this key. Enter another one; it needs the scope read." : `${reason} It needs the scope read, and is kept until this tab is closed.`);
  $("key-input").value = "";
  dialog.showModal();
}

$("key-form").addEventListener("submit", (event) => {
  event.preventDefault();
  key.set($("key-input").value.trim());
  $("key-dialog").close();
  route();
});
$("key-cancel").addEventListener("click", () => $("key-dialog").close());
$("enter-key").addEventListener("click", () => askForKey("This server asks for an API key."));
$("retry").addEventListener("click", () => pages.scene.retry());

// ---- keys ----

const scene = pages.scene;
const openHelp = () => $("help-dialog").showModal();
const table = [
  { keys: [" ", "k"], name: "Space", does: "pause, or go on live", on: "scene", act: () => scene.togglePlay() },
  { keys: [","], name: ",", does: "one tick back", on: "scene", act: () => scene.stepTime(-1) },
  { keys: ["."], name: ".", does: "one tick on", on: "scene", act: () => scene.stepTime(1) },
  { keys: ["<"], name: "<", does: "ten ticks back", on: "scene", act: () => scene.stepTime(-10) },
  { keys: [">"], name: ">", does: "ten ticks on", on: "scene", act: () => scene.stepTime(10) },
  { keys: ["n"], name: "N", does: "choose the next agent", on: "scene", act: () => scene.stepAgent(1) },
  { keys: ["p"], name: "P", does: "choose the agent before", on: "scene", act: () => scene.stepAgent(-1) },
  { keys: ["Escape"], name: "Esc", does: "choose no agent", on: "scene", act: () => scene.choose("") },
  { keys: ["f"], name: "F", does: "keep the chosen agent in the middle", on: "scene", act: () => scene.toggleFollow() },
  { keys: ["0"], name: "0", does: "show all agents", on: "scene", act: () => scene.fit() },
  { keys: ["+", "="], name: "+", does: "zoom in", on: "scene", act: () => scene.zoom(1.25) },
  { keys: ["-"], name: "−", does: "zoom out", on: "scene", act: () => scene.zoom(0.8) },
  { keys: [], name: "← → ↑ ↓", does: "in the picture: move it; in the list: choose; on the scrubber: ticks", on: "scene" },
  { keys: ["s"], name: "S", does: "draw samples of the chosen agent", on: "scene", act: () => scene.toggleSamples() },
  { keys: ["e"], name: "E", does: "explain the chosen agent's forecast", on: "scene", act: () => scene.explain() },
  { keys: ["/"], name: "/", does: "find an agent", on: "scene", act: () => $("agent-filter").focus() },
  { keys: ["l"], name: "L", does: "scenes", on: "everywhere", act: () => (location.hash = "#/scenes") },
  { keys: ["h"], name: "H", does: "health", on: "everywhere", act: () => (location.hash = "#/health") },
  { keys: ["t"], name: "T", does: "next theme: the system's, light, dark", on: "everywhere", act: () => $("theme").click() },
  { keys: ["?"], name: "?", does: "these keys", on: "everywhere", act: openHelp },
];
listenToKeys(table, () => shown);
describeKeys(table, $("help-keys"));
$("help").addEventListener("click", openHelp);
$("agent-filter").addEventListener("keydown", (event) => {
  if (event.key === "Escape") $("agent-filter").blur();
});

window.addEventListener("hashchange", route);
route();
// For tests and for those who measure.
window.cabForecastConsole = { counts: scene.counts };

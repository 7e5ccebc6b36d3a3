// Shapley values of the chosen agent's forecast, asked for when somebody wants them.

import { getJson, postJson } from "./api.js";
import { make, setText, short, showBars } from "./charts.js";
import { predictRequest } from "./frames.js";
import { timeText } from "./timeline.js";

const PATH = "v1/explain";
const NEIGHBOURS = 8; // that are shown, those with the largest values
const BASELINES = {
  EXPLANATION_BASELINE_DONORS: "Absent parts are those of other agents of the training data.",
  EXPLANATION_BASELINE_NULL_CONTEXT: "Absent parts are the null context: an unknown map, no neighbours, an agent that stands still.",
};

/** The part of the panel that explains; absent where the server cannot. */
export class Explainer {
  /** @param {HTMLElement} place */
  constructor(place) {
    this._place = place;
    this._button = make("button", { type: "button", title: "Explain the shown tick (E)" }, "Explain this forecast");
    this._note = make("p", { class: "nothing", role: "status" });
    this._bars = make("ul", { class: "bars" });
    this._neighbours = make("ul", { class: "bars" });
    this._title = make("h4", {}, "Shapley values ", make("span", { class: "unit" }, "m nearer the forecast"));
    this._byTitle = make("h4", {}, "Of each neighbour");
    place.append(this._title, this._button, this._note, this._bars, this._byTitle, this._neighbours);
    this._button.addEventListener("click", () => this.ask());
    this._known = false;
    this._allowed = true;
    this._frame = null;
    this._agent = null;
    this._clear("");
    this._update();
  }

  /** Find out whether the server explains. */
  async look() {
    try {
      this._known = `/${PATH}` in ((await getJson("openapi.json")).paths ?? {});
    } catch {
      return; // the stream says what is wrong
    }
    this._update();
  }

  setAllowed(allowed) {
    this._allowed = allowed;
    this._update();
  }

  /** Forget the values: they are of another agent. */
  choose(id) {
    if (id !== this._agent?.id) this._clear("");
  }

  show(frame, agent) {
    this._frame = frame;
    this._agent = agent;
    this._button.disabled = !agent.modes.length;
  }

  async ask() {
    const [frame, agent] = [this._frame, this._agent];
    if (!this._known || !this._allowed || !frame || !agent?.modes.length) return;
    this._clear("The server works on it: some hundred forecasts, made while no call waits for the model …");
    try {
      const model = `${frame.model.name}@${frame.model.version}`;
      const { time, agents, scene_raster } = predictRequest(frame, { only: agent.id });
      const options = { by_neighbor: true };
      const answer = await postJson(PATH, { time, model, agents, scene_raster, options });
      if (this._agent?.id === agent.id) this._render(answer, agent, frame);
    } catch (error) {
      if (this._agent?.id === agent.id) this._clear(error.message);
    }
  }

  _render(answer, agent, frame) {
    const found = answer.explanations.find((each) => each.agent_id === agent.id);
    if (!found?.state) {
      this._clear(found?.detail || "The server explained no forecast of this agent.");
      return;
    }
    this._clear([`Of the tick ${timeText(frame.time)}.`, BASELINES[found.baseline] ?? "", ...answer.warnings].join(" "));
    const parts = [["own state", found.state], ["map", found.map], ["neighbours", found.neighbors]];
    const each = found.by_neighbor ?? [];
    const limit = Math.max(...parts.map(([, value]) => Math.abs(value.nearer)), ...each.map(({ value }) => Math.abs(value.nearer)), 1e-9);
    showBars(this._bars, parts.map(bar), { limit, signed: true });
    const largest = each.slice(0, NEIGHBOURS).map(({ agent_id, value }) => [agent_id, value]);
    showBars(this._neighbours, largest.map(bar), { limit, signed: true });
    this._bars.hidden = false;
    this._byTitle.hidden = this._neighbours.hidden = largest.length === 0;
  }

  _clear(note) {
    setText(this._note, note);
    this._note.hidden = note === "";
    for (const element of [this._bars, this._byTitle, this._neighbours]) element.hidden = true;
  }

  _update() {
    this._place.hidden = !this._known || !this._allowed;
  }
}

function bar([name, { nearer, nearer_error: error, ahead, left }]) {
  const note = `${name}: ${signed(nearer)} m${error ? ` ± ${short(error)} m` : ", exact"}; moves the end ${signed(ahead)} m ahead, ${signed(left)} m left`;
  return { name, value: nearer, text: signed(nearer), note };
}

function signed(value) {
  return `${value > 0 ? "+" : value < 0 ? "−" : ""}${short(Math.abs(value))}`;
}

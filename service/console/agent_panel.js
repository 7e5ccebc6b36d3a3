// What is known of the chosen agent: status, modes, error and dispersion over time, convergence, Shapley values.

import { icon, STATUS_WORDS } from "./agent_list.js";
import { LineChart, make, percent, setText, short, showBars } from "./charts.js";
import { endPoint, heading, modelName, present, speed } from "./frames.js";
import { KEPT } from "./rolling_store.js";

const AGES = [1, 3, 6]; // s, of the errors that are drawn
const HORIZON = 6; // s, the greatest age

/** The panel beside the picture. */
export class AgentPanel {
  /** @param {HTMLElement} place */
  constructor(place) {
    this._head = make("div", { class: "agent-head" });
    this._facts = make("dl", { class: "facts" });
    this._notes = make("ul", { class: "warnings" });
    this._modes = make("table", { class: "modes" });
    this._modes.append(make("caption", {}, "Modes by probability"), make("thead"), make("tbody"));
    const charts = make("div");
    this._convergence = make("ul", { class: "bars" });
    this._convergenceNote = make("p", { class: "nothing" });
    this.explanation = make("section", { class: "explanation", "aria-label": "Explanation" });
    place.append(
      this._head, this._facts, this._notes, this._modes,
      make("h4", {}, "Convergence C(τ) ", make("span", { class: "unit" }, "s, right since")),
      this._convergence, this._convergenceNote, charts, this.explanation,
    );
    this._error = new LineChart(charts, { title: "Displacement error of forecasts made", unit: "m", window: KEPT, end: "newest", gap: 2.5 });
    this._dispersion = new LineChart(charts, { title: "Dispersion (standard deviation)", unit: "m", window: KEPT, end: "newest", gap: 2.5 });
    this._icon = "";
  }

  /**
   * Show an agent.
   * @param {import("./frames.js").Agent} agent
   * @param {import("./frames.js").Frame} frame that it is of.
   * @param {import("./frames.js").Frame | null} other the same tick by a second model.
   * @param {import("./frames.js").Frame[]} history the last 30 s.
   */
  show(agent, frame, other, history) {
    this._showHead(agent);
    this._showFacts(agent, frame);
    this._showNotes(agent);
    this._showModes(agent, other?.byId.get(agent.id) ?? null, frame, other);
    this._showCharts(agent, frame, history);
    this._showConvergence(agent);
  }

  _showHead(agent) {
    const key = `${agent.id} ${agent.type} ${agent.status}`;
    if (key === this._icon) return;
    this._icon = key;
    this._head.replaceChildren(
      icon(agent.type, agent.status),
      make("h2", {}, agent.id),
      make("span", { class: "quiet" }, agent.type),
      make("span", { class: `status ${agent.status}` }, STATUS_WORDS[agent.status] ?? agent.status),
    );
  }

  _showFacts(agent, frame) {
    const now = present(agent);
    const pace = speed(now);
    const angle = heading(now);
    const facts = [
      ["Speed", pace === null ? "unknown" : `${pace.toFixed(1)} m/s`],
      ["Heading", angle === null ? "unknown" : `${Math.round((((angle * 180) / Math.PI) % 360 + 360) % 360)}°`],
      ["Position", now ? `${now.x.toFixed(1)}, ${now.y.toFixed(1)} m` : "unknown"],
      ["History", `${agent.states.length} ${agent.states.length === 1 ? "frame" : "frames"}`],
      ["Model", modelName(agent.model ?? frame.model)],
    ];
    if (this._facts.children.length !== 2 * facts.length)
      this._facts.replaceChildren(...facts.flatMap(([name]) => [make("dt", {}, name), make("dd")]));
    facts.forEach(([, value], i) => setText(this._facts.children[2 * i + 1], value));
  }

  _showNotes(agent) {
    const notes = agent.warnings.map(({ code, detail }) => `${code.replaceAll("_", " ")}: ${detail}`);
    if (agent.detail) notes.unshift(agent.detail);
    if (agent.status === "context") notes.unshift("The call asked for no forecast of this agent: the others see it.");
    const key = notes.join("\n");
    if (this._notes.dataset.key === key) return;
    this._notes.dataset.key = key;
    this._notes.hidden = notes.length === 0;
    this._notes.replaceChildren(...notes.map((note) => make("li", {}, note)));
  }

  _showModes(agent, second, frame, other) {
    const [, head, body] = this._modes.children;
    const names = other ? [shortName(frame.model), shortName(other.model)] : ["weight"];
    const columns = ["mode", ...names, "in 6 s"];
    if (head.dataset.key !== columns.join("|")) {
      head.dataset.key = columns.join("|");
      head.replaceChildren(make("tr", {}, ...columns.map((name) => make("th", { scope: "col" }, name))));
      body.replaceChildren();
    }
    this._modes.hidden = agent.modes.length === 0 && !second?.modes.length;
    const count = Math.max(agent.modes.length, second?.modes.length ?? 0);
    while (body.rows.length > count) body.deleteRow(-1);
    while (body.rows.length < count) {
      const row = body.insertRow();
      columns.forEach((_, i) => row.append(make("td", i > 0 && i <= names.length ? { class: "weight" } : {})));
    }
    for (let i = 0; i < count; i += 1) {
      const cells = body.rows[i].cells;
      setText(cells[0], `${i + 1}`);
      weigh(cells[1], agent.modes[i]);
      if (other) weigh(cells[2], second?.modes[i]);
      setText(cells[cells.length - 1], other ? apart(agent.modes[i], second?.modes[i]) : reach(agent, agent.modes[i]));
    }
    const last = head.rows[0].lastElementChild;
    setText(last, other ? "ends apart" : "ends away");
    last.title = other ? "Between the ends of the two models' modes of this rank" : "From where the agent is now";
  }

  _showCharts(agent, frame, history) {
    const errors = AGES.map((age) => ({ name: `${age} s before`, points: [] }));
    const dispersion = { name: "of all ages", points: [] };
    for (const past of history) {
      const found = past.byId.get(agent.id)?.consistency;
      AGES.forEach((age, i) => {
        const error = found?.errors.find((each) => Math.abs(each.age - age) < 1e-6);
        errors[i].points.push([past.time, error?.displacement_error ?? null]);
      });
      dispersion.points.push([past.time, found?.complete ? (found.dispersion?.standard_deviation ?? null) : null]);
    }
    const end = history.at(-1)?.time ?? frame.time;
    const cursor = frame.time === end ? null : frame.time;
    const empty = "Nothing yet: a forecast is judged when the agent is seen at the time that it was made for.";
    this._error.show(errors, end, { cursor, empty });
    this._dispersion.show([dispersion], end, { cursor, empty: "Nothing yet: it takes forecasts of all ages up to 6 s." });
  }

  _showConvergence(agent) {
    const found = agent.consistency;
    const known = Boolean(found?.complete && found.convergence.length);
    this._convergence.hidden = !known;
    this._convergenceNote.hidden = known;
    setText(this._convergenceNote, "Nothing yet: it takes forecasts of all ages up to 6 s.");
    if (!known) return;
    const bars = found.convergence.map(({ range, duration }) => ({
      name: `within ${range} m`,
      value: duration,
      text: `${duration.toFixed(1)} s`,
      note: `All forecasts of the last ${duration} s lie within ${range} m of where the agent is.`,
    }));
    showBars(this._convergence, bars, { limit: HORIZON });
  }
}

function shortName(model) {
  return model?.name ? `${model.name} ${model.version}` : "?";
}

function weigh(cell, mode) {
  setText(cell, mode ? percent(mode.weight) : "–");
  cell.style.setProperty("--share", mode ? mode.weight : 0);
}

function apart(first, second) {
  if (!first || !second) return "–";
  const [a, b] = [endPoint(first), endPoint(second)];
  return `${short(Math.hypot(a[0] - b[0], a[1] - b[1]))} m`;
}

function reach(agent, mode) {
  const now = present(agent);
  if (!now || !mode) return "–";
  const [x, y] = endPoint(mode);
  return `${short(Math.hypot(x - now.x, y - now.y))} m`;
}

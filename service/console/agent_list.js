// The list of agents: a listbox, for those who do not use a mouse, and to find one among many.

import { make, setText } from "./charts.js";
import { present, speed } from "./frames.js";

/** Words for the statuses of agents. */
export const STATUS_WORDS = {
  ok: "OK",
  short_history: "short history",
  fallback: "fallback",
  invalid: "invalid",
  context: "context only",
  unspecified: "no forecast",
};

/** Return an icon of an agent by type and status, as the picture draws it. */
export function icon(type, status) {
  const known = ["vehicle", "pedestrian", "cyclist"].includes(type) ? type : "unknown";
  const shape = make("span", { class: `agent-icon ${known} ${status}`, "aria-hidden": "true" });
  return shape;
}

/** The listbox, with its filters. */
export class AgentList {
  /**
   * @param {{list: HTMLElement, filter: HTMLInputElement, faults: HTMLInputElement, count: HTMLElement}} parts
   * @param {(id: string) => void} onChoose
   */
  constructor({ list, filter, faults, count }, onChoose) {
    this._list = list;
    this._filter = filter;
    this._faults = faults;
    this._count = count;
    this._rows = new Map();
    this._order = "";
    this._selected = "";
    this.ids = [];
    this._onChoose = onChoose;
    list.addEventListener("click", (event) => {
      const row = event.target.closest("[role=option]");
      if (row) onChoose(row.dataset.id);
    });
    list.addEventListener("keydown", (event) => {
      const steps = { ArrowDown: 1, ArrowUp: -1, PageDown: 10, PageUp: -10, Home: -Infinity, End: Infinity }[event.key];
      if (steps === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      this.step(steps);
    });
  }

  /** Choose the agent a number of places after the chosen one in the list as it is shown. */
  step(places) {
    if (this.ids.length === 0) return;
    const from = this.ids.indexOf(this._selected);
    const to = from === -1 ? (places > 0 ? 0 : this.ids.length - 1) : from + places;
    this._onChoose(this.ids[Math.min(Math.max(to, 0), this.ids.length - 1)]);
  }

  /** Show the agents of a frame. */
  show(frame, selected) {
    const word = this._filter.value.trim().toLowerCase();
    const agents = (frame?.agents ?? []).filter(
      (agent) =>
        (!word || agent.id.toLowerCase().includes(word) || agent.type.includes(word)) &&
        (!this._faults.checked || (agent.status !== "ok" && agent.status !== "context") || agent.warnings.length),
    );
    agents.sort((a, b) => compareIds.compare(a.id, b.id));
    this.ids = agents.map((agent) => agent.id);
    const all = frame?.agents.length ?? 0;
    setText(this._count, agents.length === all ? `${all}` : `${agents.length} of ${all}`);
    for (const agent of agents) this._update(agent);
    this._arrange();
    this._select(selected);
  }

  _update(agent) {
    let row = this._rows.get(agent.id);
    if (!row) {
      row = make("li", { role: "option", id: `agent-row-${this._rows.size}`, "aria-selected": "false" });
      row.dataset.id = agent.id;
      row.append(icon(agent.type, agent.status), make("span", { class: "id" }, agent.id));
      row.append(make("span", { class: "what" }), make("span", { class: "speed" }));
      this._rows.set(agent.id, row);
    }
    const [shape, , what, pace] = row.children;
    const state = `${agent.type} ${agent.status}`;
    if (row.dataset.state !== state) {
      row.dataset.state = state;
      shape.replaceWith(icon(agent.type, agent.status));
    }
    const words = agent.status === "ok" ? "" : STATUS_WORDS[agent.status];
    setText(what, agent.warnings.length ? `${words ? `${words}, ` : ""}⚠ warning` : words);
    const pacing = speed(present(agent));
    setText(pace, pacing === null ? "" : pacing.toFixed(1));
  }

  _arrange() {
    const order = this.ids.join("\n");
    if (order === this._order) return;
    this._order = order;
    this._list.replaceChildren(...this.ids.map((id) => this._rows.get(id)));
    const shown = new Set(this.ids);
    if (this._rows.size > 4 * shown.size + 64)
      for (const id of this._rows.keys()) if (!shown.has(id)) this._rows.delete(id);
  }

  _select(selected) {
    if (selected !== this._selected) {
      this._rows.get(this._selected)?.setAttribute("aria-selected", "false");
      this._selected = selected;
      this._rows.get(selected)?.scrollIntoView({ block: "nearest" });
    }
    const row = this._rows.get(selected);
    if (row && this.ids.includes(selected)) {
      row.setAttribute("aria-selected", "true");
      this._list.setAttribute("aria-activedescendant", row.id);
    } else {
      this._list.removeAttribute("aria-activedescendant");
    }
  }
}

const compareIds = new Intl.Collator("en", { numeric: true });

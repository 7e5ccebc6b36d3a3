// The list of live scenes.

import { getJson, send } from "./api.js";
import { make, setText } from "./charts.js";
import { modelName } from "./frames.js";
import { timeText } from "./timeline.js";

const EVERY = 1000; // ms

/** The page with the list; it asks while it is shown. */
export class ScenesPage {
  /** @param {{onError: (error: Error) => void, onAlive: () => void}} on */
  constructor(on) {
    this._on = on;
    this._table = document.getElementById("scenes-table");
    this._empty = document.getElementById("scenes-empty");
    this._timer = 0;
    this._shown = false;
  }

  show() {
    this._shown = true;
    document.title = "Scenes · cab-forecast";
    this._load();
  }

  hide() {
    this._shown = false;
    clearTimeout(this._timer);
  }

  async _load() {
    clearTimeout(this._timer);
    try {
      const response = await send("v1/scenes", { headers: { Accept: "application/json" } });
      const now = Date.parse(response.headers.get("date") ?? "") / 1000 || Date.now() / 1000;
      const { scenes } = await response.json();
      if (!this._shown) return;
      this._on.onAlive();
      this._render(scenes, now);
    } catch (error) {
      if (!this._shown) return;
      this._on.onError(error);
    }
    clearTimeout(this._timer);
    if (this._shown) this._timer = setTimeout(() => this._load(), EVERY);
  }

  _render(scenes, now) {
    this._table.hidden = scenes.length === 0;
    this._empty.hidden = scenes.length > 0;
    const body = this._table.tBodies[0];
    while (body.rows.length > scenes.length) body.deleteRow(-1);
    while (body.rows.length < scenes.length) {
      const row = body.insertRow();
      row.append(make("th", { scope: "row" }, make("a")));
      for (const kind of ["number", "number", "", "number", ""]) row.append(make("td", kind ? { class: kind } : {}));
    }
    scenes.forEach((scene, i) => {
      const [name, agents, rate, model, time, age] = body.rows[i].cells;
      const link = name.firstElementChild;
      setText(link, scene.scene_id);
      const target = `#/scene/${encodeURIComponent(scene.scene_id)}`;
      if (link.getAttribute("href") !== target) link.setAttribute("href", target);
      setText(agents, `${scene.agents}`);
      setText(rate, scene.rate_hz.toFixed(1));
      setText(model, modelName(scene.model));
      setText(time, timeText(scene.time));
      const ago = Math.max(now - scene.updated_time, 0);
      setText(age, ago < 2 ? "just now" : `${Math.round(ago)} s ago`);
    });
  }
}

/** Return the models of the server. */
export async function listModels() {
  return (await getJson("v1/models")).models;
}

// What the signs of the picture mean.

import { icon } from "./agent_list.js";
import { make } from "./charts.js";

const SIGNS = [
  [["vehicle", "ok"], "vehicle"],
  [["pedestrian", "ok"], "pedestrian"],
  [["cyclist", "ok"], "cyclist"],
  [["unknown", "ok"], "unknown type"],
  [["vehicle", "short_history"], "short history"],
  [["vehicle", "fallback"], "fallback: another model"],
  [["vehicle", "invalid"], "invalid: no forecast"],
  [["vehicle", "context"], "context only"],
];
const LINES = [
  ["thick", "likely mode, thin: unlikely"],
  ["dashed", "other modes of the chosen agent"],
  ["rings", "1 σ (inner) and 2 σ"],
  ["dots", "history, every 0.5 s"],
  ["mark", "the input contradicts itself"],
];

/** Fill the legend, once. */
export function paintLegend(place) {
  if (place.querySelector("ul")) return;
  const list = make("ul");
  for (const [[type, status], text] of SIGNS) list.append(make("li", {}, icon(type, status), text));
  for (const [kind, text] of LINES) list.append(make("li", {}, make("span", { class: `sample ${kind}`, "aria-hidden": "true" }), text));
  place.append(list);
}

// Keys of the console: one table for what they do and for the dialog that says so.

import { make } from "./charts.js";

const TYPING = "input:not([type=range], [type=checkbox]), textarea, select";

/**
 * @typedef {{keys: string[], name: string, does: string, on: "everywhere" | "scene", act?: () => void}} Key
 *   keys: values of KeyboardEvent.key; without act the key is the browser's or another part's, and only listed.
 */

/**
 * Listen to keys.
 * @param {Key[]} table
 * @param {() => string} where the page that is shown.
 */
export function listenToKeys(table, where) {
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey) return;
    if (document.querySelector("dialog[open]")) return;
    if (event.target.closest(TYPING)) return;
    if (event.key === " " && event.target.closest("button, summary, a, [type=checkbox]")) return;
    const pressed = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const found = table.find(({ keys, on, act }) => act && keys.includes(pressed) && (on === "everywhere" || where() === on));
    if (!found) return;
    event.preventDefault();
    found.act();
  });
}

/** Show the table in a dialog's place. */
export function describeKeys(table, place) {
  const part = (title, on) => [
    make("h3", {}, title),
    make("dl", { class: "keys" }, ...table.filter((key) => key.on === on).flatMap(({ name, does }) => [
      make("dt", {}, ...name.split(" ").map((each) => make("kbd", {}, each))),
      make("dd", {}, does),
    ])),
  ];
  place.replaceChildren(...part("A scene", "scene"), ...part("Everywhere", "everywhere"));
}

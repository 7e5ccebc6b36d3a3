// Theme of the page: the system's, light or dark. A classic script in the head, so that the first paint has the
// right colours. The attribute data-theme of the root says which one is shown; a change is a "themechange" event.
"use strict";

(() => {
  const KEPT = "cab-forecast.theme";
  const NEXT = { system: "light", light: "dark", dark: "system" };
  const system = matchMedia("(prefers-color-scheme: dark)");
  const root = document.documentElement;
  const chosen = () => localStorage.getItem(KEPT) ?? "system";

  function apply() {
    root.dataset.theme = chosen() === "system" ? (system.matches ? "dark" : "light") : chosen();
    const button = document.getElementById("theme");
    if (button) button.textContent = `Theme: ${chosen()}`;
    document.dispatchEvent(new Event("themechange"));
  }

  document.addEventListener("click", (event) => {
    if (!event.target.closest("#theme")) return;
    localStorage.setItem(KEPT, NEXT[chosen()]);
    apply();
  });
  document.addEventListener("DOMContentLoaded", apply);
  system.addEventListener("change", apply);
  apply();
})();

// Health of the service from its own metrics, by differences between scrapes.

import { getJson, getText } from "./api.js";
import { LineChart, make, setText, short } from "./charts.js";
import { bucketGrowth, growth, growthBy, histogramQuantile, meanGrowth, parseMetrics, total } from "./prometheus.js";
import { listModels } from "./scenes_page.js";

const EVERY = 2000; // ms
const WINDOW = 10; // s that rates and quantiles look back
const SHOWN = 120; // s of a chart
const PREDICT = { method: "Predict" };
const QUANTILES = [0.5, 0.9, 0.99];

/** Return what the scrapes before and after tell, for the charts. */
export function figuresOf(before, after, seconds) {
  const rate = (name, wanted) => growth(total(before, name, wanted), total(after, name, wanted)) / seconds;
  const duration = bucketGrowth(before, after, "forecast_request_duration_seconds", PREDICT);
  const waiting = bucketGrowth(before, after, "forecast_queue_seconds");
  const perSecond = (grown) => new Map([...grown].map(([name, count]) => [name, count / seconds]));
  return {
    codes: perSecond(growthBy("code", before, after, "forecast_requests_total", PREDICT)),
    refused: perSecond(growthBy("reason", before, after, "forecast_refused_total")),
    statuses: perSecond(growthBy("status", before, after, "forecast_agents_total")),
    latency: QUANTILES.map((quantile) => histogramQuantile(quantile, duration)),
    waiting: QUANTILES.map((quantile) => histogramQuantile(quantile, waiting)),
    inference: meanGrowth(before, after, "forecast_inference_seconds"),
    batch: meanGrowth(before, after, "forecast_batch_agents"),
    queued: total(after, "forecast_queue_agents"),
    cores: rate("process_cpu_seconds_total", {}),
    memory: total(after, "process_resident_memory_bytes"),
  };
}

/** The page; it reads the metrics while it is shown. */
export class HealthPage {
  /** @param {{onError: (error: Error) => void, onAlive: () => void}} on */
  constructor(on) {
    this._on = on;
    this._scrapes = [];
    this._points = [];
    this._charts = null;
    this._timer = 0;
    this._shown = false;
    this._round = 0;
  }

  show() {
    this._shown = true;
    document.title = "Health · cab-forecast";
    this._charts ??= this._makeCharts();
    this._load();
  }

  hide() {
    this._shown = false;
    clearTimeout(this._timer);
  }

  async _load() {
    clearTimeout(this._timer);
    try {
      if (this._round++ % 15 === 0) await this._loadModels();
      this._add(parseMetrics(await getText("metrics")));
      if (!this._shown) return;
      this._on.onAlive();
    } catch (error) {
      if (!this._shown) return;
      this._round = 0;
      this._on.onError(error, "metrics");
    }
    clearTimeout(this._timer);
    if (this._shown) this._timer = setTimeout(() => this._load(), EVERY);
  }

  _add(metrics) {
    const time = performance.now() / 1000;
    this._scrapes.push({ time, metrics });
    while (this._scrapes.length > 2 && this._scrapes[1].time <= time - WINDOW) this._scrapes.shift();
    if (this._scrapes.length < 2) return;
    const first = this._scrapes[0];
    if (time - first.time > 3 * WINDOW) {
      this._scrapes = [this._scrapes.at(-1)]; // the page was hidden: a difference over so long is no present rate
      return;
    }
    this._points.push({ time, ...figuresOf(first.metrics, metrics, time - first.time) });
    while (this._points[0].time < time - SHOWN) this._points.shift();
    this._render();
  }

  _makeCharts() {
    const place = document.getElementById("health-charts");
    const chart = (title, unit, scale = 1) => {
      const figure = make("section", { class: "card" });
      place.append(figure);
      return new LineChart(figure, { title, unit, window: SHOWN, height: 130, scale });
    };
    return {
      codes: chart("Predict by code", "calls a second"),
      latency: chart("Duration of Predict", "ms", 1000),
      waiting: chart("Time in the queue", "ms", 1000),
      batch: chart("Agents in a batch, and in the queue", "agents"),
      refused: chart("Refused as overload, by reason", "calls a second"),
      statuses: chart("Agents by status", "agents a second"),
    };
  }

  _render() {
    const points = this._points;
    const now = points.at(-1);
    const line = (name, value) => ({ name, points: points.map((point) => [point.time, value(point) ?? null]) });
    const byName = (field, keep) =>
      [...now[field].keys()]
        .filter((name) => keep(name) || points.some((point) => point[field].get(name) > 0))
        .sort()
        .slice(0, 6)
        .map((name) => line(name.toLowerCase().replaceAll("_", " "), (point) => point[field].get(name)));
    const quantiles = (field) => QUANTILES.map((q, i) => line(`${q * 100} %`, (point) => point[field][i]));
    const end = now.time;
    this._charts.codes.show(byName("codes", (name) => name === "OK"), end);
    this._charts.latency.show(quantiles("latency"), end, { empty: "No call of Predict in the last 10 s." });
    this._charts.waiting.show(quantiles("waiting"), end, { empty: "Nothing was queued in the last 10 s." });
    this._charts.batch.show([line("mean of a batch", (p) => p.batch), line("in the queue", (p) => p.queued)], end);
    this._charts.refused.show(byName("refused", () => false), end, { empty: "No call was refused in the last 2 minutes." });
    this._charts.statuses.show(byName("statuses", (name) => name === "ok"), end);
    this._renderFigures(now);
  }

  _renderFigures(now) {
    const sum = (rates) => [...rates.values()].reduce((all, each) => all + each, 0);
    const ms = (seconds) => (seconds === null ? "–" : `${short(seconds * 1000)} ms`);
    const failed = sum(now.codes) - (now.codes.get("OK") ?? 0);
    const figures = [
      ["Predict calls/s", sum(now.codes).toFixed(1), ""],
      ["Not OK/s", failed.toFixed(1), failed > 0.05 ? "bad" : ""],
      ["Median time", ms(now.latency[0]), ""],
      ["99 % within", ms(now.latency[2]), ""],
      ["In the model", ms(now.inference), ""],
      ["Agents a batch", short(now.batch), ""],
      ["In the queue", short(now.queued), ""],
      ["Refused/s", sum(now.refused).toFixed(1), sum(now.refused) > 0 ? "bad" : ""],
      ["CPU", `${now.cores.toFixed(2)} cores`, ""],
      ["Memory", `${(now.memory / 2 ** 20).toFixed(0)} MiB`, ""],
    ];
    const place = document.getElementById("health-figures");
    if (place.children.length === 0)
      place.append(...figures.map(([name]) => make("div", { class: "figure" }, make("span", { class: "quiet" }, name), make("b"))));
    figures.forEach(([, value, state], i) => {
      setText(place.children[i].lastElementChild, value);
      place.children[i].dataset.state = state;
    });
  }

  async _loadModels() {
    const [models, version] = await Promise.all([listModels(), getJson("v1/version")]);
    const head = ["Model", "Version", "Protocol", "Agent types", "Modes", "Looks at", "Error in 6 s", "Trained on"];
    const rows = models.map((model) => [
      `${model.name}${model.is_default ? " (default)" : ""}`,
      model.version,
      model.protocol.replace("INPUT_PROTOCOL_", "").toLowerCase(),
      model.agent_types.map((type) => type.replace("AGENT_TYPE_", "").toLowerCase()).join(", "),
      `${model.modes}`,
      [model.uses_map && "map", model.uses_neighbors && "neighbours"].filter(Boolean).join(", ") || "own history",
      model.benchmark.fde_ml_6s_m === undefined ? "–" : `${model.benchmark.fde_ml_6s_m.toFixed(2)} m`,
      model.trained_on.replace(/;.*/s, " …") || "nothing",
    ]);
    const cells = (tag, names, options = {}) => names.map((name) => make(tag, options, name));
    document.getElementById("health-models").replaceChildren(
      make(
        "table",
        {},
        make("thead", {}, make("tr", {}, ...cells("th", head, { scope: "col" }))),
        make("tbody", {}, ...rows.map(([name, ...rest]) => make("tr", {}, make("th", { scope: "row" }, name), ...cells("td", rest)))),
      ),
    );
    const facts = Object.entries(version).filter(([, value]) => value);
    document
      .getElementById("health-version")
      .replaceChildren(...facts.flatMap(([name, value]) => [make("dt", {}, name), make("dd", {}, value)]));
  }
}

// The page of one scene: what the stream says, drawn once per tick.

import { AgentList } from "./agent_list.js";
import { AgentPanel } from "./agent_panel.js";
import { setText } from "./charts.js";
import { Explainer } from "./explainer.js";
import { Extras, SHADOW } from "./extras.js";
import { modelName, present } from "./frames.js";
import { paintLegend } from "./legend.js";
import { listenToPane } from "./pane_input.js";
import { SceneCanvas } from "./scene_canvas.js";
import { readColours } from "./scene_painter.js";
import { SceneWatch } from "./scene_watch.js";
import { listModels } from "./scenes_page.js";
import { Clock, Timeline } from "./timeline.js";
import { View } from "./view.js";

const QUIET = 2000; // ms without a frame until the page says so
const $ = (id) => document.getElementById(id);

/** The page; it watches one scene while it is shown. */
export class ScenePage {
  /** @param {{link: (link: object) => void}} on */
  constructor(on) {
    this._on = on;
    this._sceneId = "";
    this._watch = null;
    this._view = new View();
    this._canvas = new SceneCanvas($("pane-a"), this._view);
    this._secondCanvas = new SceneCanvas($("pane-b"), this._view);
    this._panel = new AgentPanel($("agent"));
    this._explainer = new Explainer(this._panel.explanation);
    this._list = new AgentList(
      { list: $("agent-list"), filter: $("agent-filter"), faults: $("agent-faults"), count: $("agent-count") },
      (id) => this.choose(id),
    );
    this._extras = new Extras(() => this._wake());
    this._sampling = false;
    this._scheduled = false;
    this._stale = false;
    this._following = false;
    this._mayPredict = true;
    /** For those who measure: ticks that came, were drawn and were lost, ms of drawing, times that are shown. */
    this.counts = { received: 0, drawn: 0, dropped: 0, milliseconds: 0, time: null, secondTime: null };
    this._reset();
    this._listen();
  }

  // ---- what the page is told ----

  show(sceneId) {
    document.title = `${sceneId} · cab-forecast`;
    setText($("scene-title"), sceneId);
    if (sceneId !== this._sceneId) {
      this._sceneId = sceneId;
      this._reset();
    }
    this._colours = readColours(document.body);
    paintLegend($("key"));
    this._loadModels();
    this._explainer.look();
    this._watch = new SceneWatch(sceneId, {
      frame: (frame) => this._addFrame(frame),
      map: (map) => this._addMap(map),
      dropped: (count) => {
        this.counts.dropped += count;
        this._dropped += count;
      },
      link: (link) => this._link(link),
    });
    this._quietTimer = setInterval(() => this._sayQuiet(), 500);
    this._measure();
  }

  hide() {
    this._watch?.stop();
    this._watch = null;
    clearInterval(this._quietTimer);
  }

  retry() {
    this._watch?.retry();
  }

  /** Allow or hide what needs the scope predict. */
  setMayPredict(may) {
    this._mayPredict = may;
    $("samples").hidden = !may;
    for (const option of $("compare").options) option.hidden = !may && option.value !== "" && option.value !== SHADOW;
    this._explainer.setAllowed(may);
  }

  choose(id) {
    this._selected = id;
    this._explainer.choose(id);
    this._wishSamples(this._sampling);
  }

  stepAgent(places) {
    this._list.step(places);
  }

  togglePlay() {
    if (this._clock.paused) this._clock.play();
    else this._clock.pause(this._shown);
    this._wake();
  }

  stepTime(ticks) {
    this._clock.step(this._shown, ticks);
    this._wake();
  }

  fit() {
    const frame = this._shown;
    if (!frame) return;
    const points = [];
    for (const agent of frame.agents) {
      const now = present(agent);
      if (now && now.x !== undefined) points.push([now.x, now.y]);
    }
    this._setFollowing(false);
    this._view.fit(points, this._canvas.size);
    this._wake();
  }

  toggleFollow() {
    this._setFollowing(!this._following && Boolean(this._selected));
    if (this._following && this._view.scale < 6) this._view.scale = 6;
    this._wake();
  }

  zoom(factor) {
    this._view.zoom(factor, this._canvas.size.width / 2, this._canvas.size.height / 2, this._canvas.size);
    this._wake();
  }

  toggleSamples() {
    this._wishSamples(!this._sampling && this._mayPredict);
  }

  explain() {
    if (this._mayPredict) this._explainer.ask();
  }

  // ---- what happens ----

  _reset() {
    this._clock = new Clock();
    this._timeline = new Timeline(this._clock, () => this._wake());
    this._extras.shadows.frames = [];
    this._extras.wish({ model: "", sampled: "" });
    $("compare").value = "";
    this._maps = new Map();
    this._mapShown = null;
    this._shown = null;
    this._drawn = null;
    this._selected = "";
    this._hovered = "";
    this._fitted = false;
    this._wishSamples(false);
    this._dropped = 0;
    this._lastFrame = performance.now();
    this._setFollowing(false);
  }

  _listen() {
    for (const canvas of [this._canvas, this._secondCanvas])
      listenToPane(canvas, {
        moved: (how) => {
          if (how !== "zoom") this._setFollowing(false);
          this._wake(false);
        },
        choose: (left, top) => {
          const id = canvas.agentAt(this._shown, left, top);
          if (id) this.choose(id);
        },
        hover: (left, top) => {
          const id = canvas.agentAt(this._shown, left, top);
          if (id !== this._hovered) {
            this._hovered = id;
            canvas.pane.classList.toggle("over-agent", id !== "");
            this._wake(false);
          }
        },
      });
    new ResizeObserver(() => this._measure()).observe($("pane-a"));
    for (const id of ["modes", "ellipses", "histories", "labels", "agent-faults"]) $(id).addEventListener("change", () => this._wake());
    $("agent-filter").addEventListener("input", () => this._wake());
    $("fit").addEventListener("click", () => this.fit());
    $("follow").addEventListener("click", () => this.toggleFollow());
    $("samples").addEventListener("click", () => this.toggleSamples());
    $("play").addEventListener("click", () => this.togglePlay());
    $("back").addEventListener("click", () => this.stepTime(-1));
    $("forward").addEventListener("click", () => this.stepTime(1));
    $("compare").addEventListener("change", () => {
      this._extras.wish({ model: $("compare").value });
      this._measure();
    });
    document.addEventListener("themechange", () => {
      this._colours = readColours(document.body);
      this._mapShown = null;
      this._wake();
    });
  }

  _setFollowing(following) {
    this._following = following;
    $("follow").setAttribute("aria-pressed", `${following}`);
  }

  _measure() {
    $("pane-b").hidden = !this._extras.model;
    this._canvas.measure();
    if (!$("pane-b").hidden) this._secondCanvas.measure();
    this._wake();
  }

  _link(link) {
    this._lastFrame = performance.now();
    this._on.link(link);
    this._wake();
  }

  _addFrame(frame) {
    this._lastFrame = performance.now();
    if (frame.shadow) {
      this._extras.shadows.add(frame);
    } else {
      this.counts.received += 1;
      this._clock.live.add(frame);
    }
    this._wake();
  }

  _addMap(map) {
    this._maps.set(map.digest, map);
    if (this._maps.size > 8) this._maps.delete(this._maps.keys().next().value);
    this._wake();
  }

  /** Draw samples of the chosen agent, or none. */
  _wishSamples(sampling) {
    this._sampling = sampling;
    $("samples").setAttribute("aria-pressed", `${sampling}`);
    this._extras.wish({ sampled: sampling ? this._selected : "" });
    this._wake();
  }

  async _loadModels() {
    let models = [];
    try {
      models = await listModels();
    } catch {
      return; // the stream says what is wrong
    }
    const select = $("compare");
    const kept = select.value;
    const options = models.map((model) => new Option(`${model.name} ${model.version}`, `${model.name}@${model.version}`));
    select.replaceChildren(new Option("nothing", ""), new Option("the server's shadow model", SHADOW), ...options);
    select.value = kept;
    this.setMayPredict(this._mayPredict);
  }

  // ---- drawing ----

  /**
   * Draw with the browser's next frame.
   * @param {boolean} contents whether more than the view has changed.
   */
  _wake(contents = true) {
    this._stale ||= contents;
    if (this._scheduled || !this._watch) return;
    this._scheduled = true;
    requestAnimationFrame(() => {
      this._scheduled = false;
      if (!this._watch) return;
      const begin = performance.now();
      this._draw();
      this.counts.milliseconds += performance.now() - begin;
    });
  }

  _draw() {
    const newest = this._clock.live.newest;
    if (!this._clock.paused && newest) this._extras.want(newest);
    const frame = this._clock.frame((each) => this._extras.complete(each.time));
    if (this._clock.paused && frame) this._extras.want(frame);
    this._shown = frame;
    if (frame && !this._fitted) {
      this._fitted = true;
      this.fit();
    }
    const chosen = frame?.byId.get(this._selected) ?? null;
    const now = chosen && present(chosen);
    if (this._following && now) this._view.centre(now.x, now.y);
    this._adoptMap(frame);
    const other = frame && this._extras.model ? this._extras.second(frame.time) : null;
    const options = this._options(frame);
    this._canvas.draw(frame, options, this._colours);
    this._caption($("pane-a"), frame, "");
    if (this._extras.model) {
      this._secondCanvas.draw(other, { ...options, samples: [] }, this._colours);
      this._caption($("pane-b"), other, this._extras.waiting);
    }
    if (this._stale) {
      this._timeline.show(frame, this._colours);
      this._list.show(frame, this._selected);
      this._showAgent(chosen, frame, other);
      this._sayQuiet();
    }
    this._stale = false;
    if (frame && frame !== this._drawn) this.counts.drawn += 1;
    this._drawn = frame;
    this.counts.time = frame?.time ?? null;
    this.counts.secondTime = other?.time ?? null;
  }

  _options(frame) {
    return {
      selected: this._selected,
      hovered: this._hovered,
      modes: $("modes").value,
      ellipses: $("ellipses").value,
      histories: $("histories").checked,
      labels: $("labels").checked,
      samples: frame ? this._extras.samples(frame.time) : [],
    };
  }

  _adoptMap(frame) {
    const map = (frame && this._maps.get(frame.mapDigest)) ?? null;
    const key = `${map?.digest ?? "none"} ${this._colours.ground}`;
    if (key === this._mapShown) return;
    this._mapShown = key;
    for (const canvas of [this._canvas, this._secondCanvas])
      canvas.setMap(map, this._colours).then(
        () => this._wake(),
        (error) => this._note(`The map cannot be drawn: ${error.message}`),
      );
  }

  _caption(pane, frame, text) {
    const caption = pane.querySelector("figcaption");
    const words = frame
      ? `${modelName(frame.model)}${frame.shadow ? " (shadow)" : ""} · ${(frame.inference * 1000).toFixed(1)} ms model, ${(frame.queue * 1000).toFixed(1)} ms queue`
      : text;
    setText(caption, words);
    caption.hidden = words === "";
  }

  _showAgent(chosen, frame, other) {
    $("agent-none").hidden = chosen !== null;
    $("agent").hidden = chosen === null;
    if (!chosen) {
      const lost = this._selected && frame;
      setText($("agent-none").querySelector("h2"), lost ? `${this._selected} is not in this tick` : "No agent is chosen");
      return;
    }
    this._panel.show(chosen, frame, other, this._clock.store.frames);
    this._explainer.show(frame, chosen);
  }

  /** Say what keeps the picture from moving, if anything does. */
  _sayQuiet() {
    if (!this._watch) return;
    const still = performance.now() - this._lastFrame;
    const error = this._extras.error;
    let note = "";
    if (error?.status === 403) {
      note = `This key may not ask for forecasts: ${error.message}`;
      this.setMayPredict(false);
    } else if (error) {
      note = error.message;
    } else if (still > QUIET) {
      note = this._clock.live.newest
        ? `No tick for ${Math.round(still / 1000)} s. The picture is of the last one.`
        : "Nothing came of this scene yet: it appears with the next call of Predict that names it.";
    } else if (this._dropped > 0) {
      note = `${this._dropped} ticks were left out: this browser, or the line to it, is too slow.`;
    }
    this._note(note);
  }

  _note(text) {
    setText($("scene-note"), text);
    $("scene-note").hidden = text === "";
  }
}

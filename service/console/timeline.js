// The last 30 s: which tick is shown, and the strip of all of them.

import { setText } from "./charts.js";
import { KEPT, RollingStore } from "./rolling_store.js";

const ROUND_TRIP = 2; // s that the picture may wait for a second model
const EPOCH = 1e9; // s: times beyond are taken for dates

/**
 * Which tick is shown: live the newest one, else one of the 30 s before the pause, which stay as they were.
 */
export class Clock {
  constructor() {
    this.live = new RollingStore();
    this._frozen = null;
    this._time = null;
  }

  get paused() {
    return this._frozen !== null;
  }

  /** Return the frames that can be shown. */
  get store() {
    return this._frozen ?? this.live;
  }

  /**
   * Return the frame to show.
   * @param {(frame: object) => boolean} complete whether all that is shown beside a frame is there.
   */
  frame(complete = () => true) {
    if (this.paused) return this._frozen.at(this._time);
    const newest = this.live.newest;
    for (let i = this.live.frames.length - 1; i >= 0; i -= 1) {
      const frame = this.live.frames[i];
      if (frame.time < newest.time - ROUND_TRIP) break;
      if (complete(frame)) return frame;
    }
    return newest;
  }

  pause(frame) {
    if (!frame) return;
    if (!this.paused) {
      this._frozen = new RollingStore();
      this._frozen.frames = [...this.live.frames];
    }
    this._time = frame.time;
  }

  /** Show the tick a number of ticks away from the one that is shown. */
  step(frame, ticks) {
    this.pause(frame);
    const next = frame && this._frozen.step(frame.time, ticks);
    if (next) this._time = next.time;
  }

  /** Show the tick nearest to a time; pauses. */
  seek(time) {
    const frame = this.store.nearest(time);
    if (frame) this.pause(frame);
  }

  play() {
    this._frozen = null;
    this._time = null;
  }
}

/** The scrubber below the picture. */
export class Timeline {
  /** @param {Clock} clock @param {() => void} onChange */
  constructor(clock, onChange) {
    this._clock = clock;
    this._range = document.getElementById("time");
    this._strip = document.getElementById("strip");
    this._label = document.getElementById("clock");
    this._play = document.getElementById("play");
    this._range.addEventListener("input", () => {
      const newest = clock.store.newest;
      if (newest) clock.seek(newest.time - KEPT + Number(this._range.value));
      onChange();
    });
    this._range.addEventListener("keydown", (event) => {
      const ticks = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageDown: -10, PageUp: 10 }[event.key];
      if (ticks === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      clock.step(clock.frame(), ticks);
      onChange();
    });
  }

  /** Show the tick that is shown, and when it was. */
  show(frame, colours) {
    const { store, paused, live } = this._clock;
    setText(this._play, paused ? "Live" : "Pause");
    this._play.setAttribute("aria-pressed", `${paused}`);
    this._range.disabled = !frame;
    if (!frame) {
      setText(this._label, "no tick yet");
      return;
    }
    const newest = store.newest;
    this._range.value = `${KEPT - (newest.time - frame.time)}`;
    const behind = live.newest ? live.newest.time - frame.time : 0;
    const when = paused ? `${behind.toFixed(1)} s before the newest` : "live";
    setText(this._label, `${timeText(frame.time)} · ${paused ? `−${behind.toFixed(1)} s` : "live"}`);
    this._range.setAttribute("aria-valuetext", `${timeText(frame.time)}, ${when}`);
    this._drawStrip(store, frame, colours);
  }

  /** Draw each tick as a bar as high as it took in queue and model. */
  _drawStrip(store, shown, colours) {
    const [width, height] = [this._strip.clientWidth, this._strip.clientHeight];
    const ratio = Math.min(devicePixelRatio || 1, 2);
    if (this._strip.width !== Math.round(width * ratio)) {
      this._strip.width = Math.round(width * ratio);
      this._strip.height = Math.round(height * ratio);
    }
    const ctx = this._strip.getContext("2d");
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, width, height);
    const begin = store.newest.time - KEPT;
    const tallest = store.frames.reduce((most, { queue, inference }) => Math.max(most, queue + inference), 0.02);
    const x = (time) => ((time - begin) / KEPT) * (width - 2);
    for (const frame of store.frames) {
      const tall = ((frame.queue + frame.inference) / tallest) * (height - 2);
      ctx.fillStyle = colours.quiet;
      ctx.fillRect(x(frame.time), height - Math.max(tall, 1), 1.5, Math.max(tall, 1));
    }
    ctx.fillStyle = colours.accent;
    ctx.fillRect(x(shown.time) - 0.5, 0, 2.5, height);
  }
}

/** Return a time of the contract for people: a date's time of day, or seconds. */
export function timeText(time) {
  if (time < EPOCH) return `${time.toFixed(2)} s`;
  const date = new Date(time * 1000);
  return `${date.toLocaleTimeString("en-GB")}.${String(date.getMilliseconds()).padStart(3, "0").slice(0, 2)}`;
}

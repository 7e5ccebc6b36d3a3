// The last seconds of a scene, kept by the browser alone.

export const KEPT = 30; // s
const BACKWARDS = 2; // s: as the track memory, a call so far back begins the scene anew

/** Frames of one model by ascending time, none older than 30 s before the newest. */
export class RollingStore {
  /** @param {number} [kept] s */
  constructor(kept = KEPT) {
    this._kept = kept;
    /** @type {import("./frames.js").Frame[]} */
    this.frames = [];
    this.restarts = 0;
  }

  get newest() {
    return this.frames.at(-1) ?? null;
  }

  get oldest() {
    return this.frames[0] ?? null;
  }

  /** Keep a frame. One that comes late is put in its place, one of the same time replaces the earlier one. */
  add(frame) {
    const newest = this.newest;
    if (newest && frame.time < newest.time - BACKWARDS) {
      this.frames = [];
      this.restarts += 1;
    }
    const at = this._after(frame.time);
    const same = at > 0 && this.frames[at - 1].time === frame.time;
    this.frames.splice(same ? at - 1 : at, same ? 1 : 0, frame);
    const limit = this.newest.time - this._kept;
    let old = 0;
    while (this.frames[old].time < limit) old += 1;
    if (old) this.frames.splice(0, old);
  }

  /** Return the frame of a time, or null. */
  at(time) {
    const frame = this.frames[this._after(time) - 1];
    return frame && frame.time === time ? frame : null;
  }

  /** Return the frame nearest to a time, or null if there is none. */
  nearest(time) {
    const after = this._after(time);
    const [before, behind] = [this.frames[after - 1], this.frames[after]];
    if (!before || !behind) return before ?? behind ?? null;
    return time - before.time <= behind.time - time ? before : behind;
  }

  /** Return the frame a number of ticks away from that of a time, at most the first or last one. */
  step(time, ticks) {
    const from = this._after(time) - 1;
    return this.frames[Math.min(Math.max(from + ticks, 0), this.frames.length - 1)] ?? null;
  }

  /** Return the number of frames up to and with a time. */
  _after(time) {
    let low = 0;
    let high = this.frames.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.frames[middle].time <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}

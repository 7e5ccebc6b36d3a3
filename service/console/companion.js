// What the console asks for a tick beyond the stream: another model's forecasts, samples.

const KEPT = 400; // ticks

/** Answers by tick, asked for one at a time: while one is under way, only the newest wish waits. */
export class Companion {
  /**
   * @param {(frame: import("./frames.js").Frame) => Promise<object>} ask
   * @param {() => void} onAnswer called after every answer and failure.
   */
  constructor(ask, onAnswer) {
    this._ask = ask;
    this._onAnswer = onAnswer;
    this._entries = new Map();
    this._waiting = null;
    this._busy = false;
    this._stopped = false;
    /** The error of the newest answer, or null. */
    this.error = null;
  }

  stop() {
    this._stopped = true;
  }

  /** Return the answer for a tick, or null while there is none. */
  at(time) {
    return this._entries.get(time) ?? null;
  }

  /** Ask for a tick, unless its answer is here. */
  want(frame) {
    if (this._stopped || this._entries.has(frame.time)) return;
    this._waiting = frame;
    if (!this._busy) this._run();
  }

  async _run() {
    this._busy = true;
    while (this._waiting && !this._stopped) {
      const frame = this._waiting;
      this._waiting = null;
      try {
        const answer = await this._ask(frame);
        this.error = null;
        this._keep(frame.time, answer);
      } catch (error) {
        this.error = error;
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
      if (!this._stopped) this._onAnswer();
    }
    this._busy = false;
  }

  _keep(time, answer) {
    this._entries.set(time, answer);
    if (this._entries.size > KEPT) this._entries.delete(this._entries.keys().next().value);
  }
}

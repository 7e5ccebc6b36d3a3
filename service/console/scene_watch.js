// The stream of a scene's forecasts, opened again whenever it ends.

import { ApiError, send } from "./api.js";
import { readEvents } from "./event_stream.js";
import { decodeFrame } from "./frames.js";

const FIRST_WAIT = 500; // ms
const LONGEST_WAIT = 5000; // ms
const SILENCE = 40_000; // ms: the server sends a heartbeat every 15 s

/**
 * @typedef {{kind: "connecting" | "open" | "gone" | "unauthorised" | "refused", text: string, retryAt?: number}} Link
 *   retryAt: when the next try is, as performance.now().
 */

/** One watch of one scene, until it is stopped. */
export class SceneWatch {
  /**
   * @param {string} sceneId
   * @param {{frame: (frame: object) => void, map: (map: object) => void, dropped: (count: number) => void,
   *   link: (link: Link) => void}} on what to call.
   */
  constructor(sceneId, on) {
    this._sceneId = sceneId;
    this._on = on;
    this._stopped = false;
    this._wait = FIRST_WAIT;
    this._abort = new AbortController();
    this._run();
  }

  stop() {
    this._stopped = true;
    this._abort.abort();
    this._wake?.();
  }

  /** Try at once, without waiting for the next try. */
  retry() {
    this._wait = FIRST_WAIT;
    this._wake?.();
  }

  async _run() {
    while (!this._stopped) {
      this._on.link({ kind: "connecting", text: "Connecting …" });
      let link;
      try {
        await this._watch();
        link = { kind: "gone", text: "The server ended the stream." };
      } catch (error) {
        if (this._stopped) return;
        link = linkOf(error);
      }
      if (this._stopped) return;
      if (link.kind === "unauthorised") {
        this._on.link(link);
        await this._sleep(2 ** 31 - 1);
      } else {
        this._on.link({ ...link, retryAt: performance.now() + this._wait });
        await this._sleep(this._wait);
        this._wait = Math.min(this._wait * 2, LONGEST_WAIT);
      }
    }
  }

  async _watch() {
    this._abort = new AbortController();
    let silent = 0;
    const onSilence = () => this._abort.abort();
    const alive = () => {
      clearTimeout(silent);
      silent = setTimeout(onSilence, SILENCE);
    };
    alive();
    try {
      const path = `v1/scenes/${encodeURIComponent(this._sceneId)}/forecasts/watch`;
      const response = await send(path, {
        headers: { Accept: "text/event-stream" },
        signal: this._abort.signal,
      });
      this._wait = FIRST_WAIT;
      this._on.link({ kind: "open", text: "Live" });
      await readEvents(response, (type, data) => this._event(type, data), alive);
    } finally {
      clearTimeout(silent);
      this._abort.abort();
    }
  }

  _event(type, data) {
    if (this._stopped) return;
    const event = JSON.parse(data);
    if (type === "error") throw new ApiError(event.status ?? 0, event.detail ?? "The stream failed.", event.reason);
    if (event.map) this._on.map(event.map);
    else if (event.frame) this._on.frame(decodeFrame(event.frame));
    else if (event.dropped) this._on.dropped(Number(event.dropped));
  }

  _sleep(milliseconds) {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, milliseconds);
      this._wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }
}

function linkOf(error) {
  if (!(error instanceof ApiError)) return { kind: "gone", text: "The connection broke." };
  if (error.status === 401) return { kind: "unauthorised", text: "The server asks for an API key." };
  if (error.status === 403) return { kind: "refused", text: `This key may not read scenes: ${error.message}` };
  return { kind: error.gone ? "gone" : "refused", text: error.message };
}

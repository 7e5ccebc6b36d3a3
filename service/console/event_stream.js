// Server-Sent Events through fetch: EventSource cannot send a key.

/** Parser of a text/event-stream, fed piece by piece. Comments and unknown fields are skipped. */
export class EventParser {
  /** @param {(type: string, data: string) => void} onEvent */
  constructor(onEvent) {
    this._onEvent = onEvent;
    this._pieces = [];
    this._type = "";
    this._data = [];
  }

  /** @param {string} text the next piece; it may begin and end anywhere. */
  push(text) {
    let from = 0;
    for (let end = text.indexOf("\n"); end !== -1; end = text.indexOf("\n", from)) {
      this._pieces.push(text.slice(from, end));
      this._line(this._pieces.length === 1 ? this._pieces[0] : this._pieces.join(""));
      this._pieces.length = 0;
      from = end + 1;
    }
    if (from < text.length) this._pieces.push(text.slice(from));
  }

  _line(raw) {
    const line = raw.endsWith("\r") ? raw.slice(0, -1) : raw;
    if (line === "") {
      if (this._data.length) this._onEvent(this._type || "message", this._data.join("\n"));
      this._type = "";
      this._data = [];
    } else if (line.startsWith("data:")) {
      this._data.push(line.slice(line[5] === " " ? 6 : 5));
    } else if (line.startsWith("event:")) {
      this._type = line.slice(6).trim();
    }
  }
}

/**
 * Read a stream of events to its end.
 * @param {Response} response
 * @param {(type: string, data: string) => void} onEvent
 * @param {() => void} [onBytes] called with every piece, comments included: a sign of life.
 */
export async function readEvents(response, onEvent, onBytes = () => {}) {
  const parser = new EventParser(onEvent);
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  for (;;) {
    const { done, value } = await reader.read();
    if (done) return;
    onBytes();
    parser.push(value);
  }
}

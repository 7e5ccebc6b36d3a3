// One picture of a scene: a canvas for the map, which is drawn when the view moves, and one for the agents above it.

import { present } from "./frames.js";
import { fromBase64, layerColours, recolour } from "./palette.js";
import { paintFrame } from "./scene_painter.js";
import { barLength } from "./view.js";

const REACH = 16; // pixels around an agent that count as a click on it

/** Return the image of a map as it is shown: x to the right and y up, where its rows run along x, its columns along y. */
async function upright(map, colours) {
  const image = await createImageBitmap(recolour(fromBase64(map.image), layerColours(colours)));
  const canvas = new OffscreenCanvas(image.height, image.width);
  const ctx = canvas.getContext("2d");
  ctx.setTransform(0, -1, 1, 0, 0, image.width);
  ctx.drawImage(image, 0, 0);
  image.close();
  return canvas.transferToImageBitmap();
}

/** A pane with its two canvases. It draws what it is told, when it is told. */
export class SceneCanvas {
  /**
   * @param {HTMLElement} pane
   * @param {import("./view.js").View} view
   */
  constructor(pane, view) {
    this.pane = pane;
    this.view = view;
    this.size = { width: 0, height: 0 };
    this._mapCanvas = pane.querySelector(".map-layer");
    this._agentCanvas = pane.querySelector(".agent-layer");
    this._map = null;
    this._bitmap = null;
    this._drawnMap = "";
    this._mapVersion = 0;
    this.measure();
  }

  /** Adopt the size of the pane. */
  measure() {
    const ratio = Math.min(devicePixelRatio || 1, 2);
    this.size = { width: this.pane.clientWidth, height: this.pane.clientHeight };
    for (const canvas of [this._mapCanvas, this._agentCanvas]) {
      canvas.width = Math.round(this.size.width * ratio);
      canvas.height = Math.round(this.size.height * ratio);
    }
    this._ratio = ratio;
    this._drawnMap = "";
  }

  /**
   * Adopt a map, or none.
   * @param {object | null} map a SceneMap.
   * @param {object} colours of the theme.
   */
  async setMap(map, colours) {
    this._map = map;
    const version = ++this._mapVersion;
    const bitmap = map ? await upright(map, colours) : null;
    if (version !== this._mapVersion) return;
    this._bitmap?.close();
    this._bitmap = bitmap;
    this._drawnMap = "";
  }

  /** Draw a frame, or the map alone. */
  draw(frame, options, colours) {
    this._drawMap(colours);
    const ctx = this._agentCanvas.getContext("2d");
    ctx.setTransform(this._ratio, 0, 0, this._ratio, 0, 0);
    ctx.clearRect(0, 0, this.size.width, this.size.height);
    if (frame) paintFrame(ctx, this.view, this.size, frame, options, colours);
  }

  /** Return the id of the agent at a point of the pane, or "". */
  agentAt(frame, left, top) {
    let nearest = "";
    let least = REACH;
    for (const agent of frame?.agents ?? []) {
      const now = present(agent);
      if (!now || now.x === undefined) continue;
      const [x, y] = this.view.toCanvas(now.x, now.y, this.size);
      const away = Math.hypot(x - left, y - top);
      if (away < least) [least, nearest] = [away, agent.id];
    }
    return nearest;
  }

  _drawMap(colours) {
    const { view, size } = this;
    const key = `${view.version} ${this._mapVersion} ${this._bitmap !== null} ${colours.ground}`;
    if (key === this._drawnMap) return;
    this._drawnMap = key;
    const ctx = this._mapCanvas.getContext("2d");
    ctx.setTransform(this._ratio, 0, 0, this._ratio, 0, 0);
    ctx.fillStyle = colours.ground;
    ctx.fillRect(0, 0, size.width, size.height);
    if (this._bitmap) {
      const { origin_x, origin_y, pixels_per_meter } = this._map;
      const pixel = view.scale / pixels_per_meter;
      const { width, height } = this._bitmap;
      // A pixel shows the ground around its point
      const highest = origin_y + (height - 0.5) / pixels_per_meter;
      const [left, top] = view.toCanvas(origin_x - 0.5 / pixels_per_meter, highest, size);
      ctx.imageSmoothingEnabled = pixel < 4;
      ctx.drawImage(this._bitmap, left, top, width * pixel, height * pixel);
    }
    this._drawBar(ctx, colours);
  }

  _drawBar(ctx, colours) {
    const length = barLength(this.view.scale);
    const [x, y, width] = [16, this.size.height - 16, length * this.view.scale];
    ctx.strokeStyle = ctx.fillStyle = colours.ink;
    ctx.lineWidth = 1.5;
    ctx.beginPath();
    ctx.moveTo(x, y - 5);
    ctx.lineTo(x, y);
    ctx.lineTo(x + width, y);
    ctx.lineTo(x + width, y - 5);
    ctx.stroke();
    ctx.font = "12px system-ui, sans-serif";
    ctx.fillText(`${length} m`, x + 6, y - 6);
  }
}

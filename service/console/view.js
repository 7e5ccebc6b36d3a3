// Which part of the ground a canvas shows.

const MIN_SCALE = 0.5; // pixels per metre
const MAX_SCALE = 80;

/** A view of the ground: x to the right, y up, as the contract's frame. One view may serve several canvases. */
export class View {
  constructor() {
    this.x = 0; // m, in the middle of the canvas
    this.y = 0;
    this.scale = 5; // CSS pixels per metre
    this.version = 0;
  }

  /** Return the point of the canvas, in CSS pixels, that shows a ground point. */
  toCanvas(x, y, size) {
    return [size.width / 2 + (x - this.x) * this.scale, size.height / 2 - (y - this.y) * this.scale];
  }

  /** Return the ground point that a point of the canvas shows. */
  toGround(left, top, size) {
    return [this.x + (left - size.width / 2) / this.scale, this.y - (top - size.height / 2) / this.scale];
  }

  /** Move what is shown by CSS pixels. */
  pan(right, down) {
    this.x -= right / this.scale;
    this.y += down / this.scale;
    this.version += 1;
  }

  centre(x, y) {
    if (x === this.x && y === this.y) return;
    this.x = x;
    this.y = y;
    this.version += 1;
  }

  /** Zoom by a factor; the ground point under a point of the canvas stays where it is. */
  zoom(factor, left, top, size) {
    const [x, y] = this.toGround(left, top, size);
    const scale = Math.min(Math.max(this.scale * factor, MIN_SCALE), MAX_SCALE);
    const kept = this.scale / scale;
    this.x = x + (this.x - x) * kept;
    this.y = y + (this.y - y) * kept;
    this.scale = scale;
    this.version += 1;
  }

  /** Show all of some points, [[x, y], …], with a margin. */
  fit(points, size) {
    if (points.length === 0) return;
    const xs = points.map((point) => point[0]);
    const ys = points.map((point) => point[1]);
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const margin = 56; // pixels
    const across = (size.width - 2 * margin) / Math.max(right - left, 40);
    const up = (size.height - 2 * margin) / Math.max(high - low, 40);
    this.scale = Math.min(Math.max(Math.min(across, up), MIN_SCALE), 20);
    this.x = (left + right) / 2;
    this.y = (low + high) / 2;
    this.version += 1;
  }
}

/** Return a round length in m that takes 60 to 160 pixels at a scale. */
export function barLength(scale) {
  for (const length of [1, 2, 5, 10, 20, 50, 100, 200]) if (length * scale >= 60) return length;
  return 200;
}

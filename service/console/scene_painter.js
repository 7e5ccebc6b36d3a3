// How a frame looks: agents by type and status, modes by probability, ellipses, samples.
//
// Nothing is told by colour alone: types have shapes, statuses have outlines, probabilities have widths.

import { percent } from "./charts.js";
import { ellipse, heading, present } from "./frames.js";

const FULL = 2 * Math.PI;
const SIZES = { vehicle: [4.6, 1.9], cyclist: [1.9, 0.8], pedestrian: [0.8, 0.8], unknown: [1.4, 1.4] }; // m
const SMALLEST = { vehicle: [13, 6], cyclist: [12, 6], pedestrian: [7, 7], unknown: [8, 8] }; // pixels
const LABEL = { width: 62, height: 13 }; // pixels of a mode's rank
const ELLIPSE_EVERY = 2; // s, of agents that are not selected

/** Colours of the canvas, from the style sheet. */
export function readColours(element) {
  const style = getComputedStyle(element);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  return {
    ink: colour("ink"),
    quiet: colour("ink-quiet"),
    ground: colour("ground"),
    accent: colour("accent"),
    warning: colour("warning"),
    halo: colour("ground"),
    vehicle: colour("vehicle"),
    pedestrian: colour("pedestrian"),
    cyclist: colour("cyclist"),
    unknown: colour("unknown"),
    driveable: rgb(colour("driveable")),
    road: rgb(colour("road-divider")),
    lane: rgb(colour("lane-divider")),
  };
}

function rgb(hex) {
  return [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
}

/**
 * Draw the agents of a frame.
 * @param {CanvasRenderingContext2D} ctx in CSS pixels.
 * @param {import("./view.js").View} view
 * @param {{width: number, height: number}} size in CSS pixels.
 * @param {import("./frames.js").Frame} frame
 * @param {{selected: string, hovered: string, modes: "all" | "likeliest", ellipses: "selected" | "all" | "none",
 *   histories: boolean, labels: boolean, samples: number[][]}} options
 * @param {ReturnType<typeof readColours>} colours
 */
export function paintFrame(ctx, view, size, frame, options, colours) {
  const painter = new Painter(ctx, view, size, frame, options, colours);
  const visible = frame.agents.filter((agent) => painter.sees(agent));
  const selected = visible.find((agent) => agent.id === options.selected);
  ctx.lineJoin = "round";
  ctx.lineCap = "round";
  for (const agent of visible) {
    if (agent === selected) continue;
    if (options.ellipses === "all") painter.ellipses(agent, false);
    if (options.histories) painter.history(agent);
    painter.modes(agent, false);
  }
  if (selected) {
    if (options.samples.length) painter.samples(options.samples, selected);
    if (options.ellipses !== "none") painter.ellipses(selected, true);
    painter.history(selected);
    painter.modes(selected, true);
  }
  for (const agent of visible) painter.body(agent);
  for (const agent of visible) painter.label(agent);
}

class Painter {
  constructor(ctx, view, size, frame, options, colours) {
    this.ctx = ctx;
    this.frame = frame;
    this.options = options;
    this.colours = colours;
    this.scale = view.scale;
    this.size = size;
    this.left = size.width / 2 - view.x * view.scale;
    this.top = size.height / 2 + view.y * view.scale;
    this.ranks = []; // places of the ranks that are written
  }

  px(x) {
    return this.left + x * this.scale;
  }

  py(y) {
    return this.top - y * this.scale;
  }

  colour(agent) {
    return agent.status === "context" ? this.colours.quiet : (this.colours[agent.type] ?? this.colours.unknown);
  }

  /** Tell whether the agent or the end of one of its modes is on the canvas. */
  sees(agent) {
    const now = present(agent);
    if (!now || now.x === undefined) return false;
    if (this.inside(now.x, now.y)) return true;
    return agent.modes.some(({ mean }) => this.inside(mean[mean.length - 2], mean[mean.length - 1]));
  }

  inside(x, y) {
    const [px, py] = [this.px(x), this.py(y)];
    return px > -60 && py > -60 && px < this.size.width + 60 && py < this.size.height + 60;
  }

  history(agent) {
    const { ctx } = this;
    if (agent.states.length < 2) return;
    ctx.strokeStyle = ctx.fillStyle = this.colour(agent);
    ctx.globalAlpha = 0.6;
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (const state of agent.states) ctx.lineTo(this.px(state.x), this.py(state.y));
    ctx.stroke();
    ctx.beginPath();
    for (const state of agent.states.slice(0, -1)) {
      const [x, y] = [this.px(state.x), this.py(state.y)];
      ctx.rect(x - 1.25, y - 1.25, 2.5, 2.5);
    }
    ctx.fill();
    ctx.globalAlpha = 1;
  }

  modes(agent, selected) {
    const { ctx } = this;
    const now = present(agent);
    const shown = this.options.modes === "all" || selected ? agent.modes : agent.modes.slice(0, 1);
    ctx.strokeStyle = this.colour(agent);
    for (let rank = shown.length - 1; rank >= 0; rank -= 1) {
      const { weight, mean } = shown[rank];
      ctx.globalAlpha = 0.35 + 0.65 * Math.sqrt(weight);
      ctx.lineWidth = (selected ? 1.2 : 0.7) + 3.2 * weight;
      if (selected && rank > 0) ctx.setLineDash([6, 3 + ctx.lineWidth]);
      ctx.beginPath();
      ctx.moveTo(this.px(now.x), this.py(now.y));
      for (let i = 0; i < mean.length; i += 2) ctx.lineTo(this.px(mean[i]), this.py(mean[i + 1]));
      ctx.stroke();
      ctx.setLineDash([]);
      const [x, y] = [this.px(mean[mean.length - 2]), this.py(mean[mean.length - 1])];
      ctx.fillStyle = this.colour(agent);
      ctx.beginPath();
      ctx.arc(x, y, 1 + 2.5 * Math.sqrt(weight), 0, FULL);
      ctx.fill();
    }
    ctx.globalAlpha = 1;
    if (selected) shown.forEach((mode, rank) => this.rank(mode, rank));
  }

  /** Write the rank of a mode at its end, as the panel numbers it. */
  rank({ mean, weight }, rank) {
    const x = this.px(mean[mean.length - 2]) + 7;
    let y = this.py(mean[mean.length - 1]) - 7;
    const covered = ([left, top]) => Math.abs(left - x) < LABEL.width && Math.abs(top - y) < LABEL.height;
    while (this.ranks.some(covered)) y -= LABEL.height;
    this.ranks.push([x, y]);
    this.text(`${rank + 1} · ${percent(weight)}`, x, y, this.colours.ink);
  }

  ellipses(agent, selected) {
    const { ctx } = this;
    const every = selected ? 1 : Math.max(1, Math.round(ELLIPSE_EVERY / this.frame.step));
    const shown = selected ? agent.modes : agent.modes.slice(0, 1);
    ctx.fillStyle = ctx.strokeStyle = this.colour(agent);
    ctx.lineWidth = 1;
    for (const { weight, mean, covariance } of shown) {
      const strength = selected ? 0.3 + 0.7 * weight : 0.6;
      for (let t = every - 1; t * 2 < mean.length; t += every) {
        const axes = ellipse(covariance[t * 3], covariance[t * 3 + 1], covariance[t * 3 + 2]);
        for (const sigma of [2, 1]) {
          ctx.beginPath();
          ctx.ellipse(
            this.px(mean[t * 2]),
            this.py(mean[t * 2 + 1]),
            axes.major * sigma * this.scale,
            axes.minor * sigma * this.scale,
            -axes.angle,
            0,
            FULL,
          );
          ctx.globalAlpha = strength * (sigma === 1 ? 0.12 : 0.06);
          ctx.fill();
          ctx.globalAlpha = strength * (sigma === 1 ? 0.7 : 0.35);
          ctx.stroke();
        }
      }
    }
    ctx.globalAlpha = 1;
  }

  samples(samples, agent) {
    const { ctx } = this;
    const now = present(agent);
    ctx.strokeStyle = this.colours.accent;
    ctx.globalAlpha = 0.3;
    ctx.lineWidth = 1;
    ctx.beginPath();
    for (const sample of samples) {
      ctx.moveTo(this.px(now.x), this.py(now.y));
      for (let i = 0; i < sample.length; i += 2) ctx.lineTo(this.px(sample[i]), this.py(sample[i + 1]));
    }
    ctx.stroke();
    ctx.globalAlpha = 1;
  }

  body(agent) {
    const { ctx } = this;
    const now = present(agent);
    const angle = heading(now);
    const [x, y] = [this.px(now.x), this.py(now.y)];
    const kind = SIZES[agent.type] ? agent.type : "unknown";
    const [length, width] = SIZES[kind].map((each, i) => Math.max(each * this.scale, SMALLEST[kind][i]));
    ctx.save();
    ctx.translate(x, y);
    if (angle !== null) ctx.rotate(-angle);
    ctx.beginPath();
    outline(ctx, kind, length / 2, width / 2);
    this.fill(agent);
    if (angle !== null) arrow(ctx, length / 2, this.colour(agent));
    ctx.restore();
    if (agent.id === this.options.selected || agent.id === this.options.hovered) {
      ctx.strokeStyle = this.colours.ink;
      ctx.lineWidth = agent.id === this.options.selected ? 2 : 1;
      ctx.beginPath();
      ctx.arc(x, y, Math.hypot(length, width) / 2 + 6, 0, FULL);
      ctx.stroke();
    }
    if (agent.warnings.length) this.mark(x + length / 2 + 3, y - width / 2 - 5);
  }

  /** Fill and stroke a body by its status. */
  fill(agent) {
    const { ctx } = this;
    const colour = this.colour(agent);
    const hollow = agent.status !== "ok" && agent.status !== "short_history";
    ctx.fillStyle = hollow ? this.colours.ground : colour;
    ctx.fill();
    ctx.strokeStyle = hollow ? colour : this.colours.halo;
    ctx.lineWidth = hollow ? 1.75 : 1;
    if (agent.status === "short_history") {
      ctx.strokeStyle = this.colours.ink;
      ctx.lineWidth = 1.5;
      ctx.setLineDash([2, 2.5]);
    }
    if (agent.status === "fallback") ctx.setLineDash([4, 2.5]);
    ctx.stroke();
    ctx.setLineDash([]);
    if (agent.status === "invalid") {
      ctx.strokeStyle = this.colours.warning;
      ctx.lineWidth = 2.5;
      ctx.beginPath();
      ctx.moveTo(-7, -7);
      ctx.lineTo(7, 7);
      ctx.moveTo(7, -7);
      ctx.lineTo(-7, 7);
      ctx.stroke();
    }
  }

  /** Draw the triangle of a warning. */
  mark(x, y) {
    const { ctx } = this;
    ctx.beginPath();
    ctx.moveTo(x, y - 6);
    ctx.lineTo(x + 6, y + 5);
    ctx.lineTo(x - 6, y + 5);
    ctx.closePath();
    ctx.fillStyle = this.colours.warning;
    ctx.fill();
    ctx.fillStyle = this.colours.ground;
    ctx.fillRect(x - 0.75, y - 2, 1.5, 3.5);
    ctx.fillRect(x - 0.75, y + 2.5, 1.5, 1.5);
  }

  label(agent) {
    const chosen = agent.id === this.options.selected || agent.id === this.options.hovered;
    if (!chosen && !this.options.labels) return;
    const now = present(agent);
    this.text(agent.id, this.px(now.x) + 9, this.py(now.y) + 16, chosen ? this.colours.ink : this.colours.quiet);
  }

  text(text, x, y, colour) {
    const { ctx } = this;
    ctx.font = "12px system-ui, sans-serif";
    ctx.lineWidth = 3;
    ctx.strokeStyle = this.colours.halo;
    ctx.strokeText(text, x, y);
    ctx.fillStyle = colour;
    ctx.fillText(text, x, y);
  }
}

function outline(ctx, kind, along, across) {
  if (kind === "vehicle") {
    ctx.roundRect(-along, -across, 2 * along, 2 * across, Math.min(across * 0.5, 4));
  } else if (kind === "pedestrian") {
    ctx.arc(0, 0, along, 0, FULL);
  } else {
    ctx.moveTo(along, 0);
    ctx.lineTo(0, across);
    ctx.lineTo(-along, 0);
    ctx.lineTo(0, -across);
    ctx.closePath();
  }
}

function arrow(ctx, along, colour) {
  ctx.strokeStyle = colour;
  ctx.lineWidth = 1.75;
  ctx.beginPath();
  ctx.moveTo(along, 0);
  ctx.lineTo(along + 7, 0);
  ctx.moveTo(along + 3.5, -3);
  ctx.lineTo(along + 7, 0);
  ctx.lineTo(along + 3.5, 3);
  ctx.stroke();
}

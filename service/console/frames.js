// Frames of WatchForecasts, and answers of Predict, as the console draws them.

/**
 * @typedef {{weight: number, mean: number[], covariance: number[]}} Mode
 *   mean: [T · 2] x, y in m; covariance: [T · 3] xx, xy, yy in m².
 * @typedef {{time: number, x: number, y: number, heading?: number, velocity_x?: number, velocity_y?: number}} State
 * @typedef {{id: string, type: string, status: string, predicted: boolean, detail: string, model: object | null,
 *   warnings: {code: string, detail: string, field: string}[], states: State[], modes: Mode[],
 *   consistency: object | null}} Agent
 * @typedef {{time: number, model: object, shadow: boolean, mapDigest: string, inference: number, queue: number,
 *   step: number, agents: Agent[], byId: Map<string, Agent>}} Frame
 */

const MOVING = 0.5; // m/s

/** Return an enum's value as the console names it: AGENT_TYPE_VEHICLE → vehicle. */
export function plain(value, prefix) {
  return typeof value === "string" ? value.replace(prefix, "").toLowerCase() : "unspecified";
}

/** Return "name version" of a model reference. */
export function modelName(reference) {
  return reference?.name ? `${reference.name} ${reference.version}` : "unknown model";
}

/** Return the modes of packed weights, means and covariances, most likely first. */
export function unpackModes(weights, means, covariances) {
  const count = weights.length;
  if (count === 0) return [];
  const steps = means.length / count / 2;
  const modes = weights.map((weight, k) => ({
    weight,
    mean: means.slice(k * steps * 2, (k + 1) * steps * 2),
    covariance: covariances.slice(k * steps * 3, (k + 1) * steps * 3),
  }));
  return modes.sort((a, b) => b.weight - a.weight);
}

function decodeWarning(warning) {
  return { ...warning, code: plain(warning.code, "INPUT_WARNING_CODE_") };
}

function decodeAgent(agent) {
  return {
    id: agent.id,
    type: plain(agent.type, "AGENT_TYPE_"),
    status: agent.predicted ? plain(agent.status, "FORECAST_STATUS_") : "context",
    predicted: agent.predicted,
    detail: agent.detail,
    model: null,
    warnings: agent.warnings.map(decodeWarning),
    states: agent.states,
    modes: unpackModes(agent.weights, agent.means, agent.covariances),
    consistency: agent.consistency ?? null,
  };
}

/** Return a frame of the stream, decoded. */
export function decodeFrame(frame) {
  const agents = frame.agents.map(decodeAgent);
  return {
    time: frame.time,
    model: frame.model ?? {},
    shadow: frame.shadow,
    mapDigest: frame.map_digest,
    inference: frame.inference_seconds,
    queue: frame.queue_seconds,
    step: frame.step || 0.5,
    agents,
    byId: new Map(agents.map((agent) => [agent.id, agent])),
  };
}

/**
 * Return a request for the agents of a frame: what the server says of them, sent back. It names no scene, so that
 * nothing of it is remembered.
 * @param {Frame} frame
 * @param {{model?: string, only?: string, samples?: number}} wish only: the id of the one agent to forecast.
 */
export function predictRequest(frame, { model = "", only = "", samples = 0 }) {
  const agents = frame.agents
    .filter((agent) => agent.states.length && agent.status !== "invalid")
    .map((agent) => ({
      id: agent.id,
      type: `AGENT_TYPE_${agent.type.toUpperCase()}`,
      states: agent.states,
      predict: only ? agent.id === only : agent.predicted,
    }));
  const request = { time: frame.time, model, agents, options: { merge: true, max_modes: 5 } };
  if (samples) request.options.samples = samples;
  if (frame.mapDigest) request.scene_raster = { digest: frame.mapDigest };
  return request;
}

/** Return a frame with the forecasts of a Predict answer in place of the frame's own. */
export function frameFromAnswer(frame, answer) {
  const forecasts = new Map(answer.forecasts.map((forecast) => [forecast.agent_id, forecast]));
  const agents = frame.agents.map((agent) => {
    const forecast = forecasts.get(agent.id);
    if (!forecast) return { ...agent, modes: [], consistency: null };
    return {
      ...agent,
      status: plain(forecast.status, "FORECAST_STATUS_"),
      detail: forecast.detail,
      model: forecast.model ?? null,
      warnings: forecast.warnings.map(decodeWarning),
      modes: unpackModes(forecast.weights, forecast.means, forecast.covariances),
      consistency: null,
    };
  });
  return {
    ...frame,
    model: answer.model ?? {},
    inference: answer.timing?.inference ?? 0,
    queue: answer.timing?.queue ?? 0,
    agents,
    byId: new Map(agents.map((agent) => [agent.id, agent])),
  };
}

/** Return the samples of a forecast: one flat array x, y, x, y … per sample. */
export function unpackSamples(forecast, steps) {
  const samples = [];
  for (let from = 0; from + steps * 2 <= forecast.samples.length; from += steps * 2)
    samples.push(forecast.samples.slice(from, from + steps * 2));
  return samples;
}

/** Return the newest state of an agent, or null. */
export function present(agent) {
  return agent.states.length ? agent.states[agent.states.length - 1] : null;
}

/** Return the speed of a state in m/s, or null where it is not known. */
export function speed(state) {
  if (state?.velocity_x === undefined || state?.velocity_y === undefined) return null;
  return Math.hypot(state.velocity_x, state.velocity_y);
}

/** Return the heading of a state in rad: the given one, else the direction of motion, else null. */
export function heading(state) {
  if (state?.heading !== undefined) return state.heading;
  return (speed(state) ?? 0) > MOVING ? Math.atan2(state.velocity_y, state.velocity_x) : null;
}

/** Return the last point of a mode, [x, y]. */
export function endPoint(mode) {
  return mode.mean.slice(-2);
}

/**
 * Return the axes of a covariance's 1 σ ellipse.
 * @returns {{major: number, minor: number, angle: number}} half axes in m; angle of the major one in rad.
 */
export function ellipse(xx, xy, yy) {
  const middle = (xx + yy) / 2;
  const apart = Math.hypot((xx - yy) / 2, xy);
  return {
    major: Math.sqrt(Math.max(middle + apart, 0)),
    minor: Math.sqrt(Math.max(middle - apart, 0)),
    angle: 0.5 * Math.atan2(2 * xy, xx - yy),
  };
}

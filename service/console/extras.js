// What is shown beside the stream's forecasts: a second model's, and samples, of the very same tick.

import { postJson } from "./api.js";
import { Companion } from "./companion.js";
import { frameFromAnswer, modelName, predictRequest, unpackSamples } from "./frames.js";
import { RollingStore } from "./rolling_store.js";

export const SHADOW = "shadow";
const SAMPLES = 100;

/** The second model and the samples, as far as they are wished for. */
export class Extras {
  /** @param {() => void} onAnswer */
  constructor(onAnswer) {
    this._onAnswer = onAnswer;
    this._companion = null;
    /** Frames of the server's shadow model. */
    this.shadows = new RollingStore();
    /** "", SHADOW, or the name@version of a model. */
    this.model = "";
    /** Id of the agent whose samples are drawn, or "". */
    this.sampled = "";
  }

  /** Change what is wished for. */
  wish({ model = this.model, sampled = this.sampled }) {
    if (model === this.model && sampled === this.sampled) return;
    this.model = model;
    this.sampled = sampled;
    this._companion?.stop();
    const asked = model === SHADOW ? "" : model;
    this._companion = asked || sampled ? new Companion((frame) => ask(frame, asked, sampled), this._onAnswer) : null;
  }

  /** Ask for what is wished beside a frame. */
  want(frame) {
    this._companion?.want(frame);
  }

  /** Return the second model's frame of a tick, or null. */
  second(time) {
    if (this.model === SHADOW) return this.shadows.at(time);
    return this._companion?.at(time)?.second ?? null;
  }

  /** Return the samples of a tick, one flat array x, y, x, y … each. */
  samples(time) {
    return this._companion?.at(time)?.samples ?? [];
  }

  /** Tell whether all that is wished beside a tick is there, or will not come. */
  complete(time) {
    if (this.model === SHADOW && this.shadows.frames.length && !this.shadows.at(time)) return false;
    return !this._companion || this.error !== null || this._companion.at(time) !== null;
  }

  get error() {
    return this._companion?.error ?? null;
  }

  /** Return what to say in the second picture while it has no frame. */
  get waiting() {
    if (this.model !== SHADOW) return this.error ? this.error.message : `Waiting for ${this.model.replace("@", " ")} …`;
    const newest = this.shadows.newest;
    if (!newest) return "No forecast of a shadow model came: the server has none (FORECAST_SHADOW), or its models are busy.";
    return `${modelName(newest.model)} made no forecast of this tick: the shadow is left out when models are busy.`;
  }
}

async function ask(frame, model, sampled) {
  const [second, samples] = await Promise.all([model ? askModel(frame, model) : null, sampled ? askSamples(frame, sampled) : []]);
  return { second, samples };
}

async function askModel(frame, model) {
  return frameFromAnswer(frame, await postJson("v1/predict", predictRequest(frame, { model })));
}

async function askSamples(frame, id) {
  if (!frame.byId.get(id)?.modes.length) return [];
  const wish = { model: `${frame.model.name}@${frame.model.version}`, only: id, samples: SAMPLES };
  const answer = await postJson("v1/predict", predictRequest(frame, wish));
  const forecast = answer.forecasts.find((each) => each.agent_id === id);
  return forecast ? unpackSamples(forecast, answer.steps) : [];
}

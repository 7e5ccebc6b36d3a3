// Calls of the server: the contract as JSON, metrics as text.

const KEY = "cab-forecast.key";
const ROOT = new URL("../", import.meta.url);

/** A call that failed, with the server's own words where it gave some. */
export class ApiError extends Error {
  /**
   * @param {number} status HTTP status; 0: the server did not answer.
   * @param {string} detail what went wrong, for people.
   * @param {string} [reason] the machine's word for it, as UNKNOWN_RASTER.
   */
  constructor(status, detail, reason = "") {
    super(detail);
    this.status = status;
    this.reason = reason;
  }

  get gone() {
    return this.status === 0 || this.status === 502 || this.status === 503;
  }
}

/** The API key, kept as long as the tab is open. */
export const key = {
  get: () => sessionStorage.getItem(KEY) ?? "",
  set: (/** @type {string} */ value) => sessionStorage.setItem(KEY, value),
  forget: () => sessionStorage.removeItem(KEY),
};

/** Return the full address of a path below the server's root. */
export function address(path) {
  return new URL(path, ROOT).href;
}

/**
 * Send a request; return the response once its headers are there.
 * @param {string} path below the server's root, as "v1/scenes".
 * @param {RequestInit} [options]
 * @throws {ApiError} for anything but success.
 */
export async function send(path, options = {}) {
  const headers = new Headers(options.headers);
  if (key.get()) headers.set("Authorization", `Bearer ${key.get()}`);
  let response;
  try {
    response = await fetch(address(path), { ...options, headers, cache: "no-store", credentials: "same-origin" });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    throw new ApiError(0, "The server does not answer.");
  }
  if (response.ok) return response;
  throw await toError(response);
}

/** Return the JSON that a path answers. */
export async function getJson(path, options = {}) {
  const response = await send(path, { ...options, headers: { Accept: "application/json" } });
  return response.json();
}

/** Send a message as JSON; return the answer. */
export async function postJson(path, message, options = {}) {
  const headers = { "Content-Type": "application/json", Accept: "application/json" };
  const response = await send(path, { ...options, method: "POST", headers, body: JSON.stringify(message) });
  return response.json();
}

/** Return the text that a path answers. */
export async function getText(path, options = {}) {
  const response = await send(path, { ...options, headers: { Accept: "text/plain" } });
  return response.text();
}

async function toError(response) {
  let detail = `The server answered ${response.status} ${response.statusText}`.trim() + ".";
  let reason = "";
  try {
    const problem = await response.json();
    const fields = (problem.errors ?? []).map((fault) => `${fault.field}: ${fault.detail}`);
    detail = fields.length ? fields.slice(0, 3).join("; ") : problem.detail || problem.title || detail;
    reason = problem.reason ?? "";
  } catch {
    // The body is no problem document: the status has to do.
  }
  return new ApiError(response.status, detail, reason);
}

// Prometheus' text format, and what two scrapes of it tell.

const SAMPLE = /^([a-zA-Z_:][\w:]*)(?:\{(.*)\})?\s+(\S+)/;
const LABEL = /(\w+)="((?:[^"\\]|\\.)*)"/g;

/**
 * Return the samples of a scrape by name.
 * @param {string} text
 * @returns {Map<string, {labels: Record<string, string>, value: number}[]>}
 */
export function parseMetrics(text) {
  const metrics = new Map();
  for (const line of text.split("\n")) {
    if (line === "" || line[0] === "#") continue;
    const match = SAMPLE.exec(line);
    if (!match) continue;
    const labels = {};
    for (const [, name, value] of (match[2] ?? "").matchAll(LABEL)) labels[name] = value.replace(/\\(.)/g, unescape);
    const value = match[3] === "+Inf" ? Infinity : Number(match[3]);
    if (!metrics.has(match[1])) metrics.set(match[1], []);
    metrics.get(match[1]).push({ labels, value });
  }
  return metrics;
}

function unescape(_, letter) {
  return letter === "n" ? "\n" : letter;
}

function matches(labels, wanted) {
  return Object.entries(wanted).every(([name, value]) => labels[name] === value);
}

/** Return the sum of a metric's samples with these labels. */
export function total(metrics, name, wanted = {}) {
  let sum = 0;
  for (const { labels, value } of metrics.get(name) ?? []) if (matches(labels, wanted)) sum += value;
  return sum;
}

/** Return how much a counter grew. One that fell was started anew: all of it is new. */
export function growth(before, after) {
  return after >= before ? after - before : after;
}

/**
 * Return how much a counter grew between two scrapes, by the value of one label.
 * @returns {Map<string, number>}
 */
export function growthBy(label, before, after, name, wanted = {}) {
  const values = new Set((after.get(name) ?? []).map(({ labels }) => labels[label]));
  const grown = new Map();
  for (const value of values) {
    const labels = { ...wanted, [label]: value };
    grown.set(value, growth(total(before, name, labels), total(after, name, labels)));
  }
  return grown;
}

/**
 * Return the growth of a histogram's buckets between two scrapes.
 * @returns {{bound: number, count: number}[]} cumulative counts by ascending upper bound; the last bound is Infinity.
 */
export function bucketGrowth(before, after, name, wanted = {}) {
  const grown = growthBy("le", before, after, `${name}_bucket`, wanted);
  return [...grown]
    .map(([bound, count]) => ({ bound: bound === "+Inf" ? Infinity : Number(bound), count }))
    .sort((a, b) => a.bound - b.bound);
}

/**
 * Return a quantile of a histogram as Prometheus' histogram_quantile: linear within a bucket, the last finite bound
 * where the quantile lies beyond it, null without any observation.
 * @param {number} quantile 0 to 1
 * @param {{bound: number, count: number}[]} buckets of bucketGrowth.
 */
export function histogramQuantile(quantile, buckets) {
  const all = buckets.at(-1)?.count ?? 0;
  if (!(all > 0)) return null;
  const rank = quantile * all;
  const at = buckets.findIndex(({ count }) => count >= rank);
  if (buckets[at].bound === Infinity) return buckets.at(-2)?.bound ?? null;
  const [low, below] = at > 0 ? [buckets[at - 1].bound, buckets[at - 1].count] : [0, 0];
  const within = buckets[at].count - below;
  return within > 0 ? low + ((buckets[at].bound - low) * (rank - below)) / within : buckets[at].bound;
}

/** Return the mean of what a histogram observed between two scrapes, or null without any observation. */
export function meanGrowth(before, after, name, wanted = {}) {
  const count = growth(total(before, `${name}_count`, wanted), total(after, `${name}_count`, wanted));
  const sum = growth(total(before, `${name}_sum`, wanted), total(after, `${name}_sum`, wanted));
  return count > 0 ? sum / count : null;
}

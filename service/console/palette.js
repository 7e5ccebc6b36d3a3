// Colours of a map: a PNG with a palette is given another palette, and the browser decodes it.

const SIGNATURE = 8;
const TABLE = new Uint32Array(256).map((_, n) => {
  let c = n;
  for (let bit = 0; bit < 8; bit += 1) c = c & 1 ? 0xedb88320 ^ (c >>> 1) : c >>> 1;
  return c >>> 0;
});

function crc32(bytes) {
  let c = 0xffffffff;
  for (const byte of bytes) c = TABLE[(c ^ byte) & 0xff] ^ (c >>> 8);
  return (c ^ 0xffffffff) >>> 0;
}

function chunk(name, data) {
  const bytes = new Uint8Array(12 + data.length);
  const view = new DataView(bytes.buffer);
  view.setUint32(0, data.length);
  bytes.set([...name].map((letter) => letter.charCodeAt(0)), 4);
  bytes.set(data, 8);
  view.setUint32(8 + data.length, crc32(bytes.subarray(4, 8 + data.length)));
  return bytes;
}

/**
 * Return a PNG with other colours.
 * @param {Uint8Array} png an image with a palette.
 * @param {number[][]} colours [red, green, blue, alpha] of each index, 0 to 255.
 * @throws {Error} if the image has no palette.
 */
export function recolour(png, colours) {
  const view = new DataView(png.buffer, png.byteOffset, png.byteLength);
  const pieces = [png.subarray(0, SIGNATURE)];
  let found = false;
  for (let at = SIGNATURE; at + 12 <= png.length; ) {
    const end = at + 12 + view.getUint32(at);
    const name = String.fromCharCode(...png.subarray(at + 4, at + 8));
    if (name === "PLTE") {
      found = true;
      pieces.push(chunk("PLTE", new Uint8Array(colours.flatMap((colour) => colour.slice(0, 3)))));
      pieces.push(chunk("tRNS", new Uint8Array(colours.map((colour) => colour[3]))));
    } else if (name !== "tRNS") {
      pieces.push(png.subarray(at, end));
    }
    at = end;
  }
  if (!found) throw new Error("The image of the map has no palette.");
  return new Blob(pieces, { type: "image/png" });
}

/** Return the bytes of base64 text. */
export function fromBase64(text) {
  return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
}

/**
 * Return the colours of a map's eight indices: bit 0 driveable area, 1 road dividers, 2 lane dividers.
 * @param {{driveable: number[], road: number[], lane: number[]}} theme [red, green, blue] of each layer.
 */
export function layerColours({ driveable, road, lane }) {
  return Array.from({ length: 8 }, (_, index) => {
    if (index & 2) return [...road, 255];
    if (index & 4) return [...lane, 255];
    if (index & 1) return [...driveable, 255];
    return [0, 0, 0, 0];
  });
}

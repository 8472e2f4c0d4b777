// Maps in tiles: what came, what each was at any time since, and their pictures.

const HISTORY_BYTES = 48e6; // of packed tiles that are kept for the time slider
const CHUNK = 16; // tiles along the side of a picture
const OCCUPIED = 65;
const FREE = 25;
const UNKNOWN = 255; // -1 as uint8

const key = (row, column) => `${row},${column}`;
const floorDiv = (value, by) => Math.floor(value / by);
const mod = (value, by) => ((value % by) + by) % by;

async function unpack(body, size) {
  if (body.length === 1) return new Uint8Array(size * size).fill(body[0]);
  // By hand: the streams of a Blob and of a Response take a hundred times as long for so little.
  const { readable, writable } = new DecompressionStream("deflate");
  const writer = writable.getWriter();
  for (const told of [writer.write(body), writer.close()]) told.catch(() => {}); // the reader tells
  const cells = new Uint8Array(size * size);
  const reader = readable.getReader();
  for (let filled = 0; ; ) {
    const { done, value } = await reader.read();
    if (done) return cells;
    cells.set(value, filled);
    filled += value.length;
  }
}

/** One state of a map: cells by tile, drawn into pictures of CHUNK x CHUNK tiles. */
export class Raster {
  constructor(layer) {
    this.layer = layer;
    this.tiles = new Map();
    this.chunks = new Map();
    this.boxes = new Map(); // of each tile's known cells: first row and column, and those after the last
  }

  put(row, column, cells) {
    this.tiles.set(key(row, column), cells);
    const size = this.layer.tile;
    this.boxes.set(key(row, column), knownBox(cells, size, row * size, column * size));
    const place = [floorDiv(row, CHUNK), floorDiv(column, CHUNK)];
    let chunk = this.chunks.get(key(...place));
    if (chunk === undefined) {
      const canvas = document.createElement("canvas");
      canvas.width = canvas.height = CHUNK * size;
      chunk = { row: place[0] * CHUNK, column: place[1] * CHUNK, canvas, context: canvas.getContext("2d") };
      this.chunks.set(key(...place), chunk);
    }
    const image = new ImageData(size, size);
    const pixels = new Uint32Array(image.data.buffer);
    const palette = this.layer.palette;
    for (let y = 0; y < size; y += 1) {
      const from = (size - 1 - y) * size; // pictures have their first row at the top
      for (let x = 0; x < size; x += 1) pixels[y * size + x] = palette[cells[from + x]];
    }
    chunk.context.putImageData(image, mod(column, CHUNK) * size, (CHUNK - 1 - mod(row, CHUNK)) * size);
  }

  /** The value of a cell, -1 where nothing is known. */
  at(row, column) {
    const size = this.layer.tile;
    const cells = this.tiles.get(key(floorDiv(row, size), floorDiv(column, size)));
    if (cells === undefined) return -1;
    const value = cells[mod(row, size) * size + mod(column, size)];
    return value === UNKNOWN ? -1 : value;
  }
}

function knownBox(cells, size, row0, column0) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  for (let at = 0; at < cells.length; at += 1) {
    if (cells[at] === UNKNOWN) continue;
    const [row, column] = [row0 + Math.floor(at / size), column0 + (at % size)];
    if (row < box[0]) box[0] = row;
    if (column < box[1]) box[1] = column;
    if (row >= box[2]) box[2] = row + 1;
    if (column >= box[3]) box[3] = column + 1;
  }
  return box;
}

/** The colour of each byte, as little-endian ABGR. */
function paletteOf(layer) {
  const pack = ([red, green, blue], alpha) =>
    ((Math.round(alpha * 255) << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  const colours = new Uint32Array(256);
  for (let value = 0; value <= 100; value += 1) {
    if (layer.kind === "agreement") {
      colours[value] = pack(layer.colours.wall, (0.9 * (100 - value)) / 100);
    } else if (value >= OCCUPIED) {
      colours[value] = pack(layer.colours.wall, 1);
    } else if (value <= FREE) {
      colours[value] = layer.kind === "fused" ? pack(layer.colours.free, 1) : 0;
    }
  }
  return colours;
}

export class Maps {
  constructor() {
    this.clear();
  }

  clear() {
    this.layers = new Map(); // by name: description, newest raster, view settings
    this.history = []; // packed tiles in the order in which they came
    this.base = new Map(); // of every tile the newest that the history has let go
    this.bytes = 0;
    this.firstS = null;
    this.lastS = null;
  }

  describe(message) {
    const { name } = message;
    let layer = this.layers.get(name);
    if (layer === undefined) {
      layer = { isShown: message.is_shown, opacity: message.kind === "fused" ? 1 : 0.85 };
      this.layers.set(name, layer);
    }
    const isNew = layer.epoch !== message.epoch;
    Object.assign(layer, message, { palette: paletteOf(message) });
    if (isNew) {
      layer.raster = new Raster(layer);
      this.forget(name);
    }
    return layer;
  }

  /** A map that was taken away; what it was is not shown any more, at no time. */
  remove(name) {
    this.layers.delete(name);
    this.forget(name);
  }

  forget(name) {
    this.history = this.history.filter((item) => item.name !== name);
    this.bytes = this.history.reduce((sum, item) => sum + item.body.length, 0);
    for (const place of this.base.keys()) if (place.startsWith(`${name}|`)) this.base.delete(place);
  }

  async take(data) {
    const length = new DataView(data).getUint16(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 2, length)));
    const body = new Uint8Array(data.slice(2 + length));
    const layer = this.layers.get(header.layer);
    if (layer === undefined) return;
    const cells = await unpack(body, layer.tile);
    layer.raster.put(header.row, header.column, cells);
    this.remember({ name: header.layer, row: header.row, column: header.column, stamp: header.stamp_s, body });
  }

  remember(item) {
    this.firstS = Math.min(this.firstS ?? item.stamp, item.stamp);
    this.lastS = Math.max(this.lastS ?? item.stamp, item.stamp);
    this.history.push(item);
    this.bytes += item.body.length;
    while (this.bytes > HISTORY_BYTES) {
      const gone = this.history.shift();
      this.bytes -= gone.body.length;
      this.base.set(`${gone.name}|${key(gone.row, gone.column)}`, gone);
      this.firstS = this.history[0]?.stamp ?? this.lastS;
    }
  }

  /** The rasters by name as they were at a time. */
  async at(stamp) {
    const newest = new Map(this.base);
    for (const item of this.history) {
      if (item.stamp <= stamp) newest.set(`${item.name}|${key(item.row, item.column)}`, item);
    }
    const rasters = new Map();
    for (const item of newest.values()) {
      const layer = this.layers.get(item.name);
      if (!rasters.has(item.name)) rasters.set(item.name, new Raster(layer));
      rasters.get(item.name).put(item.row, item.column, await unpack(item.body, layer.tile));
    }
    return rasters;
  }
}

export const css = (rgb) => `rgb(${rgb.join(" ")})`;
export const isWall = (value) => value >= OCCUPIED;
export const isKnown = (value) => value >= 0;

export function said(value) {
  if (value < 0) return "unknown";
  if (value >= OCCUPIED) return "wall";
  return value <= FREE ? "free" : `${value} %`;
}

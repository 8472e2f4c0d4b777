// The canvas: maps over each other in the fused frame, paths, the robot; moved by hand and keys.

import { css, isKnown, isWall } from "./maps.js";

export const compose = (a, b) => [
  a[0] + Math.cos(a[2]) * b[0] - Math.sin(a[2]) * b[1],
  a[1] + Math.sin(a[2]) * b[0] + Math.cos(a[2]) * b[1],
  a[2] + b[2],
];

export class View {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {() => object} scene gives what to draw: layers (bottom first; each name, layer, raster,
   *     place in the fused frame), trails, robots, difference
   * @param {(place: number[] | null) => void} onPoint receives the metres under the pointer, or under
   *     the cross that keys move
   * @param {boolean} isEmbedded in a page that scrolls: the wheel is the page's until the canvas is
   *     focused
   */
  constructor(canvas, scene, onPoint, isEmbedded) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.scene = scene;
    this.onPoint = onPoint;
    this.isEmbedded = isEmbedded;
    this.centre = [0, 0];
    this.scale = 40; // device pixels per metre
    this.isFitted = true; // until the user moves it
    this.isAsked = false;
    this.hasCross = false; // where keys ask for a cell
    this.pointers = new Map();
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("pointerleave", (event) => {
      if (event.pointerType !== "touch") this.onPoint(null); // a finger that was lifted has asked
    });
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.pressKey(event));
    canvas.addEventListener("blur", () => this.showCross(false));
    canvas.view = this; // for the console
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.drawSoon();
  }

  drawSoon() {
    if (this.isAsked) return;
    this.isAsked = true;
    requestAnimationFrame(() => {
      this.isAsked = false;
      this.draw();
    });
  }

  // -- between metres of the fused frame and device pixels --------------------------------------

  toPixel([x, y]) {
    return [
      this.canvas.width / 2 + (x - this.centre[0]) * this.scale,
      this.canvas.height / 2 - (y - this.centre[1]) * this.scale,
    ];
  }

  toPlace([px, py]) {
    return [
      this.centre[0] + (px - this.canvas.width / 2) / this.scale,
      this.centre[1] - (py - this.canvas.height / 2) / this.scale,
    ];
  }

  /** The pixel in which a cell's centre lies; null for a map that is not there. */
  pixelOf(name, row, column) {
    const found = this.scene().layers.find((item) => item.name === name);
    if (found === undefined) return null;
    const { layer, place } = found;
    const [x, y] = compose(place, [(column + 0.5) * layer.resolution, (row + 0.5) * layer.resolution, 0]);
    return this.toPixel([x, y]).map(Math.floor);
  }

  // -- what one sees -----------------------------------------------------------------------------

  /** Show all of the fused map, or of the layers that are shown without it. */
  fit() {
    const { layers } = this.scene();
    const shown = layers.filter((item) => item.isShown);
    const fused = shown.filter((item) => item.layer.kind === "fused"); // stray beams of an input do not count
    const corners = [fused, shown, layers].find((found) => found.length > 0 || found === layers).flatMap(({ layer, raster, place }) =>
      this.corners(layer, raster, place),
    );
    this.isFitted = true;
    if (corners.length === 0) return;
    const xs = corners.map((corner) => corner[0]);
    const ys = corners.map((corner) => corner[1]);
    const least = (values) => values.reduce((a, b) => Math.min(a, b));
    const most = (values) => values.reduce((a, b) => Math.max(a, b));
    const [left, right, low, high] = [least(xs), most(xs), least(ys), most(ys)];
    this.centre = [(left + right) / 2, (low + high) / 2];
    const room = 0.94;
    this.scale = Math.min(
      (room * this.canvas.width) / Math.max(right - left, 1e-6),
      (room * this.canvas.height) / Math.max(high - low, 1e-6),
    );
    this.drawSoon();
  }

  corners(layer, raster, place) {
    const step = layer.resolution;
    return [...raster.boxes.values()].flatMap(([bottom, left, top, right]) => {
      if (top < bottom) return []; // nothing is known
      const cells = [[left, bottom], [left, top], [right, bottom], [right, top]];
      return cells.map(([column, row]) => compose(place, [column * step, row * step, 0]));
    });
  }

  /** A device pixel for a cell of a map, cells on pixels. */
  oneToOne(name) {
    const found = this.scene().layers.find((item) => item.name === name) ?? this.scene().layers[0];
    if (found === undefined) return;
    this.fit();
    this.isFitted = false;
    this.scale = 1 / found.layer.resolution;
    const [px, py] = this.toPixel(found.place);
    this.centre = this.toPlace([
      this.canvas.width / 2 + px - Math.round(px),
      this.canvas.height / 2 + py - Math.round(py),
    ]);
    this.drawSoon();
  }

  zoom(factor, at = [this.canvas.width / 2, this.canvas.height / 2]) {
    const before = this.toPlace(at);
    this.scale = Math.min(Math.max(this.scale * factor, 0.05), 20000);
    const after = this.toPlace(at);
    this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    this.isFitted = false;
    this.drawSoon();
  }

  pan(dx, dy) {
    this.centre = [this.centre[0] - dx / this.scale, this.centre[1] + dy / this.scale];
    this.isFitted = false;
    this.drawSoon();
  }

  // -- hands -------------------------------------------------------------------------------------

  at(event) {
    const ratio = window.devicePixelRatio || 1;
    const box = this.canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * ratio, (event.clientY - box.top) * ratio];
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, this.at(event));
    this.onPoint(this.toPlace(this.at(event)));
  }

  move(event) {
    const now = this.at(event);
    this.showCross(false);
    this.onPoint(this.toPlace(now));
    const before = this.pointers.get(event.pointerId);
    if (before === undefined) return;
    if (this.pointers.size === 2) {
      const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const span = (a, b) => Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1]));
      this.zoom(span(now, other) / span(before, other), other);
    } else {
      this.pan(now[0] - before[0], now[1] - before[1]);
    }
    this.pointers.set(event.pointerId, now);
  }

  wheel(event) {
    if (this.isEmbedded && !event.ctrlKey && document.activeElement !== this.canvas) return;
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY / 400), this.at(event));
  }

  pressKey(event) {
    const step = 60;
    const moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key in moves) this.pan(...moves[event.key]);
    else if (event.key === "+" || event.key === "=") this.zoom(1.3);
    else if (event.key === "-") this.zoom(1 / 1.3);
    else if (event.key === "0") this.fit();
    else if (event.key === "1") this.oneToOne("fused");
    else return;
    event.preventDefault();
    this.showCross(true);
    this.onPoint(this.centre);
  }

  showCross(isShown) {
    if (this.hasCross === isShown) return;
    this.hasCross = isShown;
    this.drawSoon();
  }

  // -- drawing -----------------------------------------------------------------------------------

  draw() {
    const { context, canvas } = this;
    const scene = this.scene();
    if (this.isFitted) this.fit();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    context.imageSmoothingEnabled = false;
    for (const item of scene.layers) if (item.isShown) this.drawLayer(item);
    if (scene.difference !== null) this.drawDifference(...scene.difference);
    context.globalAlpha = 1;
    for (const { points, place, rgb } of scene.trails) this.drawTrail(points, place, rgb);
    for (const { pose, rgb } of scene.robots) this.drawRobot(pose, rgb);
    for (const [index, place] of scene.places.entries()) this.drawPlace(place, String(index + 1), css(scene.placeRgb));
    this.drawScale();
    if (this.hasCross) this.drawCross();
  }

  /** Mark the centre: dark on light and light on dark. */
  drawCross() {
    const { context, canvas } = this;
    const size = 10 * (window.devicePixelRatio || 1);
    const [x, y] = [canvas.width / 2, canvas.height / 2];
    for (const [colour, width] of [["white", 5], ["black", 2]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.beginPath();
      context.moveTo(x - size, y);
      context.lineTo(x + size, y);
      context.moveTo(x, y - size);
      context.lineTo(x, y + size);
      context.stroke();
    }
  }

  drawLayer({ layer, raster, place, opacity }) {
    const { context, scale } = this;
    const step = scale * layer.resolution;
    const [cos, sin] = [Math.cos(place[2]), Math.sin(place[2])];
    context.globalAlpha = opacity;
    for (const chunk of raster.chunks.values()) {
      const size = chunk.canvas.width;
      const [column, row] = [chunk.column * layer.tile, chunk.row * layer.tile + size];
      const corner = compose(place, [column * layer.resolution, row * layer.resolution, 0]);
      const [px, py] = this.toPixel(corner);
      context.setTransform(step * cos, -step * sin, step * sin, step * cos, px, py);
      // Coarser than the screen: walls of one cell must not fall between pixels.
      context.imageSmoothingEnabled = step < 1;
      context.drawImage(chunk.canvas, 0, 0);
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  /** Compare two maps pixel by pixel, whatever their lattices. */
  drawDifference(first, second) {
    const { width, height } = this.canvas;
    const image = new ImageData(width, height);
    const steps = [first, second].map(({ layer, place }) => {
      const [cos, sin] = [Math.cos(place[2]), Math.sin(place[2])];
      const origin = this.toPlace([0.5, 0.5]);
      const [x, y] = [origin[0] - place[0], origin[1] - place[1]];
      const per = 1 / (layer.resolution * this.scale);
      return {
        column: (cos * x + sin * y) / layer.resolution,
        row: (-sin * x + cos * y) / layer.resolution,
        right: [cos * per, -sin * per],
        down: [-sin * per, -cos * per],
      };
    });
    const colours = [first, second].map(({ layer }) => layer.colours);
    const values = [0, 0];
    for (let py = 0; py < height; py += 1) {
      for (let px = 0; px < width; px += 1) {
        for (let index = 0; index < 2; index += 1) {
          const { column, row, right, down } = steps[index];
          const raster = index === 0 ? first.raster : second.raster;
          values[index] = raster.at(
            Math.floor(row + px * right[1] + py * down[1]),
            Math.floor(column + px * right[0] + py * down[0]),
          );
        }
        const [rgb, alpha] = compared(...values, ...colours);
        const at = 4 * (py * width + px);
        image.data[at] = rgb[0];
        image.data[at + 1] = rgb[1];
        image.data[at + 2] = rgb[2];
        image.data[at + 3] = alpha;
      }
    }
    const sheet = new OffscreenCanvas(width, height);
    sheet.getContext("2d").putImageData(image, 0, 0);
    this.context.globalAlpha = 1;
    this.context.drawImage(sheet, 0, 0);
  }

  drawTrail(points, place, rgb) {
    const { context } = this;
    context.strokeStyle = css(rgb);
    context.lineWidth = 2 * (window.devicePixelRatio || 1);
    context.beginPath();
    let end = null;
    for (const [index, point] of points.entries()) {
      const [px, py] = this.toPixel(compose(place, [point[0], point[1], 0]));
      if (index === 0) context.moveTo(px, py);
      else context.lineTo(px, py);
      if (index === points.length - 1) end = [px, py];
    }
    context.stroke();
    if (end !== null) this.drawDot(end, 5, css(rgb));
  }

  drawDot([x, y], radius, colour) {
    const { context } = this;
    const ratio = window.devicePixelRatio || 1;
    context.beginPath();
    context.arc(x, y, radius * ratio, 0, 2 * Math.PI);
    context.fillStyle = colour;
    context.fill();
    context.lineWidth = 1.5 * ratio;
    context.strokeStyle = "white";
    context.stroke();
  }

  /** Number a place to check. */
  drawPlace(place, text, colour) {
    const at = this.toPixel(place);
    this.drawDot(at, 10, colour);
    this.write(text, at, "white", "center");
  }

  write(text, [x, y], colour, align) {
    const { context } = this;
    context.font = `600 ${12 * (window.devicePixelRatio || 1)}px system-ui, sans-serif`;
    [context.textAlign, context.textBaseline, context.fillStyle] = [align, "middle", colour];
    context.fillText(text, x, y);
  }

  /** Draw a bar of a round length at the lower right. */
  drawScale() {
    const { context, canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const most = (130 * ratio) / this.scale;
    const unit = 10 ** Math.floor(Math.log10(most));
    const length = unit * (most >= 5 * unit ? 5 : most >= 2 * unit ? 2 : 1);
    const [right, y] = [canvas.width - 14 * ratio, canvas.height - 16 * ratio];
    const left = right - length * this.scale;
    context.fillStyle = "rgb(255 255 255 / 75%)";
    context.fillRect(left - 6 * ratio, y - 20 * ratio, right - left + 12 * ratio, 28 * ratio);
    context.fillStyle = "black";
    context.fillRect(left, y, right - left, 3 * ratio);
    this.write(`${Number(length.toPrecision(1))} m`, [(left + right) / 2, y - 9 * ratio], "black", "center");
  }

  drawRobot(pose, rgb) {
    const { context } = this;
    const [px, py] = this.toPixel(pose);
    const size = 9 * (window.devicePixelRatio || 1);
    context.setTransform(Math.cos(pose[2]), -Math.sin(pose[2]), Math.sin(pose[2]), Math.cos(pose[2]), px, py);
    context.beginPath();
    context.moveTo(1.3 * size, 0);
    context.lineTo(-size, 0.8 * size);
    context.lineTo(-0.5 * size, 0);
    context.lineTo(-size, -0.8 * size);
    context.closePath();
    context.fillStyle = css(rgb);
    context.strokeStyle = "white";
    context.lineWidth = 2;
    context.fill();
    context.stroke();
    context.setTransform(1, 0, 0, 1, 0, 0);
  }
}

/** The colour and the opacity of a pixel on which two maps have values: whose wall it is. */
function compared(one, two, first, second) {
  if (isWall(one) && isWall(two)) return [first.agreed, 255];
  if (isWall(one)) return [first.wall, 255];
  if (isWall(two)) return [second.wall, 255];
  if (isKnown(one) && !isKnown(two)) return [first.wall, 60];
  if (isKnown(two) && !isKnown(one)) return [second.wall, 60];
  return [first.free, isKnown(one) ? 200 : 0];
}

// Map over map: layers and their switches, a difference, paths, and who says what of a cell.

import { Maps, css, said } from "./maps.js";
import { Layers } from "./panels.js";
import { View, compose } from "./view.js";

const MOST_STATUSES = 7200; // an hour
const ORIGIN = [0, 0, 0];
const DEPTHS = { fused: 0, agreement: 1, input: 2 };
const HINT = "point at a cell to see its values";

export const byId = (id) => document.getElementById(id);

export class Stage {
  /** @param {boolean} isEmbedded in a page that scrolls */
  constructor(isEmbedded = false) {
    this.maps = new Maps();
    this.layers = new Layers(byId("layers"), [byId("first"), byId("second")], () => this.view.drawSoon());
    this.view = new View(byId("map"), () => this.scene(), (place) => this.showCell(place), isEmbedded);
    this.empty();
    byId("closer").addEventListener("click", () => this.view.zoom(1.4));
    byId("farther").addEventListener("click", () => this.view.zoom(1 / 1.4));
    byId("whole").addEventListener("click", () => this.view.fit());
    byId("pixels").addEventListener("click", () => this.view.oneToOne("fused"));
    byId("show-paths").addEventListener("change", () => this.view.drawSoon());
    for (const id of ["difference", "first", "second"]) byId(id).addEventListener("change", () => this.compare());
  }

  /** Begin or end to draw the difference of two maps, and say what its colours are. */
  compare() {
    byId("difference-legend").hidden = !byId("difference").checked;
    const [first, second] = [byId("first").value, byId("second").value].map((name) => this.maps.layers.get(name)?.colours);
    for (const [kind, rgb] of Object.entries({ both: first?.agreed, one: first?.wall, two: second?.wall })) {
      if (rgb !== undefined) document.querySelector(`#difference-legend .${kind}`).style.background = css(rgb);
    }
    this.view.drawSoon();
  }

  empty() {
    this.maps.clear();
    this.layers.clear();
    this.statuses = [];
    this.trails = new Map();
    this.past = null; // { stamp, rasters, status } while another time than now is shown
  }

  get newest() {
    return this.statuses.at(-1) ?? { inputs: [], poses: [], colours: {} };
  }

  get status() {
    return this.past?.status ?? this.newest;
  }

  colourOf(name) {
    return this.maps.layers.get(name)?.colours.wall ?? this.newest.colours[name];
  }

  // -- messages ----------------------------------------------------------------------------------

  /** Take a JSON message of a scene; see slamfusion/web/scene.py. */
  take(message) {
    if (message.type === "layer" && message.gone) {
      this.maps.remove(message.name);
      this.layers.remove(message.name);
      this.trails.delete(message.name);
    } else if (message.type === "layer") {
      this.maps.describe(message);
      this.layers.show(this.maps.layers);
    } else if (message.type === "status") {
      this.statuses.push(message);
      if (this.statuses.length > MOST_STATUSES) this.statuses.shift();
    } else if (message.type === "trail") {
      this.trails.set(message.name, [...(this.trails.get(message.name) ?? []), ...message.points]);
    }
  }

  // -- what one sees -----------------------------------------------------------------------------

  inputOf(name) {
    return this.status.inputs.find((item) => item.name === name);
  }

  /** Where the frame of a map lies in the fused one; null while it is not known. */
  transformOf(name) {
    if (this.maps.layers.get(name)?.kind === "fused") return ORIGIN;
    return this.inputOf(name)?.transform ?? null;
  }

  placeOf(name, layer) {
    if (layer.kind !== "input") return layer.anchor;
    const transform = this.transformOf(name);
    return transform === null ? null : compose(transform, layer.anchor);
  }

  /** A path as far as it went at the time that is shown. */
  pointsOf(points) {
    if (this.past === null) return points;
    const after = points.findIndex(([, , stamp]) => stamp > this.past.stamp);
    return after < 0 ? points : points.slice(0, after);
  }

  /** The first and the last time that anything is known of; null while nothing is. */
  get times() {
    if (this.maps.firstS === null) return null;
    const ends = [...this.trails.values()].map((points) => points.at(-1)[2]);
    return [this.maps.firstS, Math.max(this.newest.stamp_s ?? 0, this.maps.lastS, ...ends)];
  }

  drawn(name) {
    const layer = this.maps.layers.get(name);
    if (layer === undefined) return null;
    const raster = this.past === null ? layer.raster : this.past.rasters.get(name);
    const place = this.placeOf(name, layer);
    if (raster === undefined || place === null) return null;
    return { name, layer, raster, place, isShown: layer.isShown, opacity: layer.opacity };
  }

  scene() {
    const depth = (name) => DEPTHS[this.maps.layers.get(name).kind];
    const names = [...this.maps.layers.keys()].sort((a, b) => depth(a) - depth(b));
    const showsPaths = byId("show-paths").checked;
    const pair = [byId("first").value, byId("second").value].map((name) => this.drawn(name));
    return {
      layers: names.map((name) => this.drawn(name)).filter((item) => item !== null),
      difference: byId("difference").checked && !pair.includes(null) ? pair : null,
      trails: !showsPaths ? [] : [...this.trails]
        .map(([name, trail]) => ({ points: this.pointsOf(trail), place: this.transformOf(name), rgb: this.colourOf(name) }))
        .filter((trail) => trail.place !== null),
      places: this.status.places ?? [],
      placeRgb: this.status.place_rgb,
      robots: !showsPaths ? [] : (this.status.poses ?? []).map(({ name, pose }) => ({ pose, rgb: this.colourOf(name) })),
    };
  }

  /** Say what each map that is shown, or votes, holds at a place of the fused frame. */
  showCell(place) {
    if (place === null) {
      byId("cell").textContent = HINT;
      return;
    }
    const words = this.scene().layers
      .filter(({ name, isShown }) => isShown || this.inputOf(name) === undefined || this.inputOf(name).votes)
      .map(({ name, layer, raster, place: [x, y, yaw] }) => {
        const [dx, dy] = [place[0] - x, place[1] - y];
        const column = Math.floor((Math.cos(yaw) * dx + Math.sin(yaw) * dy) / layer.resolution);
        const row = Math.floor((-Math.sin(yaw) * dx + Math.cos(yaw) * dy) / layer.resolution);
        const value = raster.at(row, column);
        return `${name}: ${layer.kind === "agreement" && value >= 0 ? `${value} %` : said(value)}`;
      });
    byId("cell").textContent = `x ${place[0].toFixed(2)} m, y ${place[1].toFixed(2)} m  ${words.join(", ")}`;
  }
}

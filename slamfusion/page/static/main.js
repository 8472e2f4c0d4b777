// The live page: what the server tells becomes maps, lists and words.

import { BOTH, ONLY_FIRST, ONLY_SECOND, css } from "./colours.js";
import { Connection } from "./connection.js";
import { Maps, said } from "./maps.js";
import { Inputs, Layers, addEvent, clock, showFigures } from "./panels.js";
import { View, compose } from "./view.js";

const MOST_STATUSES = 7200; // an hour
const ORIGIN = [0, 0, 0];

const byId = (id) => document.getElementById(id);

const maps = new Maps();
let statuses = [];
let trails = new Map();
let past = null; // { stamp, rasters, status } while the slider is not at its end

const inputs = new Inputs(byId("inputs"));
const layers = new Layers(byId("layers"), [byId("first"), byId("second")], () => view.drawSoon());

const newest = () => statuses.at(-1) ?? { inputs: [], poses: [] };
const statusNow = () => past?.status ?? newest();
const colourOf = (name) => maps.layers.get(name)?.colours.wall ?? BOTH;

/** Where a map lies in the fused frame; null while nobody knows. */
function placeOf(name, layer) {
  if (layer.kind !== "input") return layer.anchor;
  const transform = transformOf(name);
  return transform === null ? null : compose(transform, layer.anchor);
}

function transformOf(name) {
  if (name === "fused") return ORIGIN;
  return statusNow().inputs.find((item) => item.name === name)?.transform ?? null;
}

/** A path as far as it went at the time that is shown. */
function pointsOf({ points, stamps }) {
  if (past === null) return points;
  const after = stamps.findIndex((stamp) => stamp > past.stamp);
  return after < 0 ? points : points.slice(0, after);
}

function drawn(name) {
  const layer = maps.layers.get(name);
  if (layer === undefined) return null;
  const raster = past === null ? layer.raster : past.rasters.get(name);
  const place = placeOf(name, layer);
  if (raster === undefined || place === null) return null;
  return { name, layer, raster, place, isShown: layer.isShown, opacity: layer.opacity };
}

const DEPTHS = { fused: 0, agreement: 1, input: 2 };

function scene() {
  const names = [...maps.layers.keys()].sort((a, b) => DEPTHS[maps.layers.get(a).kind] - DEPTHS[maps.layers.get(b).kind]);
  const showsPaths = byId("paths").checked;
  const pair = [byId("first").value, byId("second").value].map(drawn);
  return {
    layers: names.map(drawn).filter((item) => item !== null),
    difference: byId("difference").checked && !pair.includes(null) ? pair : null,
    trails: !showsPaths ? [] : [...trails]
      .map(([name, trail]) => ({ points: pointsOf(trail), place: transformOf(name), rgb: colourOf(name) }))
      .filter((trail) => trail.place !== null),
    robots: !showsPaths ? [] : (statusNow().poses ?? []).map(({ name, pose }) => ({ pose, rgb: colourOf(name) })),
  };
}

const view = new View(byId("map"), scene, showCell);

function showCell(place) {
  if (place === null) {
    byId("cell").textContent = "point at a cell: who says what";
    return;
  }
  const words = scene().layers.map(({ name, layer, raster, place: [x, y, yaw] }) => {
    const [dx, dy] = [place[0] - x, place[1] - y];
    const column = Math.floor((Math.cos(yaw) * dx + Math.sin(yaw) * dy) / layer.resolution);
    const row = Math.floor((-Math.sin(yaw) * dx + Math.cos(yaw) * dy) / layer.resolution);
    const value = raster.at(row, column);
    return `${name}: ${layer.kind === "agreement" && value >= 0 ? `${value} %` : said(value)}`;
  });
  byId("cell").textContent = `x ${place[0].toFixed(2)} m, y ${place[1].toFixed(2)} m  ${words.join(", ")}`;
}

// -- what the server tells ------------------------------------------------------------------------

const HANDLERS = {
  hello(message) {
    document.title = byId("headline").dataset.title = message.title;
    byId("commands").hidden = !message.may_command;
    byId("time").hidden = !message.is_live;
    if (!message.isAnother) return;
    maps.clear();
    [statuses, trails, past] = [[], new Map(), null];
    layers.clear();
    byId("events").replaceChildren();
  },
  layer(message) {
    maps.describe(message);
    layers.show(maps.layers);
  },
  status(message) {
    statuses.push(message);
    if (statuses.length > MOST_STATUSES) statuses.shift();
    inputs.remember(message);
  },
  trail(message) {
    const trail = trails.get(message.name) ?? { points: [], stamps: [] };
    for (const point of message.points) {
      trail.points.push(point);
      trail.stamps.push(newest().stamp_s ?? 0);
    }
    trails.set(message.name, trail);
  },
  event(message) {
    addEvent(byId("events"), message);
  },
  end() {
    document.body.dataset.batches = String(Number(document.body.dataset.batches ?? 0) + 1);
    if (past === null && statuses.length > 0) showStatus(newest());
    showTime();
    view.drawSoon();
  },
};

function showStatus(status) {
  inputs.show(status, (name) => css(colourOf(name)));
  byId("headline").textContent = status.headline ?? "";
  byId("headline").className = status.level ?? "";
  showFigures(byId("figures"), status.figures ?? {});
}

const connection = new Connection(
  (message) => HANDLERS[message.type]?.(message),
  (data) => maps.take(data),
  (state) => {
    const line = byId("connection");
    const words = { open: "connected", lost: "not connected: trying again" };
    line.textContent = words[state];
    line.className = state === "open" ? "good" : "bad";
    document.body.dataset.connected = String(state === "open");
  },
);

const legend = { both: BOTH, one: ONLY_FIRST, two: ONLY_SECOND };
for (const [kind, rgb] of Object.entries(legend)) {
  document.querySelector(`#difference-legend .${kind}`).style.background = css(rgb);
}

// -- time -----------------------------------------------------------------------------------------

const slider = byId("slider");

function showTime() {
  if (maps.firstS === null) return;
  const isAtEnd = past === null;
  slider.min = String(maps.firstS);
  slider.max = String(Math.max(newest().stamp_s ?? 0, maps.lastS));
  if (isAtEnd) slider.value = slider.max;
  const text = isAtEnd ? "now" : clock(past.stamp);
  byId("when").textContent = text;
  slider.setAttribute("aria-valuetext", text);
  byId("now").disabled = isAtEnd;
}

let wanted = null; // the newest request for a time, while an older one is being made

async function goTo(stamp) {
  const isAsked = wanted !== null;
  wanted = stamp;
  if (isAsked) return;
  while (wanted !== null) {
    const now = wanted;
    const rasters = await maps.at(now);
    const status = statuses.findLast((item) => item.stamp_s <= now) ?? statuses[0] ?? newest();
    if (wanted === now) {
      past = { stamp: now, rasters, status };
      wanted = null;
    }
  }
  if (past === null) return; // somebody went back to now meanwhile
  showStatus(past.status);
  showTime();
  view.drawSoon();
}

function goToNow() {
  [past, wanted] = [null, null];
  showStatus(newest());
  showTime();
  view.drawSoon();
}

slider.addEventListener("input", () => {
  if (Number(slider.value) >= Number(slider.max)) goToNow();
  else goTo(Number(slider.value));
});
byId("now").addEventListener("click", goToNow);

// -- buttons --------------------------------------------------------------------------------------

byId("closer").addEventListener("click", () => view.zoom(1.4));
byId("farther").addEventListener("click", () => view.zoom(1 / 1.4));
byId("whole").addEventListener("click", () => view.fit());
byId("pixels").addEventListener("click", () => view.oneToOne("fused"));
for (const id of ["paths", "first", "second"]) byId(id).addEventListener("change", () => view.drawSoon());
byId("difference").addEventListener("change", () => {
  byId("difference-legend").hidden = !byId("difference").checked;
  view.drawSoon();
});

async function command(name, busy) {
  const line = byId("answer");
  line.className = "soft";
  line.textContent = busy;
  const answer = await connection.command(name);
  line.className = answer.success ? "good" : "bad";
  line.textContent = `${answer.success ? "✓" : "✗"} ${answer.message}`;
}

byId("save").addEventListener("click", () => command("save", "saving"));
byId("reset").addEventListener("click", () => {
  if (confirm("Begin a new fused map? The inputs go on.")) command("reset", "asking");
});

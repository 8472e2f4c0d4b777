// What stands next to the map: who votes, layers, figures, events.

import { css } from "./maps.js";

const POINTS = 600; // of the curves of health, one a status

const element = (name, text = "", kind = "") => {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
};

/** One line for each input: whether it votes, why, and its score over time. */
export class Inputs {
  constructor(list) {
    this.list = list;
    this.rows = new Map();
    this.scores = new Map();
  }

  show(status, colourOf) {
    if (this.rows.size === 0) this.list.replaceChildren();
    const names = new Set(status.inputs.map((item) => item.name));
    for (const [name, row] of this.rows) {
      if (names.has(name)) continue;
      row.item.remove();
      this.rows.delete(name);
    }
    for (const item of status.inputs) {
      const row = this.rows.get(item.name) ?? this.add(item.name);
      row.item.dataset.votes = String(item.votes);
      row.mark.textContent = item.votes === null ? "" : item.votes ? "✓ votes" : "✗ no vote";
      row.mark.className = item.votes ? "good" : "bad";
      row.reason.textContent = item.reason;
      const colour = colourOf(item.name);
      row.name.style.borderBottom = `3px solid ${colour}`;
      row.canvas.title = `score ${item.score ?? "-"}`;
      const scores = this.scores.get(item.name) ?? [];
      row.canvas.hidden = scores.length < 2;
      this.draw(row.canvas, scores, colour);
    }
  }

  remember(status) {
    for (const item of status.inputs) {
      const scores = this.scores.get(item.name) ?? [];
      scores.push({ score: item.score, votes: item.votes });
      if (scores.length > POINTS) scores.shift();
      this.scores.set(item.name, scores);
    }
  }

  add(name) {
    const item = element("li");
    item.dataset.name = name;
    const row = {
      item,
      name: element("b", name),
      mark: element("span"),
      reason: element("span", "", "reason"),
      canvas: element("canvas"),
    };
    row.canvas.setAttribute("role", "img");
    row.canvas.setAttribute("aria-label", `score of ${name} over time`);
    item.append(row.name, " ", row.mark, row.reason, row.canvas);
    this.list.append(item);
    this.rows.set(name, row);
    return row;
  }

  /** Scores from 0 to 1; grey below where it did not vote. */
  draw(canvas, scores, colour) {
    const width = (canvas.width = 320);
    const height = (canvas.height = 26);
    const context = canvas.getContext("2d");
    const step = width / Math.max(scores.length - 1, 60);
    context.fillStyle = "rgb(128 128 128 / 35%)";
    for (const [index, { votes }] of scores.entries()) {
      if (!votes) context.fillRect(index * step, 0, Math.ceil(step), height);
    }
    context.strokeStyle = colour;
    context.lineWidth = 2;
    context.beginPath();
    let isDrawn = false;
    for (const [index, { score }] of scores.entries()) {
      if (typeof score !== "number") {
        isDrawn = false;
        continue;
      }
      const [x, y] = [index * step, height - 2 - (height - 4) * Math.min(Math.max(score, 0), 1)];
      if (isDrawn) context.lineTo(x, y);
      else context.moveTo(x, y);
      isDrawn = true;
    }
    context.stroke();
  }
}

/** A line for each map: shown or not, how strongly, and in which colour. */
export class Layers {
  constructor(list, selects, onChange) {
    this.list = list;
    this.selects = selects;
    this.onChange = onChange;
    this.names = new Set();
  }

  show(layers) {
    for (const [name, layer] of layers) {
      if (this.names.has(name)) continue;
      if (this.names.size === 0) this.list.replaceChildren();
      this.names.add(name);
      this.add(name, layer);
      if (layer.kind === "agreement") continue;
      for (const [index, select] of this.selects.entries()) {
        select.append(new Option(name, name));
        if (select.length === index + 1) select.value = name;
      }
    }
  }

  add(name, layer) {
    const item = element("li");
    item.dataset.name = name;
    const shown = Object.assign(element("input"), { type: "checkbox", checked: layer.isShown });
    shown.id = `shown-${name}`;
    const label = Object.assign(element("label", name), { htmlFor: shown.id });
    const swatch = element("i");
    swatch.style.background = css(layer.colours.wall);
    const opacity = Object.assign(element("input"), {
      type: "range", min: "0", max: "1", step: "0.05", value: String(layer.opacity),
    });
    opacity.setAttribute("aria-label", `opacity of ${name}`);
    shown.addEventListener("change", () => {
      layer.isShown = shown.checked;
      this.onChange();
    });
    opacity.addEventListener("input", () => {
      layer.opacity = Number(opacity.value);
      this.onChange();
    });
    item.append(shown, swatch, label, opacity);
    this.list.append(item);
  }

  remove(name) {
    if (!this.names.delete(name)) return;
    for (const item of this.list.children) if (item.dataset.name === name) item.remove();
    for (const select of this.selects) {
      for (const option of select.options) if (option.value === name) option.remove();
    }
  }

  clear() {
    this.names.clear();
    this.list.replaceChildren();
    for (const select of this.selects) select.replaceChildren();
  }
}

export function showFigures(list, figures) {
  list.replaceChildren(
    ...Object.entries(figures).flatMap(([name, value]) => [element("dt", name), element("dd", value)]),
  );
}

const EVENT_WORDS = { ok: "", warn: "⚠ ", error: "✗ " };
const MOST_EVENTS = 500;

export function addEvent(list, event, time) {
  const item = element("li");
  item.append(element("time", time), element("span", EVENT_WORDS[event.level] + event.text, event.level === "error" ? "bad" : event.level === "warn" ? "warn" : ""));
  list.prepend(item);
  while (list.children.length > MOST_EVENTS) list.lastChild.remove();
}

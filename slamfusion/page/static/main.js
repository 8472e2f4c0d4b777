// The live page: what the server tells becomes maps, lists and words.

import { Connection } from "./connection.js";
import { css } from "./maps.js";
import { Inputs, addEvent, clock, showFigures } from "./panels.js";
import { Stage, byId } from "./stage.js";

const stage = new Stage();
const inputs = new Inputs(byId("inputs"));

// -- what the server tells ------------------------------------------------------------------------

const HANDLERS = {
  hello(message) {
    document.title = byId("headline").dataset.title = message.title;
    byId("commands").hidden = !message.may_command;
    byId("time").hidden = !message.is_live;
    if (!message.isAnother) return;
    stage.empty();
    byId("events").replaceChildren();
  },
  status(message) {
    stage.take(message);
    inputs.remember(message);
  },
  event(message) {
    addEvent(byId("events"), message);
  },
  end() {
    document.body.dataset.batches = String(Number(document.body.dataset.batches ?? 0) + 1);
    if (stage.past === null && stage.statuses.length > 0) showStatus(stage.newest);
    showTime();
    stage.view.drawSoon();
  },
};

function showStatus(status) {
  inputs.show(status, (name) => css(stage.colourOf(name)));
  const isAsked = status.inputs.some((item) => item.votes !== null);
  byId("inputs-title").textContent = isAsked || status.inputs.length === 0 ? "Who votes" : "Maps";
  byId("headline").textContent = status.headline ?? "";
  byId("headline").className = status.level ?? "";
  showFigures(byId("figures"), status.figures ?? {});
}

const connection = new Connection(
  (message) => (HANDLERS[message.type] ?? ((told) => stage.take(told)))(message),
  (data) => stage.maps.take(data),
  (state) => {
    const line = byId("connection");
    const words = { open: "connected", lost: "not connected: trying again" };
    line.textContent = words[state];
    line.className = state === "open" ? "good" : "bad";
    document.body.dataset.connected = String(state === "open");
  },
);

// -- time -----------------------------------------------------------------------------------------

const slider = byId("slider");

function showTime() {
  const { maps, newest, past } = stage;
  if (maps.firstS === null) return;
  const isAtEnd = past === null;
  slider.min = String(maps.firstS);
  slider.max = String(Math.max(newest.stamp_s ?? 0, maps.lastS));
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
    const rasters = await stage.maps.at(now);
    const status = stage.statuses.findLast((item) => item.stamp_s <= now) ?? stage.statuses[0] ?? stage.newest;
    if (wanted === now) {
      stage.past = { stamp: now, rasters, status };
      wanted = null;
    }
  }
  if (stage.past === null) return; // somebody went back to now meanwhile
  showStatus(stage.past.status);
  showTime();
  stage.view.drawSoon();
}

function goToNow() {
  [stage.past, wanted] = [null, null];
  showStatus(stage.newest);
  showTime();
  stage.view.drawSoon();
}

slider.addEventListener("input", () => {
  if (Number(slider.value) >= Number(slider.max)) goToNow();
  else goTo(Number(slider.value));
});
byId("now").addEventListener("click", goToNow);

// -- commands -------------------------------------------------------------------------------------

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

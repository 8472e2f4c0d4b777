// The live page: shows the server's messages as maps, lists and words.

import { Connection } from "./connection.js";
import { css } from "./maps.js";
import { Inputs, addEvent, showFigures } from "./panels.js";
import { Stage, byId } from "./stage.js";
import { TimeSlider } from "./time.js";

const stage = new Stage();
const slider = new TimeSlider(stage, true, () => showStatus(stage.status));
const inputs = new Inputs(byId("inputs"));

// -- messages of the server -----------------------------------------------------------------------

const HANDLERS = {
  hello(message) {
    document.title = byId("headline").dataset.title = message.title;
    byId("commands").hidden = !message.may_command;
    slider.isLive = message.is_live;
    byId("report").hidden = !message.has_report;
    if (!message.is_live) byId("connection").textContent = "finished run";
    if (!message.isAnother) return;
    stage.empty();
    byId("events").replaceChildren();
  },
  status(message) {
    stage.take(message);
    inputs.remember(message);
  },
  event(message) {
    addEvent(byId("events"), message, slider.clock(message.stamp_s));
  },
  end() {
    document.body.dataset.batches = String(Number(document.body.dataset.batches ?? 0) + 1);
    if (stage.past === null && stage.statuses.length > 0) showStatus(stage.newest);
    slider.show();
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
  (message) => (HANDLERS[message.type] ?? ((other) => stage.take(other)))(message),
  (data) => stage.maps.take(data),
  (state) => {
    const line = byId("connection");
    const words = { open: "connected", lost: "not connected: trying again" };
    line.textContent = words[state];
    line.className = state === "open" ? "good" : "bad";
    document.body.dataset.connected = String(state === "open");
  },
);

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
  if (confirm("Start a new fused map? The inputs go on.")) command("reset", "asking");
});

// The maps of a report: the messages that a scene had when the report was written.

import { Stage, byId } from "./stage.js";
import { TimeSlider } from "./time.js";

const recorded = JSON.parse(byId("recorded").textContent);
byId("viewer").hidden = false;
const stage = new Stage(true);
for (const message of recorded.messages) stage.take(message);
byId("show-paths").closest("p").hidden = stage.trails.size === 0;
byId("difference").closest("p").hidden = byId("first").options.length < 2;

async function takeTiles() {
  for (const packed of recorded.tiles) {
    await stage.maps.take(Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0)).buffer);
  }
  document.body.dataset.drawn = "true";
  new TimeSlider(stage, false).show();
  stage.view.drawSoon();
}

takeTiles().catch((error) => {
  console.error(error);
  byId("viewer").hidden = true; // the pictures below say the same
});

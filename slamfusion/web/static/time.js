// The time slider: what was at another time than now.

import { byId } from "./stage.js";

export class TimeSlider {
  /**
   * @param {Stage} stage
   * @param {boolean} isLive or of a finished drive, whose times count from its start
   * @param {() => void} onMove called when another time is shown
   */
  constructor(stage, isLive, onMove = () => {}) {
    this.stage = stage;
    this.isLive = isLive;
    this.onMove = onMove;
    this.wanted = null; // the newest request for a time, while an older one is being made
    this.slider = byId("slider");
    this.slider.addEventListener("input", () => {
      if (Number(this.slider.value) >= Number(this.slider.max)) this.goToEnd();
      else this.goTo(Number(this.slider.value));
    });
    byId("now").addEventListener("click", () => this.goToEnd());
  }

  clock(stamp) {
    if (!this.isLive) return `${stamp.toFixed(0)} s`;
    return new Date(1000 * stamp).toLocaleTimeString([], { hour12: false });
  }

  show() {
    const { times, past } = this.stage;
    byId("time").hidden = times === null || times[0] === times[1];
    if (times === null) return;
    [this.slider.min, this.slider.max] = times.map(String);
    if (past === null) this.slider.value = this.slider.max;
    const end = this.isLive ? "now" : `end, ${this.clock(times[1])}`;
    const text = past === null ? end : this.clock(past.stamp);
    byId("when").textContent = text;
    this.slider.setAttribute("aria-valuetext", text);
    byId("now").textContent = this.isLive ? "back to now" : "to the end";
    byId("now").disabled = past === null;
  }

  async goTo(stamp) {
    const isAsked = this.wanted !== null;
    this.wanted = stamp;
    if (isAsked) return;
    const { stage } = this;
    while (this.wanted !== null) {
      const now = this.wanted;
      const rasters = await stage.maps.at(now);
      const status = stage.statuses.findLast((item) => item.stamp_s <= now) ?? stage.statuses[0] ?? stage.newest;
      if (this.wanted === now) {
        stage.past = { stamp: now, rasters, status };
        this.wanted = null;
      }
    }
    if (stage.past !== null) this.moved(); // null: the user went back to now meanwhile
  }

  goToEnd() {
    [this.stage.past, this.wanted] = [null, null];
    this.moved();
  }

  moved() {
    this.onMove();
    this.show();
    this.stage.view.drawSoon();
  }
}

// The socket to the server: begins again by itself, and goes on where it was cut off.

const SILENT_MS = 8000; // the server gives a sign of life every two seconds
const FIRST_PAUSE_MS = 400;
const LONGEST_PAUSE_MS = 5000;

export class Connection {
  /**
   * @param {(message: object) => void} onText told every JSON message of the server
   * @param {(data: ArrayBuffer) => Promise<void>} onTile told every tile; awaited before "seen"
   * @param {(state: string) => void} onState told "open" or "lost"
   */
  constructor(onText, onTile, onState) {
    this.onText = onText;
    this.onTile = onTile;
    this.onState = onState;
    this.scene = "";
    this.seq = 0;
    this.pause = FIRST_PAUSE_MS;
    this.questions = new Map();
    this.asked = 0;
    this.socket = null;
    this.timer = 0;
    setInterval(() => this.watch(), 1000);
    for (const event of ["online", "pageshow"]) addEventListener(event, () => this.hurry());
    document.addEventListener("visibilitychange", () => this.hurry());
    this.open();
  }

  open() {
    clearTimeout(this.timer);
    const socket = new WebSocket(`ws://${location.host}/ws`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.heard = performance.now();
    let work = Promise.resolve(); // one message after the other, in order
    socket.onopen = () => {
      const token = new URLSearchParams(location.hash.slice(1)).get("token") ?? "";
      this.send({ type: "hello", token, scene: this.scene, seq: this.seq });
    };
    socket.onmessage = (event) => {
      this.heard = performance.now();
      work = work.then(() => this.take(socket, event.data)).catch((error) => {
        console.error(error);
        this.lose(socket); // what is missing comes again
      });
    };
    socket.onclose = () => this.lose(socket);
  }

  async take(socket, data) {
    if (socket !== this.socket) return;
    if (typeof data !== "string") {
      await this.onTile(data);
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "hello") {
      this.pause = FIRST_PAUSE_MS;
      if (message.scene !== this.scene) this.seq = 0;
      message.isAnother = message.scene !== this.scene;
      this.scene = message.scene;
      this.onState("open");
    }
    if (message.type === "end") {
      this.seq = message.seq;
      this.send({ type: "seen", seq: message.seq });
    }
    if (message.type === "answer") {
      this.questions.get(message.id)?.(message);
      this.questions.delete(message.id);
      return;
    }
    this.onText(message);
  }

  /** Ask the server for something; the promise gives its answer. */
  command(name) {
    return new Promise((answer) => {
      this.asked += 1;
      this.questions.set(this.asked, answer);
      if (!this.send({ type: "command", id: this.asked, name })) {
        this.questions.delete(this.asked);
        answer({ success: false, message: "not connected" });
      }
    });
  }

  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  watch() {
    if (performance.now() - this.heard > SILENT_MS) this.lose(this.socket);
  }

  hurry() {
    if (document.visibilityState === "hidden") return;
    this.pause = FIRST_PAUSE_MS;
    if (this.socket === null) this.open();
  }

  lose(socket) {
    if (socket === null || socket !== this.socket) return;
    this.socket = null;
    socket.onclose = null;
    socket.close();
    for (const answer of this.questions.values()) answer({ success: false, message: "cut off" });
    this.questions.clear();
    this.onState("lost");
    this.timer = setTimeout(() => this.open(), this.pause);
    this.pause = Math.min(2 * this.pause, LONGEST_PAUSE_MS);
  }
}

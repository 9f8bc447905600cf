// The WebSocket: says who we are, comes back by itself, and acknowledges what is large.
import { parse } from "/wire.js";

const FIRST_PAUSE_MS = 500, LONGEST_PAUSE_MS = 5000, SILENCE_MS = 6000;
const WRONG_TOKEN = 4401, FULL = 4429;
const STORED = "cairn-console-token"; // of this tab only

export class Link {
  /** handlers: { message(parsed), status(sentence or "") , ask(wrong) -> Promise of a token } */
  constructor(handlers) {
    this.handlers = handlers;
    this.shown = [];
    this.pause = FIRST_PAUSE_MS;
    document.addEventListener("visibilitychange", () => this.tellShown());
    setInterval(() => this.watch(), 1000);
    this.connect();
  }

  async connect() {
    try {
      const needed = await (await fetch("/access", { cache: "no-store", signal: AbortSignal.timeout(SILENCE_MS) })).text();
      if (needed.trim() === "token" && !sessionStorage.getItem(STORED)) {
        sessionStorage.setItem(STORED, await this.handlers.ask(false));
      }
    } catch {
      return this.again("The console does not answer. It is tried again.");
    }
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const socket = new WebSocket(`${scheme}://${location.host}/ws`);
    this.socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.say({ hello: { token: sessionStorage.getItem(STORED) } });
      this.tellShown();
    };
    socket.onmessage = ({ data }) => {
      this.heard = performance.now();
      if (this.pause !== FIRST_PAUSE_MS || !this.open) {
        this.pause = FIRST_PAUSE_MS;
        this.open = true;
        this.handlers.status("");
      }
      this.handlers.message(parse(data));
    };
    socket.onclose = ({ code }) => this.closed(socket, code);
  }

  async closed(socket, code) {
    if (socket !== this.socket) return;
    this.open = false;
    if (code === WRONG_TOKEN) {
      sessionStorage.setItem(STORED, await this.handlers.ask(true));
      return this.connect();
    }
    const full = "The console has as many pages as it serves. It is tried again.";
    this.again(code === FULL ? full : "The console is gone. It is tried again until it is back.");
  }

  again(sentence) {
    this.handlers.status(sentence);
    setTimeout(() => this.connect(), this.pause);
    this.pause = Math.min(2 * this.pause, LONGEST_PAUSE_MS);
  }

  /** A connection that has silently died (radio, sleep) is given up: the console says something several times a second. */
  watch() {
    if (this.open && performance.now() - this.heard > SILENCE_MS && !document.hidden) {
      const { socket } = this;
      this.socket = null;
      this.open = false;
      socket.close();
      this.again("The console says nothing. It is tried again.");
    }
  }

  /** False if there is no connection to say it on. */
  say(word) {
    const isOpen = this.socket?.readyState === WebSocket.OPEN;
    if (isOpen) this.socket.send(JSON.stringify(word));
    return isOpen;
  }

  seen(kind) {
    this.say({ seen: kind });
  }

  /** What the page shows; nothing while nobody looks at it. */
  show(parts) {
    this.shown = parts;
    this.tellShown();
  }

  tellShown() {
    this.heard = performance.now();
    this.say({ show: document.hidden ? [] : this.shown });
  }
}

// The WebSocket to the robot's computer: it comes back by itself, never queues, and says in words
// what is wrong.

const RETRY_MS = [500, 1000, 2000, 3000]; // the last one from then on
const OPEN_MS = 8000; // a connection that takes longer is given up

/** Refusals after which trying again would be wrong, by how their reason begins. */
const FINAL = ['wrong code', 'blocked', 'somebody drives already', 'somebody has taken over'];

/** Round to 10 µm, to keep messages small. */
function round(key, value) {
  return typeof value === 'number' && !Number.isInteger(value)
    ? Math.round(value * 1e5) / 1e5
    : value;
}

/** Make the address of the socket from that of the page. */
export function makeAddress(location, code, role) {
  const scheme = location.protocol === 'https:' ? 'wss:' : 'ws:';
  const query = new URLSearchParams({ code, role });
  return `${scheme}//${location.host}/ws?${query}`;
}

/**
 * Why no connection came about, in words.
 *
 * @param {Location} location
 * @param {boolean} answers whether the same computer answers other requests
 */
export function explainFailure(location, answers) {
  if (!answers) {
    return `Nobody answers at ${location.host}. Is the recording running, and is this device in `
      + 'the same network? Trying again.';
  }
  if (location.protocol === 'https:') {
    return 'This browser shows the page but refuses its connection: it does not trust the '
      + 'certificate. Open /cert on this computer, install it and trust it, then load the page '
      + 'again. Or use a cable: see docs/use/webxr.md.';
  }
  return 'The computer shows the page but accepts no connection. Trying again.';
}

/** A connection in one role. */
export class Link {
  /**
   * @param {string} role `monitor` or `operator`
   * @param {string} code the pairing code
   * @param {object} handlers `state(phase, text)` with the phase `connecting`, `open`, `waiting`
   *   or `refused`; `message(object)`; `picture(camera, Blob)`
   */
  constructor(role, code, handlers) {
    this.role = role;
    this.code = code;
    this.handlers = handlers;
    this.dropped = 0; // frames that were not sent, as earlier ones still waited
    this.sent = 0;
    this.#connect();
  }

  #socket = null;
  #attempt = 0;
  #closed = false;
  #welcome = false;
  #refusal = '';
  #timer = 0;

  #connect() {
    this.#welcome = false;
    this.#refusal = '';
    this.handlers.state('connecting', `Connecting to ${location.host} …`);
    const socket = new WebSocket(makeAddress(location, this.code, this.role));
    socket.binaryType = 'blob';
    this.#socket = socket;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => socket.close(), OPEN_MS);
    socket.onmessage = (event) => this.#receive(socket, event.data);
    socket.onclose = (event) => {
      if (socket === this.#socket && !this.#closed) this.#end(event);
    };
  }

  #receive(socket, data) {
    if (socket !== this.#socket || this.#closed) return;
    if (typeof data !== 'string') {
      data.slice(0, 1).arrayBuffer().then((first) => {
        const camera = new Uint8Array(first)[0];
        this.handlers.picture(camera, data.slice(1, data.size, 'image/jpeg'));
      });
      return;
    }
    let message;
    try {
      message = JSON.parse(data);
    } catch {
      return;
    }
    if (message.type === 'ping') {
      this.send({ type: 'pong', id: message.id, t: performance.now() });
      return;
    }
    if (message.type === 'refused') {
      this.#refusal = message.reason;
      return;
    }
    if (message.type === 'welcome') {
      clearTimeout(this.#timer);
      this.#welcome = true;
      this.#attempt = 0;
      this.handlers.state('open', '');
    }
    this.handlers.message(message);
  }

  async #end(event) {
    clearTimeout(this.#timer);
    const reason = this.#refusal || event.reason;
    if (FINAL.some((start) => reason.toLowerCase().startsWith(start))) {
      this.#closed = true;
      this.handlers.state('refused', reason);
      return;
    }
    let text = reason;
    if (!text && this.#welcome) text = 'The connection broke off. Trying again.';
    if (!text) text = explainFailure(location, await this.#answers());
    if (this.#closed) return;
    this.handlers.state('waiting', text);
    const wait = RETRY_MS[Math.min(this.#attempt, RETRY_MS.length - 1)];
    this.#attempt += 1;
    this.#timer = setTimeout(() => this.#connect(), wait);
  }

  async #answers() {
    try {
      const options = { method: 'HEAD', cache: 'no-store', signal: AbortSignal.timeout(3000) };
      await fetch('/', options);
      return true;
    } catch {
      return false;
    }
  }

  get isOpen() {
    return this.#welcome && this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Send a message; whether there is somebody to send it to. */
  send(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(JSON.stringify(message, round));
    return true;
  }

  /** Send a frame, or drop it if earlier ones still wait: old poses help nobody. */
  sendFrame(frame) {
    if (!this.isOpen) return false;
    if (this.#socket.bufferedAmount > 0) {
      this.dropped += 1;
      return false;
    }
    this.sent += 1;
    return this.send({ type: 'frame', seq: this.sent, t: performance.now(), ...frame });
  }

  /** Close for good. */
  close() {
    this.#closed = true;
    clearTimeout(this.#timer);
    this.#socket?.close();
  }
}

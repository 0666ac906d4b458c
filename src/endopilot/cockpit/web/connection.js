// The WebSocket: binary messages in (a JSON header and raw arrays), small JSON objects out.

const TYPES = { f4: Float32Array, u4: Uint32Array, u1: Uint8Array };
export const token = new URLSearchParams(location.search).get("token") ?? "";

/** Return the header of a message, with its arrays beside the other entries. */
export function decode(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  let at = 4 + length;
  for (const { name, type, shape } of header.arrays) {
    const count = shape.reduce((a, b) => a * b, 1);
    header[name] = new TYPES[type](buffer, at, count);
    at += Math.ceil(header[name].byteLength / 4) * 4;
  }
  return header;
}

/** Return the message with what does not move. */
export async function fetchScene() {
  const answer = await fetch(`scene?token=${encodeURIComponent(token)}`);
  if (!answer.ok) throw new Error(await answer.text());
  return decode(await answer.arrayBuffer());
}

/** A connection that calls `handlers[type]` for each message, and `closed(why)` at its end; it comes back by itself. */
export class Connection {
  constructor(handlers, closed) {
    this.handlers = handlers;
    this.closed = closed;
    this.open();
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    const here = location.pathname.replace(/[^/]*$/, "");
    this.socket = new WebSocket(`${scheme}://${location.host}${here}socket?token=${encodeURIComponent(token)}`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = (event) => {
      const message = decode(event.data);
      this.handlers[message.type]?.(message);
    };
    this.socket.onopen = () => this.closed(null);
    this.socket.onclose = (event) => {
      this.closed(event.reason || "The server does not answer. The wire stands still.", event.code);
      if (event.code !== 4403 && event.code !== 4429) setTimeout(() => this.open(), 1000);
    };
  }

  send(type, values = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...values }));
  }
}

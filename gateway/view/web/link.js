// The connection to the server: the scene, snapshots, words; and commands.

export function decode(buffer) {
  const data = new DataView(buffer), joints = data.getUint32(4, true), cells = data.getUint32(8, true);
  if (buffer.byteLength !== 24 + 12 * joints + 8 * cells) throw new Error("a snapshot of another length");
  const snapshot = { number: data.getUint32(0, true), time: data.getFloat64(16, true), joints: [], cells: new Uint32Array(buffer, 24 + 12 * joints, 2 * cells) };
  for (let j = 0; j < joints; j++) {
    const [position, distributed, central] = [0, 4, 8].map((at) => data.getFloat32(24 + 12 * j + at, true));
    snapshot.joints.push({ position, distributed, central });
  }
  return snapshot;
}

// The torques before a position that was gone to.
export function decodeHistory(buffer) {
  const data = new DataView(buffer), joints = data.getUint32(4, true), moments = data.getUint32(8, true);
  if (buffer.byteLength !== 16 + moments * (8 + 8 * joints)) throw new Error("a history of another length");
  const all = [];
  for (let i = 0, at = 16; i < moments; i++, at += 8 + 8 * joints) {
    const torques = [];
    for (let j = 0; j < joints; j++) {
      torques.push({ distributed: data.getFloat32(at + 8 + 8 * j, true), central: data.getFloat32(at + 12 + 8 * j, true) });
    }
    all.push({ time: data.getFloat64(at, true), joints: torques });
  }
  return all;
}

const isHistory = (buffer) => new DataView(buffer).getUint32(12, true) === 1;

// A cell of a snapshot, which has two words of it.
export function cellOf(words, i) {
  const [low, high] = [words[2 * i], words[2 * i + 1]];
  return { status: low & 255, flags: low >> 8 & 255, force: low >>> 16, proximity: high & 65535, temperature: high >> 16 };
}

export class Link {
  constructor(on) {
    this.on = on;
    this.wait = 250;
    this.open();
  }

  open() {
    const socket = new WebSocket(`ws://${location.host}/live${location.search}`);
    socket.binaryType = "arraybuffer";
    let scene = false;
    socket.onopen = () => { this.wait = 250; };
    socket.onmessage = ({ data }) => {
      if (typeof data !== "string") return isHistory(data) ? this.on.history(decodeHistory(data)) : this.on.snapshot(decode(data));
      const message = JSON.parse(data);
      if (scene) return this.on.said(message);
      scene = true;
      this.on.scene(message);
    };
    // It may come back: a run that was started again listens at the same address.
    socket.onclose = async () => {
      this.on.closed(scene ? "" : await this.refusal());
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(4000, this.wait * 2);
    };
    this.socket = socket;
  }

  // The server's words if it refuses this page: with an old token, or as one too many.
  async refusal() {
    try {
      const answer = await fetch(`/live${location.search}`);
      return answer.status === 426 ? "" : (await answer.text()).trim();
    } catch {
      return "";
    }
  }

  send(command) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(command));
  }
}

// Decodes the binary messages of the server: snapshots, and the torques before a position.

export function decode(buffer) {
  const data = new DataView(buffer), joints = data.getUint32(4, true), cells = data.getUint32(8, true);
  if (buffer.byteLength !== 24 + 12 * joints + 8 * cells) throw new Error("the snapshot has a wrong length");
  const snapshot = { number: data.getUint32(0, true), time: data.getFloat64(16, true), joints: [], cells: new Uint32Array(buffer, 24 + 12 * joints, 2 * cells) };
  for (let j = 0; j < joints; j++) {
    const [position, distributed, central] = [0, 4, 8].map((at) => data.getFloat32(24 + 12 * j + at, true));
    snapshot.joints.push({ position, distributed, central });
  }
  return snapshot;
}

// The torques before the position of a seek.
export function decodeHistory(buffer) {
  const data = new DataView(buffer), joints = data.getUint32(4, true), moments = data.getUint32(8, true);
  if (buffer.byteLength !== 16 + moments * (8 + 8 * joints)) throw new Error("the history has a wrong length");
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

export const isHistory = (buffer) => new DataView(buffer).getUint32(12, true) === 1;

// The status of a cell from which frames have stopped coming.
export const DEAD = 4;

// A cell of a snapshot, which has two words for it.
export function cellOf(words, i) {
  const [low, high] = [words[2 * i], words[2 * i + 1]];
  return { status: low & 255, flags: low >> 8 & 255, force: low >>> 16, proximity: high & 65535, temperature: high >> 16 };
}

// The words of a number of cells that are normal and not touched.
export const resting = (cells) => Uint32Array.from({ length: 2 * cells }, (_, word) => (word % 2 ? 0 : 2));

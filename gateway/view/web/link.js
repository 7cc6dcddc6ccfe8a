// The connection to the server: receives the scene, snapshots and status messages, and sends commands.

import { decode, decodeHistory, isHistory } from "./snapshot.js";

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
    // Reconnect: a run that is started again listens at the same address.
    socket.onclose = async () => {
      this.on.closed(scene ? "" : await this.refusal());
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(4000, this.wait * 2);
    };
    this.socket = socket;
  }

  // The server's reason if it refuses this page: an outdated token, or too many pages.
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

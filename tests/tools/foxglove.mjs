// Connects to `skinbus view --foxglove` with Foxglove's own client, subscribes to all topics, and prints each message as
// a line of JSON: topic, time, the bytes in base64 and, of joint states, the positions as Foxglove's library reads them.
//
//   node tests/tools/foxglove.mjs MODULES URL SECONDS        ends after SECONDS without a message
import { createRequire } from "node:module";
import { join, resolve } from "node:path";

const [modules, url, seconds] = process.argv.slice(2);
const require = createRequire(join(resolve(modules), "node_modules", "x.js"));
const { FoxgloveClient } = require("@foxglove/ws-protocol");
const { MessageReader } = require("@foxglove/rosmsg2-serialization");
const { parse } = require("@foxglove/rosmsg");
const { WebSocket } = require("ws");

const client = new FoxgloveClient({ ws: new WebSocket(url, [FoxgloveClient.SUPPORTED_SUBPROTOCOL]) });
const channels = new Map();
let timer;

function wait() {
  clearTimeout(timer);
  timer = setTimeout(() => client.close(), 1000 * Number(seconds));
}

client.on("error", (error) => {
  console.error(String(error));
  process.exit(1);
});
// What was written to a pipe has to be read before the end.
client.on("close", () => process.stdout.write("", () => process.exit(0)));
client.on("status", (status) => console.log(JSON.stringify({ status })));
client.on("serverInfo", (info) => console.log(JSON.stringify({ info })));
client.on("advertise", (advertised) => {
  for (const channel of advertised) {
    const reader = new MessageReader(parse(channel.schema, { ros2: true }));
    channels.set(client.subscribe(channel.id), { topic: channel.topic, reader });
  }
  wait();
});
client.on("message", ({ subscriptionId, timestamp, data }) => {
  const { topic, reader } = channels.get(subscriptionId);
  const line = { topic, nanos: String(timestamp), bytes: Buffer.from(data.buffer, data.byteOffset, data.byteLength).toString("base64") };
  // Each message is decoded, so that a wrong definition is an error.
  const value = reader.readMessage(data);
  if (topic.endsWith("/joint_states")) {
    line.position = [...value.position];
    line.names = value.name;
  }
  console.log(JSON.stringify(line));
  // Live diagnostics come even if the bench has ended.
  if (topic !== "/diagnostics") wait();
});

// Reads a log with MCAP's TypeScript reader, every CRC checked, and decodes each message with Foxglove's ROS 2 decoder.
// Prints {topics: {topic: {count, schema, last}}, chunks, attachments, metadata}; numbers as text, so that Infinity survives.
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import { open, readFile } from "node:fs/promises";
import { argv, stdout } from "node:process";

const path = argv[2];
const decompressHandlers = { zstd: (data) => decompress(data) };

const stream = new McapStreamReader({ validateCrcs: true, decompressHandlers });
stream.append(await readFile(path));
const channels = new Map();
const schemas = new Map();
const report = { topics: {}, chunks: 0, attachments: [], metadata: [] };
for (let record; (record = stream.nextRecord()); ) {
  if (record.type === "Schema") {
    const definitions = parse(new TextDecoder().decode(record.data), { ros2: true });
    schemas.set(record.id, { name: record.name, reader: new MessageReader(definitions) });
  } else if (record.type === "Channel") {
    channels.set(record.id, record);
    report.topics[record.topic] ??= { count: 0, schema: schemas.get(record.schemaId).name };
  } else if (record.type === "Message") {
    const channel = channels.get(record.channelId);
    const topic = report.topics[channel.topic];
    topic.count += 1;
    topic.last = schemas.get(channel.schemaId).reader.readMessage(record.data);
  } else if (record.type === "ChunkIndex") {
    report.chunks += 1;
  } else if (record.type === "Attachment") {
    report.attachments.push(record.name);
  } else if (record.type === "Metadata") {
    report.metadata.push(record.name);
  }
}
if (!stream.done()) {
  throw new Error("the file has no end");
}

const file = await open(path);
const readable = {
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    await file.read(buffer, 0, Number(length), Number(offset));
    return buffer;
  },
};
const indexed = await McapIndexedReader.Initialize({ readable, decompressHandlers });
report.indexed = 0;
for await (const _ of indexed.readMessages()) {
  report.indexed += 1;
}
await file.close();

const plain = (_, value) => {
  if (typeof value === "bigint" || typeof value === "number") {
    return String(value);
  }
  return ArrayBuffer.isView(value) ? Array.from(value, String) : value;
};
stdout.write(JSON.stringify(report, plain));

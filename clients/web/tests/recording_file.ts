/** Writes recordings for tests, uncompressed. */

import { McapWriter, TempBuffer } from "@mcap/core";

export interface RecordedMessage {
    topic: "scene" | "content" | "states" | "forces";
    /** Seconds. */
    time: number;
    data: Uint8Array;
}

export async function writeRecording(
    messages: RecordedMessage[],
    metadata: Record<string, Record<string, string>>,
): Promise<Uint8Array> {
    const buffer = new TempBuffer();
    const writer = new McapWriter({ writable: buffer, chunkSize: 4096 });
    await writer.start({ profile: "modalcast", library: "test" });
    for (const [name, values] of Object.entries(metadata)) {
        await writer.addMetadata({ name, metadata: new Map(Object.entries(values)) });
    }
    const channels = new Map<string, number>();
    for (const { topic, time, data } of messages) {
        let channelId = channels.get(topic);
        if (channelId === undefined) {
            const schemaId = await writer.registerSchema({ name: topic, encoding: "protobuf", data: new Uint8Array() });
            channelId = await writer.registerChannel({
                topic,
                schemaId,
                messageEncoding: "protobuf",
                metadata: new Map(),
            });
            channels.set(topic, channelId);
        }
        const logTime = BigInt(Math.round(time * 1e9));
        await writer.addMessage({ channelId, sequence: 0, logTime, publishTime: logTime, data });
    }
    await writer.end();
    return buffer.get().slice();
}

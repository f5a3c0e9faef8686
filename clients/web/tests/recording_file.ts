/** Writes recordings for tests, uncompressed. */

import { createHash } from "node:crypto";
import { create, toBinary } from "@bufbuild/protobuf";
import { McapWriter, TempBuffer } from "@mcap/core";
import {
    type ArrayDescription,
    ArrayDescriptionSchema,
    DescribeSceneResponseSchema,
    ReadContentResponseSchema,
} from "../src/proto/modalcast/v1/scenes_pb";
import { type StateContent, StreamStatesResponseSchema } from "../src/proto/modalcast/v1/states_pb";
import type { ArrayKind, SceneDescription } from "../src/scene/description";
import { toHex } from "../src/scene/numbers";

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

/** The contents of a recording in the order of their hashes. */
export class Contents {
    readonly all: Uint8Array[] = [];

    /** Adds arrays of a shape. Returns their descriptions. */
    add(arrays: [ArrayKind, Uint8Array][]): ArrayDescription[] {
        return arrays.map(([array, bytes]) => {
            if (bytes.length > 0) this.all.push(bytes);
            const sha256 = bytes.length > 0 ? hash(bytes) : new Uint8Array();
            return create(ArrayDescriptionSchema, { array, bytes: BigInt(bytes.length), sha256 });
        });
    }

    /** The hashes, as in the metadata record `content`. */
    get sha256(): string {
        return this.all.map((bytes) => toHex(hash(bytes))).join(" ");
    }
}

function hash(bytes: Uint8Array): Uint8Array {
    return createHash("sha256").update(bytes).digest();
}

/** The messages that precede the states. */
export function sceneMessages(scene: SceneDescription, contents: Contents): RecordedMessage[] {
    const describe = (part: Parameters<typeof create<typeof DescribeSceneResponseSchema>>[1]): RecordedMessage => ({
        topic: "scene",
        time: 0,
        data: toBinary(DescribeSceneResponseSchema, create(DescribeSceneResponseSchema, part)),
    });
    return [
        describe({ part: { case: "scene", value: scene.info } }),
        describe({ part: { case: "shapes", value: { shapes: scene.shapes } } }),
        describe({ part: { case: "materials", value: { materials: scene.materials } } }),
        describe({ part: { case: "domains", value: { domains: scene.domains } } }),
        ...contents.all.map((bytes, item): RecordedMessage => {
            const response = create(ReadContentResponseSchema, { item, total: BigInt(bytes.length), data: bytes });
            return { topic: "content", time: 0, data: toBinary(ReadContentResponseSchema, response) };
        }),
    ];
}

/** A state from the bytes of its sections. */
export function stateMessage(
    number: number,
    time: number,
    contents: [StateContent, Uint8Array][],
    complete: boolean,
): RecordedMessage {
    let offset = 0n;
    const sections = contents.map(([content, bytes]) => {
        const section = { content, offset, bytes: BigInt(bytes.length) };
        offset += section.bytes;
        return section;
    });
    const data = new Uint8Array(contents.flatMap(([, bytes]) => [...bytes]));
    const head = { step: { run: 1n, number: BigInt(number), time }, complete, sections, total: offset };
    const response = create(StreamStatesResponseSchema, { part: { case: "chunk", value: { head, offset: 0n, data } } });
    return { topic: "states", time, data: toBinary(StreamStatesResponseSchema, response) };
}

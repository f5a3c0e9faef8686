/** A recording: an MCAP file with messages of `proto/modalcast/v1`. Format: see clients/recording/README.md. */

import { type DescMessage, fromBinary, type MessageShape } from "@bufbuild/protobuf";
import { McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import { type StreamForcesResponse, StreamForcesResponseSchema } from "../proto/modalcast/v1/forces_pb";
import { DescribeSceneResponseSchema, ReadContentResponseSchema } from "../proto/modalcast/v1/scenes_pb";
import { type StreamStatesResponse, StreamStatesResponseSchema } from "../proto/modalcast/v1/states_pb";
import type { PictureCamera } from "../render/framing";
import { norm, subtract, type Vec3 } from "../scene/affine";
import { parseArrays, type SceneArrays } from "../scene/arrays";
import { DescriptionCollector, type SceneDescription } from "../scene/description";
import { at } from "../scene/numbers";

/** Version of the format in the metadata record `recording`. */
const FORMAT_VERSION = "1";
/** Largest uncompressed chunk of the format in bytes. */
const MAX_CHUNK = 64 << 20;

/** A state of a recording. A large one has several messages. */
export interface RecordedState {
    /** Seconds since the first state. */
    time: number;
    messages: StreamStatesResponse[];
    /** Whether the state has every domain, so that playback can begin here. */
    isComplete: boolean;
}

export interface RecordedForces {
    time: number;
    message: StreamForcesResponse;
}

export interface Recording {
    scene: SceneDescription;
    arrays: SceneArrays;
    states: RecordedState[];
    forces: RecordedForces[];
    /** The picture of the metadata record `view`. */
    view: PictureCamera | null;
    /** Whether the file ends without the records that close a recording. */
    isCutOff: boolean;
}

/** Reads a whole recording. Throws if the file is not a recording, or does not contain its meshes. */
export function readRecording(file: Uint8Array): Recording {
    const reader = new McapStreamReader({
        decompressHandlers: {
            zstd: (bytes, size) => {
                if (size > MAX_CHUNK) throw new Error(`chunk: expected at most ${MAX_CHUNK} bytes, got ${size}`);
                return decompress(bytes, new Uint8Array(Number(size)));
            },
        },
    });
    reader.append(file);
    const collector = new RecordingCollector();
    for (let record = reader.nextRecord(); record; record = reader.nextRecord()) {
        if (record.type === "Channel") collector.topics.set(record.id, record.topic);
        else if (record.type === "Metadata") collector.metadata.set(record.name, record.metadata);
        else if (record.type === "Message") collector.addMessage(record.channelId, record.logTime, record.data);
    }
    return collector.finish(!reader.done());
}

class RecordingCollector {
    readonly topics = new Map<number, string>();
    readonly metadata = new Map<string, Map<string, string>>();
    private readonly description = new DescriptionCollector();
    private readonly contents: Uint8Array[] = [];
    private readonly states: RecordedState[] = [];
    private readonly forces: RecordedForces[] = [];

    addMessage(channel: number, logTime: bigint, data: Uint8Array): void {
        const time = Number(logTime) / 1e9;
        const parse = <T extends DescMessage>(schema: T): MessageShape<T> => fromBinary(schema, data);
        switch (this.topics.get(channel)) {
            case "scene":
                return this.description.add(parse(DescribeSceneResponseSchema));
            case "content": {
                const { item, offset, total, data: bytes } = parse(ReadContentResponseSchema);
                this.contents[item] ??= new Uint8Array(Number(total));
                return this.contents[item].set(bytes, Number(offset));
            }
            case "states":
                return this.addState(time, parse(StreamStatesResponseSchema));
            case "forces":
                this.forces.push({ time, message: parse(StreamForcesResponseSchema) });
        }
    }

    finish(isCutOff: boolean): Recording {
        const version = this.metadata.get("recording")?.get("version");
        if (version !== FORMAT_VERSION) {
            throw new Error(
                `recording: expected format version ${FORMAT_VERSION}, got ${version ?? "no metadata record `recording`"}`,
            );
        }
        if (this.metadata.get("recording")?.get("contents") === "by-hash") {
            throw new Error(
                "The recording names its meshes by hash and does not contain them: only the server that has them can play it.",
            );
        }
        const scene = this.description.finish();
        const hashes = (this.metadata.get("content")?.get("sha256") ?? "").split(" ");
        const contents = new Map(hashes.map((hash, item) => [hash, this.contents[item] ?? new Uint8Array()]));
        if (this.states.length === 0) throw new Error("The recording has no steps.");
        // The last state of a file that was cut off may lack chunks.
        const last = this.states.at(-1);
        if (last && !isWhole(last)) this.states.pop();
        return {
            scene,
            arrays: parseArrays(scene, contents),
            states: this.states,
            forces: this.forces,
            view: readView(this.metadata.get("view")),
            isCutOff,
        };
    }

    private addState(time: number, message: StreamStatesResponse): void {
        if (message.part.case !== "chunk") return;
        const { head } = message.part.value;
        if (head) this.states.push({ time, messages: [message], isComplete: head.complete });
        else this.states.at(-1)?.messages.push(message);
    }
}

/** The picture of a metadata record; null if the record is missing or invalid. */
function readView(record: Map<string, string> | undefined): PictureCamera | null {
    const numbers = (name: string) => (record?.get(name) ?? "").split(" ").map(Number.parseFloat);
    const number = (name: string) => at(numbers(name), 0);
    const [eye, target] = [numbers("eye") as Vec3, numbers("target") as Vec3];
    const view = { eye, target, fieldOfView: number("field_of_view"), aspect: number("width") / number("height") };
    const isUsable = norm(subtract(eye, target)) > 0 && view.fieldOfView > 0 && view.aspect > 0;
    return isUsable ? view : null;
}

function isWhole({ messages }: RecordedState): boolean {
    let received = 0n;
    let total = 0n;
    for (const { part } of messages) {
        if (part.case !== "chunk") continue;
        total = part.value.head?.total ?? total;
        received += BigInt(part.value.data.length);
    }
    return received === total;
}

/** Bytes of base64 text. */
export function decodeBase64(text: string): Uint8Array {
    const binary = atob(text.trim());
    const bytes = new Uint8Array(binary.length);
    // A loop, because `Uint8Array.from` calls a function for each byte of a large recording.
    for (let place = 0; place < bytes.length; place++) bytes[place] = binary.charCodeAt(place);
    return bytes;
}

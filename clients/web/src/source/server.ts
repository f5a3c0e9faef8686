/** The calls of the viewer to a server, over one channel. */

import type { MessageInitShape } from "@bufbuild/protobuf";
import { Delivery } from "../proto/modalcast/v1/common_pb";
import { type ApplyForcesResponse, ForceService, type StreamForcesResponse } from "../proto/modalcast/v1/forces_pb";
import {
    Format,
    FrameService,
    type Hit,
    Output,
    type PickHead,
    type StreamFramesResponse,
} from "../proto/modalcast/v1/frames_pb";
import {
    type ListScenesResponse,
    type SceneInfo,
    SceneService,
    type UploadSceneRequestSchema,
    type UploadSceneResponse,
} from "../proto/modalcast/v1/scenes_pb";
import { type GetServerInfoResponse, ServerService } from "../proto/modalcast/v1/server_pb";
import { StateService, type StreamStatesResponse } from "../proto/modalcast/v1/states_pb";
import { type DriveSceneRequestSchema, type DriveSceneResponse, StepService } from "../proto/modalcast/v1/steps_pb";
import type { CameraMessage } from "../render/camera";
import { contentHashes } from "../scene/arrays";
import { DescriptionCollector, type SceneDescription } from "../scene/description";
import { toHex } from "../scene/numbers";
import type { Channel, DuplexStream, ReplyStream } from "../wire/channel";
import { type ContentCache, hasHash } from "./content_cache";

/** Version of the contract, see GetServerInfoResponse. */
export const PROTOCOL_VERSION = 2;

/** Largest number of hashes in a request. */
const HASHES_PER_REQUEST = 4096;

/** Stage times arrive with every so many states: about twice per second at 60 steps per second. */
const STAGES_EVERY = 30;

/** Bytes of a chunk of an uploaded file. */
const UPLOAD_PART = 256 << 10;

/** Flow-control window of a picture stream in bytes. It admits one frame, so that a slow browser gets the newest. */
const PICTURE_WINDOW = 1;

export interface PictureOptions {
    width: number;
    height: number;
    jpeg: boolean;
    camera: CameraMessage;
    output: Output;
    /** Column of U for the output MODE_SHAPE, from 0. */
    mode: number;
    /** Value at the bright end of a color map, in meters or in meters per unit of q; 0 fits it to each frame. */
    largest: number;
    edges: boolean;
}

export type SurfaceForceMessage = {
    id: bigint;
    domain: number;
    triangle: number;
    barycentric: number[];
    vector: number[];
};

/** A force on the coordinates of a domain. */
export interface ModalForceMessage {
    id: bigint;
    domain: number;
    /** f_q in f32, see ModalForce. */
    fQ: Uint8Array;
}

export interface PickResult {
    head: PickHead | undefined;
    hits: Hit[];
}

/** A file to upload, and its path in the folder of the scene. */
export interface UploadedFile {
    path: string;
    file: Blob;
}

type UploadStream = DuplexStream<MessageInitShape<typeof UploadSceneRequestSchema>, UploadSceneResponse>;

export type DriveStream = DuplexStream<MessageInitShape<typeof DriveSceneRequestSchema>, DriveSceneResponse>;

export class Server {
    constructor(
        readonly channel: Channel,
        private readonly cache: ContentCache,
    ) {}

    getInfo(): Promise<GetServerInfoResponse> {
        return this.channel.unary(ServerService.method.getServerInfo, {}, { timeoutMs: 10_000 });
    }

    listScenes(): Promise<ListScenesResponse> {
        return this.channel.unary(SceneService.method.listScenes, {}, { timeoutMs: 10_000 });
    }

    /** @param name The name of the scene; empty: that of the source. */
    async openScene(source: string, name = ""): Promise<SceneInfo> {
        const { scene } = await this.channel.unary(SceneService.method.openScene, { source, scene: name });
        if (!scene) throw new Error("OpenScene: expected a scene, got none");
        return scene;
    }

    /**
     * Uploads files, and opens them as a scene.
     *
     * @param entry The path to open; empty: the folder of all files.
     * @param progress Called with the number of bytes of each chunk that was sent.
     */
    async uploadScene(
        scene: string,
        entry: string,
        files: readonly UploadedFile[],
        progress: (bytes: number) => void,
    ): Promise<SceneInfo> {
        const stream = this.channel.duplexStream(SceneService.method.uploadScene);
        try {
            const totalBytes = BigInt(files.reduce((sum, { file }) => sum + file.size, 0));
            stream.send({ part: { case: "header", value: { scene, entry, files: files.length, totalBytes } } });
            for (const file of files) if (!(await sendFile(stream, file, progress))) break;
            stream.end();
            let info: SceneInfo | undefined;
            for await (const response of stream) info = response.scene;
            if (!info) throw new Error("UploadScene: expected a scene, got none");
            return info;
        } finally {
            stream.cancel();
        }
    }

    async deleteScene(scene: string): Promise<void> {
        await this.channel.unary(SceneService.method.deleteScene, { scene });
    }

    async describe(scene: string): Promise<SceneDescription> {
        const collector = new DescriptionCollector();
        const stream = this.channel.serverStream(SceneService.method.describeScene, { scene, hashes: true });
        for await (const response of stream) collector.add(response);
        return collector.finish();
    }

    /** All arrays and textures of a scene, from the cache or the server. Calls `progress` with the received bytes. */
    async readContents(scene: SceneDescription, progress: (bytes: number) => void): Promise<Map<string, Uint8Array>> {
        const hashes = contentHashes(scene);
        const contents = await this.cache.read(hashes.map(toHex));
        for (const bytes of contents.values()) progress(bytes.length);
        const missing = hashes.filter((hash) => !contents.has(toHex(hash)));
        for (let first = 0; first < missing.length; first += HASHES_PER_REQUEST) {
            const received = await this.readMissing(scene, missing.slice(first, first + HASHES_PER_REQUEST), progress);
            for (const [hash, bytes] of received) contents.set(hash, bytes);
            // Not awaited, so that the scene is shown at once.
            void this.cache.write(received);
        }
        return contents;
    }

    streamStates(scene: string): ReplyStream<StreamStatesResponse> {
        const request = { scene, delivery: Delivery.LATEST, stagesEvery: STAGES_EVERY };
        return this.channel.serverStream(StateService.method.streamStates, request);
    }

    streamForces(scene: string): ReplyStream<StreamForcesResponse> {
        return this.channel.serverStream(ForceService.method.streamForces, { scene, maxHz: 30, passive: true });
    }

    streamFrames(scene: string, options: PictureOptions): ReplyStream<StreamFramesResponse> {
        const { width, height, camera, output, mode, largest, jpeg } = options;
        const isMap = output === Output.DISPLACEMENT || output === Output.MODE_SHAPE;
        const picture = {
            width,
            height,
            camera,
            output,
            mode: output === Output.MODE_SHAPE ? mode : 0,
            largest: isMap ? largest : 0,
            format: jpeg ? Format.JPEG : Format.PNG,
            ...(output === Output.COLOR && options.edges ? { edgeWidth: 1.25 } : {}),
        };
        const request = { scene, delivery: Delivery.LATEST, pictures: [picture] };
        return this.channel.serverStream(FrameService.method.streamFrames, request, { window: PICTURE_WINDOW });
    }

    async moveCamera(stream: Uint8Array, camera: CameraMessage): Promise<bigint> {
        const request = { stream, cameras: [{ picture: 0, camera }] };
        return (await this.channel.unary(FrameService.method.updateFrameStream, request)).cameraVersion;
    }

    /** The surface under a pixel. */
    async pick(
        scene: string,
        size: [number, number],
        camera: CameraMessage,
        x: number,
        y: number,
    ): Promise<PickResult> {
        const picture = { width: size[0], height: size[1], camera };
        const result: PickResult = { head: undefined, hits: [] };
        const request = { scene, picture, x, y, width: 1, height: 1 };
        for await (const { head, hits } of this.channel.serverStream(FrameService.method.pick, request)) {
            result.head ??= head;
            result.hits.push(...hits);
        }
        return result;
    }

    applyForces(
        scene: string,
        owner: Uint8Array,
        forces: readonly (SurfaceForceMessage | ModalForceMessage)[],
        lifetimeMs: number,
    ): Promise<ApplyForcesResponse> {
        const messages = forces.map(({ id, domain, ...kind }) => ({
            id,
            domain,
            kind: "fQ" in kind ? { case: "modal" as const, value: kind } : { case: "surface" as const, value: kind },
        }));
        const request = { scene, owner, forces: messages, lifetimeMs };
        return this.channel.unary(ForceService.method.applyForces, request, { timeoutMs: 5_000 });
    }

    drive(): DriveStream {
        return this.channel.duplexStream(StepService.method.driveScene);
    }

    private async readMissing(
        scene: SceneDescription,
        hashes: Uint8Array[],
        progress: (bytes: number) => void,
    ): Promise<Map<string, Uint8Array>> {
        const received = new Map<string, Uint8Array>();
        const request = { scene: scene.info.scene, sha256: hashes };
        for await (const { item, offset, total, data } of this.channel.serverStream(
            SceneService.method.readContent,
            request,
        )) {
            const hash = toHex(hashes[item] ?? new Uint8Array());
            let content = received.get(hash);
            if (!content) {
                content = new Uint8Array(Number(total));
                received.set(hash, content);
            }
            content.set(data, Number(offset));
            progress(data.length);
        }
        for (const [hash, bytes] of received) {
            if (!(await hasHash(bytes, hash)))
                throw new Error(`content ${hash}: the received bytes have another SHA-256`);
        }
        return received;
    }
}

/** Sends a file in chunks. Returns false if the server ended the call before the last one. */
async function sendFile(
    stream: UploadStream,
    { path, file }: UploadedFile,
    progress: (bytes: number) => void,
): Promise<boolean> {
    const content = new Uint8Array(await file.arrayBuffer());
    const sha256 = new Uint8Array(await crypto.subtle.digest("SHA-256", content));
    stream.send({ part: { case: "file", value: { path, bytes: BigInt(content.length), sha256 } } });
    for (let offset = 0; offset < content.length; offset += UPLOAD_PART) {
        const part = content.subarray(offset, offset + UPLOAD_PART);
        stream.send({ part: { case: "chunk", value: part } });
        if (!(await stream.drained())) return false;
        progress(part.length);
    }
    return true;
}

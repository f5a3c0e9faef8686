/** Shows the pictures that the server draws. */

import type { StageTime } from "../proto/modalcast/v1/common_pb";
import { Format, type StreamFramesResponse } from "../proto/modalcast/v1/frames_pb";
import type { CameraMessage } from "../render/camera";
import type { PictureOptions, Server } from "../source/server";
import type { ReplyStream } from "../wire/channel";
import { RpcError, StatusCode } from "../wire/rpc_error";

/** Milliseconds from the last change of the options to a new stream. Resizing a window makes many changes. */
const RESTART_MS = 150;

export class PictureView {
    private stream: ReplyStream<StreamFramesResponse> | null = null;
    private streamId: Uint8Array | null = null;
    private options: PictureOptions | null = null;
    private restartTimer: ReturnType<typeof setTimeout> | null = null;
    private pendingCamera: CameraMessage | null = null;
    private isMoving = false;
    private readonly context: CanvasRenderingContext2D | null;
    frames = 0;
    skipped = 0n;
    lastFrameBytes = 0;
    /** How far the lowest vertex of the last frame lies below the ground, in meters. */
    belowGround = 0;
    stages: readonly StageTime[] = [];
    onFrame: () => void = () => {};
    onError: (message: string) => void = () => {};

    constructor(
        private readonly server: Server,
        private readonly scene: string,
        private readonly canvas: HTMLCanvasElement,
    ) {
        this.context = canvas.getContext("2d");
    }

    /** Starts a stream, or replaces the running one. */
    start(options: PictureOptions): void {
        this.options = options;
        if (this.restartTimer !== null) clearTimeout(this.restartTimer);
        this.restartTimer = setTimeout(() => void this.run(), this.stream ? RESTART_MS : 0);
    }

    stop(): void {
        if (this.restartTimer !== null) clearTimeout(this.restartTimer);
        this.restartTimer = null;
        this.options = null;
        this.stream?.cancel();
        this.stream = null;
        this.streamId = null;
    }

    /** Moves the camera. While an earlier move is in flight, only the newest camera is kept. */
    moveCamera(camera: CameraMessage): void {
        if (this.options) this.options = { ...this.options, camera };
        this.pendingCamera = camera;
        void this.sendCamera();
    }

    private async sendCamera(): Promise<void> {
        if (this.isMoving) return;
        this.isMoving = true;
        while (this.pendingCamera && this.streamId) {
            const camera = this.pendingCamera;
            this.pendingCamera = null;
            // The stream may have ended in the meantime; its end is reported by `run`.
            await this.server.moveCamera(this.streamId, camera).catch(() => {});
        }
        this.isMoving = false;
    }

    private async run(): Promise<void> {
        this.restartTimer = null;
        if (!this.options) return;
        this.stream?.cancel();
        this.streamId = null;
        const stream = this.server.streamFrames(this.scene, this.options);
        this.stream = stream;
        try {
            await this.show(stream);
        } catch (error) {
            const isCancelled = error instanceof RpcError && error.code === StatusCode.cancelled;
            if (this.stream === stream && !isCancelled)
                this.onError(error instanceof Error ? error.message : String(error));
        }
    }

    private async show(stream: ReplyStream<StreamFramesResponse>): Promise<void> {
        let data = new Uint8Array();
        let format = Format.PNG;
        for await (const { part } of stream) {
            if (this.stream !== stream) return;
            if (part.case === "settings") {
                this.streamId = part.value.stream;
                // The stream begins with the next step. After a moved camera it sends the current one.
                this.pendingCamera ??= this.options?.camera ?? null;
                void this.sendCamera();
            }
            if (part.case !== "chunk") continue;
            const { head, offset, data: bytes } = part.value;
            if (head) {
                data = new Uint8Array(Number(head.total));
                format = head.format;
                this.skipped += head.skipped;
                this.stages = head.stages;
                this.belowGround = head.belowGround;
            }
            data.set(bytes, Number(offset));
            if (Number(offset) + bytes.length === data.length) await this.draw(data, format);
        }
    }

    private async draw(data: Uint8Array<ArrayBuffer>, format: Format): Promise<void> {
        const type = format === Format.JPEG ? "image/jpeg" : "image/png";
        const bitmap = await createImageBitmap(new Blob([data], { type }));
        this.canvas.width = bitmap.width;
        this.canvas.height = bitmap.height;
        this.context?.drawImage(bitmap, 0, 0);
        bitmap.close();
        this.frames++;
        this.lastFrameBytes = data.length;
        this.onFrame();
    }
}

/** Drives the scene with sliders and animated modes while no other program does. */

import { Delivery } from "../proto/modalcast/v1/common_pb";
import { Reason } from "../proto/modalcast/v1/errors_pb";
import { type DriveSceneResponse, TransformFormat } from "../proto/modalcast/v1/steps_pb";
import { TRANSFORM_SIZE } from "../scene/affine";
import { hertzOf } from "../scene/description";
import { Kinematics } from "../scene/kinematics";
import { at } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import type { DriveStream, Server } from "../source/server";
import { RpcError, StatusCode } from "../wire/rpc_error";

/**
 * Milliseconds without a change after which this viewer releases the writer lease, the right to send steps that one
 * program at a time has.
 */
const IDLE_MS = 3000;

export type DriverStatus = { kind: "idle" } | { kind: "driving" } | { kind: "refused"; message: string };

export class Driver {
    private stream: DriveStream | null = null;
    private readonly kinematics: Kinematics | null;
    private q: Float32Array;
    /** The domains whose coordinates have changed since the last sent step. */
    private readonly changed = new Set<number>();
    private animation: { domain: number; mode: number; amplitude: number; frequency: number } | null = null;
    private number = 0n;
    private start = 0;
    private lastChange = 0;
    private readonly timer: ReturnType<typeof setInterval>;
    /** `StepId.run` of the steps that this viewer sends; 0 if it sends none. */
    run = 0n;
    onStatus: (status: DriverStatus) => void = () => {};

    constructor(
        private readonly server: Server,
        private readonly model: SceneModel,
    ) {
        this.kinematics = model.arrays ? new Kinematics(model.scene, model.arrays) : null;
        this.q = model.state.q.slice();
        this.timer = setInterval(() => this.tick(), 16);
    }

    /** Sets a coordinate, and acquires the writer lease if necessary. */
    set(domain: number, mode: number, value: number): void {
        this.begin();
        const owner = at(this.model.layout.owner, domain);
        this.q[at(this.model.layout.firstCoordinate, owner) + mode] = value;
        this.changed.add(owner);
        this.lastChange = performance.now();
    }

    /** Sets all coordinates of a domain to 0. */
    reset(domain: number): void {
        this.stopAnimation();
        for (let mode = 0; mode < at(this.model.layout.ranks, domain); mode++) this.set(domain, mode, 0);
    }

    /** Moves one mode as a sine of the time t in seconds: q = amplitude sin(2 pi frequency t). */
    animate(domain: number, mode: number, amplitude: number, frequency: number): void {
        this.stopAnimation();
        this.begin();
        this.animation = { domain, mode, amplitude, frequency };
        this.start = performance.now();
    }

    stopAnimation(): void {
        if (!this.animation) return;
        const { domain, mode } = this.animation;
        this.animation = null;
        this.set(domain, mode, 0);
    }

    get isAnimating(): boolean {
        return this.animation !== null;
    }

    /** Simulated per real seconds of the animation; null without an animation, or if the frequency is unknown. */
    get timeScale(): number | null {
        if (!this.animation) return null;
        const { domain, mode, frequency } = this.animation;
        const hertz = hertzOf(this.model.scene, domain, mode);
        return hertz > 0 ? frequency / hertz : null;
    }

    /** Releases the writer lease. */
    dispose(): void {
        clearInterval(this.timer);
        this.close();
    }

    private begin(): void {
        this.lastChange = performance.now();
        if (this.stream) return;
        this.q = this.model.state.q.slice();
        this.number = 0n;
        this.start = performance.now();
        const stream = this.server.drive();
        this.stream = stream;
        stream.send({
            kind: { case: "open", value: { scene: this.model.scene.info.scene, delivery: Delivery.LATEST } },
        });
        void this.readReplies(stream);
    }

    private close(): void {
        this.stream?.end();
        this.stream = null;
        this.run = 0n;
        this.animation = null;
        this.changed.clear();
        this.onStatus({ kind: "idle" });
    }

    private async readReplies(stream: DriveStream): Promise<void> {
        try {
            for await (const reply of stream) if (!this.accept(reply)) break;
        } catch (error) {
            if (this.stream === stream) this.refuse(error instanceof RpcError ? error.message : String(error));
            if (!(error instanceof RpcError) || error.code === StatusCode.unknown) throw error;
        }
    }

    /** Returns whether the stream continues. */
    private accept({ kind }: DriveSceneResponse): boolean {
        if (kind.case === "opened") {
            this.run = kind.value.run;
            this.number = kind.value.scene?.lastStep?.number ?? 0n;
            this.onStatus({ kind: "driving" });
        } else if (kind.case === "rejection") {
            const { reason, field, expected, given } = kind.value;
            const isTaken = reason === Reason.WRITER_LEASE_TAKEN;
            this.refuse(
                isTaken
                    ? "Another program controls this scene. Only one program at a time can: stop it to use the sliders."
                    : `The server rejected a step: ${field}: expected ${expected}, got ${given}.`,
            );
            return false;
        }
        return true;
    }

    private refuse(message: string): void {
        this.close();
        this.onStatus({ kind: "refused", message });
    }

    private tick(): void {
        const { stream, animation } = this;
        if (!stream) return;
        const now = performance.now();
        if (animation) {
            const seconds = (now - this.start) / 1000;
            const value = animation.amplitude * Math.sin(2 * Math.PI * animation.frequency * seconds);
            this.set(animation.domain, animation.mode, value);
        }
        if (now - this.lastChange > IDLE_MS) return this.close();
        // Wait for the reply to `open`, and for the network if it is slow: the next step then has the newest values.
        if (this.run === 0n || this.changed.size === 0 || stream.backlog > 0) return;
        this.sendStep(stream, (now - this.start) / 1000);
    }

    private sendStep(stream: DriveStream, time: number): void {
        const { layout, state } = this.model;
        const qDomains = [...this.changed].sort((a, b) => a - b);
        this.changed.clear();
        const values = qDomains.flatMap((domain) => {
            const first = at(layout.firstCoordinate, domain);
            return [...this.q.subarray(first, first + at(layout.ranks, domain))];
        });
        this.number++;
        const step = { number: this.number, time, qDomains, q: new Uint8Array(new Float32Array(values).buffer) };
        const transforms = this.kinematics?.transforms(state, this.q) ?? [];
        if (transforms.length === 0) {
            stream.send({ kind: { case: "step", value: step } });
            return;
        }
        const numbers = new Float32Array(TRANSFORM_SIZE * transforms.length);
        transforms.forEach((transform, place) => {
            numbers.set(transform, TRANSFORM_SIZE * place);
        });
        const moved = {
            transformDomains: this.kinematics?.domains ?? [],
            transforms: new Uint8Array(numbers.buffer),
            transformFormat: TransformFormat.AFFINE_F32,
        };
        stream.send({ kind: { case: "step", value: { ...step, ...moved } } });
    }
}

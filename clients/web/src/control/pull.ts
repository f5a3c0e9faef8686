/**
 * Pulls on a point of the surface with a force that is proportional to the distance of the cursor from where the pull
 * began. The stiffness is the inverse of the point's compliance (displacement per newton), so that the point follows the
 * cursor. The force is limited to what the modes can represent, see PointCompliance.
 *
 * The force does not depend on where the point has moved. Otherwise it would close a loop through the network, whose
 * delay adds energy to modes with little damping: the vibration of a tree grew until the physics process stopped.
 */

import type { Hit } from "../proto/modalcast/v1/frames_pb";
import type { OrbitCamera } from "../render/camera";
import { norm, solveLinear, subtract, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import type { Deflections } from "../scene/deflection";
import { at, toF32 } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import type { Server, SurfaceForceMessage } from "../source/server";
import { type PointCompliance, pointCompliance } from "./point_compliance";
import { pullProblem } from "./pull_problem";
import { deflectionAt, displacementAt, jointPoint, positionOf, type SurfacePoint, surfacePoint } from "./surface_point";

/** Milliseconds between renewals of a force, and until the server removes a force that is not renewed. */
const RENEWAL_MS = 100;
const LIFETIME_MS = 500;
/**
 * Without eigenvalues, the compliance is unknown. These constants replace it: the force in newtons at a distance of the
 * scene's diagonal, and the distance at which the force stops growing, in diagonals of the scene.
 */
const DEFAULT_FORCE = 1000;
const LONGEST_PULL = 0.1;

export interface PullView {
    from: Vec3;
    to: Vec3;
    newtons: number;
    /** Largest force in this direction in newtons; null if it is unknown. */
    limit: number | null;
    /** Whether the force is at its limit. */
    isLimited: boolean;
    /** The reason for the limit; empty if it is unknown. */
    limitReason: string;
    /** Deflection of the point in meters. */
    deflection: number;
}

export class PullTool {
    private point: SurfacePoint | null = null;
    private anchor: Vec3 = [0, 0, 0];
    private cursor: [number, number] = [0, 0];
    /** Null without a pull, or if the compliance is unknown. */
    private compliance: PointCompliance | null = null;
    private isPressed = false;
    /** Number of presses, so that the pick of an earlier one is ignored. */
    private presses = 0;
    private isSending = false;
    /** Whether the force has changed while the previous one is on its way. */
    private hasNewer = false;
    private readonly owner = crypto.getRandomValues(new Uint8Array(32));
    private timer: ReturnType<typeof setInterval> | null = null;
    /** The owner number of this viewer's forces in StreamForces; 0 before it has sent any. */
    ownerNumber = 0n;
    onChange: () => void = () => {};
    /** A sentence for the user; empty to remove it. */
    onMessage: (message: string) => void = () => {};

    constructor(
        private readonly server: Server,
        private readonly model: SceneModel,
        private readonly camera: OrbitCamera,
        private readonly diagonal: number,
        private readonly deflections: Deflections | null,
    ) {}

    /** The point that the user pulls, if any. */
    get grabbed(): SurfacePoint | null {
        return this.point;
    }

    /** The line to draw while the user pulls; null otherwise. */
    get view(): PullView | null {
        if (!this.point || !this.isPressed) return null;
        const from = positionOf(this.model, this.point);
        const to = this.camera.unproject(...this.cursor, this.anchor);
        const newtons = norm(this.force(to));
        const limit = this.compliance?.limit(subtract(to, this.anchor)) ?? null;
        const isLimited = limit !== null && newtons > 0.999 * limit;
        const limitReason = this.compliance?.limitReason ?? "";
        return { from, to, newtons, limit, isLimited, limitReason, deflection: deflectionAt(this.model, this.point) };
    }

    /** Starts a pull at a pixel of the viewport, which has `size` (width and height) pixels. */
    async begin(x: number, y: number, size: [number, number]): Promise<void> {
        this.end();
        this.isPressed = true;
        const press = ++this.presses;
        this.cursor = [x, y];
        try {
            const pixel = [x, y].map((value, axis) => Math.min(Math.max(Math.floor(value), 0), at(size, axis) - 1));
            const picked = await this.server.pick(
                this.model.scene.info.scene,
                size,
                this.camera.toMessage(),
                at(pixel, 0),
                at(pixel, 1),
            );
            const hit = picked.hits[0];
            if (!this.isPressed || press !== this.presses) return;
            if (!hit) {
                this.onMessage("There is no surface to pull at this point.");
                return;
            }
            this.grab(hit);
        } catch (error) {
            this.onMessage(`The server could not pick a point: ${error instanceof Error ? error.message : error}`);
        }
    }

    move(x: number, y: number): void {
        this.cursor = [x, y];
        if (this.point) void this.sendForces();
    }

    /** Removes the force. */
    end(): void {
        if (!this.isPressed) return;
        this.isPressed = false;
        if (this.timer !== null) clearInterval(this.timer);
        this.timer = null;
        const wasPulling = this.point !== null;
        this.point = null;
        if (wasPulling) void this.sendForces();
        this.onChange();
    }

    private grab(hit: Hit): void {
        const { model } = this;
        this.point =
            jointPoint(model, hit.domain) ??
            surfacePoint(model, hit.domain, hit.triangle, hit.barycentric) ??
            this.pointOf(hit);
        this.anchor = positionOf(this.model, this.point);
        this.compliance = pointCompliance(model, this.point, this.deflections, this.diagonal);
        // The renewal follows a camera that has moved, too.
        this.timer = setInterval(() => void this.sendForces(), RENEWAL_MS);
        void this.sendForces();
        this.onChange();
    }

    /** The point of a hit if the viewer has no arrays: x0 follows from the hit's position and the current state. */
    private pointOf(hit: Hit): SurfacePoint {
        const { domain, triangle, barycentric } = hit;
        const modes = toF32(hit.modes, "hit.modes");
        const point: SurfacePoint = { domain, triangle, barycentric, rest: [0, 0, 0], modes };
        const transform = this.model.state.transforms.subarray(TRANSFORM_SIZE * domain, TRANSFORM_SIZE * (domain + 1));
        const translation: Vec3 = [at(transform, 3), at(transform, 7), at(transform, 11)];
        const local = solveLinear(transform, subtract(hit.position as Vec3, translation)) ?? [0, 0, 0];
        point.rest = subtract(local, displacementAt(this.model, point));
        return point;
    }

    private force(to: Vec3): Vec3 {
        const offset = subtract(to, this.anchor);
        const stiffness = this.compliance?.stiffness ?? DEFAULT_FORCE / this.diagonal;
        const limit = this.compliance?.limit(offset) ?? stiffness * LONGEST_PULL * this.diagonal;
        const newtons = stiffness * norm(offset);
        const factor = newtons > limit ? (stiffness * limit) / newtons : stiffness;
        return offset.map((component) => factor * component) as Vec3;
    }

    /** Sends the present force. One call at a time: while it is on its way, only the newest force waits. */
    private async sendForces(): Promise<void> {
        this.hasNewer = true;
        if (this.isSending) return;
        this.isSending = true;
        while (this.hasNewer) {
            this.hasNewer = false;
            await this.send(this.point ? [this.message(this.point)] : []);
        }
        this.isSending = false;
    }

    private message({ domain, triangle, barycentric }: SurfacePoint): SurfaceForceMessage {
        const vector = this.force(this.camera.unproject(...this.cursor, this.anchor));
        return { id: 1n, domain, triangle, barycentric: [...barycentric], vector };
    }

    private async send(forces: SurfaceForceMessage[]): Promise<void> {
        const { scene } = this.model.scene.info;
        try {
            const response = await this.server.applyForces(scene, this.owner, forces, LIFETIME_MS);
            this.ownerNumber = response.owner;
            // After a pull, its message stays for the user to read.
            if (forces.length === 0) return;
            // If the reason is known, the page shows it already.
            const isLost = response.receivers === 0 && !this.model.receiverError;
            this.onMessage(isLost ? pullProblem(this.model.scene, "", globalThis.location?.origin ?? "") : "");
        } catch (error) {
            this.onMessage(`The server did not accept the force: ${error instanceof Error ? error.message : error}`);
        }
    }
}

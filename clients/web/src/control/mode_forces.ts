/**
 * Holds modes at deflections by constant forces on their coordinates, while a physics process moves the scene. With
 * U^T M U = I, the modal stiffnesses are the eigenvalues, so f_q = eigenvalue * q holds a mode at q.
 *
 * A sudden force would let a mode with little damping swing to twice the deflection for seconds. The force therefore
 * follows the set values smoothly: it is their average, weighted by a Hann window. A window of two or more whole periods
 * of a mode excites no vibration with this period.
 */

import { eigenvaluesOf, hertzOf, largestRigidEigenvalue } from "../scene/description";
import { at } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import type { ModalForceMessage, Server } from "../source/server";

/** Milliseconds between two forces while they change, between renewals, and until the server removes them. */
const CHANGE_MS = 33;
const RENEWAL_MS = 500;
const LIFETIME_MS = 2500;
/** Milliseconds between two questions whether a physics process receives forces, while no mode is held. */
const PROBE_MS = 2000;
/** Shortest and longest window in milliseconds. On a busy page, the forces of a short one would change in large steps. */
const SHORTEST_WINDOW_MS = 900;
const LONGEST_WINDOW_MS = 4000;
/** Forces that an owner may have, see ForceService. Each holds the modes of one domain. */
const MAX_FORCES = 16;

/** Milliseconds over which the set values of a mode are averaged: periods of the mode as they are seen. */
export function averagingWindow(hertz: number, timeScale: number): number {
    const period = 1000 / (hertz * timeScale);
    if (!(period > 0) || !Number.isFinite(period)) return SHORTEST_WINDOW_MS;
    return Math.min(LONGEST_WINDOW_MS, period * Math.max(2, Math.ceil(SHORTEST_WINDOW_MS / period)));
}

/** The weighted average of a piecewise constant value over the last milliseconds. The value is 0 at first. */
export class MovingAverage {
    /** The values and the times from which on they hold, ascending. */
    private changes: { time: number; value: number }[] = [{ time: -Infinity, value: 0 }];
    window = SHORTEST_WINDOW_MS;

    get target(): number {
        return this.changes.at(-1)?.value ?? 0;
    }

    set(value: number, now: number): void {
        if (value !== this.target) this.changes.push({ time: now, value });
    }

    at(now: number): number {
        const start = now - this.window;
        while ((this.changes[1]?.time ?? Infinity) <= start) this.changes.shift();
        // The integral of the Hann window from its start, as a part of the whole.
        const part = (time: number) => {
            const x = Math.max(0, (time - start) / this.window);
            return x - Math.sin(2 * Math.PI * x) / (2 * Math.PI);
        };
        return this.changes.reduce((sum, { time, value }, place) => {
            const next = this.changes[place + 1]?.time ?? now;
            return sum + value * (part(next) - part(time));
        }, 0);
    }

    /** Whether the average is the last set value. */
    isSettled(now: number): boolean {
        return (this.changes.at(-1)?.time ?? -Infinity) <= now - this.window;
    }
}

export class ModeForces {
    private readonly held = new Map<number, MovingAverage[]>();
    private readonly owner = crypto.getRandomValues(new Uint8Array(32));
    private readonly timer: ReturnType<typeof setInterval>;
    private isSending = false;
    private lastSent = -Infinity;
    /** The owner number of these forces in StreamForces; 0 without forces. */
    ownerNumber = 0n;
    /** Whether a physics process receives forces; null before the first reply. */
    hasReceiver: boolean | null = null;
    /** Whether to ask for receivers while no mode is held. */
    probes = false;
    /** Seconds of the simulation per second of real time. */
    timeScale = 1;
    onMessage: (message: string) => void = () => {};

    constructor(
        private readonly server: Pick<Server, "applyForces">,
        private readonly model: SceneModel,
    ) {
        this.timer = setInterval(() => void this.tick(performance.now()), CHANGE_MS);
    }

    /** Whether a force can hold a mode: it has stiffness. */
    canHold(domain: number, mode: number): boolean {
        const eigenvalues = eigenvaluesOf(this.model.scene, domain);
        return (eigenvalues[mode] ?? 0) > largestRigidEigenvalue(eigenvalues);
    }

    /** The coordinate at which a mode is held; 0 if it is not held. */
    target(domain: number, mode: number): number {
        return this.held.get(domain)?.[mode]?.target ?? 0;
    }

    get isHolding(): boolean {
        return this.held.size > 0;
    }

    /** Holds a mode at q. */
    set(domain: number, mode: number, q: number): void {
        if (!this.canHold(domain, mode)) return;
        let modes = this.held.get(domain);
        if (!modes) {
            if (this.held.size >= MAX_FORCES)
                return this.onMessage(`At most ${MAX_FORCES} parts can be held at a time: set the others to 0.`);
            modes = eigenvaluesOf(this.model.scene, domain).map(() => new MovingAverage());
            this.held.set(domain, modes);
        }
        const average = modes[mode];
        if (!average) return;
        const hertz = hertzOf(this.model.scene, domain, mode);
        average.window = averagingWindow(hertz, this.timeScale);
        average.set(q, performance.now());
    }

    /** Releases all modes of a domain. The forces end after the averaging. */
    reset(domain: number): void {
        const now = performance.now();
        for (const average of this.held.get(domain) ?? []) average.set(0, now);
    }

    /** Forgets all forces, for example because another program controls the scene. They expire on the server. */
    clear(): void {
        this.held.clear();
        this.hasReceiver = null;
        this.ownerNumber = 0n;
    }

    dispose(): void {
        clearInterval(this.timer);
        if (this.isHolding) void this.send([]);
        this.held.clear();
    }

    private async tick(now: number): Promise<void> {
        if (this.isSending) return;
        const isMoving = [...this.held.values()].some((modes) => modes.some((average) => !average.isSettled(now)));
        const pause = isMoving ? 0 : this.isHolding ? RENEWAL_MS : PROBE_MS;
        if (now - this.lastSent < pause || !(this.isHolding || this.probes)) return;
        for (const [domain, modes] of this.held) {
            if (modes.every((average) => average.target === 0 && average.isSettled(now))) this.held.delete(domain);
        }
        this.lastSent = now;
        this.isSending = true;
        await this.send([...this.held.keys()].map((domain) => this.message(domain, now)));
        this.isSending = false;
    }

    private message(domain: number, now: number): ModalForceMessage {
        const eigenvalues = eigenvaluesOf(this.model.scene, domain);
        const values = new Float32Array(at(this.model.layout.ranks, domain));
        this.held.get(domain)?.forEach((average, mode) => {
            if (mode < values.length) values[mode] = at(eigenvalues, mode) * average.at(now);
        });
        return { id: BigInt(domain), domain, fQ: new Uint8Array(values.buffer) };
    }

    private async send(forces: ModalForceMessage[]): Promise<void> {
        try {
            const { scene } = this.model.scene.info;
            const response = await this.server.applyForces(scene, this.owner, forces, LIFETIME_MS);
            this.ownerNumber = response.owner;
            this.hasReceiver = response.receivers > 0;
            this.onMessage("");
        } catch (error) {
            if (forces.length === 0) return;
            this.onMessage(`The server did not accept the force: ${error instanceof Error ? error.message : error}`);
        }
    }
}

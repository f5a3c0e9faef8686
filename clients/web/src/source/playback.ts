/** Plays a recording: delivers its messages to a scene at their times. */

import { norm, type Vec3 } from "../scene/affine";
import { lowestHertz } from "../scene/description";
import type { SceneModel } from "../scene/scene_model";
import { slowFactor } from "../scene/time_scale";
import type { RecordedState, Recording } from "./recording";

export class Playback {
    isPlaying = false;
    /** Recorded per real seconds. The initial speed makes the lowest frequency visible. */
    speed: number;
    loops = true;
    /** Seconds since the first state. */
    time = 0;
    /** Index of the state that is shown; -1 before the first one. */
    private shown = -1;
    private lastTick = 0;
    onChange: () => void = () => {};

    constructor(
        private readonly recording: Recording,
        private readonly model: SceneModel,
    ) {
        this.speed = 1 / slowFactor(lowestHertz(recording.scene));
    }

    get duration(): number {
        return this.recording.states.at(-1)?.time ?? 0;
    }

    /** Seconds of the first recorded force; null if there is none. */
    get firstForce(): number | null {
        return this.recording.forces.find(({ message }) => message.forces.length > 0)?.time ?? null;
    }

    /** Newtons of the largest recorded force on the surface. */
    get largestForce(): number {
        const forces = this.recording.forces.flatMap(({ message }) => message.forces);
        return forces.reduce((largest, { force }) => {
            const newtons = force?.kind.case === "surface" ? norm(force.kind.value.vector as Vec3) : 0;
            return Math.max(largest, newtons);
        }, 0);
    }

    play(): void {
        if (this.time >= this.duration) this.seek(0);
        this.isPlaying = true;
        this.lastTick = performance.now();
        requestAnimationFrame(() => this.tick());
        this.onChange();
    }

    pause(): void {
        this.isPlaying = false;
        this.onChange();
    }

    toggle(): void {
        if (this.isPlaying) this.pause();
        else this.play();
    }

    /** Shows the next state, or the previous one. */
    step(direction: number): void {
        this.pause();
        const { states } = this.recording;
        const index = Math.max(0, Math.min(states.length - 1, this.shown + Math.sign(direction)));
        this.time = states[index]?.time ?? 0;
        this.show(index);
    }

    /** Shows the last state at or before a time in seconds. */
    seek(time: number): void {
        this.time = Math.max(0, Math.min(this.duration, time));
        this.show(lastIndexAt(this.recording.states, this.time));
    }

    private tick(): void {
        if (!this.isPlaying) return;
        const now = performance.now();
        let time = this.time + ((now - this.lastTick) / 1000) * this.speed;
        this.lastTick = now;
        if (time >= this.duration) {
            if (this.loops && this.duration > 0) time %= this.duration;
            else {
                this.seek(this.duration);
                return this.pause();
            }
        }
        this.seek(time);
        requestAnimationFrame(() => this.tick());
    }

    private show(index: number): void {
        const { states } = this.recording;
        if (index !== this.shown) {
            // A state has only what differs from the previous state, so begin at a complete one after a jump.
            let first = this.shown + 1;
            const complete = lastComplete(states, index);
            if (index < this.shown || complete > first) first = complete;
            for (let i = first; i <= index; i++) {
                for (const message of states[i]?.messages ?? []) this.model.receiveState(message);
            }
            this.shown = index;
            this.showForces(states[index]?.time ?? 0);
        }
        this.onChange();
    }

    private showForces(time: number): void {
        const forces = this.recording.forces;
        const index = lastIndexAt(forces, time);
        const message = time >= (forces[0]?.time ?? Infinity) ? forces[index]?.message : undefined;
        if (message) this.model.receiveForces(message);
        else if (this.model.forces.length > 0) this.model.clearForces();
    }
}

/** Index of the last entry at or before a time; 0 if there is none. */
export function lastIndexAt(entries: readonly { time: number }[], time: number): number {
    let low = 0;
    let high = entries.length;
    while (low < high) {
        const middle = (low + high) >> 1;
        if ((entries[middle]?.time ?? Infinity) <= time) low = middle + 1;
        else high = middle;
    }
    return Math.max(0, low - 1);
}

/** Index of the last complete state at or before an index. */
export function lastComplete(states: readonly RecordedState[], index: number): number {
    let complete = index;
    while (complete > 0 && !states[complete]?.isComplete) complete--;
    return complete;
}

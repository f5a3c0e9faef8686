/** Measures how fast the time of a simulation passes, from the times of its steps and their arrival. */

import type { StepId } from "../proto/modalcast/v1/common_pb";
import { niceAbove, niceBelow } from "./nice_numbers";

/** Steps of the last milliseconds are measured. */
const WINDOW_MS = 10_000;
/** At most one step in this many milliseconds is remembered. */
const INTERVAL_MS = 50;
/** Shortest time that gives a result. */
const SHORTEST_MS = 1000;
/** A ratio is shown for this many milliseconds after it has become unknown. */
const RECENT_MS = 4000;
/** After a pause of this many milliseconds the measurement begins again. */
const LONGEST_PAUSE_MS = 1000;

/**
 * Vibrations of at most the first frequency in hertz need no slow motion. Faster ones are shown at about the second.
 */
const FASTEST_SHOWN_HERTZ = 5;
const SLOW_HERTZ = 2;

/**
 * Slow motion factor that makes a vibration of `hertz` visible, in real per simulated seconds: 1, or the nearest number
 * 1, 2 or 5 times a power of ten. `modalcast view` selects the same factor for a model.
 */
export function slowFactor(hertz: number): number {
    if (!(hertz > FASTEST_SHOWN_HERTZ)) return 1;
    const factor = hertz / SLOW_HERTZ;
    const [lower, upper] = [niceBelow(factor), niceAbove(factor)];
    return factor / lower < upper / factor ? lower : upper;
}

interface Arrival {
    /** Milliseconds of real time. */
    now: number;
    /** Seconds of the simulation. */
    time: number;
}

export class TimeScale {
    private arrivals: Arrival[] = [];
    private last: Arrival | null = null;
    private run = 0n;
    private recent: { ratio: number; now: number; run: bigint } | null = null;

    /** Adds a step that has arrived at `now`, in milliseconds. */
    add(step: StepId, now: number): void {
        const { last } = this;
        const continues = last && step.run === this.run && step.time >= last.time && !this.hasPaused(now);
        if (!continues) this.arrivals = [];
        this.run = step.run;
        this.last = { now, time: step.time };
        const newest = this.arrivals.at(-1);
        if (!newest || now - newest.now >= INTERVAL_MS) this.arrivals.push(this.last);
        const oldest = this.arrivals.findIndex((arrival) => now - arrival.now <= WINDOW_MS);
        if (oldest > 0) this.arrivals.splice(0, oldest);
    }

    /** Seconds of the simulation per second of real time; null if it is unknown at `now`, or the simulation pauses. */
    ratio(now: number): number | null {
        const { arrivals } = this;
        const elapsed = (arrivals.at(-1)?.now ?? 0) - (arrivals[0]?.now ?? 0);
        if (elapsed < SHORTEST_MS || this.hasPaused(now)) return null;
        // The median of ratios over half of the window, because a busy page receives some steps late.
        const half = arrivals.length >> 1;
        const ratios = arrivals.slice(half).map((arrival, place) => {
            const earlier = arrivals[place] ?? arrival;
            return (1000 * (arrival.time - earlier.time)) / (arrival.now - earlier.now);
        });
        const median = ratios.sort((a, b) => a - b)[ratios.length >> 1] ?? 0;
        return median > 0 && Number.isFinite(median) ? median : null;
    }

    /**
     * The ratio, or the last one of the same run for some seconds: a busy page receives steps with pauses, after which
     * the measurement begins again.
     */
    recentRatio(now: number): number | null {
        const ratio = this.ratio(now);
        if (ratio !== null) this.recent = { ratio, now, run: this.run };
        const { recent } = this;
        return recent && recent.run === this.run && now - recent.now <= RECENT_MS ? recent.ratio : null;
    }

    private hasPaused(now: number): boolean {
        return this.last !== null && now - this.last.now > LONGEST_PAUSE_MS;
    }
}

/** The end of a scale that fits the shown values without flickering. */

import { fineAbove, niceAbove } from "./nice_numbers";

/**
 * The scale shrinks to fit the values of the last two windows of this many milliseconds. Two windows contain both
 * extremes of a vibration of 0.4 Hz or more.
 */
const WINDOW_MS = 1500;

/** The scale shrinks only to an end that the values may exceed by this factor, so that it does not grow again soon. */
const MARGIN = 1.1;

/** Smallest end as a fraction of the size of a body, as on the server. A smaller scale would show rounding errors. */
const SMALLEST = 1e-5;

export class FittedRange {
    /** A round number. */
    end: number;
    private readonly smallest: number;
    /** The largest values of the previous window and of the current one. */
    private previous = 0;
    private current = 0;
    private windowStart = -Infinity;

    /** @param size Of the body, in the unit of the values. */
    constructor(size: number) {
        this.smallest = niceAbove(SMALLEST * size);
        this.end = this.smallest;
    }

    /** Adds a value at a time in milliseconds. Returns whether the end has changed. */
    update(value: number, now: number): boolean {
        const before = this.end;
        this.current = Math.max(this.current, value);
        this.end = Math.max(this.end, fineAbove(value));
        if (now - this.windowStart >= WINDOW_MS) {
            const fitting = fineAbove(MARGIN * Math.max(this.previous, this.current));
            // It does not shrink after the first value or a pause, because such a window has few values.
            if (now - this.windowStart < 2 * WINDOW_MS) this.end = Math.max(this.smallest, Math.min(this.end, fitting));
            this.previous = this.current;
            this.current = value;
            this.windowStart = now;
        }
        return this.end !== before;
    }
}

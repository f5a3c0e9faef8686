/** The largest of the recent values, such as the amplitude of a vibration. */

/** The peak is that of the current and the previous window of this many milliseconds. */
const WINDOW_MS = 1500;

export class RecentPeak {
    private previous = 0;
    private current = 0;
    private windowStart = -Infinity;

    /** Adds a value at a time in milliseconds. Returns the peak. */
    add(value: number, now: number): number {
        const elapsed = now - this.windowStart;
        if (elapsed >= WINDOW_MS) {
            this.previous = elapsed < 2 * WINDOW_MS ? this.current : 0;
            this.current = 0;
            this.windowStart = now;
        }
        this.current = Math.max(this.current, value);
        return Math.max(this.previous, this.current);
    }
}

/** Sum of values per second, over the last second. */
export class RateMeter {
    private samples: { time: number; value: number }[] = [];

    add(value: number): void {
        this.samples.push({ time: performance.now(), value });
        if (this.samples.length > 4096) this.trim();
    }

    perSecond(): number {
        this.trim();
        return this.samples.reduce((sum, sample) => sum + sample.value, 0);
    }

    private trim(): void {
        const limit = performance.now() - 1000;
        this.samples = this.samples.filter((sample) => sample.time > limit);
    }
}

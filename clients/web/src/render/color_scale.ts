/** The value at the bright end of the color map, which fits the shown values (see FittedRange). */

import type { Deflections } from "../scene/deflection";
import { FittedRange } from "../scene/fitted_range";
import type { ColorChoice } from "./scene_renderer";

/** Milliseconds between two evaluations of the largest deflection, which takes up to 5 ms. */
const INTERVAL_MS = 50;

export class ColorScale {
    private color: ColorChoice = { kind: "shaded" };
    private range: FittedRange;
    private modeEnd = 0;
    private lastUpdate = -Infinity;

    /**
     * @param deflections Null if the viewer has no U. The end is then unknown.
     * @param size Size of the scene in meters.
     */
    constructor(
        private readonly deflections: Deflections | null,
        private readonly size: number,
    ) {
        this.range = new FittedRange(size);
    }

    /** Meters for deflections, and meters per unit of q for the shape of a mode; 0: unknown. */
    get end(): number {
        if (!this.deflections || this.color.kind === "shaded") return 0;
        return this.color.kind === "mode" ? this.modeEnd : this.range.end;
    }

    /** Selects what is shown. The same choice as before keeps its range. */
    select(color: ColorChoice, now: number): void {
        if (color === this.color) return;
        this.color = color;
        if (color.kind === "mode") this.modeEnd = this.deflections?.largestOfMode(color.mode) ?? 0;
        this.range = new FittedRange(this.size);
        this.lastUpdate = -Infinity;
        this.update(now);
    }

    /** Fits the end to the current state, at a time in milliseconds. Returns whether it has changed. */
    update(now: number): boolean {
        if (!this.deflections || this.color.kind !== "displacement" || now - this.lastUpdate < INTERVAL_MS)
            return false;
        this.lastUpdate = now;
        return this.range.update(this.deflections.largestOfScene(), now);
    }
}

/** A bar with a length of the scene that is 1, 2 or 5 times a power of ten, as on a map. */

import { niceBelow } from "../scene/nice_numbers";
import { byId, h, setText } from "./dom";
import * as format from "./format";

/** Largest length of the bar in pixels. */
const MAX_PIXELS = 110;

export interface ScaleLength {
    meters: number;
    pixels: number;
}

/** The longest bar of at most `maxPixels`; null if lengths of the scene are unknown. */
export function scaleLength(metersPerPixel: number, maxPixels: number): ScaleLength | null {
    const meters = niceBelow(metersPerPixel * maxPixels);
    return meters > 0 ? { meters, pixels: meters / metersPerPixel } : null;
}

export class ScaleBar {
    private readonly bar = h("i");
    private readonly text = h("span");
    private readonly element: HTMLElement;

    constructor() {
        this.element = h("div", {
            id: "scale-bar",
            className: "card",
            hidden: true,
            title: "Length at the center of the view",
        });
        this.element.append(this.text, this.bar);
        byId("dock").prepend(this.element);
    }

    /** @param metersPerPixel At the center of the view. */
    draw(metersPerPixel: number): void {
        const length = scaleLength(metersPerPixel, MAX_PIXELS);
        this.element.hidden = length === null;
        if (!length) return;
        setText(this.text, format.meters(length.meters));
        this.bar.style.width = `${length.pixels}px`;
    }
}

/** Light and displayed colors. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { lightOf } from "../src/render/lighting";

/** The tone curve of the shaders. */
function displayed(light: number, exposure: number, tone: number): number {
    let value = Math.min(light * exposure, 65504);
    if (tone === 1) value = value / (1 + value);
    if (tone === 2) value = (value * (2.51 * value + 0.03)) / (value * (2.43 * value + 0.59) + 0.14);
    return Math.min(value, 1);
}

test("the tone curve displays the light of a color as this color", () => {
    for (const tone of [0, 1, 2]) {
        for (const exposure of [0.5, 1, 3]) {
            for (const color of [0, 0.2, 0.87, 1]) {
                const shown = displayed(lightOf(color, { exposure, tone }), exposure, tone);
                assert.ok(Math.abs(shown - color) < 1e-4, `expected ${color} with tone curve ${tone}, got ${shown}`);
            }
        }
    }
});

/** The length of the scale bar. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { meters } from "../src/ui/format";
import { scaleLength } from "../src/ui/scale_bar";

test("a scale bar has a length of 1, 2 or 5 times a power of ten", () => {
    const texts = [2e-4, 3.7e-4, 1e-3, 0.12, 4.6e-8, 55].map((metersPerPixel) => {
        const length = scaleLength(metersPerPixel, 100);
        assert.ok(length);
        assert.ok(Math.abs(length.pixels * metersPerPixel - length.meters) < 1e-12 * length.meters);
        // The next shorter length is at least 40 % of a length.
        assert.ok(length.pixels > 39.9 && length.pixels <= 100 + 1e-6, `${length.pixels} pixels`);
        return meters(length.meters);
    });
    assert.deepEqual(texts, ["20 mm", "20 mm", "100 mm", "10 m", "2 µm", "5000 m"]);
});

test("there is no scale bar without a scale", () => {
    assert.equal(scaleLength(0, 100), null);
    assert.equal(scaleLength(Number.NaN, 100), null);
});

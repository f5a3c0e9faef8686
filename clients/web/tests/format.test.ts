/** Numbers for people. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { frequency } from "../src/ui/format";

test("a frequency has at most four digits before its unit", () => {
    const texts = [0.25, 206.1, 1265, 12_651, 1.5e6].map(frequency);
    assert.deepEqual(texts, ["0.25 Hz", "206 Hz", "1270 Hz", "12.7 kHz", "1.5 MHz"]);
});

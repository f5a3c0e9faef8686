/** Numbers for people. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { frequency, seconds, timeScale } from "../src/ui/format";

test("a frequency has at most four digits before its unit", () => {
    const texts = [0.25, 206.1, 1265, 12_651, 1.5e6].map(frequency);
    assert.deepEqual(texts, ["0.25 Hz", "206 Hz", "1270 Hz", "12.7 kHz", "1.5 MHz"]);
});

test("a time scale is a fraction or a multiple of real time", () => {
    const texts = [1.02, 0.01003, 1 / 2000, 0.0129, 0.8, 12.1].map(timeScale);
    assert.deepEqual(texts, [
        "real time",
        "1/100 of real time",
        "1/2000 of real time",
        "1/78 of real time",
        "0.8x real time",
        "12x real time",
    ]);
});

test("times of slow motion are in milliseconds or microseconds", () => {
    const texts = [seconds(12.345), seconds(0), seconds(0.0125), seconds(2e-5), seconds(0.02, 4), seconds(0, 0.1)];
    assert.deepEqual(texts, ["12.35 s", "0.00 s", "12.5 ms", "20.0 µs", "0.02 s", "0.0 ms"]);
});

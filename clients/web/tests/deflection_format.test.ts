import assert from "node:assert/strict";
import { test } from "node:test";
import { limitedNewtons, signedMeters, speed } from "../src/ui/format";

test("a deflection has a sign and a unit that fits", () => {
    const texts = [0.0026, -0.00013, 0, 1.5, -2.5e-8].map(signedMeters);
    assert.deepEqual(texts, ["+2.6 mm", "−130 µm", "0", "+1.5 m", "−25 nm"]);
});

test("a force names its limit or says that it is unknown", () => {
    assert.equal(limitedNewtons(120, 380.4), "120 N of at most 380 N");
    assert.equal(limitedNewtons(120, null), "120 N, limit unknown");
    assert.equal(limitedNewtons(0, Infinity), "0 N");
});

test("a selected speed is a fraction or a multiple of real time", () => {
    assert.deepEqual([0.001, 1 / 200, 0.25, 1, 4].map(speed), ["1/1000", "1/200", "1/4", "1x", "4x"]);
});

import assert from "node:assert/strict";
import { test } from "node:test";
import { FittedRange } from "../src/scene/fitted_range";

/** The ends of a range of a body of size 0.1 while `value` is shown for some seconds from `start` on, 20 times a second. */
function run(range: FittedRange, start: number, seconds: number, value: (time: number) => number): number[] {
    return Array.from({ length: 20 * seconds }, (_, frame) => {
        const time = start + frame / 20;
        range.update(value(time), 1000 * time);
        return range.end;
    });
}

test("the range of a body at rest is a small fraction of its size", () => {
    const range = new FittedRange(0.1);
    assert.equal(range.end, 1e-6);
    assert.ok(run(range, 0, 10, () => 0).every((end) => end === 1e-6));
});

test("the range grows at once and shrinks later", () => {
    const range = new FittedRange(0.1);
    assert.equal(range.update(0.0031, 0), true);
    assert.equal(range.end, 0.004);
    assert.equal(range.update(0.0031, 50), false);
    const ends = run(range, 0.1, 6, () => 0.0004);
    assert.equal(ends[0], 0.004);
    assert.equal(ends.at(-1), 0.0005);
    const shrunk = ends.findIndex((end) => end < 0.004) / 20;
    assert.ok(shrunk >= 2.5 && shrunk <= 5, `expected to shrink after 3 to 4.5 s, got ${shrunk} s`);
});

test("the range of a vibration does not flicker", () => {
    const range = new FittedRange(0.1);
    const ends = run(range, 0, 20, (time) => 0.0031 * Math.abs(Math.sin(2 * Math.PI * 0.6 * time)));
    const changes = ends.slice(20).filter((end, frame) => frame > 0 && end !== ends[19 + frame]).length;
    assert.equal(changes, 0);
    // Around a nice number, the range grows once.
    const near = new FittedRange(0.1);
    const amplitudes = run(near, 0, 30, (time) => 0.002 * (1 + 0.02 * Math.sin(0.7 * time)));
    assert.equal(new Set(amplitudes.slice(10)).size, 1);
    assert.equal(near.end, 0.0025);
});

test("the range of a decaying vibration fits it", () => {
    const range = new FittedRange(0.1);
    const amplitude = (time: number) => 0.01 * 0.8 ** time;
    run(range, 0, 25, (time) => amplitude(time) * Math.abs(Math.sin(7 * time)));
    // The amplitude of 4 s before.
    assert.ok(range.end >= amplitude(25) && range.end <= (4 / 3) * 1.1 * amplitude(20), `${range.end}`);
});

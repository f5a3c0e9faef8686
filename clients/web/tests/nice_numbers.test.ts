import assert from "node:assert/strict";
import { test } from "node:test";
import { fineAbove, niceAbove, niceBelow } from "../src/scene/nice_numbers";

test("nice numbers are 1, 2 and 5 times a power of ten", () => {
    const values = [1, 1.01, 2, 3.3, 5.1, 9.99, 0.0049, 0.013, 123_456, 2e-9, 0.1 + 0.2];
    assert.deepEqual(values.map(niceAbove), [1, 2, 2, 5, 10, 10, 0.005, 0.02, 200_000, 2e-9, 0.5]);
    assert.deepEqual(values.map(niceBelow), [1, 1, 2, 2, 5, 5, 0.002, 0.01, 100_000, 2e-9, 0.2]);
    for (const value of [0, -1, Number.NaN, Infinity]) assert.deepEqual([niceAbove(value), niceBelow(value)], [0, 0]);
});

test("the ends of scales are at most 4/3 of the largest value", () => {
    const values = [0.0112, 1, 1.21, 1.9, 2.6, 3.1, 6.5, 8.1, 3e-7, 0];
    assert.deepEqual(values.map(fineAbove), [0.012, 1, 1.5, 2, 3, 4, 8, 10, 3e-7, 0]);
    for (let value = 1; value < 10; value += 0.01) {
        const end = fineAbove(value);
        assert.ok(end >= value * (1 - 1e-9) && end <= (4 / 3) * value * (1 + 1e-9), `${value}: ${end}`);
    }
    // Control: the coarse steps.
    assert.equal(niceAbove(0.0112), 0.02);
});

test("a nice number is not changed by rounding", () => {
    // 0.3 / 3 is 0.09999999999999999, and 3 * 0.1 / 3 may be above 0.1.
    assert.equal(niceBelow(0.3 / 3), 0.1);
    assert.equal(niceAbove(0.1 * (1 + 1e-15)), 0.1);
    assert.equal(niceAbove(0.1 * (1 + 1e-6)), 0.2);
});

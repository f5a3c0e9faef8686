import assert from "node:assert/strict";
import { test } from "node:test";
import {
    displacementBound,
    errorBound,
    fromF16,
    modeGroups,
    packModes,
    relativeError,
    toF16,
} from "../src/scene/packed_modes";

const VERTICES = 200;
const RANK = 6;

/** Pseudo-random numbers from -1 to 1 (a linear congruential generator). */
function randomNumbers(count: number, seed: number): Float32Array {
    let state = seed;
    return Float32Array.from({ length: count }, () => {
        state = (1664525 * state + 1013904223) >>> 0;
        return state / 2 ** 31 - 1;
    });
}

/** U whose columns differ by six orders of magnitude. */
function modes(): Float32Array {
    return randomNumbers(3 * VERTICES * RANK, 7).map((value, entry) => value * 10 ** ((entry % RANK) - 3));
}

/** U q of a vertex from the packed texels, as the shader computes it. */
function unpack(packed: ReturnType<typeof packModes>, q: Float32Array, vertex: number): number[] {
    const groups = modeGroups(RANK);
    return [0, 1, 2].map((component) => {
        let sum = 0;
        for (let mode = 0; mode < RANK; mode++) {
            const code =
                packed.texels[4 * ((vertex * groups + (mode >> 2)) * 3 + component) + (mode & 3)] ?? Number.NaN;
            sum += (packed.format === "f16" ? fromF16(code) : code) * (packed.scales[mode] ?? 0) * (q[mode] ?? 0);
        }
        return sum;
    });
}

test("f16 numbers are rounded to nearest, ties to even", () => {
    const cases: [number, number][] = [
        [0, 0],
        [1, 0x3c00],
        [-0.5, 0xb800],
        [1 + 2 ** -11, 0x3c00],
        [1 + 3 * 2 ** -11, 0x3c02],
        [1 - 2 ** -12, 0x3c00],
        [2 ** -14, 0x0400],
        [2 ** -24, 1],
        [2 ** -25, 0],
        [3 * 2 ** -25, 2],
        [2 ** -30, 0],
        [2 ** -14 - 2 ** -25, 0x0400],
    ];
    for (const [value, expected] of cases) assert.equal(toF16(value), expected, `${value}`);
    for (let half = 0; half < 0x3c00; half += 7) assert.equal(toF16(fromF16(half)), half);
});

for (const format of ["f16", "i16"] as const) {
    test(`the bound of ${format} holds for U q at every vertex, and is not loose`, () => {
        const values = modes();
        const packed = packModes(values, VERTICES, RANK, format);
        let worst = 0;
        for (let round = 0; round < 20; round++) {
            const q = randomNumbers(RANK, 100 + round);
            const bound = errorBound(packed, q);
            for (let vertex = 0; vertex < VERTICES; vertex++) {
                const stored = unpack(packed, q, vertex);
                const exact = [0, 1, 2].map((component) => {
                    let sum = 0;
                    for (let mode = 0; mode < RANK; mode++)
                        sum += (values[(3 * vertex + component) * RANK + mode] ?? 0) * (q[mode] ?? 0);
                    return sum;
                });
                const error = Math.hypot(...stored.map((value, component) => value - (exact[component] ?? 0)));
                const rounding = 1e-12 * displacementBound(packed, q);
                assert.ok(error <= bound + rounding, `vertex ${vertex}: expected at most ${bound}, got ${error}`);
                worst = Math.max(worst, error / bound);
                assert.ok(Math.hypot(...exact) <= displacementBound(packed, q) * (1 + 1e-12));
            }
        }
        assert.ok(worst > 0.3, `expected an error near the bound, got ${worst} of it`);
    });
}

test("integers store U more precisely than f16", () => {
    const values = modes();
    const [integers, halves] = (["i16", "f16"] as const).map((format) =>
        relativeError(packModes(values, VERTICES, RANK, format)),
    );
    assert.ok(integers !== undefined && halves !== undefined);
    // Half a step of 1 / 32767 per component, and half a unit in the last place of f16.
    assert.ok(integers < 2e-5 && halves > 1e-4 && halves < 5e-4, `got ${integers} and ${halves}`);
});

test("a column of zeros has scale 0, and a wrong size is rejected", () => {
    const packed = packModes(new Float32Array(3 * 2 * 1), 2, 1, "i16");
    assert.deepEqual([...packed.texels], new Array(24).fill(0));
    assert.equal(errorBound(packed, [5]), 0);
    assert.throws(() => packModes(new Float32Array(5), 2, 1, "i16"), /expected 6 numbers, got 5/);
});

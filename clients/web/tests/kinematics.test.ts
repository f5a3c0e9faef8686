import assert from "node:assert/strict";
import { test } from "node:test";
import { nearestRotation } from "../src/scene/kinematics";

function rotation(axis: [number, number, number], angle: number): number[] {
    const length = Math.hypot(...axis);
    const [x, y, z] = axis.map((component) => component / length) as [number, number, number];
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    const t = 1 - c;
    return [
        t * x * x + c,
        t * x * y - s * z,
        t * x * z + s * y,
        t * x * y + s * z,
        t * y * y + c,
        t * y * z - s * x,
        t * x * z - s * y,
        t * y * z + s * x,
        t * z * z + c,
    ];
}

test("the nearest rotation of a scaled rotation is this rotation", () => {
    for (const angle of [0, 0.3, 2, Math.PI]) {
        const expected = rotation([1, -2, 0.5], angle);
        const actual = nearestRotation(expected.map((entry) => 3 * entry));
        actual.forEach((entry, index) =>
            assert.ok(Math.abs(entry - (expected[index] ?? 0)) < 1e-12, `${angle}: ${actual}`),
        );
    }
});

test("the nearest rotation of a reflection is not a reflection", () => {
    const m = nearestRotation([1, 0, 0, 0, 1, 0, 0, 0, -0.2]);
    const [a, b, c, d, e, f, g, h, i] = m as [number, number, number, number, number, number, number, number, number];
    assert.ok(Math.abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) - 1) < 1e-12);
    assert.deepEqual(m.map(Math.round), [1, 0, 0, 0, 1, 0, 0, 0, 1]);
});

/** The time scale of a run, from the times of its steps. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { create } from "@bufbuild/protobuf";
import { StepIdSchema } from "../src/proto/modalcast/v1/common_pb";
import { lowestHertz } from "../src/scene/description";
import { slowFactor, TimeScale } from "../src/scene/time_scale";
import { fourDomains } from "./scene";

const step = (run: bigint, time: number) => create(StepIdSchema, { run, time });

/** Steps of `dt` seconds of the simulation every 16 ms on average. Every fifth step arrives late. */
function receive(scale: TimeScale, run: bigint, dt: number, count: number, start = 0): number {
    for (let index = 0; index < count; index++) {
        scale.add(step(run, index * dt), start + 16 * index + (index % 5 === 4 ? 15 : 0));
    }
    return start + 16 * (count - 1);
}

test("the ratio is that of the simulated and the real time", () => {
    for (const expected of [1, 0.01, 1 / 2000, 12]) {
        const scale = new TimeScale();
        const now = receive(scale, 1n, 0.016 * expected, 1000);
        const ratio = scale.ratio(now) ?? 0;
        assert.ok(Math.abs(ratio / expected - 1) < 0.005, `${ratio}, expected ${expected}`);
    }
});

test("steps that a busy page receives late do not change the ratio", () => {
    const scale = new TimeScale();
    // The steps of the first 500 ms arrive within 60 ms.
    for (let index = 0; index < 40; index++) scale.add(step(1n, 0.00016 * index), 500 + 1.5 * index);
    for (let index = 40; index < 200; index++) scale.add(step(1n, 0.00016 * index), 16 * index);
    const ratio = scale.ratio(16 * 200) ?? 0;
    assert.ok(Math.abs(ratio / 0.01 - 1) < 0.01, `${ratio}, expected 0.01`);
});

test("a new run and a new time begin a new measurement", () => {
    const scale = new TimeScale();
    let now = receive(scale, 1n, 0.016, 100);
    now = receive(scale, 2n, 0.00016, 100, now + 16);
    assert.ok(Math.abs((scale.ratio(now) ?? 0) / 0.01 - 1) < 0.02, "expected the ratio of the second run");
    now = receive(scale, 2n, 0.16, 100, now + 16);
    assert.ok(Math.abs((scale.ratio(now) ?? 0) / 10 - 1) < 0.02, "expected the ratio after the jump back in time");
});

test("a ratio is remembered while a busy page receives no steps", () => {
    const scale = new TimeScale();
    const now = receive(scale, 1n, 0.00016, 200);
    assert.ok(Math.abs((scale.recentRatio(now) ?? 0) / 0.01 - 1) < 0.02);
    // Steps arrive again after a pause of 1.5 s: the measurement has begun again.
    scale.add(step(1n, 0.05), now + 1500);
    assert.equal(scale.ratio(now + 1500), null, "control");
    assert.ok(Math.abs((scale.recentRatio(now + 1500) ?? 0) / 0.01 - 1) < 0.02);
    // Not for long, and not for another run.
    assert.equal(scale.recentRatio(now + 6000), null);
    scale.recentRatio(receive(scale, 1n, 0.00016, 200, now + 7000));
    scale.add(step(2n, 0), now + 10_300);
    assert.equal(scale.recentRatio(now + 10_300), null);
});

test("there is no ratio before the first second, in a pause, or while the time stands still", () => {
    const scale = new TimeScale();
    assert.equal(scale.ratio(0), null);
    let now = receive(scale, 1n, 0.016, 30);
    assert.equal(scale.ratio(now), null);
    now = receive(scale, 1n, 0.016, 100, now + 16);
    assert.notEqual(scale.ratio(now), null);
    assert.equal(scale.ratio(now + 2000), null);
    const still = new TimeScale();
    assert.equal(still.ratio(receive(still, 1n, 0, 100)), null);
});

test("a stiff body is shown as slowly as by `modalcast view`", () => {
    // The cases of clients/dynamics/src/slow_motion.rs.
    const factors = [0, 0.5, 5, 5.1, 20, 206, 5000, Number.NaN].map(slowFactor);
    assert.deepEqual(factors, [1, 1, 1, 2, 10, 100, 2000, 1]);
    for (let hertz = 6; hertz < 20_000; hertz *= 1.01) {
        const shown = hertz / slowFactor(hertz);
        assert.ok(shown > 1.2 && shown < 3.2, `${hertz} Hz as ${shown} Hz`);
    }
});

test("the lowest frequency of a scene is that of a vibration", () => {
    const scene = fourDomains();
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    assert.equal(lowestHertz(scene), 0);
    const [first, second] = scene.shapes;
    assert.ok(first && second);
    second.eigenvalues = [eigenvalue(450)];
    assert.ok(Math.abs(lowestHertz(scene) - 450) < 1e-9);
    // A rigid motion of the other part, with the rounding error of a solver.
    first.eigenvalues = [1e-6, eigenvalue(735)];
    assert.ok(Math.abs(lowestHertz(scene) - 450) < 1e-9);
});

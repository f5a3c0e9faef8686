/** Forces that hold modes, and the texts on sliders and pulls. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { averagingWindow, ModeForces, MovingAverage } from "../src/control/mode_forces";
import { missingModes, pullProblem } from "../src/control/pull_problem";
import { toF32 } from "../src/scene/numbers";
import { SceneModel } from "../src/scene/scene_model";
import type { ModalForceMessage, Server } from "../src/source/server";
import { sliderHint } from "../src/ui/slider_hint";
import { fourDomains } from "./scene";

/** Largest deviation of an oscillator from 1 after the force has become constant, in 10 s. Its static deflection is 1. */
function residual(hertz: number, window: number): number {
    const average = new MovingAverage();
    average.window = window;
    average.set(1, 0);
    const omega = 2 * Math.PI * hertz;
    const dt = 1 / 4000;
    let [q, velocity, largest] = [0, 0, 0];
    for (let step = 0; step < 10 / dt; step++) {
        const force = average.at(1000 * step * dt);
        velocity += dt * omega ** 2 * (force - q);
        q += dt * velocity;
        if (average.isSettled(1000 * step * dt)) largest = Math.max(largest, Math.abs(q - 1));
    }
    return largest;
}

test("the average of whole periods excites no vibration", () => {
    for (const hertz of [0.7, 1.6, 2.3, 9]) {
        const rest = residual(hertz, averagingWindow(hertz, 1));
        assert.ok(rest < 0.02, `${hertz} Hz: expected less than 0.02, got ${rest}`);
    }
    // Controls: a sudden force, and an average over another time.
    assert.ok(residual(1.6, 1) > 0.9);
    assert.ok(residual(0.7, 900) > 0.1);
});

test("the window is two or more periods as they are seen", () => {
    const windows = [averagingWindow(464, 1 / 200), averagingWindow(2, 1), averagingWindow(0.01, 1)];
    const expected = [(3 * 200_000) / 464, 1000, 4000];
    windows.forEach((window, place) => {
        assert.ok(Math.abs(window / (expected[place] ?? 0) - 1) < 1e-9, `${window}`);
    });
    assert.equal(averagingWindow(0, 1), 900);
});

test("an average ends at the last value", () => {
    const average = new MovingAverage();
    average.window = 100;
    assert.deepEqual([average.at(5), average.isSettled(5)], [0, true]);
    average.set(2, 10);
    average.set(4, 50);
    assert.equal(average.target, 4);
    assert.equal(average.isSettled(149), false);
    assert.ok(average.at(100) > 2 && average.at(100) < 4);
    assert.deepEqual([average.at(150), average.isSettled(150)], [4, true]);
});

test("a held mode has the force eigenvalue times q until it is released", async () => {
    const scene = fourDomains();
    const [shape] = scene.shapes;
    assert.ok(shape);
    shape.eigenvalues = [0, 9];
    const sent: ModalForceMessage[][] = [];
    const server = {
        applyForces: async (_scene: string, _owner: Uint8Array, forces: ModalForceMessage[]) => {
            sent.push(forces);
            return { owner: 7n, receivers: 1 };
        },
    };
    const holds = new ModeForces(server as unknown as Server, new SceneModel(scene, null));
    try {
        assert.deepEqual([holds.canHold(0, 0), holds.canHold(0, 1)], [false, true]);
        // Without stiffness, nothing is held.
        holds.set(0, 0, 1);
        assert.equal(holds.isHolding, false);
        // The shortest window, so that the test is short.
        holds.timeScale = 1e6;
        holds.set(0, 1, 0.5);
        assert.equal(holds.target(0, 1), 0.5);
        const until = async (isReached: (f: Float32Array | null) => boolean) => {
            for (;;) {
                const last = sent.at(-1)?.[0];
                if (isReached(last ? toF32(last.fQ, "f_q") : null)) return;
                await new Promise((resolve) => setTimeout(resolve, 10));
            }
        };
        await until((f) => f?.[1] === 4.5);
        assert.deepEqual([...toF32(sent.at(-1)?.[0]?.fQ ?? new Uint8Array(), "f_q")], [0, 4.5]);
        assert.equal(holds.hasReceiver, true);
        holds.reset(0);
        assert.equal(holds.target(0, 1), 0);
        await until((f) => f === null);
        assert.equal(holds.isHolding, false);
        // The force decreased in steps.
        assert.ok(sent.some(([force]) => force && (toF32(force.fQ, "f_q")[1] ?? 0) < 4));
    } finally {
        holds.dispose();
    }
});

test("a scene that does not react to a pull says which command helps", () => {
    const scene = fourDomains();
    scene.info.source = "./parts/fork.stl";
    assert.match(missingModes(scene), /no stiffness.*`modalcast view fork.stl --modes 20`$/);
    const rigid = { ...scene, domains: scene.domains.slice(3) };
    assert.match(missingModes(rigid), /^This model is rigid.*`modalcast view fork.stl --modes 20`$/);
    rigid.info.remarks = ["the scene is 80 x 60 x 70 m; if its file is in millimeters, pass --unit mm"];
    assert.match(missingModes(rigid), /`modalcast view fork.stl --unit mm --modes 20`$/);
    assert.equal(pullProblem(rigid, "an error", "http://localhost:1"), missingModes(rigid));
    // Cubic forces need no eigenvalues.
    const [first] = scene.domains;
    if (first) first.notes = { "vega.cubic": "a.cub" };
    assert.equal(missingModes(scene), "");
    const command = "`modalcast-sim four --server http://localhost:1 --slow auto --forces --seconds 0 --realtime`";
    const problem = pullProblem(scene, "", "http://localhost:1");
    assert.ok(problem.includes("no physics is running") && problem.endsWith(command), problem);
    assert.match(pullProblem(scene, "it diverged.", ""), /has ended: it diverged\./);
});

test("the panel says what sliders do, or why there are none", () => {
    const scene = fourDomains();
    const [shape] = scene.shapes;
    if (shape) shape.eigenvalues = [1, 2];
    const facts = {
        model: { scene },
        isDriven: true,
        sliderEffect: "none" as const,
        hasStiffness: true,
        modeForces: { hasReceiver: false },
        source: { server: null, features: { pictures: true, forces: true, drive: true } },
    };
    const receives = { ...facts, modeForces: { hasReceiver: true } };
    assert.match(sliderHint({ ...receives, sliderEffect: "forces" }), /holds a mode by a constant force.*--no-sim/);
    assert.match(sliderHint({ ...receives, hasStiffness: false }), /cannot be held.*--no-sim/);
    assert.match(sliderHint(facts), /accepts no forces/);
    assert.match(sliderHint({ ...facts, isDriven: false, sliderEffect: "steps" }), /a pull has no effect/);
    const recording = { server: null, features: { pictures: false, forces: false, drive: false } };
    assert.equal(sliderHint({ ...facts, source: recording }), "");
});

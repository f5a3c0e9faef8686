import assert from "node:assert/strict";
import { test } from "node:test";
import { ColorScale } from "../src/render/color_scale";
import type { SceneArrays, ShapeArrays } from "../src/scene/arrays";
import { Deflections } from "../src/scene/deflection";
import { SceneModel } from "../src/scene/scene_model";
import { floats, fourDomains } from "./scene";

/** A strip of `count` vertices along x, and a last one that no triangle uses. U has two modes with these rows. */
function strip(count: number, rows: (vertex: number) => [number, number][]): ShapeArrays {
    const vertices = Array.from({ length: count + 1 }, (_, vertex) => vertex);
    const indices = vertices.slice(2, count).flatMap((vertex) => [vertex - 2, vertex - 1, vertex]);
    return {
        origin: [0, 0, 0],
        restPositions: Float32Array.from(vertices.flatMap((vertex) => [vertex / (count - 1), 0, 0])),
        cornerVertices: Uint32Array.from(vertices),
        indices: Uint32Array.from(indices),
        normals: new Float32Array(3 * (count + 1)),
        uvs: null,
        modes: Float32Array.from(vertices.flatMap((vertex) => rows(vertex).flat())),
    };
}

/** Domain 0 of `fourDomains` with this shape, whose unit is 0.5 m. */
function modelOf(shape: ShapeArrays): { model: SceneModel; arrays: SceneArrays } {
    const scene = fourDomains();
    const [shape0] = scene.shapes;
    assert.ok(shape0);
    shape0.vertices = shape.restPositions.length / 3;
    const arrays = { shapes: [shape, { ...shape, modes: null }, { ...shape, modes: null }], textures: [] };
    return { model: new SceneModel(scene, arrays), arrays };
}

/** Mode 0 bends along y with x^2, mode 1 along z with a wave. The unused vertex moves most. */
const bends = (count: number) =>
    strip(count, (vertex) => {
        const x = vertex / (count - 1);
        return [
            [0, 0],
            [x * x, 0],
            [0, vertex === count ? 100 : Math.sin(9 * x)],
        ];
    });

test("the largest deflection is that of all vertices in meters", () => {
    const count = 101;
    const { model, arrays } = modelOf(bends(count));
    const deflections = new Deflections(model, arrays);
    const q = [0.3, -0.2];
    const expected = Math.max(
        ...Array.from({ length: count }, (_, vertex) => {
            const x = vertex / (count - 1);
            return 0.5 * Math.hypot(0.3 * x * x, 0.2 * Math.sin(9 * x));
        }),
    );
    assert.ok(Math.abs(deflections.largest(0, q) - expected) < 1e-7);
    assert.equal(deflections.isExact(0), true);
    assert.equal(deflections.count(0), count);
    assert.ok(Math.abs(deflections.ofMode(0, 0) - 0.5) < 1e-7);
    assert.ok(Math.abs(deflections.size(0) - 0.5) < 1e-7, "the unused vertex does not count");
    assert.equal(deflections.largest(0, [0, 0]), 0);
    assert.equal(deflections.largest(3), 0, "a rigid domain");
    // Its state has q = (0.5, 0).
    assert.ok(Math.abs(deflections.largest(0) - 0.25) < 1e-7);
    assert.ok(Math.abs(deflections.largestOfScene() - 0.25) < 1e-7);
});

test("a scaled placement scales deflections and sizes", () => {
    const { model, arrays } = modelOf(bends(11));
    const [domain] = model.scene.domains;
    assert.ok(domain);
    domain.placement = floats(3, 0, 0, 0, 0, 3, 0, 0, 0, 0, 3, 0);
    const scaled = new Deflections(new SceneModel(model.scene, arrays), arrays);
    assert.ok(Math.abs(scaled.ofMode(0, 0) - 1.5) < 1e-6);
    assert.ok(Math.abs(scaled.size(0) - 1.5) < 1e-6);
    assert.ok(Math.abs(scaled.largest(0, [1, 0]) - 1.5) < 1e-6);
});

test("a large scene is sampled, and says so", () => {
    const count = 5001;
    const { model, arrays } = modelOf(bends(count));
    const [exact, sampled] = [new Deflections(model, arrays), new Deflections(model, arrays, 3000)];
    assert.equal(sampled.isExact(0), false);
    assert.ok(sampled.count(0) < 1000 && sampled.count(0) > 100, `${sampled.count(0)}`);
    for (const q of [
        [1, 0],
        [0, 1],
    ])
        assert.equal(sampled.largest(0, q), exact.largest(0, q), "the vertices of single modes are kept");
    const q = [0.7, 0.9];
    assert.ok(sampled.largest(0, q) <= exact.largest(0, q));
    assert.ok(sampled.largest(0, q) > 0.999 * exact.largest(0, q));
});

test("the color map ends at a round number above the largest deflection", () => {
    const { model, arrays } = modelOf(bends(101));
    const scale = new ColorScale(new Deflections(model, arrays), 0.5);
    assert.equal(scale.end, 0, "no color map");
    const deflection = { kind: "displacement" } as const;
    scale.select(deflection, 0);
    assert.equal(scale.end, 0.25, "q = (0.5, 0) deflects by 0.25 m");
    model.state.q[0] = 3;
    assert.equal(scale.update(20), false, "at most one evaluation in 50 ms");
    assert.equal(scale.update(60), true);
    assert.equal(scale.end, 1.5);
    scale.select(deflection, 120);
    assert.equal(scale.end, 1.5, "the same choice keeps its range");
    for (let now = 120; now < 8000; now += 100) {
        model.state.q[0] = 1e-3;
        scale.update(now);
    }
    assert.equal(scale.end, 6e-4);
});

test("the color map of a mode ends at its largest displacement", () => {
    const { model, arrays } = modelOf(bends(101));
    const scale = new ColorScale(new Deflections(model, arrays), 0.5);
    scale.select({ kind: "mode", mode: 1 }, 0);
    assert.ok(Math.abs(scale.end - 0.5) < 1e-3, `${scale.end}`);
    assert.equal(new ColorScale(null, 1).end, 0);
});

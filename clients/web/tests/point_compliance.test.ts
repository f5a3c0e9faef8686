import assert from "node:assert/strict";
import { test } from "node:test";
import { pointCompliance } from "../src/control/point_compliance";
import { surfacePoint } from "../src/control/surface_point";
import type { SceneArrays } from "../src/scene/arrays";
import { Deflections } from "../src/scene/deflection";
import { SceneModel } from "../src/scene/scene_model";
import { floats, fourDomains } from "./scene";

/** A triangle whose corner 1 moves by 1 along x in mode 0, and corner 2 by 4 along x and 1 along y in modes 0 and 1. */
const TRIANGLE = {
    origin: [0, 0, 0] as [number, number, number],
    restPositions: new Float32Array([0, 0, 0, 1, 0, 0, 0, 1, 0]),
    cornerVertices: new Uint32Array([0, 1, 2]),
    indices: new Uint32Array([0, 1, 2]),
    normals: new Float32Array(9),
    uvs: null,
    modes: new Float32Array([0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 4, 0, 0, 1, 0, 0]),
};

function setUp(eigenvalues: number[], placement?: number[]) {
    const scene = fourDomains();
    const [shape] = scene.shapes;
    const [domain] = scene.domains;
    assert.ok(shape && domain);
    shape.eigenvalues = eigenvalues;
    if (placement) domain.placement = floats(...placement);
    const arrays: SceneArrays = { shapes: [TRIANGLE, TRIANGLE, TRIANGLE], textures: [] };
    const model = new SceneModel(scene, arrays);
    const corner = (weights: number[]) => {
        const point = surfacePoint(model, 0, 0, weights);
        assert.ok(point);
        return point;
    };
    return { model, corner, deflections: new Deflections(model, arrays) };
}

function assertClose(actual: number | undefined, expected: number): void {
    assert.ok(actual !== undefined && Math.abs(actual / expected - 1) < 1e-6, `expected ${expected}, got ${actual}`);
}

test("the limit deflects the body by a tenth of its size", () => {
    const { model, corner, deflections } = setUp([100, 25]);
    const compliance = pointCompliance(model, corner([0, 1, 0]), deflections, 10);
    // q = 1 / 100 per newton moves corner 2 by 0.04 scene units of 0.5 m.
    assertClose(compliance?.limit([3, 0, 0]), (0.1 * deflections.size(0)) / 0.02);
    assertClose(compliance?.stiffness, 100);
    // Nothing bends along y.
    assert.equal(compliance?.limit([0, 1, 0]), Infinity);
});

test("the limit depends on the direction of the force", () => {
    const { model, corner, deflections } = setUp([100, 25]);
    const compliance = pointCompliance(model, corner([0, 0, 1]), deflections, 10);
    const allowed = 0.1 * deflections.size(0);
    // Compliances of the point: 16 / 100 along x and 1 / 25 along y.
    assertClose(compliance?.limit([1, 0, 0]), allowed / 0.08);
    assertClose(compliance?.limit([0, 2, 0]), allowed / 0.02);
    assertClose(compliance?.limit([1, 1, 0]), allowed / (0.5 * Math.hypot(0.16, 0.04) * Math.SQRT1_2));
    assertClose(compliance?.stiffness, 1 / 0.2);
});

test("a turned and scaled part has its limit in world axes", () => {
    // Turned by 90 degrees about z, and twice as large.
    const { model, corner, deflections } = setUp([100, 25], [0, -2, 0, 0, 2, 0, 0, 0, 0, 0, 2, 0]);
    const compliance = pointCompliance(model, corner([0, 0, 1]), deflections, 10);
    assertClose(deflections.size(0), 2 * 0.5 * Math.SQRT2);
    assertClose(compliance?.limit([0, 1, 0]), (0.1 * deflections.size(0)) / (4 * 0.08));
});

test("a model of large motion bends by half its size, unless its material collapses earlier", () => {
    const limitWith = (safeCoordinates?: string) => {
        const { model, corner, deflections } = setUp([100, 25]);
        const [domain] = model.scene.domains;
        assert.ok(domain);
        if (safeCoordinates !== undefined) domain.notes["modes.safe_coordinates"] = safeCoordinates;
        const compliance = pointCompliance(model, corner([0, 1, 0]), deflections, 10);
        const limit = compliance?.limit([1, 0, 0]);
        return { limit, reason: compliance?.limitReason, size: deflections.size(0) };
    };
    const linear = limitWith();
    assertClose(linear.limit, (0.1 * linear.size) / 0.02);
    assert.equal(linear.reason, "The limit bends the part by 10 % of its size.");
    const large = limitWith("1.5e1 2");
    assertClose(large.limit, (0.5 * large.size) / 0.02);
    assert.equal(large.reason, "The limit bends the part by 50 % of its size.");
    // q is 1 / 100 per newton in mode 0, and 0 in mode 1.
    const soft = limitWith("5e-3 1e-9");
    assertClose(soft.limit, 0.5);
    assert.equal(soft.reason, "Beyond the limit, the material may collapse under compression.");
});

test("without arrays, the point and the scene stand for the body", () => {
    const { model, corner } = setUp([100, 25]);
    const compliance = pointCompliance(model, corner([0, 1, 0]), null, 10);
    assertClose(compliance?.limit([1, 0, 0]), (0.1 * 10 * 0.5) / (0.5 / 100));
});

test("without stiffness, the limit is unknown", () => {
    for (const eigenvalues of [[], [0, 0], [-1, 0]]) {
        const { model, corner, deflections } = setUp(eigenvalues);
        assert.equal(pointCompliance(model, corner([0, 0, 1]), deflections, 10), null);
    }
});

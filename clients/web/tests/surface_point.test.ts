import assert from "node:assert/strict";
import { test } from "node:test";
import { jointPoint } from "../src/control/surface_point";
import type { SceneArrays } from "../src/scene/arrays";
import { SceneModel } from "../src/scene/scene_model";
import { floats, fourDomains, translation } from "./scene";

/** The scene with a square of two triangles for domain 0, to which the rigid domain 3 is attached near (1, 1, 0). */
function attachedScene(): SceneModel {
    const scene = fourDomains();
    const [domain0, , , domain3] = scene.domains;
    assert.ok(domain0 && domain3);
    domain3.parent = 0;
    domain3.attachmentFrame = floats(...translation(0.9, 1.2, 0));
    const square = {
        origin: [0, 0, 0] as [number, number, number],
        restPositions: new Float32Array([0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0]),
        cornerVertices: new Uint32Array([0, 1, 2, 3]),
        indices: new Uint32Array([0, 1, 3, 1, 2, 3]),
        normals: new Float32Array(12),
        uvs: null,
        // x displacement of mode 0 is the number of the vertex.
        modes: Float32Array.from({ length: 24 }, (_, entry) => (entry % 6 === 0 ? entry / 6 : 0)),
    };
    const arrays: SceneArrays = { shapes: [square, square, square], textures: [] };
    return new SceneModel(scene, arrays);
}

test("a force on a rigid domain acts on its parent at the joint", () => {
    const model = attachedScene();
    const point = jointPoint(model, 3);
    assert.deepEqual([point?.domain, point?.triangle, point?.barycentric], [0, 1, [0, 1, 0]]);
    assert.deepEqual(point?.rest, [1, 1, 0]);
    assert.equal(point?.modes[0], 2);
});

test("a domain that bends or has no parent keeps its force", () => {
    const model = attachedScene();
    assert.equal(jointPoint(model, 0), null);
    const [, , , domain3] = model.scene.domains;
    assert.ok(domain3);
    delete domain3.parent;
    assert.equal(jointPoint(model, 3), null);
});

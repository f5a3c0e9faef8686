import assert from "node:assert/strict";
import { test } from "node:test";
import { create } from "@bufbuild/protobuf";
import { PullTool, type PullView } from "../src/control/pull";
import { HitSchema } from "../src/proto/modalcast/v1/frames_pb";
import type { OrbitCamera } from "../src/render/camera";
import type { SceneArrays } from "../src/scene/arrays";
import { Deflections } from "../src/scene/deflection";
import { SceneModel } from "../src/scene/scene_model";
import type { Server, SurfaceForceMessage } from "../src/source/server";
import { fourDomains } from "./scene";

interface Pull {
    force: number;
    messages: string[];
    view: PullView | null;
}

/** The messages of a pull from the point (1, 0, 0) of domain 0 along x, and its force, with these eigenvalues. */
async function pull(eigenvalues: number[], receiverError = "", distance = 1): Promise<Pull> {
    const scene = fourDomains();
    const [shape0] = scene.shapes;
    assert.ok(shape0);
    shape0.eigenvalues = eigenvalues;
    const triangle = {
        origin: [0, 0, 0] as [number, number, number],
        restPositions: new Float32Array([0, 0, 0, 1, 0, 0, 0, 1, 0]),
        cornerVertices: new Uint32Array([0, 1, 2]),
        indices: new Uint32Array([0, 1, 2]),
        normals: new Float32Array(9),
        uvs: null,
        // Both modes move all vertices along x.
        modes: Float32Array.from({ length: 18 }, (_, entry) => (entry % 6 < 2 ? 1 : 0)),
    };
    const arrays: SceneArrays = { shapes: [triangle, triangle, triangle], textures: [] };
    const model = new SceneModel(scene, arrays);
    model.receiverError = receiverError;
    const sent: SurfaceForceMessage[] = [];
    const hit = create(HitSchema, { domain: 0, triangle: 0, barycentric: [0, 1, 0] });
    const server = {
        pick: async () => ({ head: undefined, hits: [hit] }),
        applyForces: async (_scene: string, _owner: Uint8Array, forces: SurfaceForceMessage[]) => {
            sent.push(...forces);
            return { owner: 1n, receivers: 0 };
        },
    };
    const camera = {
        toMessage: () => ({}),
        unproject: (_x: number, _y: number, [x, y, z]: [number, number, number]) => [x + distance, y, z],
    };
    const tool = new PullTool(
        server as unknown as Server,
        model,
        camera as unknown as OrbitCamera,
        10,
        new Deflections(model, arrays),
    );
    const messages: string[] = [];
    tool.onMessage = (message) => messages.push(message);
    await tool.begin(0, 0, [10, 10]);
    await new Promise((resolve) => setTimeout(resolve, 0));
    const { view } = tool;
    tool.end();
    const vector = sent[0]?.vector ?? [];
    return { force: Math.hypot(...vector), messages, view };
}

test("the force of a pull ignores modes without stiffness", async () => {
    const { force } = await pull([0, 4]);
    assert.ok(force > 0, `expected a force, got ${force}`);
    // The rounding error of a solver.
    assert.equal((await pull([1e-12, 4])).force, force);
    // Control: a soft mode reduces the force.
    const { force: soft } = await pull([1, 4]);
    assert.ok(soft < 0.5 * force, `expected less than half of ${force}, got ${soft}`);
});

test("a pull without receivers says so unless the page knows the reason", async () => {
    assert.match((await pull([1, 4])).messages.join(), /no physics is running/);
    assert.equal((await pull([1, 4], "a reason")).messages.join(""), "");
});

test("a pull ends at the force that bends the part by a tenth of its size", async () => {
    // Both modes move all vertices by 1 along x: the compliance is 1 / 1 + 1 / 4, and the size is 2 ** 0.5.
    const limit = (0.1 * Math.SQRT2) / 1.25;
    const far = await pull([1, 4], "", 1);
    assert.ok(Math.abs(far.force / limit - 1) < 1e-6, `expected ${limit}, got ${far.force}`);
    assert.equal(far.view?.isLimited, true);
    assert.ok(Math.abs((far.view?.limit ?? 0) / limit - 1) < 1e-6, `expected ${limit}, got ${far.view?.limit}`);
    // The state has q = (0.5, 0), and the unit is 0.5 m.
    assert.equal(far.view?.deflection, 0.25);
    // Control: a shorter pull is proportional to its length.
    const near = await pull([1, 4], "", 0.1);
    assert.ok(Math.abs(near.force - 0.1 / 1.25) < 1e-9, `${near.force}`);
    assert.equal(near.view?.isLimited, false);
    // Without eigenvalues, the force grows up to a tenth of the scene's diagonal of 10.
    const unknown = await pull([], "", 5);
    assert.ok(Math.abs(unknown.force - 100) < 1e-9, `${unknown.force}`);
    assert.equal(unknown.view?.limit, null);
});

/** Shapes that are far from the origin of their frame, and domains that are far from the scene's origin. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { create } from "@bufbuild/protobuf";
import { StateContent, StateHeadSchema } from "../src/proto/modalcast/v1/states_pb";
import { applyToPoint, TRANSFORM_SIZE } from "../src/scene/affine";
import { restPosition, type ShapeArrays } from "../src/scene/arrays";
import { domainSpheres, restSphere } from "../src/scene/bounds";
import { SceneState, StateLayout } from "../src/scene/state";
import { floats, fourDomains, translation } from "./scene";

const CENTER: [number, number, number] = [500_000.3, 4_649_776.2, 12.1];

/** A triangle of about one unit and a vertex that it does not use. */
function triangle(origin: [number, number, number]): ShapeArrays {
    return {
        indices: new Uint32Array([0, 1, 2]),
        cornerVertices: new Uint32Array([0, 1, 2]),
        origin,
        restPositions: new Float32Array([0, 0, 0, 1, 0, 0, 0, 1, 0, 1e4, 0, 0]),
        normals: new Float32Array(9),
        uvs: null,
        modes: null,
    };
}

test("spheres of far shapes are exact and ignore unused vertices", () => {
    const near = restSphere(triangle([0, 0, 0]));
    assert.deepEqual(near.center, [0.5, 0.5, 0]);
    assert.ok(near.radius < 1);
    const far = restSphere(triangle(CENTER));
    for (let axis = 0; axis < 3; axis++) {
        const expected = (CENTER[axis] ?? 0) + (near.center[axis] ?? 0);
        assert.ok(Math.abs((far.center[axis] ?? 0) - expected) < 1e-9);
    }
    assert.ok(Math.abs(far.radius - near.radius) < 1e-9);
    assert.deepEqual(restPosition(triangle(CENTER), 1), [CENTER[0] + 1, CENTER[1], CENTER[2]]);
});

test("far placements are exact at rest", () => {
    const scene = fourDomains();
    const domain = scene.domains[3];
    assert.ok(domain);
    domain.placement = floats(...translation(...CENTER));
    domain.exactPlacement = translation(...CENTER);
    const state = new SceneState(new StateLayout(scene));
    const place = 3 * TRANSFORM_SIZE;
    assert.deepEqual([...state.transforms.slice(place, place + TRANSFORM_SIZE)], translation(...CENTER));
    const spheres = domainSpheres(
        state,
        scene.shapes.map(() => restSphere(triangle([0, 0, 0]))),
        [null, null, null],
    );
    assert.ok(Math.abs((spheres[3]?.center[1] ?? 0) - (CENTER[1] + 0.5)) < 1e-9);
});

test("states of far shapes have their translation in the origin", () => {
    const scene = fourDomains();
    const layout = new StateLayout(scene);
    const state = new SceneState(layout);
    // Roots 0 and 3. The world position of an origin is in meters: the scene's origin plus the unit times the translation.
    const transforms = new Uint8Array(new Float32Array([...translation(0, 0, 0), ...translation(0, 0, 0)]).buffer);
    const meters = CENTER.map((value, axis) => (scene.info.origin[axis] ?? 0) + scene.info.unit * value);
    const origins = new Uint8Array(new Float64Array([0, 0, 0, ...meters]).buffer);
    const data = new Uint8Array([...transforms, ...origins]);
    const section = (content: StateContent, offset: number, bytes: number) => ({
        content,
        offset: BigInt(offset),
        bytes: BigInt(bytes),
    });
    const head = create(StateHeadSchema, {
        sections: [
            section(StateContent.TRANSFORMS, 0, transforms.length),
            section(StateContent.ORIGINS, transforms.length, origins.length),
        ],
    });
    state.apply(head, data);
    const point = applyToPoint(state.transforms, 3 * TRANSFORM_SIZE, [1, 2, 3]);
    point.forEach((value, axis) => {
        assert.ok(Math.abs(value - ((CENTER[axis] ?? 0) + axis + 1)) < 1e-9);
    });
});

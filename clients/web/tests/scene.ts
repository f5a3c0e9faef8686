/** Scenes for tests. */

import { create } from "@bufbuild/protobuf";
import {
    DomainDescriptionSchema,
    MaterialDescriptionSchema,
    SceneInfoSchema,
    ShapeDescriptionSchema,
} from "../src/proto/modalcast/v1/scenes_pb";
import type { SceneDescription } from "../src/scene/description";

export function floats(...values: number[]): Uint8Array {
    return new Uint8Array(new Float32Array(values).buffer);
}

export function translation(x: number, y: number, z: number): number[] {
    return [1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, z];
}

/**
 * Four domains. 0: two modes. 1: follows 0, one unit above, and has a mode. 2: shares the q of 0, and follows 1,
 * turned by 90 degrees about z. 3: rigid, and follows no domain.
 */
export function fourDomains(): SceneDescription {
    const shape = (index: number, rank: number) =>
        create(ShapeDescriptionSchema, { shape: index, vertices: 3, rank, corners: 3, triangles: 1 });
    const turned = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0];
    return {
        info: create(SceneInfoSchema, {
            scene: "four",
            unit: 0.5,
            origin: [100, 0, 0],
            up: "y",
            bounds: [0, 0, 0, 1, 1, 1],
        }),
        shapes: [shape(0, 2), shape(1, 1), shape(2, 0)],
        materials: [create(MaterialDescriptionSchema, { material: 0 })],
        textures: [],
        domains: [
            create(DomainDescriptionSchema, {
                domain: 0,
                name: "a",
                shape: 0,
                placement: floats(...translation(1, 2, 3)),
                restQ: floats(0.5, 0),
            }),
            create(DomainDescriptionSchema, {
                domain: 1,
                name: "b",
                shape: 1,
                follows: 0,
                followFrame: floats(...translation(0, 1, 0)),
            }),
            create(DomainDescriptionSchema, {
                domain: 2,
                name: "c",
                shape: 0,
                sharesQWith: 0,
                follows: 1,
                followFrame: floats(...turned),
            }),
            create(DomainDescriptionSchema, {
                domain: 3,
                name: "d",
                shape: 2,
                placement: floats(...translation(0, 0, 9)),
            }),
        ],
    };
}

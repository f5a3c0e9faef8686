/** The arrays of a scene: what a client needs to deform and draw it. */

import type { Vec3 } from "./affine";
import { ArrayKind, arrayHash, type SceneDescription } from "./description";
import { at, toF32, toHex, toU32 } from "./numbers";

export interface ShapeArrays {
    /** Three corners per triangle. */
    indices: Uint32Array;
    /** The vertex of each corner. */
    cornerVertices: Uint32Array;
    /** c, the point that the rest positions are relative to, in the frame of the domain. */
    origin: Vec3;
    /** x0 - c: three numbers per vertex. */
    restPositions: Float32Array;
    /** Three numbers per corner. */
    normals: Float32Array;
    /** Two numbers per corner; null if the shape has none. */
    uvs: Float32Array | null;
    /** U: 3 vertices x rank, row-major; null if the shape is rigid. */
    modes: Float32Array | null;
}

/** x0 of a vertex in f64. */
export function restPosition({ origin, restPositions }: ShapeArrays, vertex: number): Vec3 {
    return [0, 1, 2].map((axis) => at(origin, axis) + at(restPositions, 3 * vertex + axis)) as Vec3;
}

export interface SceneArrays {
    shapes: ShapeArrays[];
    /** RGBA8 pixels of each texture. */
    textures: Uint8Array<ArrayBuffer>[];
}

/** Hashes of all arrays and textures of a scene, each once. */
export function contentHashes(scene: SceneDescription): Uint8Array[] {
    const hashes = new Map<string, Uint8Array>();
    const add = (hash: Uint8Array | null) => {
        if (hash && hash.length > 0) hashes.set(toHex(hash), hash);
    };
    for (const shape of scene.shapes) {
        for (const description of shape.arrays) add(arrayHash(shape, description.array));
    }
    for (const texture of scene.textures) add(texture.sha256);
    return [...hashes.values()];
}

/** Bytes of all arrays and textures of a scene, each content once. */
export function contentBytes(scene: SceneDescription): number {
    const sizes = new Map<string, bigint>();
    for (const shape of scene.shapes) {
        for (const array of shape.arrays) sizes.set(toHex(array.sha256), array.bytes);
    }
    for (const texture of scene.textures) sizes.set(toHex(texture.sha256), texture.bytes);
    return Number([...sizes.values()].reduce((sum, bytes) => sum + bytes, 0n));
}

/** Interprets the contents, by hash in hexadecimal digits. Throws if one is missing or has another size. */
export function parseArrays(scene: SceneDescription, contents: ReadonlyMap<string, Uint8Array>): SceneArrays {
    const content = (hash: Uint8Array | null, bytes: number, name: string): Uint8Array => {
        const found = hash ? contents.get(toHex(hash)) : new Uint8Array();
        if (!found) throw new Error(`${name}: the content ${hash ? toHex(hash) : ""} is missing`);
        if (found.length !== bytes) throw new Error(`${name}: expected ${bytes} bytes, got ${found.length}`);
        return found;
    };
    const shapes = scene.shapes.map((shape) => {
        const read = (kind: ArrayKind, bytes: number) =>
            content(arrayHash(shape, kind), bytes, `shapes[${shape.shape}], array ${ArrayKind[kind]}`);
        const uvs = arrayHash(shape, ArrayKind.UVS);
        const indices = toU32(read(ArrayKind.INDICES, 12 * shape.triangles));
        const cornerVertices = toU32(read(ArrayKind.CORNER_VERTICES, 4 * shape.corners));
        const [x, y, z] = shape.origin;
        const hasOrigin = x !== undefined && y !== undefined && z !== undefined;
        const positions = hasOrigin ? ArrayKind.CENTERED_POSITIONS : ArrayKind.REST_POSITIONS;
        checkIndices(`shapes[${shape.shape}].indices`, indices, shape.corners);
        checkIndices(`shapes[${shape.shape}].corner_vertices`, cornerVertices, shape.vertices);
        return {
            indices,
            cornerVertices,
            origin: (hasOrigin ? [x, y, z] : [0, 0, 0]) as Vec3,
            restPositions: toF32(read(positions, 12 * shape.vertices)),
            normals: toF32(read(ArrayKind.REST_NORMALS, 12 * shape.corners)),
            uvs: uvs ? toF32(read(ArrayKind.UVS, 8 * shape.corners)) : null,
            modes: shape.rank > 0 ? toF32(read(ArrayKind.MODES, 12 * shape.vertices * shape.rank)) : null,
        };
    });
    const textures = scene.textures.map((texture) => {
        const pixels = content(texture.sha256, 4 * texture.width * texture.height, `textures[${texture.texture}]`);
        return pixels as Uint8Array<ArrayBuffer>;
    });
    return { shapes, textures };
}

function checkIndices(name: string, indices: Uint32Array, limit: number): void {
    for (const index of indices) if (index >= limit) throw new Error(`${name}: expected below ${limit}, got ${index}`);
}

/** A point of the surface that moves with the scene. */

import { applyLinear, applyToPoint, norm, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import { restPosition } from "../scene/arrays";
import { at, toF32 } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";

export interface SurfacePoint {
    domain: number;
    triangle: number;
    barycentric: readonly number[];
    /** x0 at the point, in the domain's frame. */
    rest: Vec3;
    /** U at the point: 3 x rank, row-major. */
    modes: Float32Array;
}

/** The point of a triangle; null without the arrays of the scene, or if there is no such triangle. */
export function surfacePoint(
    model: SceneModel,
    domain: number,
    triangle: number,
    barycentric: readonly number[],
): SurfacePoint | null {
    const shapeIndex = model.scene.domains[domain]?.shape ?? -1;
    const shape = model.arrays?.shapes[shapeIndex];
    if (!shape || 3 * triangle + 2 >= shape.indices.length || barycentric.length !== 3) return null;
    const rank = at(model.layout.ranks, domain);
    const rest: Vec3 = [0, 0, 0];
    const modes = new Float32Array(3 * rank);
    for (let corner = 0; corner < 3; corner++) {
        const vertex = at(shape.cornerVertices, at(shape.indices, 3 * triangle + corner));
        const weight = at(barycentric, corner);
        const position = restPosition(shape, vertex);
        for (let axis = 0; axis < 3; axis++) {
            rest[axis] = at(rest, axis) + weight * at(position, axis);
            for (let mode = 0; mode < rank; mode++) {
                const place = axis * rank + mode;
                modes[place] = at(modes, place) + weight * at(shape.modes ?? [], (3 * vertex + axis) * rank + mode);
            }
        }
    }
    return { domain, triangle, barycentric, rest, modes };
}

/**
 * The point where a force on a rigid domain acts: on the closest ancestor that bends, at the vertex that is nearest to the
 * joint. Null if the domain bends itself, if no ancestor does, or without the arrays of the scene.
 */
export function jointPoint(model: SceneModel, domain: number): SurfacePoint | null {
    const { scene, layout, arrays } = model;
    let child = scene.domains[domain];
    while (child && at(layout.ranks, child.domain) === 0 && child.parent !== undefined) {
        const parent = child.parent;
        const indices = arrays?.shapes[scene.domains[parent]?.shape ?? -1]?.indices;
        if (at(layout.ranks, parent) > 0 && indices) {
            const corner = nearestCorner(model, parent, toF32(child.attachmentFrame, "attachment_frame"));
            const barycentric = [0, 1, 2].map((place) => (place === corner % 3 ? 1 : 0));
            return surfacePoint(model, parent, Math.floor(corner / 3), barycentric);
        }
        child = scene.domains[parent];
    }
    return null;
}

/** The entry of `indices` whose vertex is nearest to the origin of a frame (row-major 3x4) in the domain. */
function nearestCorner(model: SceneModel, domain: number, frame: Float32Array): number {
    const shape = model.arrays?.shapes[model.scene.domains[domain]?.shape ?? -1];
    let nearest = 0;
    let smallest = Infinity;
    shape?.indices.forEach((corner, place) => {
        const position = restPosition(shape, at(shape.cornerVertices, corner));
        const offset = [0, 1, 2].map((axis) => at(position, axis) - at(frame, 4 * axis + 3));
        const distance = Math.hypot(...offset);
        if (distance < smallest) [nearest, smallest] = [place, distance];
    });
    return nearest;
}

/** u = U q at the point, in the domain's frame. */
export function displacementAt(model: SceneModel, { domain, modes }: SurfacePoint): Vec3 {
    const q = model.state.qOf(domain);
    return [0, 1, 2].map((axis) => {
        let sum = 0;
        for (let mode = 0; mode < q.length; mode++) sum += at(modes, axis * q.length + mode) * at(q, mode);
        return sum;
    }) as Vec3;
}

/** The length of A U q at the point in meters, with the linear part A of T. */
export function deflectionAt(model: SceneModel, point: SurfacePoint): number {
    const turned = applyLinear(model.state.transforms, TRANSFORM_SIZE * point.domain, displacementAt(model, point));
    return norm(turned) * model.scene.info.unit;
}

/** Position of the point in the current state, in scene units relative to the scene's origin. */
export function positionOf(model: SceneModel, point: SurfacePoint): Vec3 {
    const u = displacementAt(model, point);
    const local = point.rest.map((value, axis) => value + at(u, axis));
    return applyToPoint(model.state.transforms, TRANSFORM_SIZE * point.domain, local);
}

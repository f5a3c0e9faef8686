/** Bounds of the deformed scene from one sphere per domain, for the near plane and the shadow map. */

import { applyToPoint, norm, subtract, TRANSFORM_SIZE, type Vec3 } from "./affine";
import { restPosition, type ShapeArrays } from "./arrays";
import { at } from "./numbers";
import { displacementBound, type PackedModes } from "./packed_modes";
import type { SceneState } from "./state";

export interface Sphere {
    center: Vec3;
    radius: number;
}

/** A sphere around the rest positions of the vertices that triangles use. */
export function restSphere(shape: ShapeArrays): Sphere {
    const drawn = new Uint8Array(shape.restPositions.length / 3);
    for (const corner of shape.indices) drawn[at(shape.cornerVertices, corner)] = 1;
    const min: Vec3 = [Infinity, Infinity, Infinity];
    const max: Vec3 = [-Infinity, -Infinity, -Infinity];
    const forEachPosition = (visit: (position: Vec3) => void) => {
        drawn.forEach((isDrawn, vertex) => {
            if (isDrawn) visit(restPosition(shape, vertex));
        });
    };
    forEachPosition((position) => {
        for (let axis = 0; axis < 3; axis++) {
            min[axis] = Math.min(at(min, axis), at(position, axis));
            max[axis] = Math.max(at(max, axis), at(position, axis));
        }
    });
    const center: Vec3 = [(min[0] + max[0]) / 2, (min[1] + max[1]) / 2, (min[2] + max[2]) / 2];
    let radius = 0;
    forEachPosition((position) => {
        radius = Math.max(radius, norm(subtract(position, center)));
    });
    return { center, radius };
}

/** A sphere around a deformed domain. */
export interface DomainSphere extends Sphere {
    /** Radius for the shadow map: limited, because a larger one costs resolution. Large displacements can exceed it. */
    shadowRadius: number;
}

/** Spheres that contain the vertices of each domain, relative to the scene's origin. */
export function domainSpheres(
    state: SceneState,
    restSpheres: readonly Sphere[],
    packed: readonly (Pick<PackedModes, "norms"> | null)[],
): DomainSphere[] {
    return state.layout.scene.domains.map((domain) => {
        const rest = restSpheres[domain.shape] ?? { center: [0, 0, 0], radius: 0 };
        const modes = packed[domain.shape];
        const displacement = modes ? displacementBound(modes, state.qOf(domain.domain)) : 0;
        const place = TRANSFORM_SIZE * domain.domain;
        const scale = linearNorm(state.transforms, place);
        return {
            center: applyToPoint(state.transforms, place, rest.center),
            radius: scale * (rest.radius + displacement),
            // With many modes, the bound is much larger than the displacement.
            shadowRadius: scale * (rest.radius + Math.min(displacement, 2 * rest.radius)),
        };
    });
}

/** Upper bound of the spectral norm of the linear part A of the transform at `place`; exact for uniform scales. */
export function linearNorm(transforms: ArrayLike<number>, place: number): number {
    let largest = 0;
    // The largest absolute row sum of A A^T bounds its spectral norm, which is the square of that of A.
    for (let i = 0; i < 3; i++) {
        let sum = 0;
        for (let j = 0; j < 3; j++) {
            let entry = 0;
            for (let k = 0; k < 3; k++) entry += at(transforms, place + 4 * i + k) * at(transforms, place + 4 * j + k);
            sum += Math.abs(entry);
        }
        largest = Math.max(largest, sum);
    }
    return Math.sqrt(largest);
}

/**
 * Static response of a body to a force on a point, from its modes and eigenvalues. With U^T M U = I, the modal
 * stiffnesses are the eigenvalues, so a force f on a point with the rows U_i of U gives
 * q_k = (A U_i)_k . f / eigenvalue_k, with the linear part A of T.
 */

import { applyLinear, norm, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import { type Deflections, LARGEST_DEFLECTION } from "../scene/deflection";
import { eigenvaluesOf, largestRigidEigenvalue } from "../scene/description";
import { at } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import type { SurfacePoint } from "./surface_point";

/** Cosine of 1 degree. The limit is computed again only if the direction changes by more. */
const SAME_DIRECTION = Math.cos(Math.PI / 180);

export class PointCompliance {
    private lastDirection: Vec3 = [0, 0, 0];
    private lastLimit = Infinity;

    /**
     * @param responses q per newton in the direction of each world axis.
     * @param stiffness Newtons per scene unit: the inverse of the sum of the compliances along the three axes. The sum
     *   is at least the compliance in any direction, so the point does not pass the cursor.
     * @param largestDeflection Largest deflection of the body in meters at coordinates q.
     * @param allowed Largest allowed deflection in meters.
     */
    constructor(
        private readonly responses: readonly Float64Array[],
        readonly stiffness: number,
        private readonly largestDeflection: (q: Float64Array) => number,
        private readonly allowed: number,
    ) {}

    /**
     * The force in newtons whose static deflection of the body is the allowed one, for a direction. Infinite if nothing
     * bends.
     */
    limit(direction: Vec3): number {
        const length = norm(direction);
        if (!(length > 0)) return this.lastLimit;
        const unit = direction.map((component) => component / length) as Vec3;
        const cosine = unit.reduce((sum, component, axis) => sum + component * at(this.lastDirection, axis), 0);
        if (cosine > SAME_DIRECTION) return this.lastLimit;
        const q = new Float64Array(this.responses[0]?.length ?? 0);
        this.responses.forEach((response, axis) => {
            for (let mode = 0; mode < q.length; mode++) q[mode] = at(q, mode) + at(unit, axis) * at(response, mode);
        });
        this.lastDirection = unit;
        this.lastLimit = this.allowed / this.largestDeflection(q);
        return this.lastLimit;
    }
}

/**
 * The compliance at a point; null if no mode has stiffness. The allowed deflection is a fraction of the size of the
 * body. Without `deflections`, the deflection of the pulled point is used instead of the body's, and the diagonal of
 * the scene (in scene units) instead of the body's size.
 */
export function pointCompliance(
    model: SceneModel,
    point: SurfacePoint,
    deflections: Deflections | null,
    diagonal: number,
): PointCompliance | null {
    const { domain, modes } = point;
    const { scene, state, layout } = model;
    const rank = at(layout.ranks, domain);
    const eigenvalues = eigenvaluesOf(scene, domain);
    const largestRigid = largestRigidEigenvalue(eigenvalues);
    const responses = [0, 1, 2].map(() => new Float64Array(rank));
    const rows = Array.from({ length: rank }, (_, mode) => {
        const column = [0, 1, 2].map((axis) => at(modes, axis * rank + mode));
        return applyLinear(state.transforms, TRANSFORM_SIZE * domain, column);
    });
    let compliance = 0;
    rows.forEach((row, mode) => {
        const eigenvalue = eigenvalues[mode] ?? 0;
        if (!(eigenvalue > largestRigid)) return;
        responses.forEach((response, axis) => (response[mode] = at(row, axis) / eigenvalue));
        compliance += norm(row) ** 2 / eigenvalue;
    });
    if (!(compliance > 0)) return null;
    const largestOfPoint = (q: Float64Array) => {
        const u = [0, 1, 2].map((axis) => rows.reduce((sum, row, mode) => sum + at(row, axis) * at(q, mode), 0));
        return norm(u as Vec3) * scene.info.unit;
    };
    const largestOfBody = (q: Float64Array) => deflections?.largest(domain, q) ?? 0;
    const size = deflections?.size(domain) ?? diagonal * scene.info.unit;
    return new PointCompliance(
        responses,
        1 / compliance,
        deflections ? largestOfBody : largestOfPoint,
        LARGEST_DEFLECTION * size,
    );
}

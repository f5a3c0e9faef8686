/**
 * Static response of a body to a force on a point, from its modes and eigenvalues. With U^T M U = I, the modal
 * stiffnesses are the eigenvalues, so a force f on a point with the rows U_i of U gives
 * q_k = (A U_i)_k . f / eigenvalue_k, with the linear part A of T.
 */

import { applyLinear, norm, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import { type Deflections, LARGEST_DEFLECTION, LARGEST_LARGE_MOTION } from "../scene/deflection";
import { eigenvaluesOf, largestRigidEigenvalue } from "../scene/description";
import { at } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import type { SurfacePoint } from "./surface_point";

/** Cosine of 1 degree. The limit is computed again only if the direction changes by more. */
const SAME_DIRECTION = Math.cos(Math.PI / 180);

/** The note with the coordinates of the linear modes up to which the material of a model of large motion holds. */
const SAFE_COORDINATES = "modes.safe_coordinates";

/** How far a body may be pulled. */
export interface PullRange {
    /** Largest deflection as a fraction of the size of the body. */
    fraction: number;
    /** Largest coordinates of the first modes; empty if they are unknown. */
    safeCoordinates: number[];
}

/** The range of a body with these notes. Linear modes are wrong further out; a model of large motion is not. */
export function pullRange(notes: { [name: string]: string }): PullRange {
    const safe = notes[SAFE_COORDINATES];
    if (safe === undefined) return { fraction: LARGEST_DEFLECTION, safeCoordinates: [] };
    const numbers = safe.split(" ").map(Number);
    return { fraction: LARGEST_LARGE_MOTION, safeCoordinates: numbers.filter((number) => number > 0) };
}

export class PointCompliance {
    private lastDirection: Vec3 = [0, 0, 0];
    private lastLimit = Infinity;
    private isMaterialLimit = false;

    /**
     * @param responses q per newton in the direction of each world axis.
     * @param stiffness Newtons per scene unit: the inverse of the sum of the compliances along the three axes. The sum
     *   is at least the compliance in any direction, so the point does not pass the cursor.
     * @param largestDeflection Largest deflection of the body in meters at coordinates q.
     * @param size Size of the body in meters.
     * @param range How far the body may be pulled.
     */
    constructor(
        private readonly responses: readonly Float64Array[],
        readonly stiffness: number,
        private readonly largestDeflection: (q: Float64Array) => number,
        private readonly size: number,
        private readonly range: PullRange,
    ) {}

    /** The reason for the last limit, for users. */
    get limitReason(): string {
        if (this.isMaterialLimit) return "Beyond the limit, the material may collapse under compression.";
        return `The limit bends the part by ${100 * this.range.fraction} % of its size.`;
    }

    /**
     * The force in newtons whose static deflection of the body by linear modes is the largest one of the range, for a
     * direction. Infinite if nothing bends.
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
        const ofSize = (this.range.fraction * this.size) / this.largestDeflection(q);
        const ofMaterial = this.range.safeCoordinates.reduce(
            (least, safe, mode) => Math.min(least, safe / Math.abs(q[mode] ?? 0)),
            Infinity,
        );
        this.isMaterialLimit = ofMaterial < ofSize;
        this.lastLimit = Math.min(ofSize, ofMaterial);
        return this.lastLimit;
    }
}

/**
 * The compliance at a point; null if no mode has stiffness. The largest deflection is a fraction of the size of the
 * body ({@link pullRange}). Without `deflections`, the deflection of the pulled point is used instead of the body's, and the diagonal of
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
        size,
        pullRange(scene.domains[domain]?.notes ?? {}),
    );
}

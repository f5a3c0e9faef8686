/**
 * Transforms of attached domains that keep them on the surfaces of their parents, for the sliders of the viewer.
 *
 * A domain that is attached to a parent moves with the parent's surface: its transform is the parent's, times the rigid
 * transform that best fits the displacement U q of the parent's attachment vertices, times parent_from_child at rest.
 */

import { applyToPoint, IDENTITY, multiply, product, TRANSFORM_SIZE, type Vec3 } from "./affine";
import { restPosition, type SceneArrays } from "./arrays";
import { rankOf, type SceneDescription } from "./description";
import { at, toF32 } from "./numbers";
import type { SceneState, StateLayout } from "./state";

/** The attachment of a domain to its parent. */
interface Joint {
    domain: number;
    parent: number;
    /** parent_from_child at rest: 12 numbers, row-major 3x4. */
    frame: ArrayLike<number>;
    /** Rest positions of the attachment vertices, and their rows of U: 3 x rank each. */
    rest: Vec3[];
    modes: Float32Array[];
}

export class Kinematics {
    private readonly joints: Joint[] = [];

    constructor(scene: SceneDescription, arrays: SceneArrays) {
        for (const domain of scene.domains) {
            const { parent, follows, attachmentFrame } = domain;
            if (parent === undefined || follows !== undefined || attachmentFrame.length === 0) continue;
            const parentDomain = scene.domains[parent];
            const shape = parentDomain && arrays.shapes[parentDomain.shape];
            if (!parentDomain || !shape) continue;
            const rank = rankOf(scene, parentDomain);
            const vertices = shape.modes ? domain.attachmentVertices : [];
            this.joints.push({
                domain: domain.domain,
                parent,
                frame: toF32(attachmentFrame, "attachment_frame"),
                rest: vertices.map((vertex) => restPosition(shape, vertex)),
                modes: vertices.map(
                    (vertex) => shape.modes?.slice(3 * vertex * rank, 3 * (vertex + 1) * rank) ?? new Float32Array(),
                ),
            });
        }
    }

    /** The attached domains, in the order in which `transforms` returns their transforms. */
    get domains(): number[] {
        return this.joints.map((joint) => joint.domain);
    }

    /**
     * The transform of each attached domain relative to the scene's origin, a row-major 3x4 matrix. `q` are the
     * coordinates of the whole scene.
     */
    transforms(state: SceneState, q: Float32Array): Float64Array[] {
        const { layout } = state;
        const world = state.transforms.slice();
        return this.joints.map((joint) => {
            updateFollower(world, layout, joint.parent);
            const first = at(layout.firstCoordinate, joint.parent);
            const local = product(
                fitRigid(joint, q.subarray(first, first + at(layout.ranks, joint.parent))),
                joint.frame,
            );
            const result = new Float64Array(TRANSFORM_SIZE);
            multiply(result, 0, world, TRANSFORM_SIZE * joint.parent, local, 0);
            world.set(result, TRANSFORM_SIZE * joint.domain);
            return result;
        });
    }
}

/** Sets the transform of a domain that follows another one, which has a smaller index. */
function updateFollower(world: Float64Array, layout: StateLayout, domain: number): void {
    if (layout.isRoot(domain)) return;
    const place = TRANSFORM_SIZE * domain;
    const result = new Float64Array(TRANSFORM_SIZE);
    multiply(result, 0, world, TRANSFORM_SIZE * at(layout.root, domain), layout.rootFromDomain, place);
    world.set(result, place);
}

/** The rigid transform that maps the rest positions nearest to the displaced ones in the least-squares sense. */
function fitRigid({ rest, modes }: Joint, q: Float32Array): number[] {
    if (rest.length === 0) return [...IDENTITY];
    const moved = rest.map((point, vertex) => {
        const rows = modes[vertex] as Float32Array;
        return point.map((value, component) => {
            let sum = value;
            for (let mode = 0; mode < q.length; mode++) sum += at(rows, component * q.length + mode) * at(q, mode);
            return sum;
        }) as Vec3;
    });
    const mean = (points: Vec3[]) =>
        [0, 1, 2].map((c) => points.reduce((sum, p) => sum + at(p, c), 0) / points.length) as Vec3;
    const [restMean, movedMean] = [mean(rest), mean(moved)];
    const correlation = new Array<number>(9).fill(0);
    rest.forEach((point, vertex) => {
        const target = moved[vertex] as Vec3;
        for (let i = 0; i < 3; i++) {
            for (let j = 0; j < 3; j++) {
                correlation[3 * i + j] =
                    at(correlation, 3 * i + j) + (at(target, i) - at(movedMean, i)) * (at(point, j) - at(restMean, j));
            }
        }
    });
    const rotation = nearestRotation(correlation);
    const transform = [0, 1, 2].flatMap((row) => [
        at(rotation, 3 * row),
        at(rotation, 3 * row + 1),
        at(rotation, 3 * row + 2),
        0,
    ]);
    const rotated = applyToPoint(transform, 0, restMean);
    for (let axis = 0; axis < 3; axis++) transform[4 * axis + 3] = at(movedMean, axis) - at(rotated, axis);
    return transform;
}

/**
 * The rotation nearest to a row-major 3x3 matrix. Its unit quaternion is the eigenvector of the largest eigenvalue of
 * Horn's symmetric 4x4 matrix ("Closed-form solution of absolute orientation using unit quaternions", 1987).
 */
export function nearestRotation(m: readonly number[]): number[] {
    const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = m as [
        number,
        number,
        number,
        number,
        number,
        number,
        number,
        number,
        number,
    ];
    const matrix = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, yy - xx - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, zz - xx - yy],
    ];
    const [w, x, y, z] = largestEigenvector(matrix) as [number, number, number, number];
    return [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ];
}

/** Unit eigenvector of the largest eigenvalue of a symmetric matrix, by cyclic Jacobi rotations. */
function largestEigenvector(matrix: number[][]): number[] {
    const n = matrix.length;
    const a = matrix.map((row) => row.slice());
    const vectors = a.map((_, i) => a.map((_, j) => (i === j ? 1 : 0)));
    const get = (rows: number[][], i: number, j: number) => at(rows[i] ?? [], j);
    const set = (rows: number[][], i: number, j: number, value: number) => {
        const row = rows[i];
        if (row) row[j] = value;
    };
    // Jacobi rotations converge quadratically; 12 sweeps are far more than a 4x4 matrix needs.
    for (let sweep = 0; sweep < 12; sweep++) {
        for (let p = 0; p < n; p++) {
            for (let r = p + 1; r < n; r++) {
                const off = get(a, p, r);
                if (off === 0) continue;
                const theta = (get(a, r, r) - get(a, p, p)) / (2 * off);
                const t = (theta < 0 ? -1 : 1) / (Math.abs(theta) + Math.hypot(theta, 1));
                const c = 1 / Math.hypot(t, 1);
                const s = t * c;
                for (let k = 0; k < n; k++) {
                    const [kp, kr] = [get(a, k, p), get(a, k, r)];
                    set(a, k, p, c * kp - s * kr);
                    set(a, k, r, s * kp + c * kr);
                }
                for (let k = 0; k < n; k++) {
                    const [pk, rk] = [get(a, p, k), get(a, r, k)];
                    set(a, p, k, c * pk - s * rk);
                    set(a, r, k, s * pk + c * rk);
                    const [vp, vr] = [get(vectors, k, p), get(vectors, k, r)];
                    set(vectors, k, p, c * vp - s * vr);
                    set(vectors, k, r, s * vp + c * vr);
                }
            }
        }
    }
    let best = 0;
    for (let i = 1; i < n; i++) if (get(a, i, i) > get(a, best, best)) best = i;
    return vectors.map((row) => at(row, best));
}

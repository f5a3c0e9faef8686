/** Affine transforms as 12 numbers, row-major 3x4, in a larger array at an offset. */

import { at } from "./numbers";

export type Vec3 = [number, number, number];

/** Number of entries of one transform. */
export const TRANSFORM_SIZE = 12;

export const IDENTITY: readonly number[] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];

type Numbers = Float64Array | Float32Array | number[];

/** out = a b. `out` must not overlap `a` or `b`. */
export function multiply(
    out: Numbers,
    outOffset: number,
    a: ArrayLike<number>,
    aOffset: number,
    b: ArrayLike<number>,
    bOffset: number,
): void {
    for (let row = 0; row < 3; row++) {
        for (let column = 0; column < 4; column++) {
            let sum = column === 3 ? at(a, aOffset + 4 * row + 3) : 0;
            for (let k = 0; k < 3; k++) sum += at(a, aOffset + 4 * row + k) * at(b, bOffset + 4 * k + column);
            out[outOffset + 4 * row + column] = sum;
        }
    }
}

export function product(a: ArrayLike<number>, b: ArrayLike<number>): number[] {
    const result = new Array<number>(TRANSFORM_SIZE).fill(0);
    multiply(result, 0, a, 0, b, 0);
    return result;
}

export function applyToPoint(transform: ArrayLike<number>, offset: number, point: ArrayLike<number>): Vec3 {
    const row = (r: number) =>
        at(transform, offset + 4 * r) * at(point, 0) +
        at(transform, offset + 4 * r + 1) * at(point, 1) +
        at(transform, offset + 4 * r + 2) * at(point, 2) +
        at(transform, offset + 4 * r + 3);
    return [row(0), row(1), row(2)];
}

/** The linear part times a vector. */
export function applyLinear(transform: ArrayLike<number>, offset: number, vector: ArrayLike<number>): Vec3 {
    const row = (r: number) =>
        [0, 1, 2].reduce((sum, column) => sum + at(transform, offset + 4 * r + column) * at(vector, column), 0);
    return [row(0), row(1), row(2)];
}

/** The inverse of the linear part times a vector; null if the linear part is singular. */
export function solveLinear(transform: ArrayLike<number>, vector: Vec3): Vec3 | null {
    const [a, b, c] = [0, 1, 2].map((column) => [0, 1, 2].map((row) => at(transform, 4 * row + column)) as Vec3) as [
        Vec3,
        Vec3,
        Vec3,
    ];
    const determinant = dot(a, cross(b, c));
    if (!Number.isFinite(1 / determinant)) return null;
    return [
        dot(vector, cross(b, c)) / determinant,
        dot(a, cross(vector, c)) / determinant,
        dot(a, cross(b, vector)) / determinant,
    ];
}

export function dot(a: Vec3, b: Vec3): number {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross(a: Vec3, b: Vec3): Vec3 {
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function subtract(a: Vec3, b: Vec3): Vec3 {
    return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

export function addScaled(a: Vec3, b: Vec3, factor: number): Vec3 {
    return [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
}

export function norm(a: Vec3): number {
    return Math.hypot(a[0], a[1], a[2]);
}

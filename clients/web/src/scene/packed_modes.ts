/**
 * U in 16 bits per entry, for textures.
 *
 * A column (mode) k is stored as U / scale_k, so q_k is multiplied by scale_k before the shader adds the modes. Two
 * formats exist: `f16`, and `i16` with 65,535 equal steps. The largest error of each column is measured while packing.
 *
 * A texel has four modes of one component of a vertex. Texel (v * groups + g) * 3 + c has modes 4 g to 4 g + 3 of
 * component c of vertex v, so that a dot product with four coordinates adds four modes.
 */

import { at } from "./numbers";

export type PackedFormat = "f16" | "i16";

const I16_MAX = 32767;

export interface PackedModes {
    format: PackedFormat;
    /** Four values per texel. f16: bits of the numbers. */
    texels: Uint16Array | Int16Array;
    /** One per mode, in scene units per unit of q; for i16 it includes the factor 1 / 32767. */
    scales: Float32Array;
    /** One per mode: largest distance of a vertex's row of U from the stored one, in scene units per unit of q. */
    errors: Float64Array;
    /** One per mode: largest norm of a vertex's row of U, in scene units per unit of q. */
    norms: Float64Array;
}

/** Number of texels of four modes for a component. */
export function modeGroups(rank: number): number {
    return Math.ceil(rank / 4);
}

/** Bytes of a shape's packed U. */
export function packedBytes(vertices: number, rank: number): number {
    return 8 * 3 * vertices * modeGroups(rank);
}

const f32 = new Float32Array(1);
const bits = new Uint32Array(f32.buffer);

/** The nearest f16 of a number of magnitude at most 1, ties to even. */
export function toF16(value: number): number {
    f32[0] = value;
    const word = at(bits, 0);
    const sign = (word >>> 16) & 0x8000;
    const exponent = (word >>> 23) & 0xff;
    // Bits of the significand that f16 drops: 13 for normal numbers, more below 2^-14.
    const dropped = exponent >= 113 ? 13 : 126 - exponent;
    if (dropped > 24) return sign;
    const significand = (word & 0x7fffff) | 0x800000;
    const kept = significand >>> dropped;
    const rest = significand - kept * 2 ** dropped;
    const half = 2 ** (dropped - 1);
    const rounded = kept + (rest > half || (rest === half && (kept & 1) === 1) ? 1 : 0);
    // A carry moves into the exponent, as it must.
    return sign | (exponent >= 113 ? ((exponent - 113) << 10) + rounded : rounded);
}

export function fromF16(half: number): number {
    const sign = half & 0x8000 ? -1 : 1;
    const exponent = (half >> 10) & 0x1f;
    const fraction = half & 0x3ff;
    return sign * (exponent === 0 ? fraction * 2 ** -24 : (1 + fraction / 1024) * 2 ** (exponent - 15));
}

/** Packs U, row-major (3 vertices) x rank. */
export function packModes(modes: Float32Array, vertices: number, rank: number, format: PackedFormat): PackedModes {
    if (modes.length !== 3 * vertices * rank) {
        throw new Error(`U: expected ${3 * vertices * rank} numbers, got ${modes.length}`);
    }
    const groups = modeGroups(rank);
    const texels = format === "f16" ? new Uint16Array(12 * vertices * groups) : new Int16Array(12 * vertices * groups);
    const largest = new Float64Array(rank);
    for (let entry = 0, mode = 0; entry < modes.length; entry++, mode = mode + 1 === rank ? 0 : mode + 1) {
        const size = Math.abs(at(modes, entry));
        if (size > at(largest, mode)) largest[mode] = size;
    }
    const scales = new Float32Array(rank);
    for (let mode = 0; mode < rank; mode++) {
        const size = at(largest, mode);
        // A power of two changes no bits of f16.
        if (size > 0) scales[mode] = format === "f16" ? 2 ** Math.ceil(Math.log2(size)) : size / I16_MAX;
    }
    const squaredErrors = new Float64Array(rank);
    const squaredNorms = new Float64Array(rank);
    for (let vertex = 0; vertex < vertices; vertex++) {
        for (let mode = 0; mode < rank; mode++) {
            const scale = at(scales, mode);
            let squaredError = 0;
            let squaredNorm = 0;
            for (let component = 0; component < 3; component++) {
                const value = at(modes, (3 * vertex + component) * rank + mode);
                const scaled = scale > 0 ? value / scale : 0;
                const code =
                    format === "f16" ? toF16(scaled) : Math.max(-I16_MAX, Math.min(I16_MAX, Math.round(scaled)));
                texels[4 * ((vertex * groups + (mode >> 2)) * 3 + component) + (mode & 3)] = code;
                const stored = (format === "f16" ? fromF16(code) : code) * scale;
                squaredError += (stored - value) ** 2;
                squaredNorm += value ** 2;
            }
            if (squaredError > at(squaredErrors, mode)) squaredErrors[mode] = squaredError;
            if (squaredNorm > at(squaredNorms, mode)) squaredNorms[mode] = squaredNorm;
        }
    }
    return { format, texels, scales, errors: squaredErrors.map(Math.sqrt), norms: squaredNorms.map(Math.sqrt) };
}

/** Largest ratio of a mode's error to its norm. The format with the smaller one is chosen. */
export function relativeError(packed: PackedModes): number {
    let largest = 0;
    packed.errors.forEach((error, mode) => {
        const size = at(packed.norms, mode);
        if (size > 0) largest = Math.max(largest, error / size);
    });
    return largest;
}

/** Upper bound of the error of U q at any vertex, in scene units. */
export function errorBound(packed: Pick<PackedModes, "errors">, q: ArrayLike<number>): number {
    let sum = 0;
    for (let mode = 0; mode < packed.errors.length; mode++) sum += Math.abs(at(q, mode)) * at(packed.errors, mode);
    return sum;
}

/** Upper bound of |U q| at any vertex, in scene units. */
export function displacementBound(packed: Pick<PackedModes, "norms">, q: ArrayLike<number>): number {
    let sum = 0;
    for (let mode = 0; mode < packed.norms.length; mode++) sum += Math.abs(at(q, mode)) * at(packed.norms, mode);
    return sum;
}

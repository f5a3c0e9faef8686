/** Arrays of little-endian numbers from bytes at any alignment. All browsers run on little-endian machines. */

function aligned(bytes: Uint8Array, size: number, name: string): ArrayBuffer {
    if (bytes.length % size !== 0)
        throw new Error(`${name}: expected a multiple of ${size} bytes, got ${bytes.length}`);
    return bytes.slice().buffer;
}

export function toF32(bytes: Uint8Array, name = "f32"): Float32Array<ArrayBuffer> {
    return new Float32Array(aligned(bytes, 4, name));
}

export function toF64(bytes: Uint8Array, name = "f64"): Float64Array<ArrayBuffer> {
    return new Float64Array(aligned(bytes, 8, name));
}

export function toU32(bytes: Uint8Array, name = "u32"): Uint32Array<ArrayBuffer> {
    return new Uint32Array(aligned(bytes, 4, name));
}

export function toHex(bytes: Uint8Array): string {
    return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** An element of an array of numbers. Callers guarantee the index; out of range gives NaN. */
export function at(numbers: ArrayLike<number>, index: number): number {
    return numbers[index] ?? Number.NaN;
}

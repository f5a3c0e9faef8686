/** Textures that hold tables: entry i is texel (i % width, i / width). */

import * as THREE from "three";

/** Width of tables that shaders index by number. */
export const TABLE_WIDTH = 4096;
/** Width of the texture of deformed positions, which has one texel per vertex of the scene. */
export const WIDTH = 2048;

type TableArray =
    | Float32Array<ArrayBuffer>
    | Uint16Array<ArrayBuffer>
    | Int16Array<ArrayBuffer>
    | Int32Array<ArrayBuffer>
    | Uint32Array<ArrayBuffer>;

interface TableFormat {
    format: THREE.PixelFormat;
    type: THREE.TextureDataType;
    internalFormat: THREE.PixelFormatGPU;
}

export const FORMATS = {
    f32: { format: THREE.RGBAFormat, type: THREE.FloatType, internalFormat: "RGBA32F" },
    f16: { format: THREE.RGBAFormat, type: THREE.HalfFloatType, internalFormat: "RGBA16F" },
    i16: { format: THREE.RGBAIntegerFormat, type: THREE.ShortType, internalFormat: "RGBA16I" },
    i32: { format: THREE.RGBAIntegerFormat, type: THREE.IntType, internalFormat: "RGBA32I" },
    u32: { format: THREE.RedIntegerFormat, type: THREE.UnsignedIntType, internalFormat: "R32UI" },
} satisfies Record<string, TableFormat>;

/** Number of texels of a table with at least `entries` entries. */
export function paddedEntries(entries: number, width: number): number {
    return Math.max(1, Math.ceil(entries / width)) * width;
}

/** A texture of `data`, whose length is that of `paddedEntries` texels. */
export function tableTexture(
    data: TableArray,
    components: number,
    width: number,
    format: TableFormat,
): THREE.DataTexture {
    const height = data.length / components / width;
    const texture = new THREE.DataTexture(data, width, height, format.format, format.type);
    texture.internalFormat = format.internalFormat;
    texture.minFilter = THREE.NearestFilter;
    texture.magFilter = THREE.NearestFilter;
    texture.generateMipmaps = false;
    texture.unpackAlignment = 1;
    texture.needsUpdate = true;
    return texture;
}

/**
 * Mipmap levels of cut-out images that preserve the covered fraction (Castano, "Computing alpha mipmaps", 2010), as the
 * server does. With plain averages, leaves that cover less than half of their image vanish in the distance, and others
 * become squares.
 */

import { at } from "../scene/numbers";

export interface MipLevel {
    data: Uint8Array<ArrayBuffer>;
    width: number;
    height: number;
}

const LINEAR_FROM_SRGB = Float32Array.from({ length: 256 }, (_, byte) => {
    const encoded = byte / 255;
    return encoded <= 0.04045 ? encoded / 12.92 : ((encoded + 0.055) / 1.055) ** 2.4;
});

function toSrgbByte(linear: number): number {
    return Math.round(255 * (linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055));
}

/** All levels of an RGBA8 sRGB image, level 0 first. The fraction with an alpha of at least `cutoff` is that of level 0. */
export function mipChain(pixels: Uint8Array<ArrayBuffer>, width: number, height: number, cutoff: number): MipLevel[] {
    const levels: MipLevel[] = [{ data: pixels, width, height }];
    const covered = coverage(pixels, cutoff);
    let level: MipLevel = { data: pixels, width, height };
    while (level.width > 1 || level.height > 1) {
        level = halve(level);
        levels.push({ ...level, data: withCoverage(level.data, cutoff, covered) });
    }
    return levels;
}

/** The fraction of texels with an alpha of at least the cutoff. */
export function coverage(data: Uint8Array, cutoff: number): number {
    let covered = 0;
    for (let place = 3; place < data.length; place += 4) if (at(data, place) >= 255 * cutoff) covered++;
    return covered / (data.length / 4);
}

/** Each texel is the mean of up to four texels, in linear light. */
function halve({ data, width, height }: MipLevel): MipLevel {
    const [halfWidth, halfHeight] = [Math.max(1, width >> 1), Math.max(1, height >> 1)];
    const result = new Uint8Array(4 * halfWidth * halfHeight);
    for (let y = 0; y < halfHeight; y++) {
        for (let x = 0; x < halfWidth; x++) {
            const [x0, y0] = [Math.min(2 * x, width - 1), Math.min(2 * y, height - 1)];
            const [x1, y1] = [Math.min(2 * x + 1, width - 1), Math.min(2 * y + 1, height - 1)];
            const places = [y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1];
            const target = 4 * (y * halfWidth + x);
            for (let channel = 0; channel < 4; channel++) {
                let sum = 0;
                for (const place of places) {
                    const byte = at(data, 4 * place + channel);
                    sum += channel < 3 ? at(LINEAR_FROM_SRGB, byte) : byte;
                }
                result[target + channel] = channel < 3 ? toSrgbByte(sum / 4) : Math.round(sum / 4);
            }
        }
    }
    return { data: result, width: halfWidth, height: halfHeight };
}

/** Scales alpha so that a fraction of the texels reaches the cutoff. */
function withCoverage(data: Uint8Array<ArrayBuffer>, cutoff: number, fraction: number): Uint8Array<ArrayBuffer> {
    const count = data.length / 4;
    const alphas = Uint8Array.from({ length: count }, (_, texel) => at(data, 4 * texel + 3)).sort();
    const covered = Math.round(fraction * count);
    if (covered === 0 || covered === count) return data;
    // Halfway between the lowest alpha that must reach the cutoff and the highest one that must not.
    const threshold = (at(alphas, count - covered) + at(alphas, count - covered - 1)) / 2;
    if (threshold <= 0) return data;
    const scale = (255 * cutoff) / threshold;
    const result = data.slice();
    for (let place = 3; place < result.length; place += 4)
        result[place] = Math.min(255, Math.round(scale * at(result, place)));
    return result;
}

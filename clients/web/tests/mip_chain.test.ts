import assert from "node:assert/strict";
import { test } from "node:test";
import { coverage, mipChain } from "../src/render/mip_chain";

/** Thin diagonal stripes that cover a quarter of the image. */
function stripes(side: number): Uint8Array<ArrayBuffer> {
    const pixels = new Uint8Array(4 * side * side);
    for (let place = 0; place < side * side; place++) {
        const stripe = ((place % side) + 3 * Math.floor(place / side)) % 16;
        pixels.set([90, 160, 40, stripe < 4 ? 255 : stripe < 6 ? 60 : 0], 4 * place);
    }
    return pixels;
}

test("all levels cover the same fraction", () => {
    const chain = mipChain(stripes(64), 64, 64, 0.5);
    assert.deepEqual(
        chain.map((level) => level.width),
        [64, 32, 16, 8, 4, 2, 1],
    );
    for (const { data, width } of chain.slice(0, 3)) {
        assert.ok(Math.abs(coverage(data, 0.5) - 0.25) <= 0.08, `${width}: ${coverage(data, 0.5)}`);
    }
    // Control: the plain mean of the last level is below the cutoff, so the stripes would vanish.
    const last = chain[6]?.data ?? [];
    assert.ok((last[3] ?? 255) < 127, `expected a mean alpha below the cutoff, got ${last[3]}`);
});

test("colors are averaged in linear light", () => {
    const pixels = new Uint8Array([255, 255, 255, 255, 0, 0, 0, 255, 255, 255, 255, 255, 0, 0, 0, 255]);
    assert.deepEqual([...(mipChain(pixels, 2, 2, 0.5)[1]?.data ?? [])], [188, 188, 188, 255]);
});

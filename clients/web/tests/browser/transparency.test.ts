/** Transparent surfaces in headless Chromium, and in the server's pictures. */

import assert from "node:assert/strict";
import { mkdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import type { Browser, Page } from "playwright-core";
import { launchBrowser, openPage, ServerProcess, simulateGpu, temporaryFolder, waitForScene } from "./harness";
import { browserPicture, cameraOf, meanDifference, serverPicture } from "./pictures";

const SIZE = [480, 300] as const;
const LIMIT_MS = 300_000;
/** Folder for screenshots; empty: none. */
const SCREENSHOTS = process.env["MODALCAST_SCREENSHOTS"] ?? "";

/** Colors without light and shadow: a value of 1 is white. */
const MATERIALS = { red: [1, 0, 0], green: [0, 1, 0], blue: [0, 0, 1], white: [1, 1, 1] } as const;

/** Corners of a rectangle between two values of x, with the depth z at each of them. */
function rectangle(material: keyof typeof MATERIALS, [left, right]: number[], [zLeft, zRight]: number[]): string {
    const corners = [
        [left, -1, zLeft],
        [right, -1, zRight],
        [right, 1, zRight],
        [left, 1, zLeft],
    ];
    return `usemtl ${material}\n${corners.map((corner) => `v ${corner.join(" ")}\n`).join("")}f -4 -3 -2 -1\n`;
}

/**
 * Before a white wall: red on white; red and blue rectangles that cross; and four layers, whose order in the file
 * is not that of their depths.
 */
function writeScene(folder: string): void {
    const transparent = (name: string) => (name === "white" ? "" : "d 0.5\n");
    const materials = Object.entries(MATERIALS).map(
        ([name, color]) => `newmtl ${name}\nKa ${color.join(" ")}\nKd 0 0 0\n${transparent(name)}`,
    );
    const rectangles = [
        rectangle("white", [-4, 4], [-2, -2]),
        rectangle("red", [-3, -1], [0, 0]),
        rectangle("red", [-1, 1], [0.5, -0.5]),
        rectangle("blue", [-1, 1], [-0.5, 0.5]),
        rectangle("blue", [1, 3], [0, 0]),
        rectangle("green", [1, 3], [0.5, 0.5]),
        rectangle("red", [1, 3], [-0.5, -0.5]),
        rectangle("green", [1, 3], [-1, -1]),
    ];
    mkdirSync(folder);
    writeFileSync(join(folder, "layers.mtl"), materials.join(""));
    writeFileSync(join(folder, "layers.obj"), `mtllib layers.mtl\n${rectangles.join("")}`);
    const look = 'skylight = [1, 1, 1]\nsunlight = [0, 0, 0]\nantialias = "none"\n';
    writeFileSync(join(folder, "scene.toml"), `model = "layers.obj"\n[look]\n${look}`);
}

const scenes = temporaryFolder();
writeScene(join(scenes, "layers"));
const server = new ServerProcess(scenes);
let browser: Browser;
before(async () => {
    await server.start();
    await (await server.client()).openScene("layers");
    browser = await launchBrowser();
});
after(async () => {
    await browser.close();
    await server.stop();
});

/** Color of linear light in 8 bits. */
function encoded(light: readonly number[]): number[] {
    return light.map((value) =>
        Math.round(255 * (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055)),
    );
}

/** Where surfaces are blended, and the light there: each layer has half of what the layers before it let pass. */
const POINTS: readonly { point: [number, number, number]; layers: readonly (keyof typeof MATERIALS)[] }[] = [
    { point: [-2, 0, 0], layers: ["red", "white"] },
    { point: [-0.5, 0, 0], layers: ["red", "blue", "white"] },
    { point: [0.5, 0, 0], layers: ["blue", "red", "white"] },
    { point: [2, 0, 0], layers: ["green", "blue", "red", "green", "white"] },
];

function blended(layers: readonly (keyof typeof MATERIALS)[]): number[] {
    const light = [0, 0, 0];
    let transmittance = 1;
    for (const layer of layers) {
        const weight = layer === "white" ? transmittance : transmittance / 2;
        MATERIALS[layer].forEach((value, channel) => {
            light[channel] = (light[channel] ?? 0) + weight * value;
        });
        transmittance -= weight;
    }
    return light;
}

/** The colors at `POINTS`. */
async function colorsAtPoints(page: Page, picture: Uint8Array): Promise<number[][]> {
    const points = POINTS.map(({ point }) => point);
    const pixels = await page.evaluate(
        (list) => list.map((point) => modalcastViewer.viewport.camera.project(point) ?? [-1, -1]),
        points,
    );
    return pixels.map(([x = 0, y = 0]) => {
        const first = 4 * (Math.floor(y) * SIZE[0] + Math.floor(x));
        return Array.from(picture.slice(first, first + 3));
    });
}

function largestDifference(a: readonly number[][], b: readonly number[][]): number {
    return Math.max(
        ...a.flatMap((color, i) => color.map((value, channel) => Math.abs(value - (b[i]?.[channel] ?? 0)))),
    );
}

for (const device of ["CPU", "GPU"] as const) {
    test(`transparent surfaces are blended in linear light, as on a ${device}`, { timeout: LIMIT_MS }, async () => {
        const { page, errors } = await openPage(browser, "about:blank", ...SIZE);
        if (device === "GPU") await simulateGpu(page);
        await page.goto(server.pageUrl("layers"), { waitUntil: "commit" });
        await waitForScene(page);
        assert.equal(await page.evaluate(() => modalcastViewer.viewport.isSoftware), device === "CPU");
        await page.evaluate(() => modalcastViewer.viewport.camera.look([0, 0, 9], [0, 0, 0]));
        const drawn = await browserPicture(page);
        const expected = POINTS.map(({ layers }) => encoded(blended(layers)));
        const colors = await colorsAtPoints(page, drawn);
        assert.deepEqual(expected[0], [255, 188, 188]);
        const error = largestDifference(colors, expected);
        assert.ok(error <= 1, `expected ${JSON.stringify(expected)}, got ${JSON.stringify(colors)}`);
        // Controls: another order of the layers, and colors that are blended after their encoding.
        const reversed = POINTS.map(({ layers }) => encoded(blended([...layers.slice(0, -1).reverse(), "white"])));
        assert.ok(largestDifference(colors, reversed) > 30, "expected another color with the reversed order");
        const nonlinear = POINTS.map(({ layers }) => blended(layers).map((value) => Math.round(255 * value)));
        assert.ok(largestDifference(colors, nonlinear) > 30, "expected another color than without linear light");
        // The whole picture: edges differ by their samples.
        const client = await server.client();
        const camera = await cameraOf(page);
        const reference = await serverPicture(client, "layers", camera, SIZE);
        const difference = meanDifference(drawn, reference);
        assert.ok(difference < 1, `expected the server's picture within 1 level in the mean, got ${difference}`);
        await page.evaluate(() => modalcastViewer.viewport.camera.look([1, 0, 9], [1, 0, 0]));
        const moved = meanDifference(drawn, await serverPicture(client, "layers", await cameraOf(page), SIZE));
        assert.ok(moved > 5, `control: expected another picture from another point, got ${moved}`);
        if (SCREENSHOTS) {
            mkdirSync(SCREENSHOTS, { recursive: true });
            await page.screenshot({ path: join(SCREENSHOTS, `transparency-${device}.png`) });
        }
        console.log(`${device}: largest error ${error}, mean difference from the server ${difference.toFixed(3)}`);
        assert.deepEqual(errors, []);
        await page.close();
    });
}

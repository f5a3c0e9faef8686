/** Axes, scale bar and background of the view, with a recording. */

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Page } from "playwright-core";
import { BeamSetup } from "./beam_setup";
import { takeScreenshot } from "./harness";

const LIMIT_MS = 120_000;
const setup = new BeamSetup();

/** Unit vector from the target to the camera. */
function toCamera(page: Page): Promise<number[]> {
    return page.evaluate(() => {
        const { eye, target } = modalcastViewer.viewport.camera;
        const offset = eye.map((value, axis) => value - (target[axis] ?? 0));
        return offset.map((value) => value / Math.hypot(...offset));
    });
}

/** Pixels between the images of two points at the target, which are `meters` apart along the image. */
function pixelsOf(page: Page, meters: number): Promise<number> {
    return page.evaluate((length) => {
        const { viewport, model } = modalcastViewer;
        const { camera } = viewport;
        const [x, y] = camera.project(camera.target) ?? [0, 0];
        const moved = camera.unproject(x + 1, y, camera.target);
        const units = Math.hypot(...moved.map((value, axis) => value - (camera.target[axis] ?? 0)));
        const end = camera.target.map(
            (value, axis) =>
                value + (((moved[axis] ?? 0) - value) / units) * (length / (model?.scene.info.unit ?? Number.NaN)),
        );
        return (camera.project(end as [number, number, number])?.[0] ?? Number.NaN) - x;
    }, meters);
}

/** Meters and pixels of the bar on the page. */
async function scaleBar(page: Page): Promise<{ meters: number; pixels: number }> {
    await page.locator("#scale-bar").waitFor();
    const text = (await page.locator("#scale-bar span").textContent()) ?? "";
    const [, number, unit] = /^([\d.]+) (mm|m)$/.exec(text) ?? [];
    assert.ok(number, `expected a length, got "${text}"`);
    const pixels = (await page.locator("#scale-bar i").boundingBox())?.width ?? Number.NaN;
    return { meters: Number(number) * (unit === "mm" ? 1e-3 : 1), pixels };
}

test("the scale bar has the length of an object at the center of the view", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(1280, 800);
    const lengths = new Set<number>();
    for (const zoom of [1, 0.3, 0.1]) {
        await page.evaluate((factor) => {
            const { camera } = modalcastViewer.viewport;
            const { eye, target } = camera;
            const closer = eye.map((value, axis) => (target[axis] ?? 0) + factor * (value - (target[axis] ?? 0)));
            camera.look(closer as [number, number, number], target);
            return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
        }, zoom);
        const { meters, pixels } = await scaleBar(page);
        const expected = await pixelsOf(page, meters);
        assert.ok(Math.abs(pixels - expected) < 0.5, `${meters} m: expected ${expected} pixels, got ${pixels}`);
        lengths.add(meters);
    }
    assert.equal(lengths.size, 3, "expected another length for each distance");
    assert.deepEqual(errors, []);
    await page.close();
});

test("a click on an axis looks along it", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(1280, 800);
    await takeScreenshot(page, "axes");
    for (const [name, direction] of [
        ["+x", [1, 0, 0]],
        ["+y", [0, 1, 0]],
        ["-z", [0, 0, -1]],
        ["-y", [0, -1, 0]],
        ["+z", [0, 0, 1]],
    ] as const) {
        // Another end may hide an end that points away.
        await page.getByRole("button", { name: `View from ${name}`, exact: true }).press("Enter");
        const got = await toCamera(page);
        const error = Math.hypot(...got.map((value, axis) => value - (direction[axis] ?? 0)));
        assert.ok(error < 1e-3, `${name}: expected ${direction}, got ${got}`);
    }
    // The beam lies along z, towards the viewer: its x axis points to the right, and y up.
    const x = await page.evaluate(() => modalcastViewer.viewport.camera.directionInView([1, 0, 0]));
    assert.ok(Math.hypot((x[0] ?? 0) - 1, x[1] ?? 0) < 1e-3);
    // With the mouse, and a view that the user has changed: the distance stays.
    await page.mouse.move(400, 400);
    await page.mouse.wheel(0, -300);
    const distance = () =>
        page.evaluate(() => {
            const { eye, target } = modalcastViewer.viewport.camera;
            return Math.hypot(...eye.map((value, axis) => value - (target[axis] ?? 0)));
        });
    await page.waitForFunction(() => modalcastViewer.viewport.camera.hasMoved);
    const before = await distance();
    await page.locator("#axes .x.positive .hit").click();
    assert.ok(((await toCamera(page))[0] ?? 0) > 0.999);
    assert.ok(Math.abs((await distance()) / before - 1) < 1e-6);
    await takeScreenshot(page, "axes-from-x");
    assert.deepEqual(errors, []);
    await page.close();
});

/** Colors of two pixels of the view, which is drawn anew: in the sky, and in the ground. */
function skyAndGround(page: Page): Promise<number[][]> {
    return page.evaluate(
        () =>
            new Promise<number[][]>((done) => {
                const { viewport } = modalcastViewer;
                viewport.onDrawn = () => {
                    viewport.onDrawn = () => {};
                    const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
                    const [width, height] = viewport.pixelSize;
                    const colors = [height - 20, 20].map((y) => {
                        const color = new Uint8Array(4);
                        gl.readPixels(width / 2, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, color);
                        return [...color];
                    });
                    done(colors);
                };
                viewport.invalidate();
            }),
    );
}

test("a plain background replaces sky and ground", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(1280, 800);
    const [sky, ground] = await skyAndGround(page);
    assert.notDeepEqual(sky, ground, "control: sky and ground differ");
    const select = page.getByRole("combobox", { name: "Background" });
    for (const [value, level] of [
        ["white", 255],
        ["gray", 240],
    ] as const) {
        await select.selectOption(value);
        for (const edges of [false, true]) {
            await page.evaluate((isOn) => {
                const { settings } = modalcastViewer;
                if (settings.edges !== isOn) modalcastViewer.toggleEdges();
            }, edges);
            const expected = [level, level, level, 255];
            assert.deepEqual(await skyAndGround(page), [expected, expected], `${value}, edges ${edges}`);
        }
        await takeScreenshot(page, `background-${value}`);
    }
    await page.evaluate(() => modalcastViewer.toggleEdges());
    await select.selectOption("scene");
    assert.deepEqual(await skyAndGround(page), [sky, ground]);
    assert.deepEqual(errors, []);
    await page.close();
});

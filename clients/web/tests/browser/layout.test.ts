/** The page on a desktop and on a phone: the view fits beside the panels. A recording is played, without a server. */

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Page } from "playwright-core";
import { BeamSetup } from "./beam_setup";
import { takeScreenshot } from "./harness";

const LIMIT_MS = 120_000;
const DESKTOP = [1280, 800] as const;
const PHONE = [390, 844] as const;
const setup = new BeamSetup();

interface Box {
    left: number;
    right: number;
    top: number;
    bottom: number;
}

/** The part of the page that shows the rest bounds of the scene. */
function sceneBox(page: Page): Promise<Box> {
    return page.evaluate(() => {
        const { viewport, model } = modalcastViewer;
        const bounds = model?.scene.info.bounds ?? [];
        const stage = (document.getElementById("stage") as HTMLElement).getBoundingClientRect();
        const pixels = Array.from({ length: 8 }, (_, corner) => {
            const point = [0, 1, 2].map((axis) => bounds[axis + ((corner >> axis) & 1) * 3] ?? 0);
            return viewport.camera.project(point as [number, number, number]) ?? [Number.NaN, Number.NaN];
        });
        const [x, y] = [0, 1].map((axis) => pixels.map((pixel) => pixel[axis] ?? Number.NaN)) as [number[], number[]];
        return {
            left: stage.left + Math.min(...x),
            right: stage.left + Math.max(...x),
            top: stage.top + Math.min(...y),
            bottom: stage.top + Math.max(...y),
        };
    });
}

async function elementBox(page: Page, selector: string): Promise<Box> {
    const box = await page.locator(selector).boundingBox();
    assert.ok(box, `expected ${selector} on the page`);
    return { left: box.x, right: box.x + box.width, top: box.y, bottom: box.y + box.height };
}

/** The area between the bar, the buttons and, if they are open, the panels. */
async function freeBox(page: Page): Promise<Box> {
    const stage = await elementBox(page, "#stage");
    const [bar, dock] = [await elementBox(page, "#bar"), await elementBox(page, "#dock")];
    return { left: stage.left, right: stage.right, top: bar.bottom, bottom: dock.top };
}

async function checkFit(page: Page, name: string): Promise<void> {
    // The view follows the size of the page with the next frame.
    await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
    const [scene, free] = [await sceneBox(page), await freeBox(page)];
    const tools = await elementBox(page, "#tools");
    assert.ok(tools.left >= free.left && tools.right <= free.right, `${name}: expected all buttons on the page`);
    await takeScreenshot(page, name);
    const text = `${name}: scene ${JSON.stringify(scene)}, free area ${JSON.stringify(free)}`;
    assert.ok(scene.left >= free.left && scene.right <= free.right, text);
    assert.ok(scene.top >= free.top && scene.bottom <= free.bottom, text);
    const fill = [
        (scene.right - scene.left) / (free.right - free.left),
        (scene.bottom - scene.top) / (free.bottom - free.top),
    ];
    assert.ok(Math.max(...fill) > 0.8, `expected one side to fill the free area: ${text}`);
}

test("a recording fits into the page of a desktop", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(...DESKTOP);
    await checkFit(page, "layout-desktop");
    assert.equal((await elementBox(page, "#panel")).left, (await elementBox(page, "#stage")).right);
    await page.keyboard.press("b");
    await page.locator("#panel").waitFor({ state: "hidden" });
    await checkFit(page, "layout-desktop-without-panels");
    assert.deepEqual(errors, []);
    await page.close();
});

test("a recording fits into the page of a phone, beside the panels too", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(...PHONE);
    assert.equal(await page.locator("#panel").isVisible(), false, "expected closed panels at first");
    await checkFit(page, "layout-phone");
    await page.getByRole("button", { name: "Panels", exact: true }).click();
    await checkFit(page, "layout-phone-with-panels");
    const panel = await elementBox(page, "#panel");
    assert.ok(panel.bottom - panel.top <= 0.4 * PHONE[1] + 1, `expected at most 40 % of the height: ${panel.top}`);
    assert.ok((await elementBox(page, "#stage")).bottom <= panel.top);
    await page.getByRole("button", { name: "Close the panels" }).click();
    await page.locator("#panel").waitFor({ state: "hidden" });
    await checkFit(page, "layout-phone-closed-again");
    // Turned.
    await page.setViewportSize({ width: PHONE[1], height: PHONE[0] });
    await checkFit(page, "layout-phone-landscape");
    assert.deepEqual(errors, []);
    await page.close();
});

test("the buttons of a live scene fit into the page of a phone", { timeout: LIMIT_MS }, async () => {
    const { page } = await setup.open(...PHONE);
    await page.evaluate(() => modalcastViewer.setPlayback(null));
    await checkFit(page, "layout-phone-live");
    assert.ok(await page.getByRole("button", { name: "Pull on the surface" }).isVisible());
    await page.close();
});

test("legend, scale bar and buttons do not cover each other", { timeout: LIMIT_MS }, async () => {
    for (const [name, [width, height]] of [
        ["desktop", DESKTOP],
        ["phone", PHONE],
    ] as const) {
        const { page } = await setup.open(width, height);
        await page.keyboard.press("m");
        await page.locator("#legend").waitFor();
        await takeScreenshot(page, `layout-legend-${name}`);
        const selectors = ["#legend", "#scale-bar", "#timeline", "#tools", "#axes", "#bar"];
        const boxes = await Promise.all(selectors.map((selector) => elementBox(page, selector)));
        boxes.forEach((a, index) => {
            for (const [other, b] of boxes.entries()) {
                if (other <= index) continue;
                const isApart = a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
                assert.ok(isApart, `${name}: ${selectors[index]} covers ${selectors[other]}`);
            }
        });
        await page.close();
    }
});

test("a message is one line in the corner until it is opened", { timeout: LIMIT_MS }, async () => {
    for (const [name, [width, height]] of [
        ["desktop", DESKTOP],
        ["phone", PHONE],
    ] as const) {
        const { page } = await setup.open(width, height);
        await page.evaluate(() => {
            modalcastViewer.notices.show("short", "A short message.");
            const action = { label: "Do something", run: () => {} };
            modalcastViewer.notices.show("long", "A sentence that is repeated. ".repeat(12), { duration: 0, action });
        });
        const notice = page.locator(".notice", { hasText: "repeated" });
        const more = notice.getByRole("button", { name: "More" });
        await more.waitFor();
        await takeScreenshot(page, `layout-messages-${name}`);
        const short = page.locator(".notice", { hasText: "short" });
        assert.equal(await short.getByRole("button", { name: "More" }).isVisible(), false, "control: it fits");
        const [box, bar] = [await elementBox(page, "#notices"), await elementBox(page, "#bar")];
        assert.ok(box.top >= bar.bottom && box.bottom < 0.25 * height, `${name}: ${JSON.stringify(box)}`);
        const axes = await elementBox(page, "#axes");
        const lines = await elementBox(page, ".notice:last-child");
        assert.ok(name === "phone" || lines.right <= axes.left, `${name}: expected uncovered axes`);
        await more.click();
        assert.ok((await elementBox(page, "#notices")).bottom > box.bottom + 30, "expected several lines");
        assert.ok(await notice.getByRole("button", { name: "Do something" }).isVisible());
        await notice.getByRole("button", { name: "Less" }).click();
        assert.equal((await elementBox(page, "#notices")).bottom, box.bottom);
        await page.close();
    }
});

test("the page has the color of the ground behind the sheet of a phone", { timeout: LIMIT_MS }, async () => {
    const { page } = await setup.open(...PHONE);
    const colors = await page.evaluate(
        () =>
            new Promise<number[][]>((done) => {
                const { viewport } = modalcastViewer;
                viewport.onDrawn = () => {
                    viewport.onDrawn = () => {};
                    const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
                    const pixels = [1, viewport.pixelSize[1] - 1].map((y) => {
                        const color = new Uint8Array(4);
                        gl.readPixels(1, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, color);
                        return [...color].slice(0, 3);
                    });
                    const page = getComputedStyle(document.body).backgroundColor.match(/\d+/g)?.map(Number) ?? [];
                    done([page, ...pixels]);
                };
                viewport.invalidate();
            }),
    );
    const [body = [], ground = [], sky = []] = colors;
    const difference = (other: number[]) => Math.max(...body.map((value, i) => Math.abs(value - (other[i] ?? 0))));
    assert.ok(difference(ground) <= 16, `expected ${ground}, got ${body}`);
    assert.ok(difference(sky) > 40, `control: another color than the sky ${sky}, got ${body}`);
    await page.close();
});

test("a view that the user has turned stays when the page changes its size", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(...PHONE);
    const eye = () => page.evaluate(() => modalcastViewer.viewport.camera.eye);
    const framed = await eye();
    await page.mouse.move(200, 400);
    await page.mouse.down();
    await page.mouse.move(260, 420, { steps: 4 });
    await page.mouse.up();
    const turned = await eye();
    assert.notDeepEqual(turned, framed);
    await page.setViewportSize({ width: 500, height: 700 });
    await page.waitForFunction(() => modalcastViewer.viewport.pixelSize[0] === 500);
    assert.deepEqual(await eye(), turned);
    // Control: F frames again.
    await page.keyboard.press("f");
    await checkFit(page, "layout-framed-again");
    assert.deepEqual(errors, []);
    await page.close();
});

test("the time line shows the current and the total time", { timeout: LIMIT_MS }, async () => {
    for (const [width, height] of [DESKTOP, PHONE]) {
        const { page } = await setup.open(width, height);
        await page.getByRole("slider", { name: "Time in seconds" }).evaluate((slider) => {
            (slider as HTMLInputElement).value = "0.5";
            slider.dispatchEvent(new Event("input"));
        });
        const times = page.locator("#timeline .times");
        assert.equal(await times.textContent(), "0.50 s / 2.00 s");
        const [box, line] = [await elementBox(page, "#timeline .total"), await elementBox(page, "#timeline")];
        assert.ok(box.right <= line.right && box.right <= width, "expected the total time within the time line");
        await page.close();
    }
});

test("the panel on performance is closed at first", { timeout: LIMIT_MS }, async () => {
    const { page } = await setup.open(...DESKTOP);
    const row = page.locator(".facts tr", { hasText: "Frames drawn" });
    assert.equal(await row.isVisible(), false);
    await page.locator("summary", { hasText: "Performance" }).click();
    await row.waitFor();
    await page.close();
});

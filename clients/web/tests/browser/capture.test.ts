/** Pictures and videos that the page saves, with a recording. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import type { Page } from "playwright-core";
import { BeamSetup } from "./beam_setup";

const LIMIT_MS = 120_000;
const setup = new BeamSetup();

/** Presses a button. Returns the file that the page saves. */
async function savedBy(page: Page, button: string): Promise<{ name: string; bytes: Buffer }> {
    const download = page.waitForEvent("download");
    await page.getByRole("button", { name: button, exact: true }).click();
    const file = await download;
    return { name: file.suggestedFilename(), bytes: readFileSync(await file.path()) };
}

/** Width, height and three pixels of a PNG as the browser decodes it: top left, middle, and in the bar of the legend. */
function decodePicture(page: Page, bytes: Buffer): Promise<{ size: number[]; pixels: number[][] }> {
    return page.evaluate(async (base64) => {
        const content = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
        const bitmap = await createImageBitmap(new Blob([content], { type: "image/png" }));
        const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
        const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
        context.drawImage(bitmap, 0, 0);
        const places = [
            [2, 2],
            [bitmap.width / 2, bitmap.height / 2 - 20],
            [14 + 180, bitmap.height - 34],
        ];
        const pixels = places.map(([x = 0, y = 0]) => [...context.getImageData(x, y, 1, 1).data]);
        return { size: [bitmap.width, bitmap.height], pixels };
    }, bytes.toString("base64"));
}

test("a picture has the view and the legend, without panels", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(1280, 800);
    await page.getByRole("combobox", { name: "Background" }).selectOption("white");
    const { name, bytes } = await savedBy(page, "Save a picture");
    assert.equal(name, "beam.png");
    const { size, pixels } = await decodePicture(page, bytes);
    assert.deepEqual(size, [964, 800]);
    assert.deepEqual(pixels[0], [255, 255, 255, 255]);
    assert.ok((pixels[1]?.[0] ?? 255) < 220, `expected the beam in the middle, got ${pixels[1]}`);
    assert.deepEqual(pixels[2], [255, 255, 255, 255], "control: no legend without a color map");
    await page.locator(".notice", { hasText: "Saved beam.png, 964 x 800 pixels." }).waitFor();
    await page.keyboard.press("m");
    await page.locator("#legend").waitFor();
    const map = await decodePicture(page, (await savedBy(page, "Save a picture")).bytes);
    const [red = 0, , blue = 255] = map.pixels[2] ?? [];
    assert.ok(red > 200 && blue < 80, `expected the yellow end of the legend, got ${map.pixels[2]}`);
    assert.deepEqual(errors, []);
    await page.close();
});

/** Seconds, size and number of different frames of a video as the browser plays it. */
function playVideo(page: Page, bytes: Buffer, type: string) {
    return page.evaluate(
        async ([base64, mimeType]) => {
            const content = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
            const video = document.createElement("video");
            video.muted = true;
            video.src = URL.createObjectURL(new Blob([content], { type: mimeType }));
            const canvas = new OffscreenCanvas(96, 80);
            const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
            const frames = new Set<string>();
            const watch = () => {
                context.drawImage(video, 0, 0, 96, 80);
                frames.add(context.getImageData(0, 0, 96, 80).data.join());
                video.requestVideoFrameCallback(watch);
            };
            video.requestVideoFrameCallback(watch);
            const ended = new Promise((done, fail) => {
                video.onended = done;
                video.onerror = () => fail(new Error(video.error?.message));
            });
            await video.play();
            await ended;
            const { videoWidth, videoHeight, currentTime } = video;
            return { size: [videoWidth, videoHeight], seconds: currentTime, frames: frames.size };
        },
        [bytes.toString("base64"), type] as const,
    );
}

test("a video shows the motion while it is recorded", { timeout: LIMIT_MS }, async () => {
    const { page } = await setup.open(400, 640);
    await page.getByRole("button", { name: "Play" }).click();
    const button = page.getByRole("button", { name: "Record a video" });
    await button.click();
    assert.equal(await button.getAttribute("aria-pressed"), "true");
    await page.waitForTimeout(3000);
    const { name, bytes } = await savedBy(page, "Record a video");
    assert.equal(await button.getAttribute("aria-pressed"), "false");
    assert.match(name, /^beam\.(mp4|webm)$/);
    const { size, seconds, frames } = await playVideo(page, bytes, name.endsWith("mp4") ? "video/mp4" : "video/webm");
    assert.deepEqual(size, [400, 640]);
    assert.ok(seconds > 2 && seconds < 6, `expected about 3 s, got ${seconds}`);
    assert.ok(frames > 5, `expected different frames, got ${frames}`);
    await page.close();
});

test("a browser that cannot record videos says so", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.open(1280, 800);
    await page.evaluate(() => Reflect.deleteProperty(globalThis, "MediaRecorder"));
    await page.getByRole("button", { name: "Record a video" }).click();
    await page.locator(".notice", { hasText: "This browser cannot record videos." }).waitFor();
    assert.equal(await page.getByRole("button", { name: "Record a video" }).getAttribute("aria-pressed"), "false");
    assert.deepEqual(errors, []);
    await page.close();
});

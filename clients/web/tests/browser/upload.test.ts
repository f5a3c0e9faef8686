/** Models that are dropped onto the page of a server. */

import assert from "node:assert/strict";
import { after, before, test } from "node:test";
import { crc32, deflateSync } from "node:zlib";
import type { Browser, Page } from "playwright-core";
import { dropFiles, launchBrowser, openPage, ServerProcess, takeScreenshot } from "./harness";
import { Beam } from "./model_files";

const LIMIT_MS = 120_000;
const UPLOAD_BYTES = 2_000_000;
const server = new ServerProcess("", ["--upload-bytes", String(UPLOAD_BYTES)]);
let browser: Browser;

before(async () => {
    await server.start();
    browser = await launchBrowser();
});
after(async () => {
    await browser?.close();
    await server.stop();
});

function waitForSceneNamed(page: Page, name: string): Promise<unknown> {
    return page.waitForFunction((expected) => modalcastViewer.model?.scene.info.scene === expected, name);
}

/** A PNG with one red pixel. */
function redPixel(): Buffer {
    const chunk = (type: string, data: Buffer) => {
        const body = Buffer.concat([Buffer.from(type), data]);
        const [length, sum] = [Buffer.alloc(4), Buffer.alloc(4)];
        length.writeUInt32BE(data.length);
        sum.writeUInt32BE(crc32(body));
        return Buffer.concat([length, body, sum]);
    };
    // 1 x 1 pixels, 8 bits per channel, RGB; a row begins with its filter.
    const head = Buffer.from([0, 0, 0, 1, 0, 0, 0, 1, 8, 2, 0, 0, 0]);
    const pixels = deflateSync(Buffer.from([0, 255, 0, 0]));
    const magic = Buffer.from("\x89PNG\r\n\x1a\n", "latin1");
    return Buffer.concat([magic, chunk("IHDR", head), chunk("IDAT", pixels), chunk("IEND", Buffer.alloc(0))]);
}

test("a dropped STL file is uploaded, and a second one gets another name", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.getByRole("heading", { name: "No scene is open" }).waitFor();
    for (const name of ["beam", "beam-2"]) {
        await dropFiles(page, { "beam.stl": new Beam().stl() });
        await waitForSceneNamed(page, name);
        assert.equal(await page.evaluate(() => modalcastViewer.model?.scene.info.source), "uploaded: beam.stl");
    }
    await page.locator("#cover").waitFor({ state: "hidden" });
    await takeScreenshot(page, "upload-stl");
    // Among several scenes, a new viewer chooses.
    const other = await openPage(browser, server.pageUrl(""), 900, 600);
    const choice = other.page.getByRole("button", { name: "beam-2" });
    await choice.getByText("Open now. It was sent to the server as beam.stl.").waitFor();
    await takeScreenshot(other.page, "choice");
    await choice.click();
    await waitForSceneNamed(other.page, "beam-2");
    await other.page.close();
    assert.deepEqual(errors, []);
    await page.close();
});

test("files that are dropped together form one scene", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.locator("#cover h1").waitFor();
    await dropFiles(page, {
        "red.png": redPixel(),
        "square.mtl": "newmtl red\nmap_Kd red.png\n",
        "square.obj":
            "mtllib square.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n",
    });
    await waitForSceneNamed(page, "square");
    const { textures, remarks } = await page.evaluate(() => {
        const scene = modalcastViewer.model?.scene;
        return { textures: scene?.textures.map(({ width }) => width), remarks: scene?.info.remarks };
    });
    assert.deepEqual([textures, remarks], [[1], []]);
    // Control: without the image and the library, the server says what is missing.
    await dropFiles(page, { "bare.obj": "mtllib square.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n" });
    await waitForSceneNamed(page, "bare");
    await page.locator(".notice", { hasText: "material library 'square.mtl' does not exist" }).waitFor();
    assert.deepEqual(errors, []);
    await page.close();
});

test("a model without a unit can be read in millimeters", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.locator("#cover h1").waitFor();
    const size = () =>
        page.evaluate(() => {
            const { bounds = [], unit = Number.NaN } = modalcastViewer.model?.scene.info ?? {};
            return ((bounds[3] ?? 0) - (bounds[0] ?? 0)) * unit;
        });
    await dropFiles(page, { "plate.obj": "v 0 0 0\nv 80 0 0\nv 0 40 0\nf 1 2 3\n" });
    await waitForSceneNamed(page, "plate");
    assert.equal(await size(), 80);
    const notice = page.locator(".notice", { hasText: "The file has no unit" });
    await takeScreenshot(page, "upload-unit");
    await notice.getByRole("button", { name: "Read it in millimeters" }).click();
    await waitForSceneNamed(page, "plate-2");
    assert.ok(Math.abs((await size()) - 0.08) < 1e-9);
    await notice.waitFor({ state: "hidden" });
    const { scenes } = await (await server.client()).listScenes();
    const names = scenes.map(({ scene }) => scene);
    assert.ok(names.includes("plate-2") && !names.includes("plate"), names.join());
    assert.deepEqual(errors, []);
    await page.close();
});

test("a file that the server cannot read leaves the scene in view", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.locator("#cover h1").waitFor();
    await dropFiles(page, { "plain.stl": new Beam().stl() });
    await waitForSceneNamed(page, "plain");
    await dropFiles(page, { "broken.obj": "f 1 2 3\n" });
    const notice = page.locator(".notice", { hasText: "The files could not be opened" });
    await notice.waitFor();
    assert.match((await notice.textContent()) ?? "", /broken\.obj/);
    await page.locator("#cover").waitFor({ state: "hidden" });
    assert.equal(await page.evaluate(() => modalcastViewer.model?.scene.info.scene), "plain");
    // A file of another program has a hint.
    await dropFiles(page, { "part.step": "ISO-10303-21;" });
    await page.locator(".notice", { hasText: "part.step" }).waitFor();
    await takeScreenshot(page, "upload-error");
    assert.deepEqual(errors, []);
    await page.close();
});

test("files above the limit of the server are not sent", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.locator("#cover h1").waitFor();
    await dropFiles(page, { "large.stl": Buffer.alloc(UPLOAD_BYTES + 1) });
    await page
        .locator(".notice", { hasText: "The server accepts at most 2 MB for a scene, and these files have 2 MB." })
        .waitFor();
    // Control: the choice of scenes is shown again, and a file of the largest size is sent in parts.
    await page.locator("#cover h1").waitFor();
    const stl = Buffer.alloc(84 + 50 * 39_998);
    stl.writeUInt32LE(39_998, 80);
    for (let facet = 0; facet < 39_998; facet++) {
        const start = 84 + 50 * facet + 12;
        [facet, 0, 0, facet + 1, 0, 0, facet, 1, 0].forEach((value, index) =>
            stl.writeFloatLE(value, start + 4 * index),
        );
    }
    await dropFiles(page, { "strip.stl": stl });
    await waitForSceneNamed(page, "strip");
    assert.deepEqual(errors, []);
    await page.close();
});

test("the page names its upload while it lasts", { timeout: LIMIT_MS }, async () => {
    const { page } = await openPage(browser, server.pageUrl(""), 900, 600);
    await page.locator("#cover h1").waitFor();
    const titles = await page.evaluate(async () => {
        const seen = new Set<string>();
        const cover = document.getElementById("cover") as HTMLElement;
        new MutationObserver(() => seen.add(cover.querySelector("h1")?.textContent ?? "")).observe(cover, {
            childList: true,
            characterData: true,
            subtree: true,
        });
        const dataTransfer = new DataTransfer();
        dataTransfer.items.add(new File(["v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".padEnd(1_500_000)], "padded.obj"));
        window.dispatchEvent(new DragEvent("drop", { dataTransfer, cancelable: true }));
        while (modalcastViewer.model?.scene.info.scene !== "padded") await new Promise((done) => setTimeout(done, 10));
        return [...seen];
    });
    assert.ok(titles.includes("Uploading padded.obj, 1.5 MB"), titles.join(", "));
    assert.ok(titles.includes("Opening padded.obj"), titles.join(", "));
    await page.close();
});

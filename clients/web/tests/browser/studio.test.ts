/** A part without materials in headless Chromium, and in the server's pictures: studio lighting and ambient occlusion. */

import assert from "node:assert/strict";
import { mkdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import type { Browser, Page } from "playwright-core";
import type { CameraMessage } from "../../src/render/camera";
import { FIELD_OF_VIEW, fitBox } from "../../src/render/framing";
import { normalized } from "../../src/render/lighting";
import { subtract, type Vec3 } from "../../src/scene/affine";
import {
    launchBrowser,
    openPage,
    ServerProcess,
    simulateGpu,
    takeScreenshot,
    temporaryFolder,
    type ViewerPage,
    waitForScene,
} from "./harness";
import { bracketStl } from "./model_files";
import { browserPicture, cameraOf, drawnDomains, iou, meanDifference, serverDomains, serverPicture } from "./pictures";

/** Of odd width, so that the picture has no integer number of texels of the ambient occlusion. */
const SIZE = [641, 480] as const;
const LIMIT_MS = 300_000;

/** The same part in a studio, without ambient occlusion in effect, and outdoors. */
const SCENES = {
    studio: "",
    open: "[look]\nambient_occlusion = { radius = 1e-6 }\n",
    outdoor: '[look]\nlighting = "outdoor"\n',
};

const scenes = temporaryFolder();
const server = new ServerProcess(scenes);
let browser: Browser;
before(async () => {
    for (const [name, look] of Object.entries(SCENES)) {
        const folder = join(scenes, name);
        mkdirSync(folder);
        writeFileSync(join(folder, "bracket.stl"), bracketStl());
        writeFileSync(join(folder, "scene.toml"), `model = "bracket.stl"\n${look}`);
    }
    await server.start();
    for (const name of Object.keys(SCENES)) await (await server.client()).openScene(name);
    browser = await launchBrowser();
});
after(async () => {
    await browser.close();
    await server.stop();
});

async function open(scene: string, device: "CPU" | "GPU"): Promise<ViewerPage> {
    const viewerPage = await openPage(browser, "about:blank", ...SIZE);
    const { page } = viewerPage;
    if (device === "GPU") await simulateGpu(page);
    await page.goto(server.pageUrl(scene), { waitUntil: "commit" });
    await waitForScene(page);
    return viewerPage;
}

/** Cameras around the part: eye and target. */
const VIEWS: readonly (readonly [[number, number, number], [number, number, number]])[] = [
    [
        [2.4, 1.9, 1.6],
        [0.5, 0.4, 0.3],
    ],
    // Close to the corner between plate and wall, with the rib.
    [
        [1.1, -0.5, 0.8],
        [0.2, 0.35, 0.2],
    ],
];

for (const device of ["CPU", "GPU"] as const) {
    test(`a part in a studio has the server's colors, as on a ${device}`, { timeout: LIMIT_MS }, async () => {
        const { page, errors } = await open("studio", device);
        assert.equal(await page.evaluate(() => modalcastViewer.viewport.isSoftware), device === "CPU");
        const samples = device === "CPU" ? 1 : 4;
        for (const view of [null, ...VIEWS]) {
            if (view) await page.evaluate(([eye, target]) => modalcastViewer.viewport.camera.look(eye, target), view);
            const camera = await cameraOf(page);
            const drawn = await browserPicture(page);
            const picture = async (scene: string) => serverPicture(await server.client(), scene, camera, SIZE, samples);
            const difference = meanDifference(drawn, await picture("studio"));
            const open = meanDifference(drawn, await picture("open"));
            const domains = await drawnDomains(page, SIZE);
            const same = iou(domains, await serverDomains(await server.client(), "studio", camera, SIZE));
            console.log(
                `${device}: mean difference ${difference.toFixed(3)}, IoU ${same.toFixed(4)}, ` +
                    `without ambient occlusion ${open.toFixed(3)}`,
            );
            assert.ok(difference <= 1, `expected the server's picture within 1 level in the mean, got ${difference}`);
            assert.ok(same >= 0.99, `expected an IoU of 0.99, got ${same}`);
            assert.ok(open > 3 * difference, `control: expected another picture without occlusion, got ${open}`);
            await takeScreenshot(page, `studio-${device}-${view ? VIEWS.indexOf(view) : "default"}`);
        }
        assert.deepEqual(errors, []);
        await page.close();
    });
}

/** The camera that views a scene from the direction of the page's camera. In the page, the bar covers a part of the view. */
async function uncoveredCamera(page: Page): Promise<CameraMessage> {
    const { eye, target, bounds } = await page.evaluate(() => {
        const { camera } = modalcastViewer.viewport;
        return { eye: camera.eye, target: camera.target, bounds: modalcastViewer.model?.scene.info.bounds ?? [] };
    });
    const up: Vec3 = [0, 0, 1];
    const [width, height] = SIZE;
    const area = { width, height, coveredTop: 0, coveredBottom: 0 };
    const view = fitBox(bounds, normalized(subtract(eye, target)), up, area);
    return {
        view: { case: "lookAt", value: { ...view, up } },
        lens: { case: "fieldOfView", value: FIELD_OF_VIEW },
    };
}

test("the default camera views a part from the server's direction", { timeout: LIMIT_MS }, async () => {
    for (const [scene, other] of [
        ["studio", "outdoor"],
        ["outdoor", "studio"],
    ] as const) {
        const { page, errors } = await open(scene, "CPU");
        const camera = await uncoveredCamera(page);
        // Both are drawn by the server: with this camera, and with its default camera.
        const difference = async (name: string) => {
            const client = await server.client();
            const expected = await serverPicture(client, name, undefined, SIZE);
            return meanDifference(await serverPicture(client, name, camera, SIZE), expected);
        };
        const same = await difference(scene);
        assert.ok(same < 0.01, `expected the server's default view of ${scene}, got a difference of ${same}`);
        const control = await difference(other);
        assert.ok(control > 1, `control: expected another default view of ${other}, got ${control}`);
        assert.deepEqual(errors, []);
        await page.close();
    }
});

/** Colors of pixels of the background, which is drawn anew: above, beside and below the part. */
function background(page: Page): Promise<number[][]> {
    return page.evaluate(
        () =>
            new Promise<number[][]>((done) => {
                const { viewport } = modalcastViewer;
                viewport.onDrawn = () => {
                    viewport.onDrawn = () => {};
                    const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
                    const [width, height] = viewport.pixelSize;
                    const places = [
                        [width / 2, height - 4],
                        [4, height / 2],
                        [width / 2, 4],
                        [4, 4],
                    ] as const;
                    const colors = places.map(([x, y]) => {
                        const color = new Uint8Array(4);
                        gl.readPixels(x, y, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, color);
                        return [...color];
                    });
                    done(colors);
                };
                viewport.invalidate();
            }),
    );
}

test("color maps keep the background of a studio, which the page names", { timeout: LIMIT_MS }, async () => {
    for (const [scene, name, isKept] of [
        ["studio", "Studio", true],
        ["outdoor", "Sky and ground", false],
    ] as const) {
        const { page, errors } = await open(scene, "CPU");
        const option = page.locator("#background option").first();
        assert.equal(await option.textContent(), name);
        const show = (kind: "shaded" | "displacement", edges: boolean) =>
            page.evaluate(
                ([color, isOn]) =>
                    modalcastViewer.change(() => {
                        Object.assign(modalcastViewer.settings, { color: { kind: color }, edges: isOn });
                    }),
                [kind, edges] as const,
            );
        const expected = await background(page);
        for (const edges of [false, true]) {
            await show("displacement", edges);
            const found = await background(page);
            const difference = Math.max(
                ...found.flatMap((color, place) =>
                    color.map((value, channel) => Math.abs(value - (expected[place]?.[channel] ?? 0))),
                ),
            );
            if (isKept) assert.ok(difference <= 1, `edges ${edges}: expected the background, got ${difference}`);
            else assert.ok(difference > 20, `control: expected another background, got ${difference}`);
        }
        await takeScreenshot(page, `studio-map-${scene}`);
        assert.deepEqual(errors, []);
        await page.close();
    }
});

/** Sources of the programs of WebGL that a page has compiled, with their macros. */
function programKeys(page: Page): Promise<string[]> {
    return page.evaluate(() => modalcastViewer.viewport.gl?.info.programs?.map((program) => program.cacheKey) ?? []);
}

test("outdoor scenes compile nothing of studio lighting", { timeout: LIMIT_MS }, async () => {
    for (const [scene, isStudio] of [
        ["studio", true],
        ["outdoor", false],
    ] as const) {
        const { page } = await open(scene, "CPU");
        await browserPicture(page);
        const keys = await programKeys(page);
        assert.ok(keys.length > 3, `expected programs of surfaces, background and shadow map, got ${keys.length}`);
        for (const macro of ["STUDIO", "AMBIENT_OCCLUSION", "SLICES"])
            assert.equal(
                keys.some((key) => key.includes(macro)),
                isStudio,
                `${scene}: ${macro}`,
            );
        await page.close();
    }
});

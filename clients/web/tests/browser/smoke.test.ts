/** The viewer in headless Chromium against a server. */

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Page } from "playwright-core";
import type { SurfacePoint } from "../../src/control/surface_point";
import { Delivery } from "../../src/proto/modalcast/v1/common_pb";
import { FrameService, type Hit } from "../../src/proto/modalcast/v1/frames_pb";
import type { CameraMessage } from "../../src/render/camera";
import { fitBox } from "../../src/render/framing";
import { normalized } from "../../src/render/lighting";
import type { Vec3 } from "../../src/scene/affine";
import { parseArrays } from "../../src/scene/arrays";
import { Kinematics } from "../../src/scene/kinematics";
import { SceneModel } from "../../src/scene/scene_model";
import { end, startSimulation } from "./harness";
import { cameraOf, drawnDomains, iou, meanDifference, NO_DOMAIN, serverDomains, serverPicture } from "./pictures";
import { TreeSetup } from "./tree_setup";

const WIDTH = 480;
const HEIGHT = 300;
const SIZE = [WIDTH, HEIGHT] as const;
/** A test that takes longer has failed. Alone on two cores, each takes less than a minute. */
const LIMIT_MS = 300_000;

declare global {
    /** A variable of the page: the point that a test pulls. */
    var watchedPoint: SurfacePoint | null;
    /** In the page: the scene before the server ended. */
    var shownModel: SceneModel | null;
}

const setup = new TreeSetup();
const { server } = setup;

/** Sends one step with coordinates of the trunk, and transforms that keep all joints closed. Returns the step's number. */
async function bend(q0: number): Promise<bigint> {
    const client = await server.client();
    const scene = await client.describe("tree");
    const model = new SceneModel(scene, parseArrays(scene, await client.readContents(scene, () => {})));
    const { state, layout, arrays } = model;
    assert.ok(arrays);
    const kinematics = new Kinematics(scene, arrays);
    state.q.fill(0);
    state.q[0] = q0;
    const numbers = new Float32Array(kinematics.transforms(state, state.q).flatMap((transform) => [...transform]));
    const stream = client.drive();
    stream.send({ kind: { case: "open", value: { scene: "tree", delivery: Delivery.LOSSLESS, takeOver: true } } });
    let number = 0n;
    for await (const { kind } of stream) {
        if (kind.case === "rejection") throw new Error(`rejected: ${kind.value.field} ${kind.value.given}`);
        if (kind.case !== "opened") continue;
        number = (kind.value.scene?.lastStep?.number ?? 0n) + 1n;
        const step = {
            number,
            qDomains: [0],
            q: new Uint8Array(state.q.slice(0, layout.ranks[0]).buffer),
            transformDomains: kinematics.domains,
            transforms: new Uint8Array(numbers.buffer),
        };
        stream.send({ kind: { case: "step", value: step } });
        stream.end();
    }
    return number;
}

function waitForStep(page: Page, number: bigint): Promise<unknown> {
    return page.waitForFunction((text) => String(modalcastViewer.model?.state.step?.number) === text, String(number));
}

/**
 * Views the tree from a fraction of the distance of the server's default camera. From far away, the holes of cut-out leaves
 * are smaller than a pixel, and depend on how a renderer filters textures.
 */
async function viewFrom(page: Page, fraction: number): Promise<void> {
    const { bounds } = (await (await server.client()).describe("tree")).info;
    const area = { width: WIDTH, height: HEIGHT, coveredTop: 0, coveredBottom: 0 };
    const { eye, target } = fitBox(bounds, normalized([0.42, 0.14, 0.9]), [0, 1, 0], area);
    const closer = eye.map((value, axis) => (target[axis] ?? 0) + fraction * (value - (target[axis] ?? 0))) as Vec3;
    await page.evaluate(([from, to]) => modalcastViewer.viewport.camera.look(from, to), [closer, target] as const);
}

/** Hits at pixels that are spread over the picture. */
async function pickMany(camera: CameraMessage, count: number): Promise<Hit[]> {
    const hits: Hit[] = [];
    const side = 60;
    const { channel } = await server.client();
    for (let y = 0; y + side <= HEIGHT; y += side) {
        for (let x = 0; x + side <= WIDTH; x += side) {
            const request = {
                scene: "tree",
                picture: { width: WIDTH, height: HEIGHT, camera },
                x,
                y,
                width: side,
                height: side,
                withoutModes: true,
            };
            for await (const reply of channel.serverStream(FrameService.method.pick, request)) hits.push(...reply.hits);
        }
    }
    const stride = Math.max(1, Math.floor(hits.length / count));
    return hits.filter((_, index) => index % stride === 0).slice(0, count);
}

/** Where the browser draws the surface points of hits, in pixels. */
async function projectHits(page: Page, hits: Hit[]): Promise<number[][]> {
    const points = hits.map(({ domain, vertices, barycentric }) => ({ domain, vertices, barycentric }));
    return page.evaluate((list) => {
        const { renderer, viewport } = modalcastViewer;
        if (!renderer) return [];
        const { positions, firstVertex, origin } = renderer.readVertices();
        return list.map(({ domain, vertices, barycentric }) => {
            const point = [0, 1, 2].map((axis) =>
                vertices.reduce(
                    (sum, vertex, corner) =>
                        sum +
                        (barycentric[corner] ?? 0) *
                            ((positions[4 * ((firstVertex[domain] ?? 0) + vertex) + axis] ?? 0) + (origin[axis] ?? 0)),
                    0,
                ),
            );
            return viewport.camera.project(point as [number, number, number]) ?? [-1, -1];
        });
    }, points);
}

test("the browser draws the same domains and points as the server", { timeout: LIMIT_MS }, async () => {
    const number = await bend(1);
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    await waitForStep(page, number);
    await viewFrom(page, 0.08);
    const camera = await cameraOf(page);
    const reference = await serverDomains(await server.client(), "tree", camera, SIZE);
    const drawn = await drawnDomains(page, SIZE);
    const same = iou(drawn, reference);
    assert.ok(
        reference.some((domain) => domain !== NO_DOMAIN),
        "expected a tree in the picture",
    );
    assert.ok(same >= 0.99, `expected an IoU of 0.99, got ${same}`);
    const hits = await pickMany(camera, 200);
    assert.equal(hits.length, 200);
    const places = await projectHits(page, hits);
    const distances = hits.map((hit, index) =>
        Math.hypot((places[index]?.[0] ?? 0) - hit.x - 0.5, (places[index]?.[1] ?? 0) - hit.y - 0.5),
    );
    assert.ok(Math.max(...distances) <= 1, `expected points within 1 pixel, got ${Math.max(...distances)}`);
    // Control: another q moves the masks.
    const other = await bend(-1);
    const moved = iou(drawn, await serverDomains(await server.client(), "tree", camera, SIZE));
    assert.ok(moved < 0.9, `expected an IoU below 0.9 with another q, got ${moved}`);
    await waitForStep(page, other);
    const followed = iou(
        await drawnDomains(page, SIZE),
        await serverDomains(await server.client(), "tree", camera, SIZE),
    );
    assert.ok(followed >= 0.99, `expected an IoU of 0.99 after the next step, got ${followed}`);
    console.log(
        `IoU ${same.toFixed(4)}, control ${moved.toFixed(4)}, largest distance ${Math.max(...distances).toFixed(3)} pixels`,
    );
    assert.deepEqual(errors, []);
    await page.close();
});

test("the server's pictures follow the camera and the size of the window", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    await page.keyboard.press("v");
    await page.waitForFunction(() => modalcastViewer.pictures !== null && modalcastViewer.pictures.frames > 0);
    // PNG, so that the shown pixels are those of RenderFrame.
    await page.evaluate(() => modalcastViewer.change(() => (modalcastViewer.settings.jpeg = false)));
    const shown = async () => {
        await page.evaluate(() => {
            const { camera } = modalcastViewer.viewport;
            camera.look(camera.eye.map((value) => 1.1 * value) as [number, number, number], camera.target);
        });
        return waitForServerPicture(page, WIDTH, HEIGHT);
    };
    const [first, second] = [await shown(), await shown()];
    assert.ok(meanDifference(first, second) > 1, "control: another camera shows another picture");
    await page.setViewportSize({ width: 400, height: 360 });
    await page.waitForFunction(() => (document.getElementById("picture") as HTMLCanvasElement).width === 400);
    await waitForServerPicture(page, 400, 360);
    await page.keyboard.press("v");
    assert.ok(await page.locator("#surface").isVisible());
    assert.deepEqual(errors, []);
    await page.close();
});

/**
 * Waits until the page shows the picture that RenderFrame returns for its camera. Returns its RGBA values. An earlier
 * picture may stay for seconds on a busy machine.
 */
async function waitForServerPicture(page: Page, width: number, height: number): Promise<number[]> {
    const expected = await serverPicture(await server.client(), "tree", await cameraOf(page), [width, height]);
    const limit = performance.now() + LIMIT_MS / 3;
    for (;;) {
        const { size, pixels } = await shownPicture(page);
        const isShown = size[0] === width && size[1] === height && meanDifference(pixels, expected) === 0;
        if (isShown) return pixels;
        if (performance.now() > limit) {
            assert.deepEqual(size, [width, height]);
            assert.equal(meanDifference(pixels, expected), 0);
        }
        await page.waitForTimeout(250);
    }
}

interface ShownPicture {
    size: number[];
    pixels: number[];
}

function shownPicture(page: Page): Promise<ShownPicture> {
    return page.evaluate(() => {
        const canvas = document.getElementById("picture") as HTMLCanvasElement;
        const pixels = canvas.getContext("2d")?.getImageData(0, 0, canvas.width, canvas.height).data ?? [];
        return { size: [canvas.width, canvas.height], pixels: Array.from(pixels) };
    });
}

test("a pull bends a branch, which returns afterwards", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(640, 480);
    // Independent of the first view, so that the pulled part stays the same.
    await viewFrom(page, 1);
    // Nobody receives forces yet.
    await page.keyboard.down("Shift");
    await page.mouse.move(...(await leafPixel(page)));
    await page.mouse.down();
    await page.locator(".notice", { hasText: "no physics is running" }).waitFor();
    await page.mouse.up();
    const simulation = startSimulation(server, ["--scene", "tree", "--wind", "0", "--forces"]);
    try {
        await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 5);
        const [x, y] = await leafPixel(page);
        await page.mouse.move(x, y);
        await page.mouse.down();
        await page.waitForFunction(() => modalcastViewer.pull?.view != null);
        const start = await pulledPoint(page);
        await page.mouse.move(x + 90, y - 30, { steps: 5 });
        // The limit of the force lets the tip of a leaf of 0.7 m move by 0.07 m.
        await page.waitForFunction((from) => {
            const now = modalcastViewer.pull?.view?.from ?? from;
            return Math.hypot(...now.map((value, axis) => value - (from[axis] ?? 0))) > 0.005;
        }, start);
        assert.match(
            (await page.locator("#overlay tspan").first().textContent()) ?? "",
            /^[\d.]+ N of at most [\d.]+ N$/,
        );
        await page.evaluate(() => {
            globalThis.watchedPoint = modalcastViewer.pull?.grabbed ?? null;
        });
        const pulled = await watchedPosition(page);
        await page.mouse.up();
        await page.keyboard.up("Shift");
        await page.waitForFunction(
            ([from, far]) => {
                const now = modalcastViewer.positionOf(globalThis.watchedPoint) ?? [0, 0, 0];
                const away = (point: number[]) => Math.hypot(...now.map((value, axis) => value - (point[axis] ?? 0)));
                return away(from as number[]) < 0.3 * away(far as number[]);
            },
            [start, pulled],
        );
        assert.equal(await page.evaluate(() => modalcastViewer.model?.forces.length), 0);
    } finally {
        await end(simulation);
    }
    assert.deepEqual(errors, []);
    await page.close();
});

/** A pixel of the crown around which the browser has drawn domains with modes. */
function leafPixel(page: Page): Promise<[number, number]> {
    return page.evaluate(() => {
        const { renderer, viewport, model } = modalcastViewer;
        const stage = document.getElementById("stage") as HTMLElement;
        const [width, height] = [stage.clientWidth, stage.clientHeight];
        const ids = renderer?.domainIds(viewport.camera.camera, width, height) ?? [];
        const bends = (x: number, y: number) => (model?.layout.ranks[ids[y * width + x] ?? -1] ?? 0) > 0;
        for (let x = Math.floor(0.62 * width); x > 0; x--) {
            for (let y = Math.floor(0.45 * height); y < 0.6 * height; y++) {
                const around = [-2, -1, 0, 1, 2].flatMap((dx) => [-2, -1, 0, 1, 2].map((dy) => bends(x + dx, y + dy)));
                if (around.every(Boolean)) return [x, y] as [number, number];
            }
        }
        throw new Error("expected a domain with modes in the picture");
    });
}

function pulledPoint(page: Page): Promise<number[]> {
    return page.evaluate(() => modalcastViewer.pull?.view?.from ?? []);
}

function watchedPosition(page: Page): Promise<number[]> {
    return page.evaluate(() => modalcastViewer.positionOf(globalThis.watchedPoint) ?? []);
}

test("the viewer connects again after a restart of the server", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(390, 844);
    // Phone width: nothing is wider than the screen, and the panels open above the tools.
    const overflow = await page.evaluate(() => document.documentElement.scrollWidth - window.innerWidth);
    assert.ok(overflow <= 0, `expected no horizontal scrolling, got ${overflow} pixels`);
    await page.getByRole("button", { name: "Panels" }).click();
    const box = await page.locator("#panel").boundingBox();
    assert.ok(box && box.x >= 0 && box.x + box.width <= 390 && box.height < 600, JSON.stringify(box));
    await page.evaluate(() => {
        globalThis.shownModel = modalcastViewer.model;
    });
    await server.stop();
    await page.locator("#connection .dot.bad").waitFor({ state: "attached" });
    await server.start();
    await page.waitForFunction(() => modalcastViewer.model !== globalThis.shownModel);
    await page.locator("#connection .dot.good").waitFor({ state: "attached" });
    const number = await bend(1);
    await waitForStep(page, number);
    // A browser logs each refused connection as an error.
    const unexpected = errors.filter(
        (error) => !/ERR_CONNECTION_REFUSED|ERR_CONNECTION_RESET|closed before|WebSocket/.test(error),
    );
    assert.deepEqual(unexpected, []);
    await page.close();
});

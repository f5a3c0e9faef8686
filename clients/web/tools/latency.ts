/**
 * Measures the time from a movement of the mouse during a pull to the changed picture: latency.ts OUT.json.
 * Server, physics process at 60 steps/s and headless Chromium share this machine. A sample begins with a scene at rest,
 * because only then the first changed pixel is known to follow from the movement: a physics process starts, the mouse
 * grabs the surface (no force yet) and moves once. The sample ends when the pixels of a drawn frame have changed and
 * were read back, which waits for the renderer. The time until a screen shows the frame is not part of it. A sample that
 * fails, for example because the pixels changed before a state could follow from the movement, is repeated and counted.
 */

import { type ChildProcess, execFileSync } from "node:child_process";
import { existsSync, writeFileSync } from "node:fs";
import { cpus, loadavg } from "node:os";
import { resolve } from "node:path";
import type { Browser, Page } from "playwright-core";
import { end, launchBrowser, openPage, ServerProcess, startSimulation, waitForScene } from "../tests/browser/harness";

const WIDTH = 480;
const HEIGHT = 300;
const SAMPLES = Number(process.env["MODALCAST_SAMPLES"] ?? 60);
/** The figure to reach: p95 in milliseconds. */
const GOAL_MS = 50;
/** Pixels by which the mouse moves. */
const MOVEMENT = 60;
/** Milliseconds after which a sample has failed. */
const LIMIT_MS = 30_000;

interface Case {
    scene: string;
    source: string;
    /** The folder of the scene; empty for a built-in one. */
    repository: string;
    simulation: string[];
}

const data = resolve(process.env["MODALCAST_DATA"] ?? "../../../shared/data");
const cases: Case[] = [
    {
        scene: "simpleBridge",
        source: "simpleBridge",
        repository: `${data}/vega`,
        simulation: ["--files", `${data}/vega/simpleBridge`, "--deflection", "0"],
    },
    { scene: "tree", source: "tree", repository: "", simulation: ["--wind", "0"] },
];

/** Times of one sample in milliseconds since the movement. */
interface Sample {
    /** The state that the first changed picture shows has arrived. */
    state: number;
    /** The first changed picture was drawn and read back. */
    picture: number;
    /** Part of `picture`: deforming, drawing and reading back. */
    draw: number;
}

declare global {
    /** In the page: resolves with the times of a sample. */
    var sample: Promise<Sample> | null;
}

const out = process.argv[2];
if (!out) throw new Error("expected: latency.ts OUT.json");
const browser = await launchBrowser();
const results: Record<string, unknown> = {};
for (const entry of cases) {
    if (entry.repository && !existsSync(entry.repository)) continue;
    results[entry.scene] = await measure(browser, entry);
    console.log(entry.scene, JSON.stringify(results[entry.scene]));
}
await browser.close();
const record = {
    what: "time from a movement of the mouse during a pull to the changed picture, in milliseconds; see clients/web/tools/latency.ts",
    command: "node tools/run.mjs latency OUT.json",
    commit: execFileSync("git", ["rev-parse", "HEAD"], { encoding: "utf8" }).trim(),
    programs: process.env["MODALCAST_PROGRAMS"]?.includes("release") ? "release" : "debug",
    machine: `${cpus()[0]?.model}, ${cpus().length} cores, no GPU`,
    load: loadavg()[0],
    window: [WIDTH, HEIGHT],
    goal_ms: GOAL_MS,
    scenes: results,
};
writeFileSync(out, `${JSON.stringify(record, null, 1)}\n`);

async function measure(browser: Browser, { scene, source, repository, simulation }: Case): Promise<unknown> {
    const server = new ServerProcess(repository);
    await server.start();
    await (await server.client()).openScene(source, scene);
    const { page } = await openPage(browser, server.pageUrl(scene), WIDTH, HEIGHT);
    await waitForScene(page);
    await page.evaluate(() => modalcastViewer.frameScene());
    const samples: Sample[] = [];
    const rates: number[] = [];
    const failures: string[] = [];
    while (samples.length < SAMPLES) {
        const run = String(await page.evaluate(() => modalcastViewer.model?.state.step?.run ?? 0n));
        const physics = startSimulation(server, ["--scene", scene, "--forces", ...simulation]);
        try {
            samples.push(await takeSample(page, physics, run));
            rates.push(await page.evaluate(() => modalcastViewer.status.stateRate.perSecond()));
        } catch (error) {
            failures.push(String(error));
            if (failures.length > SAMPLES) throw new Error(`more failures than samples: ${failures.join("; ")}`);
        } finally {
            await page.mouse.up();
            await page.keyboard.up("Shift");
            await end(physics, "SIGKILL");
        }
    }
    const renderer = await page.evaluate(() => modalcastViewer.viewport.rendererName);
    await page.close();
    await server.stop();
    const of = (name: keyof Sample) => summary(samples.map((sample) => sample[name]));
    return {
        renderer,
        steps_per_second: summary(rates).p50,
        state_ms: of("state"),
        picture_ms: of("picture"),
        draw_ms: of("draw"),
        failures,
    };
}

/** @param run The run before the physics process has started. */
async function takeSample(page: Page, physics: ChildProcess, run: string): Promise<Sample> {
    const ended = new Promise<never>((_, fail) =>
        physics.once("exit", (code) => fail(new Error(`the physics process has ended with code ${code}`))),
    );
    ended.catch(() => {});
    await Promise.race([waitForRest(page, run), ended]);
    const [x, y] = await surfacePixel(page);
    await page.keyboard.down("Shift");
    // The center of the pixel, which the server picks: elsewhere, the pull would begin with a force.
    await page.mouse.move(x + 0.5, y + 0.5);
    await page.mouse.down();
    await page.waitForFunction(() => modalcastViewer.pull?.view != null, undefined, { timeout: LIMIT_MS });
    // Not in phase with the steps.
    await page.waitForTimeout(100 + 50 * Math.random());
    await page.evaluate(watch, LIMIT_MS);
    await page.mouse.move(x + MOVEMENT, y + MOVEMENT / 4);
    return page.evaluate(() => globalThis.sample as Promise<Sample>);
}

/** Waits for half a second of another run than `run`, which has not moved the scene. */
async function waitForRest(page: Page, run: string): Promise<void> {
    const isAtRest = (previous: string) => {
        const { step, q } = modalcastViewer.model?.state ?? {};
        return step && String(step.run) !== previous && step.number > 30n && q?.every((value) => value === 0);
    };
    await page.waitForFunction(isAtRest, run, { timeout: LIMIT_MS });
}

/** Runs in the page: starts to wait for the next movement, and for the state and the picture that follow from it. */
async function watch(limit: number): Promise<void> {
    const { viewport, model } = modalcastViewer;
    if (!model) throw new Error("expected a scene");
    const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
    const [width, height] = viewport.pixelSize;
    const readPixels = () => {
        const pixels = new Uint8Array(4 * width * height);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
        return new Uint32Array(pixels.buffer);
    };
    const before = await new Promise<Uint32Array>((done) => {
        viewport.onDrawn = () => done(readPixels());
        viewport.invalidate();
    });
    const { onFrame } = viewport;
    const { onState } = model;
    const result = new Promise<Sample>((done, fail) => {
        let moved = 0;
        let state = 0;
        let frame = 0;
        const onMove = (event: PointerEvent) => {
            moved = event.timeStamp;
        };
        window.addEventListener("pointermove", onMove, { capture: true, once: true });
        model.onState = () => {
            state = performance.now();
            onState();
        };
        viewport.onFrame = () => {
            frame = performance.now();
            onFrame();
        };
        viewport.onDrawn = () => {
            if (readPixels().every((pixel, index) => pixel === before[index])) return;
            const now = performance.now();
            if (moved > 0 && state > moved) done({ state: state - moved, picture: now - moved, draw: now - frame });
            else fail(new Error("the picture has changed before a state could follow from the movement"));
        };
        setTimeout(() => fail(new Error(`expected another picture within ${limit} ms`)), limit);
    });
    globalThis.sample = result.finally(() => {
        model.onState = onState;
        viewport.onFrame = onFrame;
        viewport.onDrawn = () => {};
    });
    // A rejected promise without a handler would count as an error of the page.
    globalThis.sample.catch(() => {});
}

/** A pixel in the middle of the surface of domains with modes. */
function surfacePixel(page: Page): Promise<[number, number]> {
    return page.evaluate(() => {
        const { renderer, viewport, model } = modalcastViewer;
        const [width, height] = viewport.pixelSize;
        const ids = renderer?.domainIds(viewport.camera.camera, width, height) ?? [];
        const bends = (x: number, y: number) => (model?.layout.ranks[ids[y * width + x] ?? -1] ?? 0) > 0;
        const found: [number, number][] = [];
        for (let y = 1; y < height - 1; y++) {
            for (let x = 1; x < width - 1; x++)
                if (bends(x - 1, y) && bends(x, y) && bends(x + 1, y)) found.push([x, y]);
        }
        const middle = (place: [number, number]) => Math.hypot(place[0] - width / 2, place[1] - height / 2);
        found.sort((a, b) => middle(a) - middle(b));
        if (!found[0]) throw new Error("expected a domain with modes in the picture");
        return found[0];
    });
}

function summary(values: number[]): { p50: number; p95: number; largest: number; samples: number } {
    const sorted = [...values].sort((a, b) => a - b);
    const at = (share: number) =>
        Number((sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] ?? 0).toFixed(1));
    return { p50: at(0.5), p95: at(0.95), largest: at(1), samples: sorted.length };
}

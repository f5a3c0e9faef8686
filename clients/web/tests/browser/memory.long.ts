/** Ten minutes in the browser, in which neither the page nor the server may grow, and connections that break. */

import assert from "node:assert/strict";
import { test } from "node:test";
import type { Page } from "playwright-core";
import type { DataTexture } from "three";
import type { Server } from "../../src/source/server";
import { growing, growth, ResourceMeter, type Resources } from "./growth";
import { end, startSimulation } from "./harness";
import { TreeSetup } from "./tree_setup";

const WIDTH = 480;
const HEIGHT = 300;
/** MODALCAST_SECONDS, and MODALCAST_RECONNECTS in multiples of ten, shorten the tests. */
const SECONDS = Number(process.env["MODALCAST_SECONDS"] ?? 600);
const RECONNECTS = Number(process.env["MODALCAST_RECONNECTS"] ?? 100);
const CONTROL_SECONDS = 60;
/** On a busy machine the test takes longer, because a slope of few samples is noise. */
const LEAST_SAMPLES = 6;

declare global {
    /** In the page: what a control has leaked. */
    var leaked: unknown[];
}

const setup = new TreeSetup();
const { server } = setup;

/** What a user does: pulls, moves the camera, and switches all ways to draw. Ends in the state in which it began. */
async function useViewer(page: Page): Promise<void> {
    await page.keyboard.down("Shift");
    await page.mouse.move(WIDTH / 2, HEIGHT / 2);
    await page.mouse.down();
    await page.mouse.move(WIDTH / 2 + 60, HEIGHT / 2, { steps: 10 });
    await page.mouse.up();
    await page.keyboard.up("Shift");
    await page.mouse.down();
    await page.mouse.move(WIDTH / 2, HEIGHT / 2, { steps: 10 });
    await page.mouse.up();
    for (const key of ["v", "v", "m", "m", "m", "e", "e", "s", "s", "b", "b"]) {
        await page.keyboard.press(key);
        await page.waitForTimeout(150);
    }
    await page.keyboard.press("f");
}

/** Samples while the viewer is used. `afterEach` is called between the samples. */
async function sample(page: Page, seconds: number, afterEach: () => Promise<unknown>): Promise<Resources[]> {
    const meter = await ResourceMeter.create(page);
    // Caches are full, and all shaders are compiled, after a few rounds.
    for (let round = 0; round < 3; round++) await useViewer(page);
    const samples = [await meter.read(server.pid)];
    const deadline = performance.now() + 1000 * seconds;
    while (performance.now() < deadline || samples.length < LEAST_SAMPLES) {
        await useViewer(page);
        await afterEach();
        samples.push(await meter.read(server.pid));
    }
    return samples;
}

function describe(samples: readonly Resources[]): string {
    const total = growth(samples);
    const first = samples[0];
    const texts = Object.entries(total).map(
        ([name, value]) => `${name} ${first?.[name as keyof Resources]} + ${value.toFixed(0)}`,
    );
    return `${samples.length} samples: ${texts.join(", ")}`;
}

test("neither the page nor the server grows", { timeout: 1000 * (SECONDS + 1200) }, async () => {
    const simulation = startSimulation(server, ["--scene", "tree", "--forces", "--delivery", "latest"]);
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    const samples = await sample(page, SECONDS, async () => {});
    console.log(`${SECONDS} s, ${describe(samples)}`);
    assert.deepEqual(growing(samples), []);
    assert.deepEqual(errors, []);

    // Control: a page that keeps a state, a texture, a node and a listener of each round, and a server with more scenes.
    let scenes = 0;
    const leaking = await sample(page, CONTROL_SECONDS, async () => {
        await (await server.client()).openScene("tree", `copy-${scenes++}`);
        await page.evaluate(() => {
            globalThis.leaked ??= [];
            const { gl } = modalcastViewer.viewport;
            // A texture of its own: clones share theirs.
            const Texture = modalcastViewer.renderer?.deformer.transforms.constructor as new (
                pixels: Uint8Array,
                width: number,
                height: number,
            ) => DataTexture;
            const texture = new Texture(new Uint8Array(4), 1, 1);
            texture.needsUpdate = true;
            gl?.initTexture(texture);
            window.addEventListener("resize", () => texture);
            document.body.append(document.createElement("i"));
            globalThis.leaked.push(texture, new Uint8Array(8e6), Array.from({ length: 1e6 }, Math.random));
        });
    });
    console.log(`control, ${describe(leaking)}`);
    const found = growing(leaking);
    for (const name of ["heap", "buffers", "textures", "serverMemory"] as const)
        assert.ok(found.includes(name), `expected the control to find ${name}, got ${found.join(", ")}`);
    await end(simulation);
    await page.close();
});

test(`${RECONNECTS} reconnects leak nothing`, { timeout: 1_800_000 }, async () => {
    const { page } = await setup.openTree(WIDTH, HEIGHT);
    const meter = await ResourceMeter.create(page);
    const samples: Resources[] = [];
    for (let count = 0; count <= RECONNECTS; count++) {
        await reconnect(page);
        // The first connections fill caches.
        if (count > 0 && count % (RECONNECTS / 10) === 0) samples.push(await meter.read(server.pid));
    }
    console.log(`${RECONNECTS} reconnects, ${describe(samples)}`);
    assert.deepEqual(growing(samples), []);
    // Control: connections that stay open.
    const others: Server[] = [];
    const leaking: Resources[] = [];
    for (let count = 0; count < 3; count++) {
        others.push(await server.connect());
        leaking.push(await meter.read(server.pid));
    }
    assert.ok(growing(leaking).includes("serverDescriptors"), describe(leaking));
    for (const other of others) other.channel.close();
    await page.close();
});

/** Breaks the connection of a page, and waits until the page shows the scene again. */
async function reconnect(page: Page): Promise<void> {
    await page.evaluate(() => {
        globalThis.leaked = [modalcastViewer.model];
        modalcastViewer.disconnect();
    });
    await page.waitForFunction(() => modalcastViewer.model !== globalThis.leaked[0]);
}

test("the viewer goes on after a server that was killed", { timeout: 300_000 }, async () => {
    const { page } = await setup.openTree(WIDTH, HEIGHT);
    await page.evaluate(() => {
        globalThis.leaked = [modalcastViewer.model];
    });
    await server.stop("SIGKILL");
    await page.locator("#connection .dot.bad").waitFor({ state: "attached" });
    await server.start();
    await page.waitForFunction(() => modalcastViewer.model !== globalThis.leaked[0]);
    const simulation = startSimulation(server, ["--scene", "tree"]);
    await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 1);
    await end(simulation);
    await page.close();
});

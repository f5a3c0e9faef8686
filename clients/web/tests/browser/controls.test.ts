/** Sliders, animated modes, keys, touch and the copied camera in headless Chromium. */

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import type { CDPSession, Page } from "playwright-core";
import { SceneModel } from "../../src/scene/scene_model";
import { changedValues, end, rememberPixels, rememberSettledPixels, startSimulation } from "./harness";
import { TreeSetup } from "./tree_setup";

const LIMIT_MS = 300_000;
/** Wide enough for the panels beside the view. */
const WIDTH = 760;
const HEIGHT = 420;

const setup = new TreeSetup();
const { server } = setup;

/** The first coordinate of the tree that the server has. */
async function serverQ(): Promise<number> {
    const client = await server.client();
    const model = new SceneModel(await client.describe("tree"), null);
    // A stream begins with the current state.
    for await (const response of client.streamStates("tree")) {
        model.receiveState(response);
        if (model.counts.states > 0) break;
    }
    return model.state.q[0] ?? Number.NaN;
}

function shownQ(page: Page): Promise<number> {
    return page.evaluate(() => modalcastViewer.model?.state.q[0] ?? Number.NaN);
}

test("sliders and animated modes drive a scene that nobody else drives", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    const slider = page.getByRole("slider", { name: "Mode 1", exact: true });
    await slider.waitFor();
    await slider.focus();
    for (let press = 0; press < 10; press++) await page.keyboard.press("ArrowRight");
    // The trunk has a size of 6.8 m, so the sliders end at 0.5 m, and a press is a step of 2.5 mm.
    await page.getByText("−500 mm0+500 mm").waitFor();
    await page
        .locator(".mode .value", { hasText: /^\+25 mm$/ })
        .first()
        .waitFor();
    assert.equal(await slider.inputValue(), "10");
    await page.locator("#deflection", { hasText: /^25 mm$/ }).waitFor();
    const value = await shownQ(page);
    assert.ok(value > 0, `expected a positive value, got ${value}`);
    assert.equal(await serverQ(), value);

    await page.getByRole("button", { name: "Animate mode 1", exact: true }).click();
    await page.waitForFunction(() => (modalcastViewer.model?.state.q[0] ?? 0) < 0);
    await page.waitForFunction(() => (modalcastViewer.model?.state.q[0] ?? 0) > 0);
    assert.equal(
        await page.getByRole("button", { name: "Animate mode 1", exact: true }).getAttribute("aria-pressed"),
        "true",
    );
    await page.getByRole("button", { name: "Animate mode 1", exact: true }).click();
    await page.waitForFunction(() => modalcastViewer.model?.state.q[0] === 0);

    // Control: a physics process takes over when the viewer is idle, and the sliders give way to bars.
    let simulation = startSimulation(server, ["--scene", "tree"]);
    for (let attempt = 0; attempt < 20; attempt++) {
        // While the viewer has the writer lease, the physics process ends.
        await page.waitForTimeout(1000);
        if (simulation.exitCode === null && (await shownQ(page)) !== 0) break;
        if (simulation.exitCode !== null) simulation = startSimulation(server, ["--scene", "tree"]);
    }
    await slider.waitFor({ state: "hidden" });
    assert.ok(await page.getByText("Another program moves this model and accepts no forces.").isVisible());
    await end(simulation);
    await slider.waitFor();
    assert.deepEqual(errors, []);
    await page.close();
});

test("keys switch edges, shadows, colors, panels, the pull tool and help", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    await rememberSettledPixels(page);
    for (const [key, name, legends] of [
        ["e", "edges", [null]],
        ["s", "shadows", [null]],
        ["m", "a color map", [/^Deflection0/, /^Mode 1.*100 %$/]],
    ] as const) {
        for (const legend of legends) {
            await page.keyboard.press(key);
            const changed = await changedValues(page);
            assert.ok(changed > 500, `expected other pixels with ${name} switched, got ${changed}`);
            if (legend) await page.locator("#legend").filter({ hasText: legend }).waitFor();
        }
        await page.keyboard.press(key);
        assert.equal(await changedValues(page), 0, `expected the same pixels without ${name}`);
    }
    await page.locator("#legend").waitFor({ state: "hidden" });
    await page.keyboard.press("b");
    await page.locator("#panel").waitFor({ state: "hidden" });
    await page.keyboard.press("b");
    await page.locator("#panel").waitFor();
    await page.keyboard.press("p");
    assert.equal(await page.getByRole("button", { name: "Pull on the surface" }).getAttribute("aria-pressed"), "true");
    await page.keyboard.press("p");
    await page.keyboard.press("?");
    await page.locator("#help").waitFor();
    await page.keyboard.press("Escape");
    await page.locator("#help").waitFor({ state: "hidden" });
    // The page has one word for each thing: part, note, control, deflection.
    const titles = await page.evaluate(() =>
        [...document.querySelectorAll("[title], [aria-label]")].map(
            (element) => `${element.getAttribute("title")} ${element.getAttribute("aria-label")}`,
        ),
    );
    const panels = (await page.locator("#panel").textContent()) ?? "";
    assert.match(panels, /Modes.*Largest deflection.*Parts/s);
    for (const text of [...titles, panels])
        assert.doesNotMatch(text.replace("Programs call it a domain.", ""), /domain|remark|lease|displacement/i);
    // Control: letters in a text field are text.
    await page.locator("summary", { hasText: "Parts" }).click();
    const filter = page.getByRole("searchbox");
    await filter.pressSequentially("branch-1");
    assert.equal(await filter.inputValue(), "branch-1");
    assert.ok(await page.locator("#panel").isVisible());
    assert.deepEqual(errors, []);
    await page.close();
});

test("a paused view shows one step at a time", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    const simulation = startSimulation(server, ["--scene", "tree"]);
    await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 2);
    await page.keyboard.press(" ");
    await rememberPixels(page);
    await page.waitForTimeout(500);
    assert.equal(await changedValues(page), 0, "expected the same picture while paused");
    await page.keyboard.press(".");
    await page.waitForTimeout(500);
    assert.ok((await changedValues(page)) > 100, "expected a picture of a later step");
    await rememberPixels(page);
    await page.waitForTimeout(500);
    assert.equal(await changedValues(page), 0, "expected one step only");
    await page.keyboard.press(" ");
    await page.waitForTimeout(500);
    assert.ok((await changedValues(page)) > 100, "control: it moves again");
    await end(simulation);
    assert.deepEqual(errors, []);
    await page.close();
});

test("the camera is copied as an expression of the Python package", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(WIDTH, HEIGHT);
    await page.context().grantPermissions(["clipboard-read", "clipboard-write"]);
    const copied = async () => {
        await page.keyboard.press("c");
        await page.locator(".notice", { hasText: "Copied: mc.look_at" }).waitFor();
        return page.evaluate(() => navigator.clipboard.readText());
    };
    const framed = await copied();
    const tuple = String.raw`\((\S+), (\S+), (\S+)\)`;
    const call = new RegExp(String.raw`^mc\.look_at\(eye=${tuple}, target=${tuple}, field_of_view=28\)$`).exec(framed);
    assert.ok(call, framed);
    const { eye, target } = await page.evaluate(() => {
        const { camera } = modalcastViewer.viewport;
        return { eye: camera.eye, target: camera.target };
    });
    [...eye, ...target].forEach((value, index) => {
        const text = Number(call[index + 1]);
        assert.ok(Math.abs(text - value) <= 1e-6 * Math.abs(value), `expected ${value}, got ${text}`);
    });
    // The package has these parameters.
    const python = readFileSync("../python/src/modalcast/camera.py", "utf8");
    const parameters = /^def look_at\((.*)\) ->/m.exec(python)?.[1] ?? "";
    for (const name of ["eye", "target", "field_of_view"]) assert.match(parameters, new RegExp(`\\b${name}:`));
    // Control: another view is another expression, and F returns to the first one.
    await page.mouse.move(200, 200);
    await page.mouse.down();
    await page.mouse.move(260, 220);
    await page.mouse.up();
    assert.notEqual(await copied(), framed);
    await page.keyboard.press("f");
    assert.equal(await copied(), framed);
    assert.deepEqual(errors, []);
    await page.close();
});

interface View {
    target: number[];
    distance: number;
    direction: number[];
}

function viewOf(page: Page): Promise<View> {
    return page.evaluate(() => {
        const { eye, target } = modalcastViewer.viewport.camera;
        const offset = eye.map((value, axis) => value - (target[axis] ?? 0));
        const distance = Math.hypot(...offset);
        return { target: [...target], distance, direction: offset.map((value) => value / distance) };
    });
}

/** Moves fingers from their first to their last places in ten steps. */
async function touch(session: CDPSession, from: number[][], to: number[][]): Promise<void> {
    const send = (type: "touchStart" | "touchMove" | "touchEnd", points: number[][]) =>
        session.send("Input.dispatchTouchEvent", {
            type,
            touchPoints: points.map(([x = 0, y = 0], id) => ({ x, y, id })),
        });
    await send("touchStart", from);
    for (let step = 1; step <= 10; step++) {
        const mix = (a: number, b: number) => a + ((b - a) * step) / 10;
        await send(
            "touchMove",
            from.map((place, id) => place.map((value, axis) => mix(value, to[id]?.[axis] ?? value))),
        );
    }
    await send("touchEnd", []);
}

function distance(a: readonly number[], b: readonly number[]): number {
    return Math.hypot(...a.map((value, axis) => value - (b[axis] ?? 0)));
}

test("fingers orbit, pinch and pan", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await setup.openTree(390, 844);
    const session = await page.context().newCDPSession(page);
    await session.send("Emulation.setTouchEmulationEnabled", { enabled: true, maxTouchPoints: 2 });
    const start = await viewOf(page);
    await touch(session, [[200, 400]], [[260, 420]]);
    const orbited = await viewOf(page);
    assert.ok(distance(orbited.direction, start.direction) > 0.1, "expected another direction after one finger");
    assert.ok(Math.abs(orbited.distance / start.distance - 1) < 1e-6, "one finger does not zoom");
    await touch(
        session,
        [
            [180, 400],
            [220, 400],
        ],
        [
            [120, 400],
            [280, 400],
        ],
    );
    const pinched = await viewOf(page);
    const zoom = orbited.distance / pinched.distance;
    assert.ok(zoom > 2, `expected a zoom by more than 2 after a pinch, got ${zoom}`);
    await touch(
        session,
        [
            [180, 400],
            [220, 400],
        ],
        [
            [180, 480],
            [220, 480],
        ],
    );
    const panned = await viewOf(page);
    assert.ok(distance(panned.target, pinched.target) > 0.02 * pinched.distance, "expected another target after a pan");
    assert.ok(distance(panned.direction, pinched.direction) < 1e-3, "two fingers do not turn the view");
    assert.deepEqual(errors, []);
    await page.close();
});

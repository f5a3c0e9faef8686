/** Recordings in headless Chromium, without a server: dropped onto the page, and inside of an exported page. */

import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { pathToFileURL } from "node:url";
import type { Browser, Page } from "playwright-core";
import { SceneModel } from "../../src/scene/scene_model";
import { Playback } from "../../src/source/playback";
import { type Recording, readRecording } from "../../src/source/recording";
import {
    changedValues,
    committedPage,
    dropFiles,
    end,
    launchBrowser,
    openPage,
    printedUrl,
    rememberPixels,
    runProgram,
    ServerProcess,
    startProgram,
    startSimulation,
    temporaryFolder,
    usesCommittedPage,
    waitForScene,
} from "./harness";

const LIMIT_MS = 300_000;
const WIDTH = 480;
const HEIGHT = 300;
const folder = temporaryFolder();
const file = join(folder, "tree.mcap");
const viewerPage = join(folder, "viewer.html");
const exportedPage = join(folder, "tree.html");

let browser: Browser;
let recording: Recording;

before(async () => {
    writeFileSync(viewerPage, committedPage());
    await record();
    recording = readRecording(readFileSync(file));
    await runProgram("modalcast-record", [
        ...["export", file, "--to", "html", "--out", exportedPage],
        ...["--page", viewerPage],
    ]);
    browser = await launchBrowser();
});

after(async () => browser?.close());

/** Records a moving tree. A force acts from the middle on. The server ends before the recording is played. */
async function record(): Promise<void> {
    const server = new ServerProcess();
    await server.start();
    const client = await server.client();
    await client.openScene("tree");
    const simulation = startSimulation(server, ["--scene", "tree", "--wind", "8", "--forces"]);
    const options = ["record", "tree", "--out", file, "--server", server.grpcUrl, "--steps", "120"];
    const recorder = runProgram("modalcast-record", options);
    let states = 0;
    for await (const { part } of client.streamStates("tree")) if (part.case === "chunk" && ++states === 60) break;
    const force = { id: 1n, domain: 0, triangle: 100, barycentric: [1, 0, 0], vector: [500, 0, 0] };
    await client.applyForces("tree", new Uint8Array(32).fill(7), [force], 10_000);
    await recorder;
    await end(simulation);
    await server.stop();
}

/** q of the trunk that the recording has at a time in seconds. */
function expectedQ(time: number): number[] {
    const model = new SceneModel(recording.scene, recording.arrays);
    new Playback(recording, model).seek(time);
    return [...model.state.qOf(0)];
}

function shownQ(page: Page): Promise<number[]> {
    return page.evaluate(() => [...(modalcastViewer.model?.state.qOf(0) ?? [])]);
}

/** Seeks with the slider of the time line, as a user does. */
async function seek(page: Page, time: number): Promise<void> {
    await page.getByRole("slider", { name: "Time in seconds" }).evaluate((slider, value) => {
        (slider as HTMLInputElement).value = String(value);
        slider.dispatchEvent(new Event("input"));
    }, time);
}

/** Plays, seeks and loops. The page shows the first scene of a recording. */
async function checkPlayback(page: Page): Promise<void> {
    const duration = recording.states.at(-1)?.time ?? 0;
    assert.ok(duration > 1, `expected a recording of more than a second, got ${duration}`);
    await waitForScene(page);
    // It plays by itself.
    await page.waitForFunction(() => modalcastViewer.playback?.isPlaying && modalcastViewer.playback.time > 0.2);
    await page.getByRole("button", { name: "Pause" }).click();
    const paused = await page.evaluate(() => modalcastViewer.playback?.time ?? -1);
    assert.deepEqual(await shownQ(page), expectedQ(paused));
    await seek(page, 0);
    assert.deepEqual(await shownQ(page), expectedQ(0));
    await rememberPixels(page);
    assert.equal(await changedValues(page), 0, "expected equal pictures of one state");
    await seek(page, 0.8 * duration);
    assert.deepEqual(await shownQ(page), expectedQ(0.8 * duration));
    // Control: another time has other coordinates and another picture.
    assert.notDeepEqual(await shownQ(page), expectedQ(0));
    const changed = await changedValues(page);
    assert.ok(changed > 100, `expected another picture, got ${changed} other values`);
    // The force of the recording is shown at its time only.
    await page.locator("#overlay text", { hasText: "500 N" }).waitFor({ state: "attached" });
    await seek(page, 0);
    await page.locator("#overlay text").waitFor({ state: "detached" });
    await checkLoop(page, duration);
}

async function checkLoop(page: Page, duration: number): Promise<void> {
    await seek(page, 0.9 * duration);
    await page.getByRole("button", { name: "Play" }).click();
    await page.waitForFunction((limit) => (modalcastViewer.playback?.time ?? limit) < limit, 0.5 * duration);
    assert.ok(await page.evaluate(() => modalcastViewer.playback?.isPlaying));
    // Control: without the loop, it stops at the end. It is paused meanwhile, so that it does not end before the seek.
    await page.getByRole("button", { name: "Pause" }).click();
    await page.getByRole("button", { name: "Loop" }).click();
    await seek(page, 0.9 * duration);
    await page.getByRole("button", { name: "Play" }).click();
    await page.waitForFunction(() => modalcastViewer.playback?.isPlaying === false);
    assert.deepEqual(await shownQ(page), expectedQ(duration));
    // Keys step through the recording.
    await page.locator("#stage").focus();
    await page.keyboard.press("ArrowLeft");
    assert.deepEqual(await shownQ(page), expectedQ(recording.states.at(-2)?.time ?? 0));
    await page.keyboard.press("ArrowRight");
    assert.deepEqual(await shownQ(page), expectedQ(duration));
}

test("an exported page plays its recording without a server", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, "about:blank", WIDTH, HEIGHT);
    const requests: string[] = [];
    page.on("request", (request) => requests.push(new URL(request.url()).protocol));
    await page.goto(pathToFileURL(exportedPage).href, { waitUntil: "commit" });
    await checkPlayback(page);
    const others = requests.filter((protocol) => protocol !== "file:" && protocol !== "data:");
    assert.deepEqual(others, [], "expected no requests to a server");
    assert.deepEqual(errors, []);
    await page.close();
});

// The recording is in the page of the server.
test("`modalcast view` plays a recording", { timeout: LIMIT_MS, skip: usesCommittedPage }, async () => {
    const server = startProgram("modalcast", ["view", file, "--no-open"], ["ignore", "pipe", "inherit"]);
    const url = await printedUrl(server, "open");
    const { page, errors } = await openPage(browser, url, WIDTH, HEIGHT);
    await checkPlayback(page);
    assert.deepEqual(errors, []);
    await page.close();
    await end(server);
    assert.equal(server.exitCode, 0);
});

test("a page that is exported for slow motion plays slowly first", { timeout: LIMIT_MS }, async () => {
    const slowPage = join(folder, "slow.html");
    const options = ["export", file, "--to", "html", "--slow", "400", "--page", viewerPage, "--out", slowPage];
    await runProgram("modalcast-record", options);
    const { page, errors } = await openPage(browser, pathToFileURL(slowPage).href, 900, HEIGHT);
    await waitForScene(page);
    await page.locator("#time-scale", { hasText: "1/400 of real time" }).waitFor();
    // It has played for at most as long as the page exists.
    await page.waitForFunction(() => (modalcastViewer.playback?.time ?? 0) > 0.002);
    const [time, age] = await page.evaluate(() => [modalcastViewer.playback?.time ?? 0, performance.now() / 1000]);
    assert.ok((time ?? 0) < (age ?? 0) / 300, `expected at most 1/400 of ${age} s, got ${time} s`);
    // Control: at the recorded speed, the bar shows no time scale.
    await page.getByRole("combobox", { name: "Speed" }).selectOption("1");
    await page.locator("#time-scale").waitFor({ state: "hidden" });
    await page.waitForFunction(() => (modalcastViewer.playback?.time ?? 0) > 0.5);
    assert.deepEqual(errors, []);
    await page.close();
});

test("a recording that is dropped onto the page plays", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, pathToFileURL(viewerPage).href, WIDTH, HEIGHT);
    // Control: without a recording there is nothing to play.
    await page.getByRole("heading", { name: "No recording" }).waitFor();
    await dropFiles(page, { "cut.mcap": readFileSync(file).subarray(0, 3000) });
    await page.getByRole("heading", { name: "The recording cannot be played" }).waitFor();
    await dropFiles(page, { "part.stl": "solid part" });
    const noServer = page.locator(".notice", { hasText: "This page has no server that could read a model." });
    // The message must not cover the view that is clicked below.
    await noServer.getByRole("button", { name: "Close this message" }).click();
    await dropFiles(page, { "tree.mcap": readFileSync(file) });
    await checkPlayback(page);
    // A pull says that a recording does not react.
    const notice = page.locator(".notice", { hasText: "does not react to forces" }).waitFor();
    await page.keyboard.down("Shift");
    await page.mouse.click(WIDTH / 2, HEIGHT / 3);
    await page.keyboard.up("Shift");
    // The message disappears by itself, on a busy machine before the click has returned.
    await notice;
    assert.deepEqual(errors, []);
    await page.close();
});

test("a page with a damaged recording says so", { timeout: LIMIT_MS }, async () => {
    const damaged = readFileSync(exportedPage, "utf8");
    const start = damaged.indexOf('<script id="recording"');
    const middle = start + Math.floor((damaged.length - start) / 2);
    const path = join(folder, "damaged.html");
    writeFileSync(path, `${damaged.slice(0, middle)}${"A".repeat(4000)}${damaged.slice(middle + 4000)}`);
    const { page } = await openPage(browser, pathToFileURL(path).href, WIDTH, HEIGHT);
    await page.getByRole("heading", { name: "The recording cannot be played" }).waitFor();
    assert.equal(await page.evaluate(() => modalcastViewer.model), null);
    await page.close();
});

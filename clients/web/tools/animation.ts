/**
 * Records a pull on the tree and saves the frames of its replay in the viewer as PNG files: animation.ts FOLDER.
 * This program applies the force with the calls of a viewer, in simulated time, and a browser draws the recording later,
 * frame by frame. The animation is thus smooth on every machine.
 */

import { mkdirSync } from "node:fs";
import { writeFile } from "node:fs/promises";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import type { Browser, Page } from "playwright-core";
import { FrameService } from "../src/proto/modalcast/v1/frames_pb";
import type { Server } from "../src/source/server";
import {
    committedPage,
    end,
    launchBrowser,
    openPage,
    runProgram,
    ServerProcess,
    startProgram,
    startSimulation,
    temporaryFolder,
    waitForScene,
} from "../tests/browser/harness";

const WIDTH = 600;
const HEIGHT = 400;
const FRAMES_PER_SECOND = 16;
/** Seconds of the animation before the pull begins, and in total. */
const LEAD = 0.2;
const DURATION = 3.2;
/** Simulated seconds until the pull begins, during which it grows, and after which it ends. */
const START = 4;
const GROWTH = 0.5;
const HOLD = 0.85;
/** The largest force: 2 kN to the right of the default camera, which looks along -(0.42, 0.14, 0.9). */
const FORCE = [0.906 * 2000, 0, -0.423 * 2000] as const;
/** Height of the pulled point on the trunk, as a part of the picture from its upper edge. */
const PULLED_HEIGHT = 0.42;
/** Distance of the camera, relative to that which frames the whole scene. */
const CAMERA_DISTANCE = 0.8;

const folder = process.argv[2];
if (!folder) throw new Error("expected: animation.ts FOLDER");
mkdirSync(folder, { recursive: true });
const work = temporaryFolder();
const recording = join(work, "tree.mcap");
const page = join(work, "tree.html");
await recordPull();
const browser = await launchBrowser();
try {
    await writeFile(join(work, "viewer.html"), committedPage());
    await runProgram("modalcast-record", [
        "export",
        recording,
        "--to",
        "html",
        "--out",
        page,
        "--page",
        join(work, "viewer.html"),
    ]);
    await saveFrames(browser, folder);
} finally {
    await browser.close();
}

/** Records the tree while a force acts on its trunk. */
async function recordPull(): Promise<void> {
    const server = new ServerProcess();
    await server.start();
    const client = await server.client();
    await client.openScene("tree");
    const point = await trunkPoint(client);
    const simulation = startSimulation(server, ["--scene", "tree", "--wind", "0", "--forces"]);
    const options = ["record", "tree", "--out", recording, "--server", server.grpcUrl];
    const recorder = startProgram("modalcast-record", options);
    const owner = crypto.getRandomValues(new Uint8Array(32));
    let isSending = false;
    const apply = async (share: number) => {
        isSending = true;
        const vector = FORCE.map((component) => share * component);
        await client.applyForces("tree", owner, share > 0 ? [{ id: 1n, ...point, vector }] : [], 1000);
        isSending = false;
    };
    for await (const { part } of client.streamStates("tree")) {
        const time = (part.case === "chunk" ? (part.value.head?.step?.time ?? 0) : 0) - START;
        const growth = Math.min(Math.max(time / GROWTH, 0), 1);
        if (!isSending) void apply(time > HOLD ? 0 : growth * growth * (3 - 2 * growth));
        if (time > DURATION) break;
    }
    await end(recorder, "SIGINT");
    await end(simulation);
    await server.stop();
}

/** A visible point of the trunk. */
async function trunkPoint(client: Server): Promise<{ domain: number; triangle: number; barycentric: number[] }> {
    const scene = await client.describe("tree");
    const trunk = scene.domains.findIndex(({ name }) => name === "trunk");
    const picture = { width: WIDTH, height: HEIGHT };
    const middle = Math.round(PULLED_HEIGHT * HEIGHT);
    const request = {
        scene: "tree",
        picture,
        x: WIDTH / 2 - 32,
        y: middle - 20,
        width: 64,
        height: 40,
        withoutModes: true,
    };
    for await (const { hits } of client.channel.serverStream(FrameService.method.pick, request)) {
        const hit = hits.find(({ domain }) => domain === trunk);
        if (hit) return { domain: hit.domain, triangle: hit.triangle, barycentric: [...hit.barycentric] };
    }
    throw new Error("expected the trunk in the middle of the picture");
}

/** Saves what the viewer shows from shortly before the first force on. */
async function saveFrames(browser: Browser, folder: string): Promise<void> {
    const { page: viewer } = await openPage(browser, pathToFileURL(page).href, WIDTH, HEIGHT);
    await prepare(viewer);
    const start = await viewer.evaluate(() => {
        modalcastViewer.playback?.pause();
        return modalcastViewer.playback?.firstForce ?? 0;
    });
    for (let frame = 0; frame < DURATION * FRAMES_PER_SECOND; frame++) {
        const time = start - LEAD + frame / FRAMES_PER_SECOND;
        await viewer.evaluate(async (seconds) => {
            modalcastViewer.playback?.seek(seconds);
            // The first animation frame draws the state, and the second one follows its presentation.
            for (let i = 0; i < 2; i++) await new Promise((done) => requestAnimationFrame(done));
        }, time);
        await viewer.screenshot({ path: join(folder, `${String(frame).padStart(3, "0")}.png`) });
    }
    await writeFile(join(folder, "rate"), String(FRAMES_PER_SECOND));
    await viewer.close();
}

/** Hides panels and tools, and moves the camera closer. */
async function prepare(page: Page): Promise<void> {
    await waitForScene(page);
    await page.addStyleTag({ content: "#bar, #dock, #panel { display: none !important }" });
    await page.evaluate(() => {
        if (!document.body.classList.contains("wide")) modalcastViewer.togglePanel();
    });
    await page.waitForFunction((width) => document.getElementById("stage")?.clientWidth === width, WIDTH);
    await page.evaluate((distance) => {
        modalcastViewer.frameScene();
        const { camera } = modalcastViewer.viewport;
        const { eye, target } = camera;
        const closer = eye.map((value, axis) => distance * value + (1 - distance) * (target[axis] ?? 0));
        camera.look(closer as [number, number, number], target);
    }, CAMERA_DISTANCE);
}

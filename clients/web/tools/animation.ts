/**
 * Records a pull on the tree and saves the frames of its replay in the viewer as PNG files: animation.ts FOLDER.
 * The pull is made with the mouse in a viewer, which draws as fast as this machine can. Each frame then shows the
 * recording at its time, so that the animation is smooth on every machine.
 */

import { mkdirSync } from "node:fs";
import { writeFile } from "node:fs/promises";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import type { Browser, Page } from "playwright-core";
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

const WIDTH = 640;
const HEIGHT = 400;
const FRAMES_PER_SECOND = 16;
/** Seconds of the animation before the pull begins, and in total. */
const LEAD = 0.15;
const DURATION = 3;
/** Simulated seconds during which the cursor moves, and until the button goes up. */
const MOVE = 0.5;
const HOLD = 0.85;
/** Pixels from the pulled point to the cursor. */
const OFFSET = [170, 15] as const;
/** The height in the picture of the pulled point on the trunk. */
const PULLED_HEIGHT = 0.45;

const folder = process.argv[2];
if (!folder) throw new Error("expected: animation.ts FOLDER");
mkdirSync(folder, { recursive: true });
const work = temporaryFolder();
const recording = join(work, "tree.mcap");
const page = join(work, "tree.html");
const browser = await launchBrowser();
try {
    await recordPull(browser);
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

/** Records the tree while a viewer pulls on its trunk. */
async function recordPull(browser: Browser): Promise<void> {
    const server = new ServerProcess();
    await server.start();
    await (await server.client()).openScene("tree");
    const simulation = startSimulation(server, ["--scene", "tree", "--wind", "0", "--forces"]);
    const { page } = await openPage(browser, server.pageUrl("tree"), WIDTH, HEIGHT);
    await prepare(page);
    await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 5);
    const recorder = startProgram("modalcast-record", [
        "record",
        "tree",
        "--out",
        recording,
        "--server",
        server.grpcUrl,
    ]);
    const [x, y] = await trunkPixel(page);
    await waitSeconds(page, 2);
    await page.keyboard.down("Shift");
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.waitForFunction(() => modalcastViewer.pull?.view != null);
    const start = await simulatedTime(page);
    for (let part = 0; part < 1; ) {
        part = Math.min(1, ((await simulatedTime(page)) - start) / MOVE);
        const eased = part * part * (3 - 2 * part);
        await page.mouse.move(x + OFFSET[0] * eased, y + OFFSET[1] * eased);
    }
    await waitSeconds(page, HOLD - MOVE);
    await page.mouse.up();
    await waitSeconds(page, DURATION);
    await end(recorder, "SIGINT");
    await end(simulation);
    await page.close();
    await server.stop();
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
    await viewer.close();
}

/** Hides panels and tools, and moves the camera closer to the crown. */
async function prepare(page: Page): Promise<void> {
    await waitForScene(page);
    await page.addStyleTag({ content: "#bar, #dock, #panel { display: none !important }" });
    await page.evaluate(() => {
        if (!document.body.classList.contains("wide")) modalcastViewer.togglePanel();
    });
    await page.waitForFunction((width) => document.getElementById("stage")?.clientWidth === width, WIDTH);
    await page.evaluate(() => modalcastViewer.frameScene());
}

/** The visible pixel of the trunk that is closest to a height in the picture. */
async function trunkPixel(page: Page): Promise<[number, number]> {
    return page.evaluate(
        ([width, height, share]) => {
            const { renderer, viewport, model } = modalcastViewer;
            const ids = renderer?.domainIds(viewport.camera.camera, width, height) ?? [];
            const trunk = model?.scene.domains.findIndex(({ name }) => name === "trunk") ?? -1;
            let best: [number, number] | null = null;
            for (let y = 1; y < height - 1; y++) {
                for (let x = 1; x < width - 1; x++) {
                    const isInside = [-1, 0, 1].every((dx) => ids[y * width + x + dx] === trunk);
                    if (isInside && (!best || Math.abs(y - share * height) < Math.abs(best[1] - share * height)))
                        best = [x, y];
                }
            }
            if (!best) throw new Error("expected the trunk in the picture");
            return best;
        },
        [WIDTH, HEIGHT, PULLED_HEIGHT] as const,
    );
}

function simulatedTime(page: Page): Promise<number> {
    return page.evaluate(() => modalcastViewer.model?.state.step?.time ?? 0);
}

async function waitSeconds(page: Page, seconds: number): Promise<void> {
    const until = (await simulatedTime(page)) + seconds;
    await page.waitForFunction((time) => (modalcastViewer.model?.state.step?.time ?? 0) >= time, until);
}

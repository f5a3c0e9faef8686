/** `modalcast view` in headless Chromium: a body with eigenvalues answers a pull, and others say why they do not. */

import assert from "node:assert/strict";
import type { ChildProcess } from "node:child_process";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before, test } from "node:test";
import type { Browser, Page } from "playwright-core";
import {
    dropFiles,
    end,
    launchBrowser,
    openPage,
    printedUrl,
    runProgram,
    startProgram,
    takeScreenshot,
    temporaryFolder,
    type ViewerPage,
    waitForScene,
} from "./harness";
import { Beam } from "./model_files";

const LIMIT_MS = 300_000;
const WIDTH = 1000;
const HEIGHT = 640;

let browser: Browser;
const programs: ChildProcess[] = [];
before(async () => {
    browser = await launchBrowser();
});
after(async () => {
    await browser.close();
    await Promise.all(programs.map((program) => end(program)));
});

/** `modalcast view` of a model file, and its page. */
interface View extends ViewerPage {
    program: ChildProcess;
    url: string;
}

async function view(name: string, content: Buffer | string, modeling: string[] = []): Promise<View> {
    const model = join(temporaryFolder(), name);
    writeFileSync(model, content);
    const options = ["view", model, "--no-open", "--backend", "cpu", ...modeling];
    const program = startProgram("modalcast", options, ["ignore", "pipe", "pipe"]);
    programs.push(program);
    const url = await printedUrl(program, "open");
    const viewerPage = await openPage(browser, url, WIDTH, HEIGHT);
    await waitForScene(viewerPage.page);
    return { ...viewerPage, program, url };
}

async function close({ page, errors, program }: View): Promise<void> {
    assert.deepEqual(errors, []);
    await page.close();
    await end(program);
    assert.equal(program.exitCode, 0);
}

/** The child processes of a program, zombies included: their numbers by their names. */
function children(program: ChildProcess): Record<string, number> {
    const found: Record<string, number> = {};
    for (const pid of readdirSync("/proc").filter((name) => /^\d+$/.test(name))) {
        let stat = "";
        try {
            stat = readFileSync(`/proc/${pid}/stat`, "utf8");
        } catch {
            // The process has ended.
        }
        const [, name = "", parent] = /^\d+ \((.*)\) \w (\d+)/.exec(stat) ?? [];
        if (Number(parent) === program.pid) found[name] = Number(pid);
    }
    return found;
}

/** A pixel in the middle of the beam, in its upper half and below the bar at the top of the page. */
function upperPixel(page: Page): Promise<[number, number]> {
    return page.evaluate(() => {
        const { renderer, viewport } = modalcastViewer;
        const stage = document.getElementById("stage") as HTMLElement;
        const [width, height] = [stage.clientWidth, stage.clientHeight];
        const ids = renderer?.domainIds(viewport.camera.camera, width, height) ?? [];
        const y = Math.round(0.3 * height);
        const pixels = Array.from({ length: width }, (_, x) => x).filter((x) => ids[y * width + x] === 0);
        const x = pixels[Math.floor(pixels.length / 2)];
        if (x === undefined) throw new Error("expected the beam in the picture");
        return [x, y] as [number, number];
    });
}

/** The color map of deflections ends at a round number that is at most 4 / 3 times the largest recent deflection. */
async function checkColorRange(page: Page): Promise<void> {
    await page.keyboard.press("m");
    const legend = page.locator("#legend .ends span").nth(1);
    await legend.filter({ hasText: / m/ }).waitFor();
    const scale = await page.evaluate(() => {
        const { deflections, colorScale } = modalcastViewer.session ?? {};
        return { end: colorScale?.end ?? 0, largest: deflections?.largestOfScene() ?? 0 };
    });
    assert.ok(scale.end >= scale.largest && scale.end < 0.1, JSON.stringify(scale));
    assert.match(
        (await legend.textContent()) ?? "",
        /^(?:1|1\.2|1\.5|2|2\.5|[34568]|1[025]|2[05]|[34568]0|1[025]0|2[05]0|[34568]00) mm$/,
    );
    await page.keyboard.press("m");
    await page.locator("#legend", { hasText: "Mode 1, 1 Hz: part of its largest deflection" }).waitFor();
    await page.keyboard.press("m");
    await page.locator("#legend").waitFor({ state: "hidden" });
}

/** Pulls the beam from a pixel, farther than it may bend: by a tenth of its length of 1 m. */
async function checkForceLimit(page: Page, [x, y]: [number, number]): Promise<void> {
    const text = (line: number) => page.locator("#overlay tspan").nth(line).textContent();
    const view = () => page.evaluate(() => modalcastViewer.pull?.view);
    await page.mouse.move(x + 20, y);
    await page.waitForFunction(() => modalcastViewer.pull?.view?.isLimited === false);
    assert.match((await text(0)) ?? "", /^[\d.]+ N of at most [\d.]+ N$/);
    await page.mouse.move(x + 300, y);
    await page.waitForFunction(() => modalcastViewer.pull?.view?.isLimited);
    const pull = await view();
    const [newtons, limit] = [pull?.newtons ?? 0, pull?.limit ?? 0];
    assert.ok(Math.abs(newtons / limit - 1) < 1e-9, `expected ${limit} N, got ${newtons} N`);
    assert.match((await text(1)) ?? "", /mm at the pulled point$/);
    assert.match((await text(2)) ?? "", /mm largest$/);
    assert.equal(await text(3), "The limit bends the part by 10 % of its size.");
    const [label, stage] = await page.evaluate(() =>
        ["#overlay text", "#stage"].map(
            (selector) => document.querySelector(selector)?.getBoundingClientRect().right ?? 0,
        ),
    );
    assert.ok(label && stage && label < stage, `expected the text left of ${stage}, got ${label}`);
    // q = f U_i / eigenvalue, and |q| is the deflection of the free end.
    const point = await page.evaluate(() => [...(modalcastViewer.pull?.grabbed?.modes ?? [])]);
    const [x0 = 0, , , y1 = 0] = point;
    const direction = (pull?.to ?? []).map((value, axis) => value - (pull?.from[axis] ?? 0));
    const length = Math.hypot(...direction);
    const [fx = 0, fy = 0] = direction.map((component) => ((pull?.newtons ?? 0) * component) / length);
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const deflection = Math.hypot((x0 * fx) / eigenvalue(1), (y1 * fy) / eigenvalue(1.5));
    assert.ok(deflection > 0.09 && deflection < 0.12, `expected 0.1 m at the free end, got ${deflection}`);
    await page.getByText(/^you: [\d.]+ N of at most [\d.]+ N on beam$/).waitFor({ state: "attached" });
}

function coordinates(page: Page): Promise<number[]> {
    return page.evaluate(() => [...(modalcastViewer.model?.state.q ?? [])]);
}

/** Largest norm of q within some time. */
async function largestNorm(page: Page, milliseconds: number): Promise<number> {
    let largest = 0;
    for (const limit = performance.now() + milliseconds; performance.now() < limit; ) {
        largest = Math.max(largest, Math.hypot(...(await coordinates(page))));
        await page.waitForTimeout(20);
    }
    return largest;
}

test("a one-part archive with eigenvalues is pulled, moves and rings down", { timeout: LIMIT_MS }, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const shown = await view("beam.npz", new Beam().npz([eigenvalue(1), eigenvalue(1.5)]));
    const { page, program } = shown;
    await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 5);
    assert.equal(Math.hypot(...(await coordinates(page))), 0, "expected no motion without a pull");
    assert.deepEqual(Object.keys(children(program)), ["modalcast-sim"]);
    const [x, y] = await upperPixel(page);
    await page.keyboard.down("Shift");
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.waitForFunction(() => modalcastViewer.pull?.view != null);
    await page.mouse.move(x + 80, y, { steps: 5 });
    // The displacement at the free end is |q|; the beam has length 1.
    await page.waitForFunction(() => Math.hypot(...(modalcastViewer.model?.state.q ?? [])) > 0.1);
    await page.waitForTimeout(500);
    await takeScreenshot(page, "view-npz-pulled");
    const pulled = await coordinates(page);
    await checkForceLimit(page, [x, y]);
    await page.mouse.up();
    await page.keyboard.up("Shift");
    // It swings to the other side, and comes to rest.
    await page.waitForFunction((start) => {
        const q = modalcastViewer.model?.state.q ?? [];
        return start.reduce((sum, value, mode) => sum + value * (q[mode] ?? 0), 0) < 0;
    }, pulled);
    let norm = Math.hypot(...pulled);
    while (norm > 0.2 * Math.hypot(...pulled)) norm = await largestNorm(page, 1200);
    await checkColorRange(page);
    assert.equal(await page.locator(".notice").count(), 0);
    // The page learns that the physics process has ended.
    const physics = children(program)["modalcast-sim"];
    assert.ok(physics);
    process.kill(physics, "SIGKILL");
    await page.locator(".notice", { hasText: "modalcast-sim has ended (signal: 9" }).waitFor();
    assert.deepEqual(children(program), {}, "expected no child process, and no zombie");
    await close(shown);
});

test("the modes of a surface are computed, and the part is pulled", { timeout: LIMIT_MS }, async () => {
    process.env["XDG_CACHE_HOME"] = temporaryFolder();
    // The first frequency of the beam is about 2.7 Hz.
    const material = ["--material", "E=2e7,nu=0.3,rho=1000", "--damping", "0.05"];
    const modeling = ["--modes", "12", ...material, "--clamp", "z < 0.05", "--freedoms", "5000"];
    const shown = await view("beam.stl", new Beam().stl(), modeling);
    const { page } = shown;
    await page.waitForFunction(() => modalcastViewer.status.stateRate.perSecond() > 5);
    assert.equal((await coordinates(page)).length, 12);
    // The panel shows ten modes at first, each with its bar.
    const bars = page.locator(".mode .track");
    assert.equal(await bars.count(), 10);
    await page.getByRole("button", { name: "Show all 12 modes" }).click();
    assert.equal(await bars.count(), 12);
    assert.ok(await bars.evaluateAll((all) => all.every((bar) => bar.getBoundingClientRect().height > 0)));
    assert.equal(await page.locator(".modes").evaluate((list) => list.scrollHeight - list.clientHeight), 0);
    await page.getByRole("button", { name: "Show 10 modes" }).click();
    assert.equal(Math.hypot(...(await coordinates(page))), 0, "expected no motion without a pull");
    await takeScreenshot(page, "view-stl-at-rest");
    const [x, y] = await upperPixel(page);
    await page.keyboard.down("Shift");
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.waitForFunction(() => modalcastViewer.pull?.view != null);
    await page.mouse.move(x + 80, y, { steps: 5 });
    // The mass of the beam is 14 kg, so the displacement at the free end is about 0.5 |q|.
    await page.waitForFunction(() => Math.hypot(...(modalcastViewer.model?.state.q ?? [])) > 0.1);
    await page.waitForTimeout(500);
    await takeScreenshot(page, "view-stl-pulled");
    await page.mouse.up();
    await page.keyboard.up("Shift");
    await page.waitForFunction(() => Math.hypot(...(modalcastViewer.model?.state.q ?? [])) < 0.02);
    assert.equal(await page.locator(".notice").count(), 0);
    await close(shown);
});

test("remarks on the files are a message and a list", { timeout: LIMIT_MS }, async () => {
    // A triangle of 200 m, which may be one of 200 mm.
    const triangle = "mtllib absent.mtl\nv 0 0 0\nv 200 0 0\nv 0 200 0\nf 1 2 3\n";
    const shown = await view("triangle.obj", triangle, ["--no-sim"]);
    const { page } = shown;
    const notice = page.locator(".notice", { hasText: "2 notes on the files of this scene." });
    await notice.getByRole("button", { name: "Show" }).click();
    await notice.waitFor({ state: "hidden" });
    const remarks = await page.locator("ul.remarks li").allTextContents();
    assert.match(remarks[0] ?? "", /^material library 'absent.mtl' does not exist: the default color is drawn/);
    assert.match(remarks[1] ?? "", /^The model is 200 x 200 x 0 m large.*modalcast view triangle.obj --unit mm$/);
    assert.equal(remarks.length, 2);
    assert.equal(await page.locator("ul.remarks").isVisible(), true);
    await takeScreenshot(page, "view-remarks");
    await close(shown);
    const plain = await view("triangle.obj", triangle.replace("mtllib absent.mtl\n", ""), ["--no-sim", "--unit", "mm"]);
    assert.equal(await plain.page.locator(".notice").count(), 0, "control");
    assert.equal(await plain.page.locator("summary", { hasText: "Notes on files" }).isVisible(), false, "control");
    await close(plain);
});

/** Begins a pull on the beam. */
async function press(page: Page): Promise<void> {
    await page.keyboard.down("Shift");
    await page.mouse.move(...(await upperPixel(page)));
    await page.mouse.down();
    await page.waitForFunction(() => modalcastViewer.pull?.view != null);
}

async function release(page: Page): Promise<void> {
    await page.mouse.up();
    await page.keyboard.up("Shift");
}

/** q of the first mode: its mean over some time, and the largest distance from the mean. */
async function vibration(page: Page, milliseconds: number): Promise<{ mean: number; amplitude: number }> {
    const values: number[] = [];
    for (const limit = performance.now() + milliseconds; performance.now() < limit; ) {
        values.push((await coordinates(page))[0] ?? Number.NaN);
        await page.waitForTimeout(20);
    }
    const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
    return { mean, amplitude: Math.max(...values.map((value) => Math.abs(value - mean))) };
}

test("a slider holds a mode while physics is running", { timeout: LIMIT_MS }, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const shown = await view("fork.npz", new Beam().npz([eigenvalue(206), eigenvalue(300)]));
    const { page } = shown;
    const slider = page.getByRole("slider", { name: "Mode 1", exact: true });
    await slider.waitFor();
    await page.locator("#time-scale", { hasText: "1/100 of real time" }).waitFor();
    await page.locator("#panel .hint", { hasText: "holds a mode by a constant force" }).waitFor();
    assert.equal((await vibration(page, 500)).mean, 0, "control: at rest without a force");
    const play = page.getByRole("button", { name: "Animate mode 1", exact: true });
    assert.equal(await play.isVisible(), false, "only steps of this viewer animate a mode");
    // One step from the middle is 0.5 mm, and a corner moves by 1.007 m per unit of q.
    await slider.focus();
    for (let press = 0; press < 60; press++) await page.keyboard.press("ArrowRight");
    const target = 0.03 / 1.007;
    for (;;) {
        const { mean, amplitude } = await vibration(page, 1500);
        if (Math.abs(mean / target - 1) < 0.05 && amplitude < 0.1 * target) break;
    }
    assert.equal(await slider.inputValue(), "60");
    await page.getByText("you: modes held on fork").waitFor({ state: "attached" });
    await takeScreenshot(page, "view-held-mode");
    await page.getByRole("button", { name: "Set all to 0" }).click();
    await page.waitForFunction(() => modalcastViewer.model?.forces.length === 0);
    for (;;) {
        const { mean, amplitude } = await vibration(page, 1500);
        if (Math.abs(mean) < 0.05 * target && amplitude < 0.1 * target) break;
    }
    assert.equal(await slider.inputValue(), "0");
    // A hint says how to pull, until the first pull of this browser.
    const hint = page.locator(".notice", { hasText: "Shift + drag pulls on the model." });
    await hint.waitFor();
    await press(page);
    await hint.waitFor({ state: "hidden" });
    await release(page);
    assert.equal(await page.evaluate(() => localStorage.getItem("modalcast.has-pulled")), "1");
    await close(shown);
});

test("a phone has a hint at the tool that pulls", { timeout: LIMIT_MS }, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const shown = await view("fork.npz", new Beam().npz([eigenvalue(206), eigenvalue(300)]));
    const { page } = shown;
    await page.setViewportSize({ width: 390, height: 844 });
    await page.reload({ waitUntil: "commit" });
    await waitForScene(page);
    const hint = page.locator(".notice", { hasText: "To pull: tap the arrow below, then drag." });
    await hint.waitFor();
    await takeScreenshot(page, "view-phone-hint");
    await page.getByRole("button", { name: "Pull on the surface" }).click();
    await page.mouse.move(...(await upperPixel(page)));
    await page.mouse.down();
    await hint.waitFor({ state: "hidden" });
    await page.mouse.up();
    // Control: the next page of this browser has no hint.
    await page.reload({ waitUntil: "commit" });
    await waitForScene(page);
    await page.waitForFunction(() => modalcastViewer.session?.modeForces?.hasReceiver);
    await page.waitForTimeout(500);
    assert.equal(await page.locator(".notice").count(), 0);
    await close(shown);
});

test("a pull without physics names a command that starts it", { timeout: LIMIT_MS }, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const shown = await view("fork.npz", new Beam().npz([eigenvalue(206), eigenvalue(300)]), ["--no-sim"]);
    const { page } = shown;
    await page.locator("#panel .hint", { hasText: "a pull has no effect" }).waitFor();
    assert.equal(await page.locator(".notice").count(), 0, "expected no hint at a pull without effect");
    await press(page);
    const notice = page.locator(".notice", { hasText: "no physics is running" });
    await notice.waitFor();
    await release(page);
    // One line in the corner until the user opens it.
    const height = async () => (await notice.boundingBox())?.height ?? 0;
    assert.ok((await height()) < 40, `expected one line, got ${await height()}`);
    await notice.getByRole("button", { name: "More" }).click();
    assert.ok((await height()) > 60, `expected several lines, got ${await height()}`);
    await takeScreenshot(page, "view-no-physics");
    const [name = "", ...options] = ((await notice.locator("code").last().textContent()) ?? "").split(" ");
    assert.equal(name, "modalcast-sim");
    await notice.getByRole("button", { name: "Close this message" }).click();
    const physics = startProgram(name, options);
    // The command starts physics, which receives forces.
    await page.locator("#panel .hint", { hasText: "holds a mode by a constant force" }).waitFor();
    await end(physics);
    await close(shown);
});

/** Its vibrations of 206 Hz are slowed down by default, so that they are seen. */
test("a stiff body is shown in slow motion, which the page names", { timeout: LIMIT_MS }, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const fork = new Beam().npz([eigenvalue(206), eigenvalue(300)]);
    for (const [options, text] of [
        [[], "1/100 of real time"],
        [["--slow", "500"], "1/500 of real time"],
        [["--slow", "1"], null],
    ] as const) {
        const shown = await view("fork.npz", fork, [...options]);
        const { page } = shown;
        await page.locator("summary", { hasText: "Performance" }).click();
        const facts = page.locator(".facts tr", { hasText: "Time scale" });
        await facts.getByText(text ?? "real time", { exact: true }).waitFor();
        const bar = page.locator("#time-scale");
        if (text) assert.equal(await bar.textContent(), text);
        else assert.equal(await bar.isVisible(), false, "expected no remark on real time");
        await takeScreenshot(page, `view-slow-${options[1] ?? "default"}`);
        await close(shown);
    }
});

test("a recording of a stiff body that is dropped onto the page plays in slow motion", {
    timeout: LIMIT_MS,
}, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    for (const [hertz, text] of [
        [450, "1/200 of real time"],
        [3, null],
    ] as const) {
        const shown = await view("fork.npz", new Beam().npz([eigenvalue(hertz), eigenvalue(600)]));
        const { page } = shown;
        const file = join(temporaryFolder(), "fork.mcap");
        const server = new URL(shown.url).origin;
        await runProgram("modalcast-record", ["record", "fork", "--out", file, "--server", server, "--steps", "30"]);
        await dropFiles(page, { "fork.mcap": readFileSync(file) });
        await page.getByRole("slider", { name: "Time in seconds" }).waitFor();
        const speed = await page.getByRole("combobox", { name: "Speed" }).inputValue();
        assert.equal(Number(speed), text ? 1 / 200 : 1);
        const bar = page.locator("#time-scale");
        if (text) await bar.filter({ hasText: text }).waitFor();
        else assert.equal(await bar.isVisible(), false, "control");
        await takeScreenshot(page, `view-recording-${hertz}-hertz`);
        await close(shown);
    }
});

test("an animated mode of a stiff body is slowed down, and the page says by which factor", {
    timeout: LIMIT_MS,
}, async () => {
    const eigenvalue = (hertz: number) => (2 * Math.PI * hertz) ** 2;
    const shown = await view("fork.npz", new Beam().npz([eigenvalue(450), eigenvalue(600)]), ["--no-sim"]);
    const { page } = shown;
    const bar = page.locator("#time-scale");
    assert.equal(await bar.isVisible(), false, "control: nothing moves");
    await page.getByText("Mode 1, 450 Hz").waitFor();
    // The beam has a size of 1.01 m. The end turns, too, so a corner moves by 1.007 m per unit of q.
    assert.equal(await page.locator(".mode-scale").textContent(), "−100 mm0+100 mm");
    await page.getByRole("button", { name: "Animate mode 1", exact: true }).click();
    await bar.filter({ hasText: "1/450 of real time" }).waitFor();
    await page.waitForFunction(() => (modalcastViewer.model?.state.q[0] ?? 0) > 0.03);
    await takeScreenshot(page, "view-animated-mode");
    await page.getByRole("button", { name: "Animate mode 1", exact: true }).click();
    await bar.waitFor({ state: "hidden" });
    await page.getByRole("slider", { name: "Mode 2", exact: true }).focus();
    await page.keyboard.press("End");
    await page.locator("#deflection", { hasText: /^100 mm$/ }).waitFor();
    assert.equal(await page.locator(".mode .value").nth(1).textContent(), "+100 mm");
    assert.equal(
        await page.locator(".mode .value").nth(1).getAttribute("title"),
        "q[1] = 0.0993, counted from 0 as in programs",
    );
    await takeScreenshot(page, "view-slider");
    await close(shown);
});

for (const [name, content, reason] of [
    ["beam.npz", new Beam().npz(null), "The modes of this model have no stiffness"],
    ["beam.stl", new Beam().stl(), "This model is rigid"],
] as const) {
    test(`${name} without eigenvalues says why it does not answer a pull`, { timeout: LIMIT_MS }, async () => {
        const shown = await view(name, content);
        const { page, program } = shown;
        const notice = page.locator(".notice", { hasText: reason });
        await notice.waitFor();
        const text = (await notice.textContent()) ?? "";
        assert.ok(text.includes(`modalcast view ${name} --modes 20`), text);
        assert.ok(
            (await page.locator("#panel .hint", { hasText: reason }).count()) > 0,
            "expected it in the panel, too",
        );
        const reset = page.getByRole("button", { name: "Set all to 0" });
        assert.equal(await reset.isVisible(), name === "beam.npz", "a model without modes has no sliders");
        await takeScreenshot(page, `view-${name.replace("beam.", "")}-without-eigenvalues`);
        assert.deepEqual(children(program), {}, "expected no child process, and no zombie");
        // A pull shows the reason again after the user has closed it.
        await notice.getByRole("button", { name: "Close this message" }).click();
        await notice.waitFor({ state: "hidden" });
        await page.keyboard.down("Shift");
        await page.mouse.move(...(await upperPixel(page)));
        await page.mouse.down();
        await notice.waitFor();
        await page.mouse.up();
        await page.keyboard.up("Shift");
        assert.equal(await page.locator(".notice").count(), 1, "expected one message");
        await close(shown);
    });
}

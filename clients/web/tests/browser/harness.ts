/** Starts servers, physics processes and browsers for tests, and ends them. */

import { type ChildProcess, type StdioOptions, spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { gunzipSync } from "node:zlib";
import { type Browser, type BrowserContextOptions, type ConsoleMessage, chromium, type Page } from "playwright-core";
import WebSocket from "ws";
import type { App } from "../../src/app";
import { ContentCache } from "../../src/source/content_cache";
import { Server } from "../../src/source/server";
import { Channel } from "../../src/wire/channel";

// Node 20 has no WebSocket.
globalThis.WebSocket ??= WebSocket as unknown as typeof globalThis.WebSocket;

declare global {
    var modalcastViewer: App;
    /** In the page: see `rememberPixels`. */
    var rememberedPixels: Uint8Array;
}

const TIMEOUT_MS = 120_000;
/** Whether servers show the page of dist instead of the one that they were built with. */
export const usesCommittedPage = Boolean(process.env["MODALCAST_COMMITTED_PAGE"]);
const programs = resolve(process.env["MODALCAST_PROGRAMS"] ?? join(process.cwd(), "../../target/debug"));

/** The page of this folder. The programs have that of their build. */
export function committedPage(): string {
    return gunzipSync(readFileSync(join(process.cwd(), "dist/index.html.gz"))).toString();
}

const temporaryFolders: string[] = [];
process.once("exit", () => {
    for (const folder of temporaryFolders) rmSync(folder, { recursive: true, force: true });
});

/** A folder that the process removes when it ends. */
export function temporaryFolder(): string {
    const folder = mkdtempSync(join(tmpdir(), "modalcast-viewer-"));
    temporaryFolders.push(folder);
    return folder;
}

/** A running server. */
export class ServerProcess {
    private process: ChildProcess | null = null;
    private readonly state = temporaryFolder();
    private port = 0;
    /** The link that the server has printed at its last start. */
    link = "";
    private connected: Server | null = null;

    /**
     * @param scenes Folder of the scene repository; empty: built-in scenes only.
     * @param options More options of `modalcast serve`.
     * @param needsSession Whether pages need a link with a code. Otherwise the server identifies nobody.
     */
    constructor(
        private readonly scenes = "",
        private readonly options: readonly string[] = [],
        private readonly needsSession = false,
    ) {}

    /** Starts the server, the second time at the same port. */
    async start(): Promise<void> {
        const listen = `127.0.0.1:${this.port}`;
        const scenes = this.scenes ? ["--scenes", this.scenes] : [];
        const options = [
            "serve",
            "--listen",
            listen,
            ...(this.needsSession ? [] : ["--no-auth"]),
            "--state",
            this.state,
            "--backend",
            "cpu",
            ...scenes,
            ...this.options,
        ];
        this.process = startProgram("modalcast", options, ["ignore", "pipe", "pipe"]);
        this.link = await printedUrl(this.process, "viewer at");
        this.port = Number(new URL(this.link).port);
    }

    /** The page with a scene. */
    pageUrl(scene: string, parameters = ""): string {
        return `http://127.0.0.1:${this.port}/#scene=${scene}${parameters}`;
    }

    get grpcUrl(): string {
        return `http://127.0.0.1:${this.port}`;
    }

    /** A new client in this process. */
    async connect(): Promise<Server> {
        const channel = await Channel.open(`ws://127.0.0.1:${this.port}/websocket`);
        return new Server(channel, await ContentCache.open());
    }

    /**
     * The client of the tests in this process. On a busy machine, a comparison of pictures may delay the answer to a
     * ping for so long that the server closes the connection; the client then connects again.
     */
    async client(): Promise<Server> {
        if (!this.connected?.channel.isOpen) this.connected = await this.connect();
        return this.connected;
    }

    get pid(): number {
        return this.process?.pid ?? 0;
    }

    /** Ends the server; its state remains. */
    async stop(signal: NodeJS.Signals = "SIGTERM"): Promise<void> {
        this.connected?.channel.close();
        this.connected = null;
        await end(this.process, signal);
        this.process = null;
    }
}

export function programPath(name: string): string {
    return join(programs, name);
}

/** Starts a program of the project. It ends with this process at the latest. */
export function startProgram(name: string, options: string[], stdio: StdioOptions = "ignore"): ChildProcess {
    const program = spawn(programPath(name), options, { stdio });
    const kill = () => program.kill("SIGKILL");
    process.once("exit", kill);
    program.once("exit", () => process.removeListener("exit", kill));
    return program;
}

/** The URL after `prefix` in the output of a server. */
export function printedUrl(server: ChildProcess, prefix: string): Promise<string> {
    let log = "";
    server.stderr?.on("data", (text) => (log += text));
    return new Promise<string>((done, fail) => {
        let output = "";
        server.stdout?.on("data", (text) => {
            output += text;
            const found = new RegExp(`${prefix} (https?:\\S+)`).exec(output);
            if (found?.[1]) done(found[1]);
        });
        server.once("exit", (code) => fail(new Error(`the server has ended with code ${code}: ${log.slice(-2000)}`)));
    });
}

/** Runs a program of the project to its end. Throws if it fails. */
export async function runProgram(name: string, options: string[]): Promise<void> {
    const program = startProgram(name, options, ["ignore", "ignore", "inherit"]);
    const code = await new Promise((done) => program.once("exit", done));
    if (code !== 0) throw new Error(`${name} ${options.join(" ")}: expected exit code 0, got ${code}`);
}

/** A physics process that receives the forces of viewers. */
export function startSimulation(server: ServerProcess, options: string[]): ChildProcess {
    const all = ["--server", server.grpcUrl, "--seconds", "0", "--realtime", ...options];
    return startProgram("modalcast-sim", all);
}

export async function end(program: ChildProcess | null, signal: NodeJS.Signals = "SIGTERM"): Promise<void> {
    if (!program || program.exitCode !== null || program.signalCode !== null) return;
    const ended = new Promise((done) => program.once("exit", done));
    program.kill(signal);
    await ended;
}

export function launchBrowser(): Promise<Browser> {
    // WebGL on the CPU, because test machines have no GPU.
    const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
    // Chromium does not count a replaced page as one of the loopback address.
    if (usesCommittedPage) args.push("--disable-features=LocalNetworkAccessChecks");
    return chromium.launch({ executablePath: process.env["MODALCAST_CHROMIUM"] ?? "/usr/bin/chromium", args });
}

/** A page, and the errors that it has reported. */
export interface ViewerPage {
    page: Page;
    errors: string[];
}

/** `options`: further properties of the page's browser context. */
export async function openPage(
    browser: Browser,
    url: string,
    width = 480,
    height = 300,
    options: BrowserContextOptions = {},
): Promise<ViewerPage> {
    const page = await browser.newPage({ viewport: { width, height }, ...options });
    page.setDefaultTimeout(TIMEOUT_MS);
    const errors: string[] = [];
    page.on("pageerror", (error) => errors.push(String(error)));
    page.on("console", (message: ConsoleMessage) => {
        // The tests read pixels of a canvas, which the browser advises against.
        if (message.text().includes("willReadFrequently")) return;
        if (message.type() === "error" || message.type() === "warning") errors.push(message.text());
    });
    if (usesCommittedPage) await serveCommittedPage(page);
    // Until the first bytes: a page with a recording loads for as long as it decodes the recording.
    await page.goto(url, { waitUntil: "commit" });
    return { page, errors };
}

/** Replaces the server's page by that of this folder, so that a new page can be tested without a build of the server. */
async function serveCommittedPage(page: Page): Promise<void> {
    const isPage = (url: URL) => url.protocol === "http:" && url.pathname === "/";
    await page.route(isPage, (route) => route.fulfill({ body: committedPage(), contentType: "text/html" }));
}

/** Lets WebGL report the name of a GPU in the next document of a page, for which the viewer draws more samples and layers. */
export async function simulateGpu(page: Page): Promise<void> {
    await page.addInitScript(() => {
        const original = WebGL2RenderingContext.prototype.getParameter;
        WebGL2RenderingContext.prototype.getParameter = function (name) {
            const isRenderer = name === 0x9246 || name === WebGL2RenderingContext.RENDERER;
            return isRenderer ? "GPU of a test" : original.call(this, name);
        };
    });
}

/** Folder for screenshots of some tests; empty: none. */
const SCREENSHOTS = process.env["MODALCAST_SCREENSHOTS"] ?? "";

export async function takeScreenshot(page: Page, name: string): Promise<void> {
    if (!SCREENSHOTS) return;
    mkdirSync(SCREENSHOTS, { recursive: true });
    await page.screenshot({ path: join(SCREENSHOTS, `${name}.png`) });
}

/** Drops files onto the page. */
export async function dropFiles(page: Page, files: Record<string, Buffer | string>): Promise<void> {
    const entries = Object.entries(files).map(([name, content]) => [name, Buffer.from(content).toString("base64")]);
    await page.evaluate((list) => {
        const dataTransfer = new DataTransfer();
        for (const [name = "", base64 = ""] of list) {
            const content = Uint8Array.from(atob(base64), (character) => character.charCodeAt(0));
            dataTransfer.items.add(new File([content], name));
        }
        window.dispatchEvent(new DragEvent("drop", { dataTransfer, cancelable: true }));
    }, entries);
}

/** Waits until the page shows a scene. */
export async function waitForScene(page: Page): Promise<void> {
    await page.waitForFunction(() => Boolean(globalThis.modalcastViewer?.model));
}

/** Draws the current state, and remembers its pixels in the page. */
export async function rememberPixels(page: Page): Promise<void> {
    await comparePixels(page, true);
}

/** Remembers the pixels of a picture that has not changed for 500 ms: the first state arrives after the model. */
export async function rememberSettledPixels(page: Page): Promise<void> {
    do {
        await rememberPixels(page);
        await page.waitForTimeout(500);
    } while ((await changedValues(page)) !== 0);
}

/** Draws the current state. Returns the number of values (RGBA) that differ from the remembered pixels. */
export function changedValues(page: Page): Promise<number> {
    return comparePixels(page, false);
}

/** The pixels stay in the page, because a picture has more than a million values. */
function comparePixels(page: Page, remembers: boolean): Promise<number> {
    return page.evaluate(
        (isNew) =>
            new Promise<number>((done) => {
                const { viewport } = modalcastViewer;
                const gl = viewport.gl?.getContext() as WebGL2RenderingContext;
                const [width, height] = viewport.pixelSize;
                viewport.onDrawn = () => {
                    viewport.onDrawn = () => {};
                    const pixels = new Uint8Array(4 * width * height);
                    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
                    if (isNew) globalThis.rememberedPixels = pixels;
                    done(pixels.reduce((sum, value, i) => sum + Number(value !== globalThis.rememberedPixels[i]), 0));
                };
                viewport.invalidate();
            }),
        remembers,
    );
}

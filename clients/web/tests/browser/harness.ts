/** Starts servers, physics processes and browsers for tests, and ends them. */

import { type ChildProcess, spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, resolve } from "node:path";
import { type Browser, type ConsoleMessage, chromium, type Page } from "playwright-core";
import WebSocket from "ws";
import type { App } from "../../src/app";
import { ContentCache } from "../../src/source/content_cache";
import { Server } from "../../src/source/server";
import { Channel } from "../../src/wire/channel";

// Node 20 has no WebSocket.
globalThis.WebSocket ??= WebSocket as unknown as typeof globalThis.WebSocket;

declare global {
    var modalcastViewer: App;
}

const TIMEOUT_MS = 120_000;
const TOKEN = "smoke-test-token-0001";
const programs = resolve(process.env["MODALCAST_PROGRAMS"] ?? join(process.cwd(), "../../target/debug"));

/** A running server. */
export class ServerProcess {
    private process: ChildProcess | null = null;
    private readonly state = mkdtempSync(join(tmpdir(), "modalcast-viewer-"));
    private port = 0;

    /** @param scenes Folder of the scene repository; empty: built-in scenes only. */
    constructor(private readonly scenes = "") {}

    /** Starts the server, the second time at the same port. */
    async start(): Promise<void> {
        const listen = `127.0.0.1:${this.port}`;
        const scenes = this.scenes ? ["--scenes", this.scenes] : [];
        const options = [
            "serve",
            "--listen",
            listen,
            "--viewer-token",
            TOKEN,
            "--state",
            this.state,
            "--backend",
            "cpu",
            ...scenes,
        ];
        const server = spawn(join(programs, "modalcast"), options, { stdio: ["ignore", "pipe", "pipe"] });
        this.process = server;
        let log = "";
        server.stderr.on("data", (text) => (log += text));
        const line = await new Promise<string>((done, fail) => {
            let output = "";
            server.stdout.on("data", (text) => {
                output += text;
                const found = /viewer at (http:\S+)/.exec(output);
                if (found?.[1]) done(found[1]);
            });
            server.once("exit", (code) =>
                fail(new Error(`the server has ended with code ${code}: ${log.slice(-2000)}`)),
            );
        });
        this.port = Number(new URL(line).port);
    }

    /** The page with a scene. */
    pageUrl(scene: string, parameters = ""): string {
        return `http://127.0.0.1:${this.port}/?token=${TOKEN}#scene=${scene}${parameters}`;
    }

    get grpcUrl(): string {
        return `http://127.0.0.1:${this.port}`;
    }

    /** A client in this process. */
    async connect(): Promise<Server> {
        const channel = await Channel.open(`ws://127.0.0.1:${this.port}/websocket?token=${TOKEN}`);
        return new Server(channel, await ContentCache.open());
    }

    /** Ends the server; its state remains. */
    async stop(): Promise<void> {
        await end(this.process);
        this.process = null;
    }

    async dispose(): Promise<void> {
        await this.stop();
        rmSync(this.state, { recursive: true, force: true });
    }
}

/** A physics process that receives the forces of viewers. */
export function startSimulation(server: ServerProcess, options: string[]): ChildProcess {
    const all = ["auto", "--server", server.grpcUrl, "--seconds", "0", "--realtime", ...options];
    return spawn(join(programs, "modalcast-sim"), all, { stdio: "ignore" });
}

export async function end(process: ChildProcess | null): Promise<void> {
    if (!process || process.exitCode !== null || process.signalCode !== null) return;
    const ended = new Promise((done) => process.once("exit", done));
    process.kill("SIGTERM");
    await ended;
}

export function launchBrowser(): Promise<Browser> {
    // WebGL on the CPU, because test machines have no GPU.
    const args = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"];
    return chromium.launch({ executablePath: process.env["MODALCAST_CHROMIUM"] ?? "/usr/bin/chromium", args });
}

/** A page, and the errors that it has reported. */
export interface ViewerPage {
    page: Page;
    errors: string[];
}

export async function openPage(browser: Browser, url: string, width = 480, height = 300): Promise<ViewerPage> {
    const page = await browser.newPage({ viewport: { width, height } });
    page.setDefaultTimeout(TIMEOUT_MS);
    const errors: string[] = [];
    page.on("pageerror", (error) => errors.push(String(error)));
    page.on("console", (message: ConsoleMessage) => {
        // The tests read pixels of a canvas, which the browser advises against.
        if (message.text().includes("willReadFrequently")) return;
        if (message.type() === "error" || message.type() === "warning") errors.push(message.text());
    });
    await page.goto(url);
    return { page, errors };
}

/** Waits until the page shows a scene. */
export async function waitForScene(page: Page): Promise<void> {
    await page.waitForFunction(() => Boolean(globalThis.modalcastViewer?.model));
}

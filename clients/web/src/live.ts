/** Shows scenes of a server, and connects again after the connection has broken. */

import type { App } from "./app";
import { Feature } from "./proto/modalcast/v1/server_pb";
import { contentBytes, parseArrays, type SceneArrays } from "./scene/arrays";
import type { SceneDescription } from "./scene/description";
import type { SceneModel } from "./scene/scene_model";
import type { SourceFeatures } from "./session";
import { ContentCache } from "./source/content_cache";
import { PROTOCOL_VERSION, Server } from "./source/server";
import * as format from "./ui/format";
import { Channel } from "./wire/channel";
import { RpcError, StatusCode } from "./wire/rpc_error";

/** Milliseconds until the next attempt to connect: doubled after each one, up to the limit. */
const FIRST_RETRY_MS = 250;
const LONGEST_RETRY_MS = 4000;
/** Milliseconds between pings, which measure the round trip, and between lists of the scenes while none is shown. */
const PING_MS = 2000;

/** An error that would occur again at the next attempt to connect. */
class FatalError extends Error {}

export class LiveViewer {
    private switchScene: () => void = () => {};
    private isConnected = false;
    private isStopped = false;
    /** The list of scenes that is offered, as JSON; empty while a scene is shown. */
    private offered = "";

    constructor(private readonly app: App) {
        window.addEventListener("hashchange", () => this.switchScene());
        app.bar.onScene = (value) => void this.select(value);
    }

    private server: Server | null = null;

    /** Ends the connection, for example because a recording is shown in its place. */
    stop(): void {
        this.isStopped = true;
        this.server?.channel.close();
    }

    /** Connects until the viewer is stopped. */
    async run(): Promise<void> {
        const cache = await ContentCache.open();
        const { app } = this;
        let retry = FIRST_RETRY_MS;
        while (!this.isStopped) {
            try {
                app.bar.setConnection("warn", "connecting");
                const channel = await Channel.open(webSocketUrl());
                retry = FIRST_RETRY_MS;
                await this.serve(new Server(channel, cache));
            } catch (error) {
                if (this.isStopped) return;
                if (error instanceof FatalError) {
                    app.bar.setConnection("bad", "stopped");
                    app.closeScene();
                    app.cover.showMessage("The viewer cannot go on", error.message);
                    return;
                }
                const reason = await this.explain(error);
                if (!app.model) app.cover.showMessage(reason.title, reason.text, reason.command);
                else
                    app.notices.show("connection", `${reason.title}. ${reason.text}`, { severity: "bad", duration: 0 });
            }
            this.server = null;
            this.offered = "";
            app.bar.setConnection("bad", this.isConnected ? "reconnecting" : "not connected");
            await new Promise((resolve) => setTimeout(resolve, retry));
            retry = Math.min(2 * retry, LONGEST_RETRY_MS);
        }
    }

    /** Shows scenes until the connection ends. */
    private async serve(server: Server): Promise<void> {
        const { app } = this;
        this.server = server;
        const info = await server.getInfo();
        if (info.protocolVersion !== PROTOCOL_VERSION) {
            throw new FatalError(
                `The server speaks version ${info.protocolVersion} of the protocol, and this page version ${PROTOCOL_VERSION}. Load the page again from the server.`,
            );
        }
        const features = {
            pictures: info.features.includes(Feature.FRAMES),
            forces: true,
            drive: true,
        };
        this.isConnected = true;
        app.notices.hide("connection");
        const ping = setInterval(() => void this.ping(server), PING_MS);
        try {
            let isOpen = true;
            server.channel.closed.then(() => {
                isOpen = false;
                this.switchScene();
            });
            while (isOpen) await this.showSelected(server, features);
        } finally {
            clearInterval(ping);
        }
        throw new RpcError(StatusCode.unavailable, "the connection has ended");
    }

    /** Shows the scene that the address names, until another one is selected or the connection ends. */
    private async showSelected(server: Server, features: SourceFeatures): Promise<void> {
        const { app } = this;
        const changed = new Promise<void>((resolve) => {
            this.switchScene = resolve;
        });
        const { scenes, sources } = await server.listScenes();
        const names = scenes.map((scene) => scene.scene);
        const wanted = new URLSearchParams(location.hash.slice(1)).get("scene") ?? "";
        const name = wanted || (names.length === 1 ? (names[0] ?? "") : "");
        app.bar.setScenes(
            names,
            sources.filter((source) => !names.includes(source)),
            name,
        );
        app.bar.setConnection("good", "connected");
        if (!names.includes(name)) {
            this.offerScenes(
                scenes.map((scene) => [scene.scene, scene.source]),
                sources,
                wanted,
            );
            // A restarted server opens its scenes one after the other, so list them again.
            await Promise.race([changed, new Promise((resolve) => setTimeout(resolve, PING_MS))]);
            return;
        }
        this.offered = "";
        try {
            await this.showScene(server, name, features, changed);
        } catch (error) {
            if (!(error instanceof RpcError) || error.code === StatusCode.unavailable) throw error;
            // For example because the scene was closed.
            app.closeScene();
            app.cover.showMessage("The scene has ended", error.message);
            await Promise.race([changed, new Promise((resolve) => setTimeout(resolve, PING_MS))]);
        }
    }

    private async showScene(
        server: Server,
        name: string,
        features: SourceFeatures,
        changed: Promise<void>,
    ): Promise<void> {
        const { app } = this;
        const isKnown = app.model?.scene.info.scene === name;
        if (!isKnown) app.cover.showProgress(`Loading ${name}`, 0, 0);
        const scene = await server.describe(name);
        const reason = app.drawingProblem(scene);
        if (reason && !features.pictures) throw new FatalError(`${reason} The server has no renderer.`);
        const arrays = reason ? null : await this.load(server, scene, isKnown);
        const hint = reason && `${reason} The server draws this scene.`;
        const model = app.showScene(scene, arrays, hint, { server, features });
        const states = server.streamStates(name);
        const forces = server.streamForces(name);
        try {
            await Promise.race([changed, this.readStates(states, model), this.readForces(forces, model)]);
        } finally {
            states.cancel();
            forces.cancel();
        }
    }

    private async load(server: Server, scene: SceneDescription, isKnown: boolean): Promise<SceneArrays> {
        const total = contentBytes(scene);
        let received = 0;
        const contents = await server.readContents(scene, (bytes) => {
            received += bytes;
            const text = `Loading ${scene.info.scene}, ${format.bytes(total)}`;
            if (!isKnown) this.app.cover.showProgress(text, received, total);
        });
        return parseArrays(scene, contents);
    }

    private async readStates(stream: ReturnType<Server["streamStates"]>, model: SceneModel): Promise<void> {
        for await (const response of stream) model.receiveState(response);
    }

    private async readForces(stream: ReturnType<Server["streamForces"]>, model: SceneModel): Promise<void> {
        for await (const response of stream) model.receiveForces(response);
    }

    private offerScenes(open: [string, string][], sources: string[], wanted: string): void {
        const { app } = this;
        const offer = JSON.stringify([open, sources, wanted]);
        if (offer === this.offered) return;
        this.offered = offer;
        app.closeScene();
        const title = open.length > 0 ? "Choose a scene" : "No scene is open";
        const problem = wanted ? `The server has no open scene "${wanted}". ` : "";
        const choices = [
            ...open.map(([name, source]) => ({
                label: name,
                detail: `open, from ${source}`,
                run: () => void this.select(`open:${name}`),
            })),
            ...sources.map((source) => ({
                label: source,
                detail: "open it",
                run: () => void this.select(`source:${source}`),
            })),
        ];
        app.cover.showChoices(title, `${problem}Open one of these, or send one with the Python package.`, choices);
    }

    /** Opens "source:SOURCE" or shows "open:NAME". */
    private async select(value: string): Promise<void> {
        const { app, server } = this;
        const [kind, ...rest] = value.split(":");
        let name = rest.join(":");
        if (kind === "source" && server) {
            app.closeScene();
            app.cover.showProgress(`Opening ${name}`, 0, 0);
            try {
                name = (await server.openScene(name)).scene;
            } catch (error) {
                app.notices.show(
                    "open",
                    `The scene could not be opened: ${error instanceof Error ? error.message : error}`,
                    { severity: "bad" },
                );
                this.switchScene();
                return;
            }
        }
        const parameters = new URLSearchParams(location.hash.slice(1));
        if (parameters.get("scene") === name) return this.switchScene();
        parameters.set("scene", name);
        location.hash = parameters.toString();
    }

    private async ping(server: Server): Promise<void> {
        const start = performance.now();
        try {
            await server.getInfo();
            this.app.status.latency = performance.now() - start;
        } catch {
            // The end of the connection is handled elsewhere.
        }
    }

    /** Why there is no connection, in words for the user. The browser hides the status of a failed WebSocket. */
    private async explain(error: unknown): Promise<{ title: string; text: string; command?: string }> {
        if (!(error instanceof RpcError)) {
            console.warn(error);
            return { title: "The viewer failed", text: error instanceof Error ? error.message : String(error) };
        }
        try {
            const response = await fetch(location.pathname + location.search, { cache: "no-store" });
            if (response.status === 401 || response.status === 403) {
                return {
                    title: "The address has no valid token",
                    text: "The server has started again and has a new token. Open the address that it printed.",
                    command: "modalcast serve  # prints the address of the viewer",
                };
            }
        } catch {
            // No server answers.
        }
        return {
            title: "The server does not answer",
            text: "The viewer connects by itself when the server is back.",
            command: "modalcast serve",
        };
    }
}

/** The WebSocket beside this page, with its token. */
function webSocketUrl(): string {
    const token = new URLSearchParams(location.search).get("token") ?? "";
    const protocol = location.protocol === "https:" ? "wss:" : "ws:";
    return `${protocol}//${location.host}/websocket?token=${encodeURIComponent(token)}`;
}

/** Shows scenes of a server, and connects again after the connection has broken. */

import type { App } from "./app";
import { inMillimeters, mayBeInMillimeters, uploadScene } from "./control/scene_upload";
import type { SceneInfo } from "./proto/modalcast/v1/scenes_pb";
import { Feature } from "./proto/modalcast/v1/server_pb";
import { contentBytes, parseArrays, type SceneArrays } from "./scene/arrays";
import type { SceneDescription } from "./scene/description";
import type { SceneModel } from "./scene/scene_model";
import type { SourceFeatures } from "./session";
import { ContentCache } from "./source/content_cache";
import { PROTOCOL_VERSION, Server, type UploadedFile } from "./source/server";
import * as format from "./ui/format";
import { Channel } from "./wire/channel";
import { RpcError, StatusCode } from "./wire/rpc_error";
import {
    type CodeResult,
    forgetSession,
    hasCode,
    redeemCode,
    sessionToken,
    UNKNOWN_SESSION_CODE,
    urlBesidePage,
} from "./wire/session";

/** Milliseconds until the next attempt to connect: doubled after each one, up to the limit. */
const FIRST_RETRY_MS = 250;
const LONGEST_RETRY_MS = 4000;
/** Milliseconds between pings, which measure the round trip, and between lists of the scenes while none is shown. */
const PING_MS = 2000;

/** What the user can do without a scene. */
const CHOICE = "Choose one of these, drop a model file onto this page, or send a scene with the Python package.";
/** Milliseconds for which the page says why it does not upload. */
const NOTICE_MS = 12_000;
/** Why dropped files are not uploaded. */
const NO_UPLOAD = {
    noServer:
        "This page has no server that could read a model. It plays recordings: files that end in .mcap. `modalcast view FILE` opens a model.",
    left: "The page has left its server to play a recording. Load the page again to open a model.",
    disconnected: "There is no connection to the server at present. Drop the files again when it is back.",
    busy: "Another upload is in progress. Drop the files again when it has ended.",
} as const;

/** An error that would occur again at the next attempt to connect. */
class FatalError extends Error {}

export class LiveViewer {
    private switchScene: () => void = () => {};
    private isConnected = false;
    private isStopped = false;
    private isUploading = false;
    /** What has become of the code in the last link. */
    private code: CodeResult = "none";
    /** The list of scenes that is offered, as JSON; empty while a scene is shown. */
    private offered = "";

    constructor(private readonly app: App) {
        window.addEventListener("hashchange", () => {
            if (hasCode()) this.useNewLink();
            else this.switchScene();
        });
        app.bar.onScene = (value) => void this.select(value);
    }

    private server: Server | null = null;
    /** Ends the wait for the next attempt to connect. */
    private connectNow: () => void = () => {};

    /** Connects again with the session of a link that was opened in this tab. */
    private useNewLink(): void {
        this.server?.channel.close();
        this.connectNow();
    }

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
                const code = await redeemCode();
                if (code !== "none") this.code = code;
                const channel = await Channel.open(webSocketUrl(), sessionToken());
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
                if (this.server?.channel.closeCode === UNKNOWN_SESSION_CODE) {
                    // The server has started again. Without a session it tells what it expects.
                    forgetSession();
                    this.server = null;
                    continue;
                }
                const reason = this.explain(error);
                if (!app.model) app.cover.showMessage(reason.title, reason.text, reason.command);
                else
                    app.notices.show("connection", `${reason.title}. ${reason.text}`, { severity: "bad", duration: 0 });
            }
            this.server = null;
            this.offered = "";
            app.bar.setConnection("bad", this.isConnected ? "reconnecting" : "not connected");
            await new Promise<void>((resolve) => {
                this.connectNow = resolve;
                setTimeout(resolve, retry);
            });
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
                detail: format.sceneOrigin(source),
                run: () => void this.select(`open:${name}`),
            })),
            ...sources.map((source) => ({
                label: source,
                detail: "Not open yet. The server can open it.",
                run: () => void this.select(`source:${source}`),
            })),
        ];
        app.cover.showChoices(title, `${problem}${CHOICE}`, choices);
    }

    /**
     * Uploads files that the user has dropped onto the page, and shows their scene.
     *
     * @param replaced Name of a scene that is deleted afterwards; empty: none.
     */
    async upload(files: readonly UploadedFile[], replaced = ""): Promise<void> {
        const { app, server } = this;
        const show = (text: string) => app.notices.show("upload", text, { severity: "warn", duration: NOTICE_MS });
        if (this.isStopped) return show(this.isConnected ? NO_UPLOAD.left : NO_UPLOAD.noServer);
        if (!server) return show(this.isConnected ? NO_UPLOAD.disconnected : NO_UPLOAD.noServer);
        if (this.isUploading) return show(NO_UPLOAD.busy);
        this.isUploading = true;
        app.notices.hide("upload");
        try {
            const names = files.length === 1 ? files[0]?.path : `${files.length} files`;
            const info = await uploadScene(server, files, (sent, total) => {
                // The server reads the files when it has all of them.
                if (sent === total) app.cover.showProgress(`Opening ${names}`, 0, 0);
                else app.cover.showProgress(`Uploading ${names}, ${format.bytes(total)}`, sent, total);
            });
            await this.select(`open:${info.scene}`);
            if (replaced) await server.deleteScene(replaced);
            this.offerMillimeters(files, info);
        } catch (error) {
            const text = error instanceof Error ? error.message : String(error);
            app.notices.show("upload", `The files could not be opened: ${text}`, { severity: "bad", duration: 0 });
            // Shows the previous scene or the choice of scenes again.
            if (app.model) app.cover.hide();
            this.offered = "";
            if (!app.model) this.switchScene();
        } finally {
            this.isUploading = false;
        }
    }

    private offerMillimeters(files: readonly UploadedFile[], info: SceneInfo): void {
        const millimeters = mayBeInMillimeters(info) ? inMillimeters(files) : null;
        if (!millimeters) return;
        const text = "The file has no unit, so its lengths were read in meters, which makes the model very large.";
        const run = () => void this.upload(millimeters, info.scene);
        const action = { label: "Read it in millimeters", run };
        this.app.notices.show("upload", text, { severity: "warn", duration: 0, action });
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

    /** Why there is no connection, in words for the user. */
    private explain(error: unknown): { title: string; text: string; command?: string } {
        if (!(error instanceof RpcError)) {
            console.warn(error);
            return { title: "The viewer failed", text: error instanceof Error ? error.message : String(error) };
        }
        if (error.code === StatusCode.unauthenticated) {
            const text =
                this.code === "rejected"
                    ? "The link was used before or has expired: each is valid once. Make another one on the server's machine."
                    : "The server has started again, or this address is no link. Make a link on the server's machine.";
            return { title: "This page needs a new link", text, command: "modalcast link" };
        }
        return {
            title: "The server does not answer",
            text: "The viewer connects by itself when the server is back.",
            command: "modalcast serve",
        };
    }
}

/** The WebSocket beside this page. */
function webSocketUrl(): string {
    const url = urlBesidePage("websocket");
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    return url.href;
}

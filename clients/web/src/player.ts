/** Plays recordings without a server: from the page itself, or from a file. */

import type { App } from "./app";
import { Playback } from "./source/playback";
import { decodeBase64, type Recording, readRecording } from "./source/recording";
import { Timeline } from "./ui/timeline";
import { redeemCode, sessionToken, urlBesidePage } from "./wire/session";

export class RecordingPlayer {
    private timeline: Timeline | null = null;
    private playback: Playback | null = null;

    constructor(private readonly app: App) {}

    /** Plays a file. */
    async openFile(name: string, file: Blob): Promise<void> {
        const bytes = new Uint8Array(await file.arrayBuffer());
        this.open(name, bytes);
    }

    /** Plays the recording that the page contains. False if it contains none. */
    openEmbedded(): boolean {
        const element = document.getElementById("recording");
        if (!element?.textContent) return false;
        const text = element.textContent;
        element.remove();
        const slow = Number(element.dataset["slow"]);
        this.open(document.title, () => decodeBase64(text), slow > 0 && Number.isFinite(slow) ? slow : null);
        return true;
    }

    /** Plays the recording of the server, if the page names one. False if it names none. */
    openServed(): boolean {
        const element = document.getElementById("recording");
        const path = element?.dataset["path"];
        if (!element || !path) return false;
        element.remove();
        const slow = Number(element.dataset["slow"]);
        void this.fetchRecording(path, slow > 0 && Number.isFinite(slow) ? slow : null);
        return true;
    }

    private async fetchRecording(path: string, slow: number | null): Promise<void> {
        const { cover } = this.app;
        try {
            await redeemCode();
            const headers = { authorization: `Bearer ${sessionToken() ?? ""}` };
            const response = await fetch(urlBesidePage(path), { headers, cache: "no-store" });
            if (response.status === 403) {
                const text = "A link is valid once. Start `modalcast view` again for another one.";
                cover.showMessage("This page needs a new link", text);
            } else if (!response.ok) throw new Error(`the server answers with status ${response.status}`);
            else this.open(document.title, new Uint8Array(await response.arrayBuffer()), slow);
        } catch (error) {
            const text = error instanceof Error ? error.message : String(error);
            cover.showMessage("The recording cannot be loaded", text);
        }
    }

    /** @param slow Initial slow motion factor; null: by the lowest frequency of the scene. */
    private open(name: string, file: Uint8Array | (() => Uint8Array), slow: number | null = null): void {
        const { app } = this;
        this.close();
        try {
            this.play(name, readRecording(typeof file === "function" ? file() : file), slow);
        } catch (error) {
            app.closeScene();
            const text = error instanceof Error ? error.message : String(error);
            app.cover.showMessage("The recording cannot be played", `${name}: ${text}`);
        }
    }

    private play(name: string, recording: Recording, slow: number | null): void {
        const { app } = this;
        const { scene, arrays, view, isCutOff } = recording;
        const reason = app.drawingProblem(scene);
        if (reason) throw new Error(reason);
        app.bar.setScenes([], [], "");
        app.bar.setConnection("idle", `recording of ${scene.info.scene}`);
        const features = { pictures: false, forces: false, drive: false };
        const model = app.showScene(scene, arrays, "", { server: null, features });
        document.title = `${scene.info.scene} - modalcast`;
        if (isCutOff) {
            const text = `${name} was cut off. \`modalcast recover\` repairs it; the steps before the end can be played.`;
            app.notices.show("recording", text, { severity: "warn" });
        }
        const playback = new Playback(recording, model);
        if (slow !== null) playback.speed = 1 / slow;
        this.playback = playback;
        this.timeline = new Timeline(playback);
        app.setPlayback(playback);
        // After the time line was added, because it covers a part of the image.
        if (view) app.viewport.camera.frameAs(view);
        else app.viewport.camera.frame();
        playback.seek(0);
        playback.play();
    }

    private close(): void {
        this.playback?.pause();
        this.playback = null;
        this.timeline?.remove();
        this.timeline = null;
        this.app.setPlayback(null);
    }
}

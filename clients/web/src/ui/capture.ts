/** Saves the view as a picture or a video, without panels. */

import { VideoRecorder } from "../control/video_recorder";
import type { Viewport } from "../render/viewport";
import { byId, h } from "./dom";
import * as format from "./format";
import type { Legend } from "./legend";
import type { Notices } from "./notices";

const TOPIC = "capture";
/** Milliseconds until the object URL of a saved file is revoked. */
const LINK_MS = 60_000;

export class Capture {
    private recorder: VideoRecorder | null = null;
    /** Called when a video begins or ends. */
    onRecording: (isRecording: boolean) => void = () => {};

    constructor(
        private readonly viewport: Viewport,
        private readonly legend: Legend,
        private readonly notices: Notices,
    ) {}

    /** Saves the view and its legend as a PNG. */
    async savePicture(name: string): Promise<void> {
        const source = shownCanvas();
        const picture = h("canvas", { width: source.width, height: source.height });
        const context = picture.getContext("2d");
        // The pixels of a canvas with WebGL can be read only in the task that draws it.
        this.viewport.draw();
        context?.drawImage(source, 0, 0);
        if (context) this.legend.paint(context, source.width / Math.max(1, source.clientWidth));
        const file = await new Promise<Blob | null>((resolve) => picture.toBlob(resolve, "image/png"));
        if (!file) return this.notices.show(TOPIC, "The browser could not save the picture.", { severity: "bad" });
        saveFile(file, `${name}.png`);
        this.notices.show(TOPIC, `Saved ${name}.png, ${picture.width} x ${picture.height} pixels.`);
    }

    /** Starts a video or, if one is being recorded, ends and saves it. */
    async toggleVideo(name: string): Promise<void> {
        if (this.recorder) return this.saveVideo(name);
        try {
            this.recorder = new VideoRecorder(shownCanvas());
        } catch (error) {
            const text = error instanceof Error ? error.message : String(error);
            return this.notices.show(TOPIC, text, { severity: "warn" });
        }
        this.recorder.onError = (message) => {
            this.notices.show(TOPIC, `The video ended: ${message}`, { severity: "bad" });
            void this.saveVideo(name);
        };
        this.setRecording(true);
        this.notices.show(TOPIC, "Recording a video of the view. Press the button again to save it.");
    }

    /** Ends the video if the recorded canvas does not show the view any more. */
    followView(name: string): void {
        if (this.recorder && this.recorder.canvas !== shownCanvas()) void this.saveVideo(name);
    }

    private async saveVideo(name: string): Promise<void> {
        const { recorder } = this;
        if (!recorder) return;
        this.recorder = null;
        this.setRecording(false);
        const file = await recorder.stop();
        if (file.size === 0) return this.notices.show(TOPIC, "The video has no frames.", { severity: "warn" });
        const fileName = `${name}.${recorder.extension}`;
        saveFile(file, fileName);
        this.notices.show(TOPIC, `Saved ${fileName}, ${format.bytes(file.size)}.`);
    }

    private setRecording(isRecording: boolean): void {
        // Only drawn frames are recorded, so a scene at rest is drawn continuously.
        this.viewport.drawsAlways = isRecording;
        this.onRecording(isRecording);
    }
}

/** The visible canvas, which has the browser's drawing or the server's pictures. */
function shownCanvas(): HTMLCanvasElement {
    const picture = byId<HTMLCanvasElement>("picture");
    return picture.hidden ? byId<HTMLCanvasElement>("surface") : picture;
}

function saveFile(file: Blob, name: string): void {
    const link = h("a", { href: URL.createObjectURL(file), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), LINK_MS);
}

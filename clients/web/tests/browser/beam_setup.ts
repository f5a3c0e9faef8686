/** What the tests of a page with the recording of a beam share: a file, a browser, and pages. */

import { writeFileSync } from "node:fs";
import { join } from "node:path";
import { after, before } from "node:test";
import { pathToFileURL } from "node:url";
import type { Browser } from "playwright-core";
import { beamRecording } from "./beam_recording";
import { committedPage, launchBrowser, openPage, temporaryFolder, type ViewerPage, waitForScene } from "./harness";

export class BeamSetup {
    private readonly file = join(temporaryFolder(), "beam.html");
    private browser: Browser | null = null;

    /** Registers the start of the browser before the tests of a file, and its end after them. */
    constructor() {
        before(async () => {
            const base64 = Buffer.from(await beamRecording()).toString("base64");
            const element = `<script id="recording" type="application/octet-stream">${base64}</script>`;
            writeFileSync(
                this.file,
                committedPage().replace("<!--RECORDING-->", () => element),
            );
            this.browser = await launchBrowser();
        });
        after(async () => this.browser?.close());
    }

    /** A page that shows the paused recording. */
    async open(width: number, height: number): Promise<ViewerPage> {
        if (!this.browser) throw new Error("expected a browser");
        const opened = await openPage(this.browser, pathToFileURL(this.file).href, width, height);
        await waitForScene(opened.page);
        await opened.page.getByRole("button", { name: "Pause" }).click();
        return opened;
    }
}

/** What the tests of a file share: a server that has opened the built-in tree, and a browser. */

import { after, before } from "node:test";
import type { Browser } from "playwright-core";
import { launchBrowser, openPage, ServerProcess, type ViewerPage, waitForScene } from "./harness";

/** Create it once per file: the server and the browser start before the first test of the file, and end after the last one. */
export class TreeSetup {
    readonly server = new ServerProcess();
    private browser: Browser | null = null;

    constructor() {
        before(async () => {
            await this.server.start();
            await (await this.server.client()).openScene("tree");
            this.browser = await launchBrowser();
        });
        after(async () => {
            await this.browser?.close();
            await this.server.stop();
        });
    }

    /** A new page that shows the tree. */
    async openTree(width: number, height: number): Promise<ViewerPage> {
        if (!this.browser) throw new Error("expected a browser: pages exist within tests only");
        const viewerPage = await openPage(this.browser, this.server.pageUrl("tree"), width, height);
        await waitForScene(viewerPage.page);
        return viewerPage;
    }
}

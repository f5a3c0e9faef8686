/** Entry point of the page. */

import { App } from "./app";
import { LiveViewer } from "./live";
import { RecordingPlayer } from "./player";
import { listenToDrops } from "./ui/file_drop";

declare global {
    /** The running viewer, for tests and for the browser's console. */
    var modalcastViewer: App;
}

function start(): void {
    const app = new App();
    globalThis.modalcastViewer = app;
    const live = new LiveViewer(app);
    const player = new RecordingPlayer(app);
    listenToDrops((files) => {
        const [first] = files;
        if (first && files.length === 1 && first.path.toLowerCase().endsWith(".mcap")) {
            live.stop();
            void player.openFile(first.path, first.file);
        } else void live.upload(files);
    });
    if (player.openEmbedded() || player.openServed()) return;
    if (location.protocol === "file:")
        app.cover.showMessage("No recording", "Drop a recording, a file that ends in .mcap, onto this page.");
    else void live.run();
}

// A recording may follow the script in the page.
if (document.readyState === "loading") document.addEventListener("DOMContentLoaded", start);
else start();
